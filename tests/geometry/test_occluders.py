"""What stands before a photo: counts of points around, splats, and the holes between them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.occluders import Box, Occluders, depth_buffer, occluders_in
from tests import samples, scenes
from tests.long_loops import seeds
from tests.plane_scenes import cloud_of

ORIGIN = np.array([10.0, -4.0, 2.0])
LOW, HIGH, SPACING_M = np.array([-0.6, -0.4, 1.8]), np.array([0.7, 0.5, 3.1]), 0.03
# Six cells of a spacing each.
SIDE_M = 6.0 * SPACING_M
# So far off that hardly one of its rays meets a voxel.
FAR = ORIGIN + np.array([[0.0, -1000.0, 0.0]])


def points_m(seed: int) -> NDArray[np.float64]:
    """Offsets of which some lie outside the box; float32, as kernels see them."""
    rng = np.random.default_rng(seed)
    return rng.uniform(LOW - 0.2, HIGH + 0.2, (3_000, 3)).astype(np.float32).astype(np.float64)


def box() -> Box:
    return Box(low=LOW, high=HIGH, spacing_m=SPACING_M)


def counts_at(found: Occluders, points: NDArray[np.float64], low: NDArray[np.float64]) -> NDArray:
    """How many points the voxels around points have."""
    return found.around.counts[tuple(np.floor((points - low) / found.around.side_m).astype(int).T)]


def expected_around(points: NDArray[np.float64]) -> NDArray[np.int64]:
    shape = np.ceil((HIGH - LOW) / SIDE_M).astype(int)
    cells = np.floor((points - LOW) / SIDE_M).astype(int)
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    counts = np.zeros(shape, dtype=np.int64)
    np.add.at(counts, tuple(cells[inside].T), 1)
    return ndimage.convolve(counts, np.ones((3, 3, 3), dtype=int), mode="constant")


def camera() -> ViewingCamera:
    """At the cloud's origin, looking up along z, turned a little."""
    turn = scenes.rotation_about(np.array([0.3, 0.9, 0.1]), 4.0)
    lens = {"fx": 90.0, "fy": 110.0, "cx": 50.0, "cy": 40.0, "width": 100, "height": 80}
    bent = np.array([0.01, 0.0, 0.001, 0.0, 0.0])
    return samples.camera(turn, ORIGIN, distortion=bent, **lens)


@pytest.mark.parametrize("seed", seeds(2))
def test_points_are_counted_with_those_in_the_voxels_around(seed: int) -> None:
    points = points_m(seed)
    found = occluders_in(cloud_of(points, origin=tuple(ORIGIN)), box(), FAR, n_least=4, threads=2)
    np.testing.assert_array_equal(found.around.counts, expected_around(points))
    assert found.around.side_m == pytest.approx(SIDE_M)
    np.testing.assert_array_equal(found.around.low, LOW)


def test_nothing_is_where_a_scanner_is_blind() -> None:
    points = points_m(0)
    station = np.array([0.1, 0.0, 2.4])
    beside = np.array([0.65, -0.5, 1.7])
    stations, cloud = ORIGIN + np.array([station, beside]), cloud_of(points, origin=tuple(ORIGIN))
    found = occluders_in(cloud, box(), stations, n_least=4, threads=1)
    middles = LOW + SIDE_M * (np.indices(found.around.counts.shape).transpose(1, 2, 3, 0) + 0.5)
    expected = expected_around(points)
    for place in (station, beside):
        expected[np.linalg.norm(middles - place, axis=-1) < 0.3] = 0
    assert (expected == 0).sum() > 10
    np.testing.assert_array_equal(found.around.counts, expected)


def scan_of(places: NDArray[np.float64], station: NDArray[np.float64]) -> NDArray[np.float64]:
    """A wall (x = 3 m) and a rod of 6 mm before it, scanned; one ray in fifty is stray."""
    ways = places - station
    rng = np.random.default_rng(5)
    along = np.where(rng.uniform(size=len(places)) < 0.02, rng.uniform(0.05, 0.9, len(places)), 1.0)
    before = station + ways * (1.5 / ways[:, :1])
    is_rod = np.abs(before[:, 1] - 0.5) < 0.003
    return np.where(is_rod[:, None], before, station + ways * along[:, None])


