"""A part of a large wall is compared: spread evenly, whole blocks, nothing where nothing shows."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.inspect.cell_errors import BLOCK_CELLS, sampling, sampling_rule

from orthoflow.geometry import frame_over
from orthoflow.products import Orthoimage, OrthoMask


def image(mask: np.ndarray) -> Orthoimage:
    rows, columns = mask.shape
    corners = np.array([[0, 0, rows], [0, 0, 0], [columns, 0, 0], [columns, 0, rows]]) * 0.01
    return Orthoimage(
        frame=frame_over(corners, np.array([0.0, -1.0, 0.0]), gsd_m=0.01),
        wall=0,
        name="wall",
        rgb=np.zeros((rows, columns, 3), dtype=np.uint8),
        mask=mask.astype(np.uint8),
        source=np.zeros(mask.shape, dtype=np.int16),
        sources=("photo",),
    )


def test_a_small_wall_is_compared_whole() -> None:
    wall = image(np.full((130, 250), OrthoMask.PAINTED))
    rule = sampling_rule([wall], colour_cells_most=32_500, seen_cells_most=32_500)
    chosen = sampling(wall, rule)
    assert chosen.coloured.all()
    assert chosen.lattice.all()


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
def test_a_large_wall_is_compared_evenly(share: float) -> None:
    side = 40 * BLOCK_CELLS
    walls = [image(np.full((side, side), OrthoMask.PAINTED))] * 2
    most = round(2 * share * side**2)
    rule = sampling_rule(walls, colour_cells_most=most, seen_cells_most=most)
    chosen = sampling(walls[0], rule)
    blocks = chosen.coloured.reshape(40, BLOCK_CELLS, 40, BLOCK_CELLS)
    np.testing.assert_array_equal(blocks.any(axis=(1, 3)), blocks.all(axis=(1, 3)))
    # Every tenth of the wall has its share of blocks, but for a few of them.
    tenths = blocks[:, 0, :, 0].reshape(4, 10, 10, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(tenths, share, atol=0.08)
    assert chosen.coloured.mean() == pytest.approx(share, rel=0.05)
    rows, columns = np.nonzero(chosen.lattice)
    steps = {int(step) for axis in (rows, columns) for step in np.diff(np.unique(axis))}
    assert steps == {rule.lattice_step}
    assert share / 3 < chosen.lattice.mean() <= share


def test_what_shows_nothing_has_no_colours_to_compare() -> None:
    mask = np.full((3 * BLOCK_CELLS, 3 * BLOCK_CELLS), OrthoMask.NONE)
    mask[5, 5], mask[BLOCK_CELLS + 5, 2 * BLOCK_CELLS + 5] = OrthoMask.PAINTED, OrthoMask.FILLED
    wall = image(mask)
    rule = sampling_rule([wall], colour_cells_most=1_000_000, seen_cells_most=1_000_000)
    coloured = sampling(wall, rule).coloured[::BLOCK_CELLS, ::BLOCK_CELLS]
    np.testing.assert_array_equal(coloured, [[1, 0, 0], [0, 0, 1], [0, 0, 0]])
