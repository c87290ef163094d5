"""What every detector of planes must do: truth, invariances, options, refusals."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane import search
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.hough3d import Hough3d
from orthoflow_plugins.plane.ransac import Ransac
from orthoflow_plugins.plane.region import Region
from pydantic import ValidationError

from orthoflow.errors import MethodError
from orthoflow.geometry import angle_between_deg
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import Method, StepContext
from tests.plane_scenes import ROOM, Rectangle, cloud_of, sampled

DETECTORS: dict[str, tuple[type[Method], dict[str, Any]]] = {
    "hough2d": (Hough2d, {}),
    "hough3d": (Hough3d, {}),
    "ransac-msac": (Ransac, {}),
    "ransac-count": (Ransac, {"scoring": "count"}),
    "ransac-a-contrario": (Ransac, {"scoring": "a-contrario"}),
    "region-cube": (Region, {}),
    "region-radius": (Region, {"neighbourhood": "radius"}),
    "region-knn": (Region, {"neighbourhood": "knn"}),
}
STATION = np.array([[0.3, -0.2, 0.1]])
SURVEY = (634512.347, 486215.781, 112.193)

# Half of a room's points fix its planes as well: errors are a fourth of what is asserted, or less,
# but for the table's, which has the fewest. A fourth of them shows which planes are left.
HALF = slice(None, None, 2)
FEW = slice(None, None, 4)

every_detector = pytest.mark.parametrize("detector", DETECTORS)
# The options of a method share its search.
every_method = pytest.mark.parametrize(
    "detector", ["hough2d", "hough3d", "ransac-msac", "region-cube"]
)
# What follows when candidates were found is shared by all methods.
any_method = pytest.mark.parametrize("detector", ["hough2d", "region-cube"])


def detect(
    detector: str,
    cloud: PointCloud,
    folder: Path,
    *,
    seed: int = 0,
    **params: Any,
) -> tuple[Any, StepContext]:
    method, options = DETECTORS[detector]
    folder.mkdir(parents=True, exist_ok=True)
    ctx = StepContext(rng=np.random.default_rng(seed), cores=2, scratch=folder)
    inputs = method.In(cloud=cloud)
    return method().run(inputs, method.Params(**{**options, **params}), ctx), ctx


def nearest(planes: Planes, normal: NDArray[np.float64], centre: NDArray[np.float64]) -> int:
    """The plane that passes nearest to a true one's centre among those with its direction."""
    parallel = np.abs(planes.normal @ normal) > np.cos(np.radians(1.0))
    return int(np.argmin(np.abs(planes.normal @ centre - planes.offset) + 1e6 * ~parallel))


def errors(planes: Planes, truth: Rectangle) -> tuple[float, float]:
    """Angle in degrees and offset at the true centre in metres, of the plane nearest to it."""
    normal, centre = truth.normal, np.array(truth.centre)
    found = planes.plane(nearest(planes, normal, centre))
    angle = angle_between_deg(found.normal, normal)
    return min(angle, 180.0 - angle), abs(float(found.distances_m(centre[None])[0]))


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    cloud = cloud_of(sampled()[HALF], stations=STATION)
    return {name: detect(name, cloud, tmp_path_factory.mktemp(name))[0] for name in DETECTORS}


def same_planes(planes: Planes, expected: Planes) -> None:
    """Each plane within 0.002 degrees and 0.1 mm (at its own middle) of the expected one."""
    assert len(planes) == len(expected)
    for normal, corners in zip(expected.normal, expected.corners, strict=True):
        middle = corners.mean(axis=0)
        index = nearest(planes, normal, middle)
        assert abs(planes.normal[index] @ middle - planes.offset[index]) < 1e-4
        # The table has 1 250 points of 2 mm noise over a metre: other cells, other weights.
        limit_deg = 0.002 if planes.n_points[index] > 2_500 else 0.02
        assert angle_between_deg(planes.normal[index], normal) < limit_deg


