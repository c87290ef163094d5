"""Light of layers: between levels and light, and its means over blocks that say something."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.blocks import Blocks, block_light, common, inside

from orthoflow.geometry.levels import lit, lit_shares
from orthoflow.products import Layer, LayerMask
from tests import samples

SHAPE = (40, 60)
BLOCKS = Blocks.over(SHAPE, 10)


def light_of(levels: NDArray[np.generic], highest: int) -> NDArray[np.float64]:
    """As IEC 61966-2-1 has it, cell by cell."""
    share = np.asarray(levels, dtype=np.float64) / highest
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def layer(rgb: NDArray[np.generic], mask: NDArray[np.uint8] | None = None) -> Layer:
    return samples.layer(SHAPE if mask is None else mask, rgb=rgb)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("gain", [0.25, 1.0, 1.7])
def test_light_is_multiplied_and_clipped(dtype: type[np.unsignedinteger], gain: float) -> None:
    highest = int(np.iinfo(dtype).max)
    colours = np.random.default_rng(1).integers(0, highest + 1, (500, 3)).astype(dtype)
    colours[:2] = [[0, 0, 0], [highest] * 3]
    logs = np.full((500, 3), np.log(gain), np.float32)
    found = lit(colours, logs)
    assert found.dtype == dtype
    light = np.clip(gain * light_of(colours, highest), 0.0, 1.0)
    level = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    # Rounded to whole levels, of 16 bits to about one.
    limit = 0.51 if dtype is np.uint8 else 1.5
    assert np.abs(found - highest * level).max() <= limit
    shares = lit_shares(colours / highest, logs)
    np.testing.assert_allclose(shares, level, atol=2e-5)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_blocks_have_the_mean_light_of_what_a_layer_paints_wholly(
    dtype: type[np.unsignedinteger],
) -> None:
    highest = int(np.iinfo(dtype).max)
    rng = np.random.default_rng(2)
    rgb = rng.integers(highest // 4, highest // 2, (*SHAPE, 3)).astype(dtype)
    mask = np.full(SHAPE, LayerMask.PAINTED, np.uint8)
    # Nothing in the outermost blocks, and a cell is missing in one within.
    mask[:10] = mask[:, 50:] = LayerMask.OCCLUDED
    mask[25, 15] = LayerMask.NO_SURFACE
    found = block_light(layer(rgb, mask), BLOCKS)
    assert found.box == (slice(1, 4), slice(0, 5))
    for row, column in np.ndindex(3, 5):
        part = np.s_[10 * row + 10 : 10 * row + 20, 10 * column : 10 * column + 10]
        is_missing = (row, column) == (1, 1)
        assert found.is_known[row, column] == (not is_missing)
        if is_missing:
            assert np.isnan(found.log_light[row, column]).all()
        else:
            wanted = np.log(light_of(rgb[part], highest).mean(axis=(0, 1)))
            np.testing.assert_allclose(found.log_light[row, column], wanted, atol=1e-5)


@pytest.mark.parametrize(("level", "is_said"), [(9, False), (10, True), (245, True), (246, False)])
@pytest.mark.parametrize("channel", [0, 2])
@pytest.mark.parametrize("scale", [1, 257])
def test_black_and_white_say_nothing(
    level: int, channel: int, scale: int, *, is_said: bool
) -> None:
    rgb = np.full((*SHAPE, 3), 100, np.uint16 if scale > 1 else np.uint8) * scale
    # One channel is enough.
    rgb[..., channel] = level * scale
    found = block_light(layer(rgb), BLOCKS)
    assert found.is_known.all() == is_said
    assert found.is_known.any() == is_said


@pytest.mark.parametrize(("n_white", "is_said"), [(5, True), (6, False)])
def test_a_twentieth_of_a_block_may_be_white(n_white: int, *, is_said: bool) -> None:
    rgb = np.full((*SHAPE, 3), 100, np.uint8)
    # Of the hundred cells of the first block.
    rgb[0, :n_white] = 255
    found = block_light(layer(rgb), BLOCKS)
    assert found.is_known[0, 0] == is_said
    assert found.is_known.sum() == 24 - (not is_said)


# --- boxes ---


def box(*sides: int) -> tuple[slice, slice]:
    return slice(sides[0], sides[1]), slice(sides[2], sides[3])


def test_boxes_share_what_lies_in_both() -> None:
    assert common(box(0, 5, 2, 9), box(3, 8, 0, 4)) == box(3, 5, 2, 4)
    assert common(box(0, 5, 2, 9), box(1, 2, 3, 4)) == box(1, 2, 3, 4)
    # Beside each other, or in a corner, they share nothing.
    assert common(box(0, 5, 2, 9), box(5, 8, 2, 9)) is None
    assert common(box(0, 5, 2, 9), box(0, 5, 9, 12)) is None
    assert inside(box(3, 5, 4, 6), box(1, 9, 4, 9)) == box(2, 4, 0, 2)