def test_stray_points_of_a_dense_scan_hide_nothing_and_a_rod_does() -> None:
    side = np.arange(-1.0, 1.0, 0.004)
    wall = np.stack(np.meshgrid([3.0], side, side), axis=-1).reshape(-1, 3)
    station = np.array([0.0, 0.1, 0.2])
    points = scan_of(wall, station)
    before = Box(low=np.array([0.0, -1.0, -1.0]), high=np.array([3.1, 1.0, 1.0]), spacing_m=0.008)

    def is_kept(stations: NDArray[np.float64] | None) -> NDArray[np.bool_]:
        found = occluders_in(cloud_of(points), before, stations, n_least=6, threads=1)
        return counts_at(found, points, before.low) >= found.n_least

    is_rod = (points[:, 0] == 1.5) & (np.abs(points[:, 1] - 0.5) < 0.003)
    is_wall = points[:, 0] == 3.0
    # What stands beside rod or wall counts with it.
    is_stray = (points[:, 0] < 1.2) | ((points[:, 0] > 1.8) & (points[:, 0] < 2.7))
    assert is_rod.sum() > 300
    assert is_stray.sum() > 2_000
    assert is_kept(FAR)[is_stray].mean() > 0.5
    twice = np.array([station, station])
    kept = is_kept(twice)
    # Close to the station they are as many as a thinned surface would have there.
    assert kept[is_stray].mean() < 0.15
    assert kept[is_rod].all()
    assert kept[is_wall].all()


def test_a_thinned_surface_close_to_its_station_stays() -> None:
    rng = np.random.default_rng(4)
    wall = np.column_stack([np.full(400_000, 9.0), rng.uniform(-4.0, 4.0, (400_000, 2))])
    near = np.column_stack([np.full(500, 0.5), rng.uniform(-0.14, 0.14, (500, 2))])
    space = Box(low=np.array([0.0, -1.0, -1.0]), high=np.full(3, 1.0), spacing_m=0.0126)
    station = np.zeros((1, 3))
    found = occluders_in(cloud_of(np.vstack([wall, near])), space, station, n_least=6, threads=1)
    assert (counts_at(found, near, space.low) > 0).all()


def test_without_stations_few_points_that_are_spread_evenly_hide_nothing() -> None:
    rng = np.random.default_rng(3)
    space = Box(low=np.zeros(3), high=np.full(3, 3.0), spacing_m=SPACING_M)
    stray = rng.uniform(0.0, 3.0, (12_000, 3))
    # Along a line and on a surface, both sparser than anybody scans a wall.
    line = np.array([0.4, 0.5, 0.6]) + np.linspace(0.0, 2.0, 120)[:, None] * [0.5, 0.6, 0.3]
    face = np.column_stack([rng.uniform(0.0, 3.0, (3_000, 2)), np.full(3_000, 1.3)])

    def is_kept(points: NDArray[np.float64], space: Box = space) -> NDArray[np.bool_]:
        found = occluders_in(cloud_of(points), space, None, n_least=6, threads=1)
        return counts_at(found, points, space.low) >= found.n_least

    # Fewer of the voxels about an edge of the box lie in it, and share more pairs.
    is_inside = ((stray > 0.2) & (stray < 2.8)).all(axis=1)
    assert is_kept(stray)[is_inside].mean() < 0.05
    assert is_kept(line).all()
    assert is_kept(face).mean() > 0.95
    # In a hall, voxels are 2.6 times as wide, so surfaces have 7 times as many points in them.
    hall = Box(low=np.zeros(3), high=np.full(3, 20.0), spacing_m=0.005)
    stray, clump = rng.uniform(9.0, 10.0, (36_000, 3)), rng.normal(5.0, 0.01, (12, 3))
    kept = is_kept(np.vstack([stray, clump]), hall)
    assert kept[: len(stray)].mean() < 0.1
    assert not kept[len(stray) :].any()