@every_detector
def test_every_surface_of_a_room_is_found_and_nothing_else(
    detector: str, rooms: dict[str, Any]
) -> None:
    planes = rooms[detector].planes
    assert len(planes) == len(ROOM)
    for truth in ROOM:
        angle_deg, miss_m = errors(planes, truth)
        assert angle_deg < 0.02, truth.name
        assert miss_m < 2e-4, truth.name  # 2 mm noise over thousands of points
    assert planes.viewpoint == "stations"
    assert (planes.normal @ STATION[0] > planes.offset).all()


@every_detector
def test_labels_name_the_plane_each_point_lies_on(detector: str, rooms: dict[str, Any]) -> None:
    out, start = rooms[detector], 0
    for truth in ROOM:
        index = nearest(out.planes, truth.normal, np.array(truth.centre))
        n_points = truth.n_points // 2
        own = out.labels.plane_index[start : start + n_points]
        # Points in a corner belong to either surface; a strip of some millimetres along the edges.
        assert np.mean(own == index) > 0.98
        start += n_points
    labels = out.labels.plane_index
    counts = np.bincount(labels[labels >= 0], minlength=len(out.planes))
    np.testing.assert_array_equal(counts, out.planes.n_points)


@every_method
def test_shuffled_points_give_the_same_planes(
    detector: str, rooms: dict[str, Any], tmp_path: Path
) -> None:
    points = np.random.default_rng(7).permutation(sampled()[HALF])
    cloud = cloud_of(points, stations=STATION)
    out, _ = detect(detector, cloud, tmp_path)
    same_planes(out.planes, rooms[detector].planes)


@every_method
def test_survey_coordinates_of_a_million_metres_lose_nothing(
    detector: str, rooms: dict[str, Any], tmp_path: Path
) -> None:
    cloud = cloud_of(sampled()[HALF], stations=STATION, origin=SURVEY)
    out, _ = detect(detector, cloud, tmp_path)
    expected = rooms[detector].planes
    np.testing.assert_array_equal(out.planes.normal, expected.normal)
    np.testing.assert_allclose(
        out.planes.offset, expected.offset + expected.normal @ np.array(SURVEY), atol=1e-8
    )


@every_method
def test_five_percent_of_gross_outliers_neither_hide_nor_move_a_wall(
    detector: str, rooms: dict[str, Any], tmp_path: Path
) -> None:
    stray = np.random.default_rng(3).uniform(-400.0, 400.0, (2_200, 3))
    cloud = cloud_of(np.vstack([sampled()[HALF], stray]), stations=STATION)
    out, _ = detect(detector, cloud, tmp_path)
    for truth in ROOM[:6]:
        angle_deg, miss_m = errors(out.planes, truth)
        assert angle_deg < 0.02
        assert miss_m < 2e-4


@every_method
def test_recesses_of_different_depth_are_not_joined_by_a_plane_that_leans(
    detector: str, tmp_path: Path
) -> None:
    door = Rectangle("door", (1.7, 2.12, -0.4), (0.45, 0, 0), (0, 0, 1.1), 12_000)
    niche = Rectangle("niche", (-1.5, 2.25, -0.2), (0.4, 0, 0), (0, 0, 0.9), 10_000)
    cloud = cloud_of(sampled((*ROOM, door, niche))[HALF], stations=STATION)
    out, _ = detect(detector, cloud, tmp_path)
    for truth in (door, niche):
        angle_deg, miss_m = errors(out.planes, truth)
        assert angle_deg < 0.03
        assert miss_m < 2e-4


