"""`plane.region`: voxels, normals, growing, the paper's preset; the rest in test_detectors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.region import Region, RegionProposer, region_proposer
from orthoflow_plugins.plane.voxels import (
    HALF_STEPS,
    Neighbourhood,
    SurfaceVoxels,
    VoxelTable,
    surface_voxels,
)

from orthoflow.geometry import angle_between_deg
from tests import plane_scenes
from tests.plane_scenes import Rectangle, cloud_of, prepared, sampled, search_in

STATION = np.array([[0.0, -1.5, 0.0]])
CUBE = Neighbourhood(shape="cube", size_m=0.15, n_points=30, voxel_m=0.05)
# A wall with a niche a quarter of a metre deep, and a floor before them.
WALL = Rectangle("wall", (0, 2, 0), (1.5, 0, 0), (0, 0, 1.0), 60_000)
NICHE = Rectangle("niche", (2.0, 2.25, 0), (0.4, 0, 0), (0, 0, 0.8), 13_000)
FLOOR = Rectangle("floor", (0, 1, -1.0), (1.5, 0, 0), (0, 1, 0), 20_000)


def voxels_of(points: NDArray[np.float64], *, parts: int = 1) -> SurfaceVoxels:
    return surface_voxels(prepared(points, parts=parts), CUBE)


def grown(points: NDArray[np.float64], min_share: float, **params: Any) -> RegionProposer:
    """Regions of a cloud in cubes of 15 cm; a fifth of the share has to be in each."""
    search = search_in(prepared(points))
    settled = {"neighbourhood_m": 0.15, "min_share": min_share, **params}
    return region_proposer(search, Region.Params(**settled), viewer_m=STATION[0])


def detect(
    points: NDArray[np.float64], folder: Path, **params: Any
) -> tuple[Any, dict[str, float]]:
    cloud = cloud_of(points, stations=STATION)
    out, ctx = plane_scenes.detect(Region, cloud, folder, **params)
    return out, {metric.name: metric.value for metric in ctx.metrics}


def test_voxels_and_wider_ones_hold_the_moments_of_their_points() -> None:
    points = sampled((WALL, NICHE))[::7]
    voxels, cloud = voxels_of(points), prepared(points)
    wide, of_member = voxels.table.coarser(np.arange(len(voxels.counts)))
    assert wide.grid.cell_m == 2.0 * voxels.table.grid.cell_m
    voxel_of = voxels.table.voxel_of(cloud.points)
    inside = voxel_of >= 0
    assert inside.mean() > 0.99  # the robust box may leave out a few at its edge
    # The kernels find each wide voxel where its points are.
    wide_of = wide.voxel_of(cloud.points)[inside]
    np.testing.assert_array_equal(wide_of, of_member[voxel_of[inside]])
    for table, of_point in ((voxels.table, voxel_of[inside]), (wide, wide_of)):
        n_points = np.bincount(of_point)
        np.testing.assert_array_equal(table.sums[:, 0], n_points)
        means = np.column_stack([np.bincount(of_point, axis) for axis in points[inside].T])
        # Places within a voxel are kept in steps.
        step_m = table.grid.cell_m / HALF_STEPS
        centroids = table.centroids() @ table.grid.basis
        np.testing.assert_allclose(centroids, means / n_points[:, None], atol=0.6 * step_m)
    counts = VoxelTable.over(cloud, voxels.table.grid.cell_m, n_sums=1)
    np.testing.assert_array_equal(counts.sums[:, 0], voxels.table.sums[:, 0])
    np.testing.assert_array_equal(counts.places, voxels.table.places)


def test_neither_threads_nor_the_order_of_points_show() -> None:
    points = sampled((WALL, NICHE))[::5]
    expected = voxels_of(points)
    found = voxels_of(np.random.default_rng(1).permutation(points), parts=3)
    # The robust box comes from a sample, which for so few points is all of them.
    for name in ("bricks", "numbers", "places", "sums"):
        np.testing.assert_array_equal(getattr(found.table, name), getattr(expected.table, name))
    np.testing.assert_array_equal(found.normals, expected.normals)
    np.testing.assert_array_equal(found.spreads, expected.spreads)


@pytest.mark.parametrize(
    ("shape", "size_m", "count"),
    [("cube", 0.03, 27), ("cube", 0.01, 1), ("cube", 0.05, 125), ("radius", 0.02, 33)],
)
def test_neighbourhoods_have_the_cells_of_their_shape(
    shape: Any, size_m: float, count: int
) -> None:
    around = Neighbourhood(shape=shape, size_m=size_m, n_points=9, voxel_m=0.01).around()
    assert len(around) == count - 1  # the voxel itself is there without being listed
    assert (np.diff(around[:, 3]) >= 0).all()


def test_a_region_is_fitted_by_total_least_squares_through_its_points() -> None:
    lean = np.radians(7.0)
    wall = Rectangle("lean", (1, 3, 2), (2, 0, 0), (0, np.sin(lean), np.cos(lean)), 80_000)
    points = sampled((wall,), noise_m=0.001)
    (plane,) = grown(points, 0.005).planes.values()
    expected = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    # A few voxels at the edges do not join, and places are rounded to 50 micrometres.
    assert min(angle_between_deg(plane.normal, s * expected) for s in (1, -1)) < 0.002
    assert abs(plane.distances_m(points.mean(axis=0)[None])[0]) < 2e-5


def test_a_thinly_scanned_wall_beside_a_dense_one_is_one_region() -> None:
    # A point per decimetre: neighbourhoods of 10 cm that suit the dense wall hold one of them.
    thin = Rectangle("thin", (3.0, 1.0, 0.0), (0, 3.0, 0), (0, 0, 2.0), 2_400)
    dense = Rectangle("dense", (0.0, 4.0, 0.0), (2.0, 0, 0), (0, 0, 2.0), 90_000)
    points = sampled((thin, dense), noise_m=0.002)
    regions = grown(points, 2_000.0 / len(points), neighbourhood_m=0.1)
    assert len(regions.planes) == 2
    of_thin = min(regions.planes, key=lambda region: regions.n_points[region])
    assert regions.n_points[of_thin] > 0.9 * 2_400
    normal = regions.planes[of_thin].normal
    assert angle_between_deg(normal * np.sign(normal[0]), np.array([1.0, 0.0, 0.0])) < 0.05


def test_a_step_of_three_centimetres_parts_regions() -> None:
    upper = Rectangle("upper", (0, 2, 0.5), (1, 0, 0), (0, 0, 0.5), 30_000)
    lower = Rectangle("lower", (0, 2.03, -0.5), (1, 0, 0), (0, 0, 0.5), 25_000)
    points = sampled((upper, lower), noise_m=0.001)
    assert len(grown(points, 0.18).planes) == 2
    either_depth = grown(points, 0.18, criterion="normal")
    # All but the voxels at the step itself, whose neighbourhoods lean.
    assert either_depth.n_points.max() > 0.85 * 55_000


def test_the_paper_s_preset_does_not_tell_a_niche_from_its_wall(tmp_path: Path) -> None:
    """Figure 8: normals alone know no depth."""
    points = sampled((WALL, NICHE, FLOOR), noise_m=2e-5)
    paper, metrics = detect(points, tmp_path / "paper", preset="paper", thinning=1)
    ours, by_region = (
        detect(points, tmp_path / labels, labels=labels)[0].labels.plane_index
        for labels in ("plane", "region")
    )
    niche = slice(WALL.n_points, WALL.n_points + NICHE.n_points)
    of_wall = paper.labels.plane_index[: WALL.n_points]
    wall = int(np.bincount(of_wall[of_wall >= 0]).argmax())
    # Some voxels of a centimetre have too few points for a normal.
    assert np.mean(of_wall == wall) > 0.85
    assert np.mean(paper.labels.plane_index[niche] == wall) > 0.85
    own = np.bincount(ours[niche] + 1).argmax() - 1
    assert np.mean(ours[niche] == own) > 0.98
    assert own not in ours[: WALL.n_points]
    # The raw plane lies between the two, as R in Table 1 does; the common fit is on the wall.
    raw = paper.planes.details["raw"][wall]
    between_m = abs(np.array(raw["normal"]) @ (0, 2, 0) - raw["offset_m"])
    assert 0.02 < between_m < 0.1
    assert abs(paper.planes.normal[wall] @ (0, 2, 0) - paper.planes.offset[wall]) < 1e-4
    assert metrics["neighbourhood_mm"] >= 10.0
    # Labels by region leave out what lies on the plane but not in the region.
    on, within = ours >= 0, by_region >= 0
    assert 0.9 < np.mean(within) < np.mean(on)
    assert (ours[within & on] == by_region[within & on]).mean() > 0.99
    settings = Region.Params(preset="paper", angle_deg=2.0)
    assert (settings.criterion, settings.thinning, settings.neighbourhood_m) == ("normal", 10, 0.01)
    assert (settings.angle_deg, settings.labels) == (2.0, "region")
    assert Region.Params().criterion == "normal-and-distance"


def test_neighbourhoods_follow_the_density(tmp_path: Path) -> None:
    thin = Rectangle("thin", (0, 2, 0), (3, 0, 0), (0, 0, 1.5), 2_000)  # 111 points per m2
    _, metrics = detect(sampled((thin,)), tmp_path)
    # 16 points at 111 per m2: 38 cm.
    assert metrics["neighbourhood_mm"] == pytest.approx(380.0, rel=0.15)
    assert metrics["cell_mm"] == pytest.approx(metrics["neighbourhood_mm"] / 3.0)
