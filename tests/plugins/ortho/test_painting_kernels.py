"""How a tile's colours are sampled, and how it is handed over, against plain formulations."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.painting_kernels import (
    Canvas,
    Patch,
    hand_over,
    pack_pixels,
    sample_bilinear,
    sample_deep,
)
from orthoflow_plugins.ortho.views import OCCLUDED, PAINTED, TileVisibility

SHAPE = (70, 90)
TILE = (slice(11, 50), slice(7, 80))
INNER = (3, 5)


def mixed(
    photo: NDArray[np.unsignedinteger], u: NDArray[np.float32], v: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Colours (..., 3) between four pixels, u and v counted from the first pixel's centre."""
    last = np.array(photo.shape[1::-1]) - 1
    across, down = np.clip(u.astype(np.float64), 0, last[0]), np.clip(v.astype(float), 0, last[1])
    left, upper = np.floor(across).astype(int), np.floor(down).astype(int)
    right, lower = np.minimum(left + 1, last[0]), np.minimum(upper + 1, last[1])
    a, d = (across - left)[..., None], (down - upper)[..., None]
    above = photo[upper, left] * (1 - a) + photo[upper, right] * a
    below = photo[lower, left] * (1 - a) + photo[lower, right] * a
    return np.asarray(above * (1 - d) + below * d)


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("size", [(40, 60), (1, 7), (6, 1), (1, 1)], ids=str)
def test_a_patch_of_places_is_sampled_about_any_corner(depth: int, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(6)
    photo = rng.integers(0, 2**depth, (*size, 3), dtype=np.uint8 if depth == 8 else np.uint16)
    # Places in a photo of which this is a part; a patch of them, in a larger tile.
    u = rng.uniform(95.0, 105.0 + size[1], (12, 17)).astype(np.float32)
    v = rng.uniform(195.0, 205.0 + size[0], (12, 17)).astype(np.float32)
    corner = (np.float32(100.25), np.float32(199.5))
    patch = Patch(row=2, column=5, n_rows=8, n_columns=9)
    part = (slice(2, 10), slice(5, 14))
    expected = mixed(photo, u[part] - corner[0], v[part] - corner[1])
    if depth == 16:
        deep = np.empty((8, 9, 3), dtype=np.uint16)
        sample_deep(photo, (u, v), corner, patch, deep)
        np.testing.assert_allclose(deep, expected, atol=0.51 + 65535 * 1e-6)
        return
    packed = np.empty((size[0] + 1, size[1] + 1), dtype=np.uint64)
    pack_pixels(photo, packed)
    colours = np.empty((8, 9, 3), dtype=np.uint8)
    sample_bilinear(packed, (u, v), corner, patch, colours)
    # Places count in 64ths of a pixel.
    np.testing.assert_allclose(colours, expected, atol=0.51 + 2 * 255 / 128)
    assert np.abs(colours - expected).mean() < 1.0


def test_packed_pixels_repeat_the_last_row_and_column() -> None:
    photo = np.random.default_rng(1).integers(0, 256, (3, 4, 3), dtype=np.uint8)
    packed = np.zeros((4, 5), dtype=np.uint64)
    pack_pixels(photo, packed)
    edged = np.pad(photo, ((0, 1), (0, 1), (0, 0)), mode="edge").astype(np.uint64)
    np.testing.assert_array_equal(packed & np.uint64(0xFF), edged[..., 0])
    np.testing.assert_array_equal((packed >> np.uint64(21)) & np.uint64(0xFF), edged[..., 1])
    np.testing.assert_array_equal(packed >> np.uint64(42), edged[..., 2])


@pytest.mark.parametrize("deep", [False, True], ids=["8 bit", "16 bit"])
@pytest.mark.parametrize("has_near", [False, True], ids=["", "beside hidden patches"])
def test_a_tile_is_handed_over_and_what_is_not_painted_is_bare(deep: bool, has_near: bool) -> None:
    rng = np.random.default_rng(3)
    n_rows, n_columns = 39, 73
    around = (n_rows + 8, n_columns + 9)
    visible = TileVisibility(
        u=np.zeros(around, dtype=np.float32),
        v=np.zeros(around, dtype=np.float32),
        mask=rng.choice(np.arange(4), around, p=[0.1, 0.7, 0.1, 0.1]).astype(np.uint8),
        quality=rng.uniform(0.01, 9.0, around).astype(np.float32),
        summary=np.zeros(8),
    )
    # Whole runs of 32 cells that are painted, and one that is not at all.
    visible.mask[10:20] = PAINTED
    visible.mask[21] = OCCLUDED
    near = (rng.random(around) < 0.2).astype(np.uint8) if has_near else np.empty((0, 0), np.uint8)
    mask = np.full(SHAPE, 77, dtype=np.uint8)
    quality = np.full(SHAPE, 5.0, dtype=np.float32)
    rgb = rng.integers(1, 200, (*SHAPE, 3), dtype=np.uint16 if deep else np.uint8)
    before = rgb.copy()
    hand_over(visible, near, INNER, Canvas(mask, quality, rgb), TILE)
    inner = (slice(3, 3 + n_rows), slice(5, 5 + n_columns))
    expected = visible.mask[inner].copy()
    if has_near:
        expected[(near[inner] > 0) & (expected == PAINTED)] = OCCLUDED
    np.testing.assert_array_equal(mask[TILE], expected)
    painted = expected == PAINTED
    assert not quality[TILE][~painted].any()
    # Cut off to 20 bits: a part in two thousand at most, and never more than it was.
    kept, given = quality[TILE][painted], visible.quality[inner][painted]
    assert (kept <= given).all()
    np.testing.assert_allclose(kept, given, rtol=2.0**-11)
    assert not (kept.view(np.uint32) & np.uint32(0xFFF)).any()
    np.testing.assert_array_equal(rgb[TILE][painted], before[TILE][painted])
    assert not rgb[TILE][~painted].any()
    outside = np.ones(SHAPE, dtype=np.bool_)
    outside[TILE] = False
    assert (mask[outside] == 77).all()
    assert (quality[outside] == 5.0).all()
    np.testing.assert_array_equal(rgb[outside], before[outside])
