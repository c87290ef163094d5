"""Rays through, before and onto a wall, followed one by one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.segment import areas as module
from orthoflow_plugins.segment.areas import sight_lines

from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud
from tests import samples

GSD_M = 0.01
# The wall is seen along +y, its top-left corner at (10, 20, 30): depth is 20 - y.
CORNER = np.array([10.0, 20.0, 30.0])
FRONT_M, BEHIND_M = 0.15, 0.4
# Cells of a tile of 5 cm.
SIDE = 5


def slab(rows: int = 43, columns: int = 61, gsd_m: float = GSD_M) -> Slab:
    frame = samples.facing_south(gsd_m, columns, rows, tuple(CORNER))
    return Slab(frame=frame, front_m=FRONT_M, behind_m=BEHIND_M)


def cloud(
    ends: NDArray[np.float64],
    stations: NDArray[np.float64] | None = None,
    scan: NDArray[np.integer] | None = None,
    source: str = "file",
) -> PointCloud:
    """Points given as metres (n, 3) right, down and before the wall."""
    x, y, z = (
        np.ascontiguousarray(axis, dtype=np.float32) for axis in world(ends).T - CORNER[:, None]
    )
    return PointCloud(
        origin=CORNER.copy(),
        x=x,
        y=y,
        z=z,
        up=np.array([0.0, 0.0, 1.0]),
        stations=None if stations is None else world(stations),
        stations_source=None if stations is None else source,  # type: ignore[arg-type]
        scan=None if scan is None else scan.astype(np.uint16),
    )


def world(places: NDArray[np.float64]) -> NDArray[np.float64]:
    right, down, before = places.T
    return CORNER + np.column_stack([right, -before, -down])


def followed(
    ends: NDArray[np.float64],
    stations: NDArray[np.float64] | None,
    scan: NDArray[np.integer],
    shape: tuple[int, int],
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Crossed and stopped tiles, one ray after the other."""
    counts = np.zeros((3, *shape), dtype=int)
    for end, of_scan in zip(ends, scan, strict=True):
        place = end[:2]
        if stations is None:
            if not -4.0 < end[2] < 1.5:
                continue
        else:
            if of_scan >= len(stations):
                continue
            start = stations[of_scan]
            if start[2] <= 0.0 or start[2] <= end[2]:
                continue
            place = start[:2] + start[2] / (start[2] - end[2]) * (end[:2] - start[:2])
        column, row = (int(np.floor(value / (SIDE * GSD_M))) for value in place)
        if 0 <= row < shape[0] and 0 <= column < shape[1]:
            what = 0 if end[2] < -BEHIND_M else 1 if end[2] > FRONT_M else 2
            counts[what, row, column] += 1
    crossed, stopped, met = counts
    is_crossed = (crossed >= 2) & (crossed / np.maximum(crossed + met, 1) >= 0.2)
    is_stopped = (stopped >= 2) & (stopped / np.maximum(stopped + met, 1) >= 0.2)
    return is_crossed, is_stopped & ~is_crossed


def some_ends(count: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(4)
    depths = rng.choice([0.0, 0.0, 0.3, 1.0, 1.4, 1.6, -0.2, -0.6, -3.9, -4.2, 2.5], count)
    places = rng.uniform([-0.1, -0.1], [0.72, 0.53], (count, 2))
    return np.column_stack([places, depths + 0.05 * rng.uniform(-1.0, 1.0, count)])


# The last one stands behind the wall, as does what the scan before it saw of it.
STATIONS = np.array([[0.3, 0.2, 2.0], [-1.0, 0.5, 1.2], [0.2, 0.2, -1.0]])


@pytest.mark.parametrize("is_known", [True, False], ids=["stations", "squarely"])
def test_tiles_are_what_each_ray_says(is_known: bool) -> None:
    ends = some_ends(1500)
    # A fourth scan has no station.
    scan = np.random.default_rng(5).integers(0, 4, len(ends))
    stations = STATIONS if is_known else None
    found = sight_lines(cloud(ends, stations, scan), slab())
    crossed, stopped = followed(ends, stations, scan, (9, 13))
    assert found.side == SIDE
    np.testing.assert_array_equal(found.crossed, crossed)
    np.testing.assert_array_equal(found.stopped, stopped)
    assert 10 < np.count_nonzero(crossed) < 110
    assert np.count_nonzero(stopped) > 3


def test_stations_that_are_no_fact_of_the_file_are_not_asked() -> None:
    ends = some_ends(1500)
    scan = np.zeros(len(ends), dtype=int)
    squarely = sight_lines(cloud(ends), slab())
    for given in (cloud(ends, STATIONS, scan, source="params"), cloud(ends, STATIONS)):
        found = sight_lines(given, slab())
        np.testing.assert_array_equal(found.crossed, squarely.crossed)
        np.testing.assert_array_equal(found.stopped, squarely.stopped)


def test_large_clouds_are_followed_part_by_part(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = some_ends(1500)
    scan = np.random.default_rng(5).integers(0, 4, len(ends))
    given = cloud(ends, STATIONS, scan)
    whole = sight_lines(given, slab())
    monkeypatch.setattr(module, "_BLOCK", 64)
    parts = sight_lines(given, slab())
    np.testing.assert_array_equal(parts.crossed, whole.crossed)
    np.testing.assert_array_equal(parts.stopped, whole.stopped)


@pytest.mark.parametrize(
    ("n_other", "n_met", "is_told"),
    [(1, 0, False), (2, 0, True), (2, 8, True), (2, 9, False), (3, 12, True)],
)
@pytest.mark.parametrize("depth_m", [-0.5, 0.5], ids=["crossed", "stopped"])
def test_so_many_rays_must_agree(depth_m: float, n_other: int, n_met: int, is_told: bool) -> None:
    depths = np.array([depth_m] * n_other + [0.0] * n_met)
    ends = np.column_stack([np.full((len(depths), 2), 0.12), depths])
    found = sight_lines(cloud(ends), slab())
    told = found.crossed if depth_m < 0.0 else found.stopped
    assert bool(told[2, 2]) == is_told
    assert np.count_nonzero(found.crossed | found.stopped) == is_told
