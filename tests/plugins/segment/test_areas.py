"""Open areas of a relief defined cell by cell, and rays traced one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.segment import areas
from orthoflow_plugins.segment.areas import (
    Area,
    Relief,
    SightLines,
    open_areas,
    relief_of,
    sight_lines,
)

from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud, Wall
from tests import samples
from tests.raster_scenes import cloud_of

GSD_M = 0.02
SHAPE = (60, 80)
BEHIND_M, WIDTH_LEAST_M, AREA_LEAST_M2 = 0.05, 0.2, 0.05


def wall(depth_m: NDArray[np.float32]) -> Wall:
    rows, columns = depth_m.shape
    return samples.wall(samples.facing_south(GSD_M, columns, rows), depth_m=depth_m)


def flat(depth_m: float = 0.0) -> NDArray[np.float32]:
    return np.full(SHAPE, depth_m, dtype=np.float32)


def relief(is_open: NDArray[np.bool_], **changes: object) -> Relief:
    """Return a relief whose open cells are 0.1 m behind a face at 0."""
    nothing = np.zeros(is_open.shape, dtype=np.bool_)
    made = Relief(
        gsd_m=GSD_M,
        step=1,
        is_face=~is_open,
        is_open=is_open,
        is_empty=nothing,
        is_crossed=nothing,
        depth_m=np.where(is_open, np.float32(-0.1), np.float32(0.0)),
        face_m=0.0,
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def block(top: int, bottom: int, left: int, right: int) -> NDArray[np.bool_]:
    cells = np.zeros(SHAPE, dtype=np.bool_)
    cells[top:bottom, left:right] = True
    return cells


def whole(area: Area) -> NDArray[np.bool_]:
    """Return the cells of an area in the raster."""
    cells = np.zeros((SHAPE[0] + 2, SHAPE[1] + 2), dtype=np.bool_)
    top, left = area.corner[0] + 1, area.corner[1] + 1
    cells[top : top + area.cells.shape[0], left : left + area.cells.shape[1]] = area.cells
    return cells[1:-1, 1:-1]


@pytest.mark.parametrize(
    ("behind_m", "is_behind"), [(0.049, False), (0.051, True), (0.3, True), (-0.2, False)]
)
def test_cells_farther_behind_the_face_than_asked_are_open(
    behind_m: float, is_behind: bool
) -> None:
    depth = flat()
    depth[10:30, 20:50] = -behind_m
    found = relief_of(wall(depth), None, BEHIND_M)
    expected = block(10, 30, 20, 50) if is_behind else block(0, 0, 0, 0)
    # The median of 5 x 5 cells rounds the corners by three cells each.
    assert np.count_nonzero(found.is_open ^ expected) == (12 if is_behind else 0)
    np.testing.assert_array_equal(found.is_face, ~expected)
    assert found.face_m == 0.0
    assert (found.gsd_m, found.step) == (GSD_M, 1)
    assert not found.is_empty.any()


def test_single_cells_decide_nothing_and_holes_of_three_by_five_do() -> None:
    depth = flat()
    depth[10, 10] = depth[20, 20:24] = np.nan
    depth[30:33, 30:35] = -1.0
    found = relief_of(wall(depth), None, BEHIND_M)
    assert found.is_open[31, 32]
    found.is_open[28:36, 28:38] = False
    assert not found.is_open.any()
    assert found.is_empty.sum() == 5


@pytest.mark.parametrize(("n_deep_rows", "face_m"), [(30, 0.0), (31, -0.2)])
def test_the_face_is_what_more_than_half_of_the_wall_is_on(n_deep_rows: int, face_m: float) -> None:
    depth = flat()
    depth[:n_deep_rows] = -0.2
    found = relief_of(wall(depth), None, BEHIND_M)
    assert found.face_m == pytest.approx(face_m, abs=1e-6)
    # Cells behind the face are open.
    assert found.is_open[5, 40] == (face_m == 0.0)
    # Cells without a depth are not counted.
    depth[-10:] = np.nan
    assert relief_of(wall(depth), None, BEHIND_M).face_m == pytest.approx(-0.2, abs=1e-6)


def test_empty_cells_are_open_unless_hidden_and_crossed_only_where_empty() -> None:
    depth = flat()
    depth[10:30, 10:30] = depth[10:30, 50:70] = np.nan
    tiles = np.zeros((6, 8), dtype=np.bool_)
    tiles[1:3, 1:3] = True
    lines = SightLines(side=10, crossed=tiles, stopped=np.flip(tiles, axis=1))
    found = relief_of(wall(depth), lines, BEHIND_M)
    np.testing.assert_array_equal(found.is_crossed, block(10, 30, 10, 30))
    assert found.is_open[20, 20]
    assert not found.is_open[20, 60]
    assert relief_of(wall(depth), None, BEHIND_M).is_open[20, 60]
    assert not relief_of(wall(flat()), lines, BEHIND_M).is_crossed.any()


def test_of_a_large_wall_every_nth_cell_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    depth = flat()
    depth[9:30, 21:51] = -0.25
    # A quarter of 60 x 80 cells exceeds the limit by one; a ninth does not.
    monkeypatch.setattr(areas, "MAX_MEASURED_CELLS", 1199)
    found = relief_of(wall(depth), None, BEHIND_M)
    assert (found.step, found.gsd_m) == (3, pytest.approx(3 * GSD_M))
    np.testing.assert_array_equal(found.depth_m, depth[::3, ::3])
    monkeypatch.setattr(areas, "MAX_MEASURED_CELLS", 1200)
    assert relief_of(wall(depth), None, BEHIND_M).step == 2


def test_areas_come_from_the_largest_with_a_rim_of_other_cells() -> None:
    small, large = block(5, 20, 60, 75), block(10, 50, 10, 40)
    found = list(open_areas(relief(small | large), WIDTH_LEAST_M, AREA_LEAST_M2))
    assert [np.count_nonzero(area.cells) for area in found] == [1200, 225]
    for area, cells in zip(found, (large, small), strict=True):
        np.testing.assert_array_equal(whole(area), cells)
        rim = area.cells.copy()
        rim[1:-1, 1:-1] = False
        assert not rim.any()
        assert area.cells[1:-1, 1:-1].all()
    assert found[0].corner == (9, 9)


def test_bars_across_an_opening_are_part_of_it() -> None:
    cells = block(10, 50, 10, 40)
    cells[28:31, 20:30] = False
    (area,) = open_areas(relief(cells), WIDTH_LEAST_M, AREA_LEAST_M2)
    np.testing.assert_array_equal(whole(area), block(10, 50, 10, 40))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("width", "is_opening"), [(9, False), (10, True)])
def test_a_square_of_the_least_width_fits_into_an_opening(
    axis: int, width: int, is_opening: bool
) -> None:
    # 0.2 m are ten cells; the rule also applies at the border of the raster.
    cells = block(0, width, 10, 50) if axis else block(10, 50, 0, width)
    assert len(list(open_areas(relief(cells), WIDTH_LEAST_M, AREA_LEAST_M2))) == is_opening


@pytest.mark.parametrize(
    ("n_crossed", "n_empty", "kind"),
    [
        (40, 40, "through"),
        (39, 39, "niche"),
        (39, 200, "no data"),
        (0, 199, "niche"),
        (400, 400, "through"),
    ],
)
def test_the_kind_is_told_by_the_share_of_cells(n_crossed: int, n_empty: int, kind: str) -> None:
    # The area has 400 cells; cells outside it have no influence.
    cells = block(10, 30, 10, 30)

    def first(count: int) -> NDArray[np.bool_]:
        some = ~block(10, 30, 10, 30)
        some[10:30, 10:30] = (np.arange(400) < count).reshape(20, 20)
        return some

    depth = np.where(cells, np.float32(-0.3), np.float32(7.0))
    depth[10:12, 10:30] = -5.0
    made = relief(
        cells, is_crossed=first(n_crossed), is_empty=first(n_empty), depth_m=depth, face_m=0.1
    )
    (area,) = open_areas(made, WIDTH_LEAST_M, AREA_LEAST_M2)
    assert area.kind == kind
    if n_empty == 400:
        assert area.depth_m is None
    else:
        # Median of the measured depths, from the face.
        assert area.depth_m == pytest.approx(0.4, abs=1e-6)


CELL_M = 0.01
# The wall is seen along +y, with its top-left corner at (10, 20, 30); depth is 20 - y.
CORNER = np.array([10.0, 20.0, 30.0])
FRONT_M, FAR_BEHIND_M = 0.15, 0.4
# Number of cells along a 5 cm tile.
SIDE = 5


def slab(rows: int = 43, columns: int = 61, gsd_m: float = CELL_M) -> Slab:
    frame = samples.facing_south(gsd_m, columns, rows, tuple(CORNER))
    return Slab(frame=frame, front_m=FRONT_M, behind_m=FAR_BEHIND_M)


def cloud(
    ends: NDArray[np.float64],
    stations: NDArray[np.float64] | None = None,
    scan: NDArray[np.integer] | None = None,
    source: str = "file",
) -> PointCloud:
    """Return a cloud of points (n, 3) given in metres right, down and in front of the wall."""
    return replace(
        cloud_of(world(ends)),
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
    """Return crossed and stopped tiles, computed ray by ray."""
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
        column, row = (int(np.floor(value / (SIDE * CELL_M))) for value in place)
        if 0 <= row < shape[0] and 0 <= column < shape[1]:
            what = 0 if end[2] < -FAR_BEHIND_M else 1 if end[2] > FRONT_M else 2
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


# The last station is behind the wall.
STATIONS = np.array([[0.3, 0.2, 2.0], [-1.0, 0.5, 1.2], [0.2, 0.2, -1.0]])


@pytest.mark.parametrize("is_known", [True, False], ids=["stations", "squarely"])
def test_tiles_are_what_each_ray_says(is_known: bool) -> None:
    ends = some_ends(1500)
    # The fourth scan has no station.
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
    monkeypatch.setattr(areas, "BLOCK", 64)
    parts = sight_lines(given, slab())
    np.testing.assert_array_equal(parts.crossed, whole.crossed)
    np.testing.assert_array_equal(parts.stopped, whole.stopped)
