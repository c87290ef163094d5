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
from orthoflow.sdk import StepContext
from tests.plane_scenes import Rectangle, cloud_of, context, prepared, sampled, search_in

STATION = np.array([[0.0, -1.5, 0.0]])
CUBE = Neighbourhood(shape="cube", size_m=0.15, n_points=30, voxel_m=0.05)
# A wall with a niche a quarter of a metre deep, and a floor before them.
WALL = Rectangle("wall", (0, 2, 0), (1.5, 0, 0), (0, 0, 1.0), 120_000)
NICHE = Rectangle("niche", (2.0, 2.25, 0), (0.4, 0, 0), (0, 0, 0.8), 26_000)
FLOOR = Rectangle("floor", (0, 1, -1.0), (1.5, 0, 0), (0, 1, 0), 40_000)


def voxels_of(
    points: NDArray[np.float64], wanted: Neighbourhood, *, parts: int = 1
) -> SurfaceVoxels:
    return surface_voxels(prepared(points, parts=parts), wanted)


def grown(points: NDArray[np.float64], min_share: float, **params: Any) -> RegionProposer:
    """Regions of a cloud in cubes of 15 cm; a fifth of the share has to be in each."""
    search = search_in(prepared(points))
    settled = {"neighbourhood_m": 0.15, "min_share": min_share, **params}
    return region_proposer(search, Region.Params(**settled), viewer_m=STATION[0])


def detect(folder: Path, **params: Any) -> tuple[Any, StepContext]:
    cloud = cloud_of(sampled((WALL, NICHE, FLOOR), noise_m=2e-5), stations=STATION)
    ctx = context(folder)
    return Region().run(Region.In(cloud=cloud), Region.Params(**params), ctx), ctx


def named(ctx: StepContext) -> dict[str, float]:
    return {metric.name: metric.value for metric in ctx.metrics}


def test_cells_hold_the_moments_of_their_points() -> None:
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (40_000, 3))
    voxels = voxels_of(points, CUBE)
    voxel_of = voxels.table.voxel_of(prepared_points(points))
    assert (voxel_of >= 0).mean() > 0.99  # the robust box may leave out a few at its edge
    kept, voxel_of = points[voxel_of >= 0], voxel_of[voxel_of >= 0]
    np.testing.assert_array_equal(np.bincount(voxel_of), voxels.counts)
    means = np.stack([np.bincount(voxel_of, axis) for axis in kept.T], axis=1)
    # Places within a voxel are kept in 1024 steps.
    step_m = voxels.table.grid.cell_m / 1024
    np.testing.assert_allclose(
        voxels.table.centroids(), means / voxels.counts[:, None], atol=0.6 * step_m
    )


def prepared_points(points: NDArray[np.float64]) -> Any:
    return prepared(points).points


@pytest.mark.parametrize("parts", [2, 3])
def test_neither_threads_nor_the_order_of_points_show(parts: int) -> None:
    points = sampled((WALL, NICHE))[::5]
    expected = voxels_of(points, CUBE)
    order = np.random.default_rng(1).permutation(len(points))
    found = voxels_of(points[order], CUBE, parts=parts)
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
    regions = grown(points, 0.005)
    assert len(regions.planes) == 1
    (plane,) = regions.planes.values()
    centred = points - points.mean(axis=0)
    expected = np.linalg.svd(centred, full_matrices=False)[2][2]
    # A few voxels at the edges do not join, and places are rounded to 50 micrometres.
    assert min(angle_between_deg(plane.normal, s * expected) for s in (1, -1)) < 0.002
    assert abs(plane.distances_m(points.mean(axis=0)[None])[0]) < 2e-5


def test_wider_cells_have_the_moments_of_their_points() -> None:
    points = sampled((WALL, NICHE))[::7]
    voxels = voxels_of(points, CUBE)
    wide, of_member = voxels.table.coarser(np.arange(len(voxels.counts)))
    assert wide.grid.cell_m == 2.0 * voxels.table.grid.cell_m
    voxel_of = voxels.table.voxel_of(prepared_points(points))
    inside = voxel_of >= 0
    wide_of = of_member[voxel_of[inside]]
    count = np.bincount(wide_of)
    np.testing.assert_array_equal(wide.sums[:, 0], count)
    mean = (
        np.column_stack([np.bincount(wide_of, column) for column in points[inside].T])
        / count[:, None]
    )
    step_m = wide.grid.cell_m / HALF_STEPS
    centroids = wide.centroids() @ wide.grid.basis
    np.testing.assert_allclose(centroids, mean, atol=step_m)
    # The kernels find each wide voxel where its points are.
    np.testing.assert_array_equal(wide.voxel_of(prepared_points(points))[inside], wide_of)


