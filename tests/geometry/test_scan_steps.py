"""How far apart points lie is read from how many fall into each cell."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry.cloud_quality import scan_step_m

GSD_M = 0.01


@pytest.mark.parametrize("step_cells", [0.4, 1.0, 2.0, 5.0])
def test_the_scan_step_is_read_from_the_counts(step_cells: float) -> None:
    positions = np.arange(0.0, 400.0, step_cells) + 0.1
    count, _, _ = np.histogram2d(
        np.repeat(positions, positions.size),
        np.tile(positions, positions.size),
        bins=400,
        range=[[0, 400], [0, 400]],
    )
    # 6 %: blocks at the rim are partly empty.
    assert scan_step_m(count.astype(np.uint32), gsd_m=0.01) == pytest.approx(
        0.01 * step_cells, rel=0.06
    )


def every(step: int, shape: tuple[int, int] = (96, 128)) -> NDArray[np.uint32]:
    """One point in each block of step x step cells."""
    count = np.zeros(shape, dtype=np.uint32)
    count[step // 2 :: step, step // 2 :: step] = 1
    return count


@pytest.mark.parametrize("step", [1, 2, 4, 8])
def test_points_every_few_cells_lie_so_many_apart(step: int) -> None:
    assert scan_step_m(every(step), gsd_m=GSD_M) == pytest.approx(step * GSD_M)
    # So they do where they cover a corner of the wall alone, and on cells of other sizes.
    part = every(step)
    part[64:] = part[:, 64:] = 0
    assert scan_step_m(part, gsd_m=0.25) == pytest.approx(step * 0.25)


@pytest.mark.parametrize("per_cell", [1, 4, 9, 100])
def test_many_points_per_cell_lie_closer_than_cells(per_cell: int) -> None:
    count = np.full((30, 40), per_cell, dtype=np.uint32)
    assert scan_step_m(count, gsd_m=GSD_M) == pytest.approx(GSD_M / np.sqrt(per_cell))


def test_points_at_random_are_as_far_apart_as_they_are_many() -> None:
    rng = np.random.default_rng(3)
    for mean in (0.05, 0.3, 1.0, 6.0):
        count = rng.poisson(mean, (200, 240)).astype(np.uint32)
        assert scan_step_m(count, gsd_m=GSD_M) == pytest.approx(GSD_M / np.sqrt(mean), rel=0.05)


def test_a_wall_without_points_has_no_step_and_one_point_has_the_wall() -> None:
    assert scan_step_m(np.zeros((7, 9), dtype=np.uint32), gsd_m=GSD_M) == 0.0
    one = np.zeros((7, 9), dtype=np.uint32)
    one[3, 8] = 1
    # Four doublings make one block of nine columns.
    assert scan_step_m(one, gsd_m=GSD_M) == pytest.approx(16 * GSD_M)
