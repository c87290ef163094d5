"""Parts of single detectors: accumulators, scores, regions and comparators."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.cloud import prepare
from orthoflow_plugins.plane.comparators import Open3dPatches, Open3dRansac, load_open3d
from orthoflow_plugins.plane.hough import (
    SpaceProposer,
    directions_over,
    normals_of,
)
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.hough3d import Hough3d
from orthoflow_plugins.plane.ransac import (
    Ransac,
    curve_order,
    draw_hypotheses,
    fewest_false_alarms,
)
from orthoflow_plugins.plane.region import Region, RegionProposer
from orthoflow_plugins.plane.voxels import (
    HALF_STEPS,
    Neighbourhood,
    surface_voxels,
)
from pydantic import ValidationError
from scipy.spatial import KDTree

from orthoflow.errors import PluginError
from orthoflow.geometry import angle_between_deg
from orthoflow.sdk import Method
from tests import plane_scenes
from tests.long_loops import long_only
from tests.plane_scenes import (
    FIT_TOLERANCE_M,
    ROOM,
    STATION,
    TOLERANCE_M,
    Rectangle,
    cloud_of,
    detect,
    expect,
    prepared,
    sampled,
    search_in,
    turned,
)


@pytest.mark.parametrize(
    ("method", "options", "n_true"),
    [
        # If each cell votes once, floor and ceiling obscure the walls next to them.
        (Hough2d, {"accumulator": "unit"}, 1),
        (Hough2d, {"accumulator": "canny"}, 1),
        # "Identical result, considerably longer" (markiewicz2015).
        (Hough2d, {"coordinates": "raw"}, 7),
        (Hough3d, {"search": "full", "cell_m": 0.03, "angle_step_deg": 1.5}, 7),
        (Hough3d, {"coordinates": "raw"}, 7),
    ],
    ids=str,
)
def test_other_ways_to_vote_find_the_same_walls(
    method: Any, options: dict[str, Any], n_true: int, tmp_path: Path
) -> None:
    cloud = cloud_of(sampled()[::2], stations=STATION)
    planes = detect(method, cloud, tmp_path, **options)[0].planes
    assert len(planes) >= n_true
    expect(planes, ROOM[:n_true], 0.02)


def test_raw_coordinates_with_one_vote_per_cell_are_refused() -> None:
    with pytest.raises(ValidationError, match="accumulator: counts"):
        Hough2d.Params(coordinates="raw", accumulator="unit")


@pytest.mark.parametrize("method", [Hough2d, Hough3d])
def test_floor_and_ceiling_alone_are_found_once_each(method: Any, tmp_path: Path) -> None:
    planes = detect(method, cloud_of(sampled(ROOM[4:6])), tmp_path)[0].planes
    assert sorted(planes.names) == ["ceiling 1", "floor 0"]


def test_a_perfectly_flat_wall_is_found(tmp_path: Path) -> None:
    cloud = cloud_of(sampled(ROOM[1:2], noise_m=0.0))
    planes = detect(Hough2d, cloud, tmp_path)[0].planes
    np.testing.assert_allclose(np.abs(planes.normal[0]), [0, 1, 0], atol=1e-7)
    assert abs(planes.offset[0]) == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize(
    ("method", "options", "step_deg"),
    [(Hough2d, {}, 1.0), (Hough3d, {"search": "full", "angle_step_deg": 2.0}, 2.0)],
)
def test_the_plain_maximum_lies_in_the_middle_of_a_bin_and_of_a_step(
    method: Any, options: dict[str, Any], step_deg: float, tmp_path: Path
) -> None:
    """markiewicz2015 uses the centre of the fullest bin, off by up to half a bin and step."""
    turn = turned(17.37)
    cloud = cloud_of(sampled()[::2] @ turn.T, stations=STATION)
    found = []
    for scoring in ("votes", "contrast"):
        given = {"scoring": scoring, "constraint": "vertical", "min_share": 0.02, **options}
        planes = detect(method, cloud, tmp_path, **given)[0].planes
        raw = planes.details["raw"][0]
        normal = np.array(raw["normal"])
        omega_deg = np.degrees(np.arctan2(normal[1], normal[0])) / step_deg
        found.append(omega_deg)
        assert angle_between_deg(normal, planes.normal[0]) < 0.75 * step_deg + 0.4
        middle = planes.corners[0].mean(axis=0)
        assert abs(normal @ middle - raw["offset_m"]) < 0.04
    assert found[0] == pytest.approx(round(found[0]), abs=1e-6)
    assert found[1] != pytest.approx(round(found[1]), abs=1e-3)


# --- all directions ---


@pytest.mark.parametrize("slope_deg", [15.0, 45.0, 70.0])
def test_a_slope_is_found_whatever_its_inclination(slope_deg: float, tmp_path: Path) -> None:
    slope = np.radians(slope_deg)
    roof = Rectangle("roof", (0, 0, 3), (3, 0, 0), (0, np.cos(slope), np.sin(slope)), 20_000)
    planes = detect(Hough3d, cloud_of(sampled((roof, ROOM[4]))), tmp_path)[0].planes
    expect(planes, (roof, ROOM[4]), 0.05)


@pytest.mark.parametrize("step_deg", [1.0, 5.0])
def test_directions_cover_the_hemisphere_evenly_and_the_pole_once(step_deg: float) -> None:
    normals = normals_of(*directions_over(round(180.0 / step_deg), "any", 10.0).T)
    wanted = np.random.default_rng(0).normal(size=(2_000, 3))
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    chords, _ = KDTree(np.vstack([normals, -normals])).query(wanted)
    nearest_deg = np.degrees(2.0 * np.arcsin(0.5 * chords))
    assert nearest_deg.max() < 1.1 * step_deg
    assert np.count_nonzero(np.abs(normals[:, 2]) > np.cos(np.radians(0.5 * step_deg))) == 1
    # Each direction has a square of one step of the hemisphere's solid angle of 2 pi.
    assert len(normals) == pytest.approx(2.0 * np.pi / np.radians(step_deg) ** 2, rel=0.1)


def test_voxels_grow_where_a_scene_would_have_too_many() -> None:
    search = search_in(prepared(np.random.default_rng(0).uniform(-300.0, 300.0, (20_000, 3))))
    proposer = SpaceProposer(search, Hough3d.Params(angle_step_deg=5.0, min_share=0.05))
    assert proposer.bin_m > 0.3
    found = proposer.propose(search)
    assert found is None or proposer.votes.nbytes < 500_000_000


UP = np.array([0.0, 0.0, 1.0])


def test_the_plan_model_finds_the_walls_and_lets_them_lean(tmp_path: Path) -> None:
    cloud = cloud_of(sampled(), stations=STATION)
    planes = detect(Ransac, cloud, tmp_path, model="2d")[0].planes
    assert len(planes) == 4
    assert abs(planes.normal[0] @ UP) == pytest.approx(np.sin(np.radians(0.4)), abs=2e-4)
    raw = np.array([item["normal"] for item in planes.details["raw"]])
    np.testing.assert_allclose(raw @ UP, 0.0, atol=1e-9)
    with pytest.raises(ValidationError, match="model: 2d finds only vertical planes"):
        Ransac.Params(model="2d", constraint="horizontal")


@pytest.mark.parametrize("noise_m", [*long_only(0.001), 0.005])
@pytest.mark.usefixtures("all_places")
def test_the_tolerance_found_by_itself_follows_the_noise(noise_m: float, tmp_path: Path) -> None:
    cloud = cloud_of(sampled(noise_m=noise_m)[::2], stations=STATION)
    out, ctx = detect(Ransac, cloud, tmp_path, scoring="a-contrario")
    own_m = {m.name: m.value for m in ctx.metrics}["own_tolerance_mm"] / 1000.0
    # In a normal distribution, 2 sigma contain 95 %, and each further millimetre adds too little.
    assert 1.3 * noise_m < own_m < 3.5 * noise_m
    assert out.planes.details["raw"][0]["own_tolerance_m"] == pytest.approx(own_m)
    # The other scores keep the given tolerance.
    out, ctx = detect(Ransac, cloud, tmp_path)
    assert "own_tolerance_mm" not in {metric.name for metric in ctx.metrics}
    assert out.planes.details["raw"][0]["own_tolerance_m"] is None


def test_chance_alone_is_not_meaningful_a_contrario_and_a_wall_is() -> None:
    rng = np.random.default_rng(0)
    background_m = rng.uniform(-2.0, 2.0, 5_000)
    both = np.concatenate([background_m, rng.normal(0.0, 0.002, 500)])
    alone, found = (
        fewest_false_alarms(counts[None], 0.05, int(n_points), np.array([4.0]), 3)
        for values, n_points in ((background_m, 5_000), (both, 5_500))
        for counts in (np.histogram(np.abs(values), 100, (0.0, 0.05))[0],)
    )
    assert alone.value[0] < 0.0
    assert found.value[0] > 100.0
    assert 0.003 < found.tolerance_m[0] < 0.007


def test_hypotheses_pass_through_points_near_each_other() -> None:
    rng = np.random.default_rng(0)
    points_m = sampled()[::10]
    points = points_m[curve_order(points_m)]
    drawn = draw_hypotheses(points, 1_000, "3d", UP, rng)
    normals, offsets_m = drawn[:, :3], drawn[:, 3]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    distances_m = np.abs(points @ normals.T - offsets_m)
    assert ((distances_m < 1e-9).sum(axis=0) >= 3).all()
    # Three random points are on the table, which has 3 % of the points, once in 40,000 times.
    table_m = np.abs(offsets_m * normals[:, 2] + 0.75)
    assert np.mean((np.abs(normals[:, 2]) > 0.999) & (table_m < 0.01)) > 0.001


@pytest.mark.parametrize("thinning", [1, 3])
def test_without_refit_planes_stay_as_the_detector_gave_them(tmp_path: Path, thinning: int) -> None:
    cloud = cloud_of(sampled()[::2], stations=STATION)
    planes, fitted = (
        detect(Ransac, cloud, tmp_path, refit=refit, thinning=thinning)[0].planes
        for refit in (False, True)
    )
    assert len(planes) == len(fitted)
    for k, raw in enumerate(planes.details["raw"]):
        np.testing.assert_allclose(planes.normal[k], raw["normal"], atol=1e-12)
        assert planes.offset[k] == pytest.approx(raw["offset_m"], abs=1e-12)
    front = ROOM[0].normal
    apart = [
        min(angle_between_deg(each.normal[0], sign * front) for sign in (1.0, -1.0))
        for each in (planes, fitted)
    ]
    assert apart[1] < 0.02 < apart[0] < 1.0


# --- open3d ---


@pytest.mark.usefixtures("_open3d")
@pytest.mark.parametrize("method", [Open3dRansac, Open3dPatches])
def test_comparators_find_the_large_planes_of_a_room(method: type[Method], tmp_path: Path) -> None:
    cloud = cloud_of(sampled()[::2], stations=STATION)
    out, _ = detect(method, cloud, tmp_path / "all")
    # Chance decides whether open3d finds small planes, and its patches need a higher density.
    expect(out.planes, (ROOM[0], ROOM[4], ROOM[5]), 0.03)
    own = out.labels.plane_index[: ROOM[0].n_points // 2]
    assert np.mean(own == np.bincount(own[own >= 0]).argmax()) > 0.97
    # With a constraint, the planes that open3d finds first are skipped.
    planes = detect(method, cloud, tmp_path, constraint="horizontal")[0].planes
    assert len(planes) >= 2
    assert (np.abs(planes.normal @ planes.up) > 0.99).all()


def test_an_open3d_that_is_missing_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(PluginError, match=r"plane\.x needs open3d, which is not installed: .* pip"):
        load_open3d("plane.x")


VIEWER = np.array([[0.0, -1.5, 0.0]])
CUBE = Neighbourhood(shape="cube", size_m=0.15, n_points=30, voxel_m=0.05)
# The wall has a niche a quarter of a metre deep, and a floor in front of it.
WALL = Rectangle("wall", (0, 2, 0), (1.5, 0, 0), (0, 0, 1.0), 60_000)
NICHE = Rectangle("niche", (2.0, 2.25, 0), (0.4, 0, 0), (0, 0, 0.8), 13_000)
FLOOR = Rectangle("floor", (0, 1, -1.0), (1.5, 0, 0), (0, 1, 0), 20_000)


def grown(points: NDArray[np.float64], min_share: float, **params: Any) -> RegionProposer:
    """Return the regions of a cloud in cubes of 15 cm; each has at least a fifth of `min_share`."""
    cloud = cloud_of(points, stations=VIEWER)
    search = search_in(prepare(cloud, TOLERANCE_M, FIT_TOLERANCE_M, parts=1))
    settled = {"neighbourhood_m": 0.15, "min_share": min_share, **params}
    return RegionProposer(search, Region.Params(**settled))


def detect_regions(
    points: NDArray[np.float64], folder: Path, **params: Any
) -> tuple[Any, dict[str, float]]:
    cloud = cloud_of(points, stations=VIEWER)
    out, ctx = plane_scenes.detect(Region, cloud, folder, **params)
    return out, {metric.name: metric.value for metric in ctx.metrics}


def test_voxels_and_wider_ones_hold_the_moments_of_their_points() -> None:
    points = sampled((WALL, NICHE))[::7]
    cloud = prepared(points)
    voxels = surface_voxels(cloud, CUBE)
    wide, of_member = voxels.table.coarser(np.arange(len(voxels.counts)))
    assert wide.voxel_m == 2.0 * voxels.table.voxel_m
    voxel_of = voxels.table.voxel_of(cloud.points)
    inside = voxel_of >= 0
    assert inside.mean() > 0.99  # the robust box may exclude a few points at its edge
    # The kernels find the wide voxel of each point.
    wide_of = wide.voxel_of(cloud.points)[inside]
    np.testing.assert_array_equal(wide_of, of_member[voxel_of[inside]])
    for table, of_point in ((voxels.table, voxel_of[inside]), (wide, wide_of)):
        n_points = np.bincount(of_point)
        np.testing.assert_array_equal(table.sums[:, 0], n_points)
        means = np.column_stack([np.bincount(of_point, axis) for axis in points[inside].T])
        # Positions in a voxel are stored in steps.
        step_m = table.voxel_m / HALF_STEPS
        centroids = table.centroids() @ table.basis
        np.testing.assert_allclose(centroids, means / n_points[:, None], atol=0.6 * step_m)


@pytest.mark.parametrize(
    ("shape", "size_m", "count"),
    [("cube", 0.03, 27), ("cube", 0.01, 1), ("cube", 0.05, 125), ("radius", 0.02, 33)],
)
def test_neighbourhoods_have_the_cells_of_their_shape(
    shape: Any, size_m: float, count: int
) -> None:
    around = Neighbourhood(shape=shape, size_m=size_m, n_points=9, voxel_m=0.01).around()
    assert len(around) == count - 1  # the voxel itself is not listed
    assert (np.diff(around[:, 3]) >= 0).all()


def test_a_region_is_fitted_by_total_least_squares_through_its_points() -> None:
    lean = np.radians(7.0)
    wall = Rectangle("lean", (1, 3, 2), (2, 0, 0), (0, np.sin(lean), np.cos(lean)), 80_000)
    points = sampled((wall,), noise_m=0.001)
    (plane,) = grown(points, 0.005).planes.values()
    expected = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    # A few voxels at the edges are not in the region, and positions are rounded to 50 micrometres.
    assert min(angle_between_deg(plane.normal, s * expected) for s in (1, -1)) < 0.002
    assert abs(plane.distances_m(points.mean(axis=0)[None])[0]) < 2e-5


def test_a_thinly_scanned_wall_beside_a_dense_one_is_one_region() -> None:
    # Its points are a decimetre apart, so neighbourhoods of 10 cm, which suit the dense wall,
    # contain one of them.
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
    # The region lacks only the voxels at the step, whose neighbourhoods are inclined.
    assert either_depth.n_points.max() > 0.85 * 55_000


def test_the_paper_s_preset_does_not_tell_a_niche_from_its_wall(tmp_path: Path) -> None:
    """As in Figure 8, normals alone contain no depth."""
    points = sampled((WALL, NICHE, FLOOR), noise_m=2e-5)
    paper, metrics = detect_regions(points, tmp_path / "paper", preset="paper", thinning=1)
    ours, by_region = (
        detect_regions(points, tmp_path / labels, labels=labels)[0].labels.plane_index
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
    # The raw plane is between the two, like R in Table 1; the common fit is on the wall.
    raw = paper.planes.details["raw"][wall]
    between_m = abs(np.array(raw["normal"]) @ (0, 2, 0) - raw["offset_m"])
    assert 0.02 < between_m < 0.1
    assert abs(paper.planes.normal[wall] @ (0, 2, 0) - paper.planes.offset[wall]) < 1e-4
    assert metrics["neighbourhood_mm"] >= 10.0
    # Labels by region exclude points that are on the plane but not in the region.
    on, within = ours >= 0, by_region >= 0
    assert 0.9 < np.mean(within) < np.mean(on)
    assert (ours[within & on] == by_region[within & on]).mean() > 0.99
    settings = Region.Params(preset="paper", angle_deg=2.0)
    assert (settings.criterion, settings.thinning, settings.neighbourhood_m) == ("normal", 10, 0.01)
    assert (settings.angle_deg, settings.labels) == (2.0, "region")
    assert Region.Params().criterion == "normal-and-distance"


def test_neighbourhoods_follow_the_density(tmp_path: Path) -> None:
    thin = Rectangle("thin", (0, 2, 0), (3, 0, 0), (0, 0, 1.5), 2_000)  # 111 points per m2
    _, metrics = detect_regions(sampled((thin,)), tmp_path)
    # With 111 points per m2, a neighbourhood of 16 points has 38 cm.
    assert metrics["neighbourhood_mm"] == pytest.approx(380.0, rel=0.15)
    assert metrics["cell_mm"] == pytest.approx(metrics["neighbourhood_mm"] / 3.0)
