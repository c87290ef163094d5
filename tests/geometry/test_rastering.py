"""The compiled passes: which cell a point falls into, who wins it, which gaps are narrow."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from orthoflow.geometry import frame_over, rastering
from orthoflow.geometry.narrow_gaps import narrow_gaps
from orthoflow.geometry.rastering import (
    NO_POINT,
    places_of_winners,
    topmost_points,
    values_of_winners,
    wall_from_offset,
)
from orthoflow.geometry.slabs import Offsets, Slab
from orthoflow.products import PointCloud
from tests import raster_scenes as scenes
from tests.long_loops import seeds


def slab_of(wall: scenes.KnownWall, *, front_m: float = 0.15, behind_m: float = 0.15) -> Slab:
    frame = frame_over(wall.planes().corners[0], wall.normal, gsd_m=wall.gsd_m)
    assert frame.shape == wall.shape
    return Slab(frame=frame, front_m=front_m, behind_m=behind_m)


def random_cloud(wall: scenes.KnownWall, *, n_points: int, seed: int) -> PointCloud:
    rng = np.random.default_rng(seed)
    rows, columns = wall.shape
    # A few depths only, so that ties in depth are frequent; beyond all borders on purpose.
    depths_m = rng.choice(np.linspace(-0.25, 0.25, 9), n_points)
    return scenes.cloud_of(
        wall.world(
            rng.uniform(-3, columns + 3, n_points), rng.uniform(-3, rows + 3, n_points), depths_m
        )
    )


def sorted_winners(cloud: PointCloud, slab: Slab) -> NDArray[np.uint32]:
    """The winners by sorting all points: depth, then distance to the centre, then index."""
    matrix = wall_from_offset(slab.frame, cloud.origin)
    xyz = np.stack([cloud.x, cloud.y, cloud.z]).astype(np.float64)
    # Term by term, as the kernel adds: a matrix product rounds differently.
    u, v, depth = (m[0] * xyz[0] + m[1] * xyz[1] + m[2] * xyz[2] + m[3] for m in matrix)
    rows, columns = slab.frame.shape
    inside = (depth >= -slab.behind_m) & (depth <= slab.front_m)
    inside &= (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    points = np.flatnonzero(inside)
    u, v, depth = u[inside], v[inside], depth[inside].astype(np.float32)
    cells = np.floor(v).astype(int) * columns + np.floor(u).astype(int)
    squares = ((u % 1 - 0.5) ** 2 + (v % 1 - 0.5) ** 2).astype(np.float32)
    order = np.lexsort((points, squares, -depth, cells))
    is_first = np.append(True, np.diff(cells[order]) != 0)
    winners = np.full(rows * columns, NO_POINT, dtype=np.uint32)
    winners[cells[order[is_first]]] = points[order[is_first]]
    return winners


@pytest.mark.parametrize("seed", seeds(4))
def test_topmost_points_are_those_found_by_sorting(seed: int) -> None:
    wall = scenes.upright_wall(shape=(60, 80))
    cloud, slab = random_cloud(wall, n_points=60_000, seed=seed), slab_of(wall)
    winners = topmost_points(cloud, slab, threads=1)
    np.testing.assert_array_equal(winners["point"], sorted_winners(cloud, slab))
    for threads in (2, 3, 8):
        np.testing.assert_array_equal(winners, topmost_points(cloud, slab, threads=threads))


@pytest.mark.parametrize("threads", [1, 3])
def test_points_that_are_left_out_win_nothing(threads: int) -> None:
    wall = scenes.upright_wall(shape=(60, 80))
    cloud, slab = random_cloud(wall, n_points=60_000, seed=2), slab_of(wall)
    is_left_out = np.random.default_rng(2).random(len(cloud)) < 0.4
    winners = topmost_points(cloud, slab, threads=threads, is_left_out=is_left_out)
    kept = np.flatnonzero(~is_left_out)
    expected = topmost_points(cloud.selected(kept), slab, threads=1)
    has_point = expected["point"] != NO_POINT
    np.testing.assert_array_equal(winners["point"] != NO_POINT, has_point)
    np.testing.assert_array_equal(winners["point"][has_point], kept[expected["point"][has_point]])
    np.testing.assert_array_equal(winners["n_points"], expected["n_points"])


@pytest.mark.parametrize(("dtype", "nothing"), [("u1", 0), ("f4", np.nan)])
def test_cells_take_every_channel_of_their_winner(dtype: str, nothing: float) -> None:
    wall = scenes.upright_wall(shape=(60, 80))
    cloud, slab = random_cloud(wall, n_points=6_000, seed=3), slab_of(wall)
    values = np.random.default_rng(3).integers(1, 256, (len(cloud), 3)).astype(dtype)
    winners = topmost_points(cloud, slab, threads=1)
    has_point = winners["point"] != NO_POINT
    assert 0 < has_point.sum() < has_point.size
    taken = values_of_winners(winners, values, nothing)
    np.testing.assert_array_equal(taken[has_point], values[winners["point"][has_point]])
    np.testing.assert_array_equal(taken[~has_point], nothing)


def test_depths_are_in_order_on_both_sides_of_the_plane() -> None:
    wall = scenes.upright_wall()
    depths_m = np.array([-1e-3, -1e-6, 0.0, 0.0, 1e-6, -1e-6])
    points = scenes.cloud_of(wall.world(np.full(6, 3.5), np.full(6, 4.5), depths_m))
    for n_points, winner in ((1, 0), (2, 1), (3, 2), (4, 2), (5, 4), (6, 4)):
        some = points.selected(np.arange(n_points))
        assert topmost_points(some, slab_of(wall), threads=1)["point"][4 * 40 + 3] == winner


def test_a_cell_owns_its_left_and_upper_border() -> None:
    wall = scenes.upright_wall()
    corners = wall.world(np.array([7.0, 0.0, 40.0]), np.array([5.0, 0.0, 0.0]), np.zeros(3))
    winners = topmost_points(scenes.cloud_of(corners), slab_of(wall), threads=1)
    assert np.flatnonzero(winners["point"] != NO_POINT).tolist() == [0, 5 * 40 + 7]


def test_both_ends_of_the_buffer_are_inside() -> None:
    wall = scenes.upright_wall()
    depths_m = np.array([0.25, 0.2500001, -0.5, -0.5000001])
    points = wall.world(np.array([0.5, 1.5, 2.5, 3.5]), np.full(4, 0.5), depths_m)
    winners = topmost_points(
        scenes.cloud_of(points), slab_of(wall, front_m=0.25, behind_m=0.5), threads=1
    )
    assert np.flatnonzero(winners["point"] != NO_POINT).tolist() == [0, 2]


def test_blocks_beside_a_wall_are_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = scenes.leaning_wall(shape=(60, 80))
    some = random_cloud(wall, n_points=1_100_000, seed=2)
    # As a scanner goes: along the wall, and then along what lies beside it.
    cloud = some.selected(np.argsort(some.x, kind="stable"))
    frame = slab_of(wall).frame
    part = Slab(frame=replace(frame, width=8), front_m=0.15, behind_m=0.15)
    read = {}
    project = rastering.project_points

    def project_points(offsets: Offsets, *rest: Any) -> None:
        read[offsets.x.ctypes.data] = offsets.x.size
        project(offsets, *rest)

    monkeypatch.setattr(rastering, "project_points", project_points)
    assert cloud.boxes_m is not None
    found = [topmost_points(cloud, part, threads=2)]
    assert sum(read.values()) < 0.3 * len(cloud)
    monkeypatch.setattr(PointCloud, "boxes_m", None)
    found.append(topmost_points(replace(cloud), part, threads=2))
    np.testing.assert_array_equal(*found)
    assert (found[0]["point"] != NO_POINT).mean() > 0.9


def test_only_what_may_lie_in_some_rows_is_read() -> None:
    wall = scenes.upright_wall(shape=(60, 80))
    some = random_cloud(wall, n_points=1_100_000, seed=2)
    cloud = some.selected(np.argsort(some.z, kind="stable"))
    slab, rows = slab_of(wall), slice(20, 30)
    counts = []
    for asked in (None, rows):
        count = np.zeros(slab.n_cells, dtype=np.uint32)
        for entries in rastering.entries_inside(cloud, slab, threads=2, rows=asked):
            np.add.at(count, entries.cells, 1)
        counts.append(count.reshape(60, 80))
    np.testing.assert_array_equal(counts[1][rows], counts[0][rows])
    assert counts[1].sum() < 0.4 * counts[0].sum()


@pytest.mark.parametrize("radius", [1, 2, 3])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.7])
def test_narrow_gaps_are_the_void_without_its_opening(radius: int, share: float) -> None:
    is_measured = np.random.default_rng(radius).random((37, 53)) < share
    steps = np.arange(-radius, radius + 1)
    disc = steps[:, None] ** 2 + steps**2 <= radius**2
    padded = np.pad(~is_measured, 2 * radius, constant_values=True)
    opened = ndimage.binary_opening(padded, disc)[(slice(2 * radius, -2 * radius),) * 2]
    found = narrow_gaps(is_measured, radius)
    np.testing.assert_array_equal(found, np.flatnonzero(~is_measured & ~opened))


def test_places_are_told_of_points_up_to_two_cells_beside_a_gap() -> None:
    wall = scenes.upright_wall(shape=(20, 30))
    rows, columns = np.indices(wall.shape)
    rng = np.random.default_rng(2)
    offsets = rng.uniform(-0.4, 0.4, (*wall.shape, 2))
    is_gap = np.zeros(wall.shape, dtype=np.bool_)
    is_gap[4, 5] = is_gap[12:14, 20:25] = is_gap[19, 0] = True
    u, v = columns + 0.5 + offsets[..., 0], rows + 0.5 + offsets[..., 1]
    kept = ~is_gap
    cloud = scenes.cloud_of(wall.world(u[kept], v[kept], np.zeros(kept.sum())))
    winners = topmost_points(cloud, slab_of(wall), threads=1)
    places = places_of_winners(cloud, slab_of(wall), winners).reshape(*wall.shape, 2)
    assert np.isnan(places[is_gap]).all()
    is_near = np.zeros(wall.shape, dtype=np.bool_)
    for row, column in np.argwhere(is_gap):
        is_near[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3] = True
    is_known = is_near & ~is_gap
    np.testing.assert_allclose(places[is_known], offsets[is_known], atol=2e-3)
    assert (places[~is_near] == 0.0).all()