@every_method
def test_mirror_ghosts_and_furniture_neither_hide_nor_move_the_walls(
    detector: str, tmp_path: Path
) -> None:
    rng = np.random.default_rng(5)
    room = sampled()[HALF]
    # A mirror on the front wall shows the room behind it: 4 % of the points lie where nothing is.
    front = ROOM[0]
    seen = room[rng.choice(len(room), 1_750, replace=False)]
    depth_m = (seen - front.centre) @ front.normal
    ghosts = seen - 2.0 * depth_m[:, None] * front.normal
    boxes = tuple(
        Rectangle(f"box {k}", (x, y, z), a, b, 1_200)
        for k, (x, y, z, a, b) in enumerate(
            [
                (-1.5, 0.4, -1.1, (0.3, 0.1, 0), (0, 0, 0.4)),
                (-1.4, 0.1, -0.7, (0.3, 0.1, 0), (-0.1, 0.3, 0)),
                (1.8, -0.8, -1.2, (0.1, 0.35, 0), (0, 0, 0.3)),
            ]
        )
    )
    points = np.concatenate([room, ghosts, sampled(boxes, seed=6)[HALF]])
    planes = detect(detector, cloud_of(points, stations=STATION), tmp_path)[0].planes
    for truth in ROOM[:6]:
        angle_deg, miss_m = errors(planes, truth)
        assert angle_deg < 0.03
        assert miss_m < 3e-4


@every_method
@pytest.mark.parametrize(
    ("constraint", "count"), [("vertical", 4), ("horizontal", 3)], ids=["walls", "levels"]
)
def test_a_constraint_leaves_only_its_planes(
    detector: str, constraint: str, count: int, tmp_path: Path
) -> None:
    cloud = cloud_of(sampled()[FEW], stations=STATION)
    few = {"constraint": constraint}
    planes = detect(detector, cloud, tmp_path, **few)[0].planes
    rises = np.abs(planes.normal @ planes.up)
    assert len(planes) == count
    assert (rises < 0.1 if constraint == "vertical" else rises > 0.99).all()


@every_method
def test_the_tilt_allowed_decides_about_a_leaning_wall(detector: str, tmp_path: Path) -> None:
    lean = np.radians(6.0)
    wall = Rectangle("wall", (0, 2, 0), (3, 0, 0), (0, np.sin(lean), np.cos(lean)), 20_000)
    cloud = cloud_of(sampled((wall, ROOM[4]))[FEW])
    keep = detect(detector, cloud, tmp_path, constraint="vertical", max_tilt_deg=8.0)[0]
    assert errors(keep.planes, wall)[0] < 0.02
    with pytest.raises(MethodError, match="no plane was found in"):
        detect(detector, cloud, tmp_path, constraint="vertical", max_tilt_deg=4.0)


@any_method
def test_exact_walls_are_exactly_vertical_and_floors_exactly_level(
    detector: str, tmp_path: Path
) -> None:
    cloud = cloud_of(sampled()[FEW], stations=STATION)
    planes = detect(detector, cloud, tmp_path, exact=True)[0].planes
    rises = np.abs(planes.normal @ planes.up)
    assert (np.minimum(rises, 1.0 - rises) < 1e-12).all()


@any_method
def test_parts_that_do_not_touch_are_one_plane_only_on_demand(
    detector: str, tmp_path: Path
) -> None:
    pair = (
        Rectangle("west", (-3, 2, 0), (1, 0, 0), (0, 0, 1.5), 8_000),
        Rectangle("east", (3, 2, 0), (1.5, 0, 0), (0, 0, 1.5), 9_000),
    )
    cloud = cloud_of(sampled(pair))
    joined = detect(detector, cloud, tmp_path)[0].planes
    apart = detect(detector, cloud, tmp_path, join_parts=False)[0].planes
    assert (len(joined), len(apart)) == (1, 2)
    assert joined.part_plane is not None
    assert joined.part_plane.tolist() == [0, 0]
    widths = np.linalg.norm(apart.corners[:, 3] - apart.corners[:, 0], axis=1)
    np.testing.assert_allclose(widths, [3.0, 2.0], atol=0.1)