def test_counts_alone_are_the_first_of_the_moments() -> None:
    cloud = prepared(np.random.default_rng(0).uniform(-1.0, 1.0, (9_000, 3)), parts=2)
    moments, counts = (VoxelTable.over(cloud, 0.05, n_sums=n) for n in (10, 1))
    np.testing.assert_array_equal(counts.sums[:, 0], moments.sums[:, 0])
    np.testing.assert_array_equal(counts.places, moments.places)


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
    paper, ctx = detect(tmp_path / "paper", preset="paper", thinning=1)
    ours, _ = detect(tmp_path / "ours")
    niche = slice(WALL.n_points, WALL.n_points + NICHE.n_points)
    of_wall = paper.labels.plane_index[: WALL.n_points]
    wall = int(np.bincount(of_wall[of_wall >= 0]).argmax())
    # Some voxels of a centimetre have too few points for a normal.
    assert np.mean(of_wall == wall) > 0.85
    assert np.mean(paper.labels.plane_index[niche] == wall) > 0.85
    own = np.bincount(ours.labels.plane_index[niche] + 1).argmax() - 1
    assert np.mean(ours.labels.plane_index[niche] == own) > 0.98
    assert own not in ours.labels.plane_index[: WALL.n_points]
    # The raw plane lies between the two, as R in Table 1 does; the common fit is on the wall.
    raw = paper.planes.details["raw"][wall]
    between_m = abs(np.array(raw["normal"]) @ (0, 2, 0) - raw["offset_m"])
    assert 0.02 < between_m < 0.1
    assert abs(paper.planes.normal[wall] @ (0, 2, 0) - paper.planes.offset[wall]) < 1e-4
    assert named(ctx)["neighbourhood_mm"] >= 10.0


def test_the_paper_s_preset_sets_what_is_not_set_otherwise() -> None:
    paper = Region.Params(preset="paper", angle_deg=2.0)
    assert (paper.criterion, paper.thinning, paper.neighbourhood_m) == ("normal", 10, 0.01)
    assert (paper.angle_deg, paper.labels) == (2.0, "region")
    assert Region.Params().criterion == "normal-and-distance"


def test_thin_clouds_get_larger_neighbourhoods_and_it_is_said(tmp_path: Path) -> None:
    thin = Rectangle("thin", (0, 2, 0), (3, 0, 0), (0, 0, 1.5), 2_000)  # 111 points per m2
    ctx = context(tmp_path)
    Region().run(Region.In(cloud=cloud_of(sampled((thin,)))), Region.Params(), ctx)
    # 16 points at 111 per m2: 38 cm.
    assert named(ctx)["neighbourhood_mm"] == pytest.approx(380.0, rel=0.15)
    assert named(ctx)["cell_mm"] == pytest.approx(named(ctx)["neighbourhood_mm"] / 3.0)


def test_labels_by_region_leave_out_what_lies_on_the_plane_but_not_in_the_region(
    tmp_path: Path,
) -> None:
    by_plane, _ = detect(tmp_path / "plane")
    by_region, _ = detect(tmp_path / "region", labels="region")
    on, within = by_plane.labels.plane_index >= 0, by_region.labels.plane_index >= 0
    assert 0.9 < np.mean(within) < np.mean(on)
    assert (
        by_plane.labels.plane_index[within & on] == by_region.labels.plane_index[within & on]
    ).mean() > 0.99


def test_the_scatter_of_normals_follows_noise_and_neighbourhood(tmp_path: Path) -> None:
    wall = Rectangle("wall", (0, 2, 0), (1.5, 0, 0), (0, 0, 1.0), 100_000)
    scatters = []
    for name, size_m in (("narrow", 0.05), ("wide", 0.1)):
        ctx = context(tmp_path / name)
        cloud = cloud_of(sampled((wall,), noise_m=0.003), stations=STATION)
        Region().run(Region.In(cloud=cloud), Region.Params(neighbourhood_m=size_m), ctx)
        scatters.append(named(ctx)["normal_scatter_deg"])
    # A slope's error is s / (extent sqrt(n)), and n is a density times the extent squared: a
    # neighbourhood of half the size scatters four times as much.
    assert scatters[0] == pytest.approx(4.0 * scatters[1], rel=0.2)


@pytest.mark.usefixtures("charts")
def test_normals_are_drawn(tmp_path: Path) -> None:
    _, ctx = detect(tmp_path)
    assert {"normals", "deviations"} <= {figure.name for figure in ctx.figures}