def test_voxels_grow_where_a_box_would_have_too_many() -> None:
    wide = Box(low=np.zeros(3), high=np.array([200.0, 300.0, 40.0]), spacing_m=0.005)
    found = occluders_in(cloud_of(np.zeros((3, 3))), wide, None, n_least=4, threads=1)
    assert found.around.counts.size <= 1 << 24
    # A tenth wider at a time.
    assert found.around.counts.size * 1.1**3 > 0.95 * (1 << 24)
    thin = Box(low=np.zeros(3), high=np.array([0.5, 0.0, 0.5]), spacing_m=0.05)
    found = occluders_in(cloud_of(np.zeros((3, 3))), thin, None, n_least=4, threads=1)
    assert found.around.counts.shape == (2, 1, 2)


@pytest.mark.parametrize("scale", [1, 30], ids=["full size", "reduced"])
def test_a_photo_sees_the_nearest_of_squares_as_large_as_the_gaps(scale: int) -> None:
    points = points_m(1)
    cloud = cloud_of(points, origin=tuple(ORIGIN))
    small = camera()
    sizes = ("fx", "fy", "cx", "cy", "width", "height")
    seen_by = replace(small, **{name: scale * getattr(small, name) for name in sizes})
    n_least = 40
    occluders = occluders_in(cloud, box(), FAR, n_least=n_least, threads=3)
    found = depth_buffer(occluders, seen_by)
    # No side of more than 2048 pixels.
    reduction = 2 if scale == 30 else 1
    assert found.reduction == reduction
    shape = (-(-seen_by.height // reduction), -(-seen_by.width // reduction))
    assert found.nearest.shape == shape
    around = expected_around(points)
    cells = np.floor((points - LOW) / SIDE_M).astype(int)
    nearest = np.full(shape, np.inf, dtype=np.float32)
    projected = seen_by.project(points + ORIGIN)
    focal = math.sqrt(seen_by.fx * seen_by.fy)
    n_drawn = 0
    for cell, (u, v, distance) in zip(cells, projected, strict=True):
        if (cell < 0).any() or (cell >= around.shape).any() or around[tuple(cell)] < n_least:
            continue
        # Nine faces of a voxel hold so many points.
        spacing_m = math.sqrt((3.0 * SIDE_M) ** 2 / around[tuple(cell)])
        half = min(spacing_m * focal / distance / reduction, 24.0)
        first = [max(0, math.floor(place / reduction - half)) for place in (v, u)]
        end = [math.floor(place / reduction + half) + 1 for place in (v, u)]
        part = nearest[first[0] : max(end[0], 0), first[1] : max(end[1], 0)]
        np.minimum(part, np.float32(distance), out=part)
        n_drawn += 1
    assert 100 < n_drawn < 2_900
    lowest = ndimage.minimum_filter(nearest, 3, mode="nearest")
    closed = ndimage.maximum_filter(lowest, 3, mode="nearest")
    np.testing.assert_allclose(found.nearest, closed, rtol=1e-6)


def test_what_is_at_the_camera_or_behind_it_hides_nothing() -> None:
    at = np.tile([[0.0, 0.0, 0.04], [0.0, 0.0, -0.5]], (50, 1))
    around = Box(low=np.full(3, -1.0), high=np.ones(3), spacing_m=0.1)
    level = replace(camera(), rotation=np.eye(3), translation=-ORIGIN, distortion=np.zeros(5))
    for shift_m, nearest_m in ((0.0, np.inf), (0.02, 0.06)):
        cloud = cloud_of(at + np.array([0.0, 0.0, shift_m]), origin=tuple(ORIGIN))
        found = depth_buffer(occluders_in(cloud, around, None, n_least=2, threads=1), level)
        assert found.nearest.min() == pytest.approx(nearest_m)