@any_method
def test_thinning_finds_the_same_planes_and_labels_every_point(
    detector: str, rooms: dict[str, Any], tmp_path: Path
) -> None:
    cloud = cloud_of(sampled()[HALF], stations=STATION)
    out, _ = detect(detector, cloud, tmp_path, thinning=5)
    front = ROOM[0]
    angle_deg, miss_m = errors(out.planes, front)
    assert angle_deg < 0.02
    assert miss_m < 3e-4
    index = nearest(out.planes, front.normal, np.array(front.centre))
    assert np.mean(out.labels.plane_index[: front.n_points // 2] == index) > 0.97
    assert out.planes.n_points.sum() == np.count_nonzero(out.labels.plane_index >= 0)


@every_method
@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.outer(np.linspace(0, 5, 500), [1.0, 2.0, 0.5]), "lie on one line"),
        (np.ones((500, 3)), "coincide"),
    ],
    ids=["collinear", "duplicates"],
)
def test_points_that_fix_no_plane_are_refused(
    detector: str, points: NDArray[np.float64], message: str, tmp_path: Path
) -> None:
    with pytest.raises(MethodError, match=message):
        detect(detector, cloud_of(points), tmp_path)


@every_method
def test_clutter_alone_is_no_plane(detector: str, tmp_path: Path) -> None:
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (10_000, 3))
    method = DETECTORS[detector][0].id
    with pytest.raises(MethodError, match=rf"no plane was found in .* \({re.escape(method)}\)"):
        detect(detector, cloud_of(points), tmp_path)


@any_method
def test_a_tolerance_below_the_noise_is_answered_with_one_that_does(
    detector: str, tmp_path: Path
) -> None:
    cloud = cloud_of(sampled(noise_m=0.006)[FEW], stations=STATION)
    with pytest.raises(MethodError, match="no plane was found") as refusal:
        detect(detector, cloud, tmp_path, tolerance_m=0.005)
    advice = re.search(r"with tolerance_m ([\d.]+) one is found", str(refusal.value))
    assert advice is not None, refusal.value
    assert detect(detector, cloud, tmp_path, tolerance_m=float(advice[1]))[0].planes


@any_method
def test_a_fit_tolerance_above_the_find_tolerance_is_refused(detector: str) -> None:
    with pytest.raises(ValidationError, match=r"must be at most tolerance_m = 0\.01"):
        DETECTORS[detector][0].Params(tolerance_m=0.01, fit_tolerance_m=0.02)


def test_a_part_of_a_large_cloud_is_fitted_whatever_the_number_of_threads(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    cloud = cloud_of(np.random.default_rng(0).permutation(sampled()), stations=STATION)

    def found(cores: int) -> Planes:
        ctx = StepContext(rng=np.random.default_rng(0), cores=cores, scratch=tmp_path)
        planes: Planes = Ransac().run(Ransac.In(cloud=cloud), Ransac.Params(), ctx).planes
        return planes

    whole = found(1)
    # 88 000 points in blocks of 256: one of three blocks is fitted.
    monkeypatch.setattr(search, "_FITTED_MOST", 25_000)
    one, three = found(1), found(3)
    np.testing.assert_array_equal(one.normal, three.normal)
    np.testing.assert_array_equal(one.offset, three.offset)
    assert not np.array_equal(one.offset, whole.offset)
    for truth in ROOM[:6]:
        angle_deg, miss_m = errors(one, truth)
        assert angle_deg < 0.02
        assert miss_m < 3e-4  # a third of the points: 1.7 times the error of all of them


@pytest.mark.parametrize("detector", sorted(DETECTORS))
def test_the_fit_follows_a_tolerance_below_its_default(detector: str) -> None:
    params = DETECTORS[detector][0].Params(tolerance_m=0.01)
    # What is recorded is given back as it is when the step runs, and by a replay.
    again = type(params).model_validate_json(params.model_dump_json(), strict=True)
    assert again == params
    assert again.tolerances_m(0.0, 0.0) == (0.01, 0.01)
    assert DETECTORS[detector][0].Params(tolerance_m=0.02).tolerances_m(0.0, 0.0) == (0.02, 0.015)
