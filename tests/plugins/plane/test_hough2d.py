"""`plane.hough2d` finds the true planes, wherever they lie and however the points are ordered."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from orthoflow_plugins.plane.hough2d import Hough2d, PlanProposer
from pydantic import ValidationError

from orthoflow.errors import MethodError, ProductError
from orthoflow.geometry import angle_between_deg, frame_over
from orthoflow.products import Planes, PointCloud
from tests.plane_scenes import (
    ROOM,
    Rectangle,
    cloud_of,
    context,
    prepared,
    sampled,
    search_in,
    turned,
)

STATION = np.array([[0.3, -0.2, 0.1]])
SURVEY = (634512.347, 486215.781, 112.193)


def detect(cloud: PointCloud, folder: Path, *, cores: int = 2, **params: object) -> Hough2d.Out:
    return Hough2d().run(
        Hough2d.In(cloud=cloud), Hough2d.Params(**params), context(folder, cores=cores)
    )


def nearest(planes: Planes, normal: NDArray[np.float64], centre: NDArray[np.float64]) -> int:
    """The plane that passes nearest to a true one's centre among those with its direction."""
    angles = np.array([angle_between_deg(found, normal) for found in planes.normal])
    angles = np.minimum(angles, 180.0 - angles)
    misses = np.abs(planes.normal @ centre - planes.offset)
    return int(np.argmin(misses + np.where(angles < 1.0, 0.0, 1e6)))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Hough2d.Out:
    # To the last point: by the paper's rule the table, 3 % of the points, would be left.
    cloud = cloud_of(sampled(), stations=STATION)
    return detect(cloud, tmp_path_factory.mktemp("room"))


@pytest.mark.parametrize("truth", ROOM, ids=lambda truth: truth.name)
def test_every_surface_of_a_room_is_found_within_its_sigma(
    truth: Rectangle, room: Hough2d.Out
) -> None:
    index = nearest(room.planes, truth.normal, np.array(truth.centre))
    found = room.planes.plane(index)
    angle = angle_between_deg(found.normal, truth.normal)
    miss_m = abs(float(found.distances_m(np.array([truth.centre]))[0]))
    assert min(angle, 180.0 - angle) < 0.02
    assert miss_m < 2e-4  # 2 mm noise over thousands of points, mostly below 0.03 mm
    at_centre = np.append(truth.centre, -1.0)
    sigma_m = float(np.sqrt(at_centre @ room.planes.covariance[index] @ at_centre))
    assert miss_m < 5.0 * sigma_m


def test_planes_are_ordered_by_support_and_named_by_position(room: Hough2d.Out) -> None:
    planes = room.planes
    assert (np.diff(planes.n_points) <= 0).all()
    assert planes.names[0] == "wall 0"
    kinds = [name.split()[0] for name in planes.names]
    assert list(planes.names) == [f"{kind} {place}" for place, kind in enumerate(kinds)]
    floor, ceiling = kinds.index("floor"), kinds.index("ceiling")
    assert planes.normal[floor] @ planes.up > 0.99 > -0.99 > planes.normal[ceiling] @ planes.up
    assert [name for name in planes.names if name.startswith("level")] == [
        f"level {nearest(planes, ROOM[6].normal, np.array(ROOM[6].centre))}"
    ]


def test_normals_point_to_the_station_inside_the_room(room: Hough2d.Out) -> None:
    assert room.planes.viewpoint == "stations"
    assert (room.planes.normal @ STATION[0] > room.planes.offset).all()


def test_rectangles_hold_the_entire_wall_and_little_more(room: Hough2d.Out) -> None:
    frame = frame_over(room.planes.corners[0], room.planes.normal[0], gsd_m=0.01)
    assert frame.u_world @ (1.0, 0.0, 0.0) > 0.99  # the front wall seen from inside: east is right
    front = sampled()[: ROOM[0].n_points]
    placed = frame.wall_from_world(front)
    assert (placed[:, 0] >= -0.1).all()
    assert (placed[:, 0] <= frame.width + 0.1).all()
    assert (placed[:, 1] >= -0.1).all()
    assert (placed[:, 1] <= frame.height + 0.1).all()
    assert frame.width * 0.01 == pytest.approx(6.0, abs=0.02)
    assert frame.height * 0.01 == pytest.approx(3.0, abs=0.02)


def test_labels_name_the_plane_each_point_lies_on(room: Hough2d.Out) -> None:
    labels = room.labels.plane_index
    start = 0
    for truth in ROOM:
        index = nearest(room.planes, truth.normal, np.array(truth.centre))
        own = labels[start : start + truth.n_points]
        # Points in a corner belong to either surface; a strip of some millimetres along the edges.
        assert np.mean(own == index) > 0.985
        start += truth.n_points
    counts = np.bincount(labels[labels >= 0], minlength=len(room.planes))
    np.testing.assert_array_equal(counts, room.planes.n_points)


def test_labelled_points_lie_within_the_find_tolerance(room: Hough2d.Out) -> None:
    labels, points = room.labels.plane_index, sampled()
    on_plane = labels >= 0
    normals, offsets = room.planes.normal[labels], room.planes.offset[labels]
    distances = np.einsum("ij,ij->i", points, normals) - offsets
    assert np.abs(distances[on_plane]).max() < 0.05 + 1e-6
    first = distances[labels == 0]
    assert room.planes.rms_m[0] == pytest.approx(np.sqrt(np.mean(first**2)), abs=2e-6)


@pytest.mark.parametrize("angle_deg", [0.5, 33.3, 90.0, 179.6, 271.0])
def test_a_turned_room_gives_the_turned_planes(
    angle_deg: float, room: Hough2d.Out, tmp_path: Path
) -> None:
    turn = turned(angle_deg)
    cloud = cloud_of(sampled() @ turn.T, stations=STATION @ turn.T)
    moved = detect(cloud, tmp_path).planes
    assert len(moved) == len(room.planes)
    for normal, corners in zip(room.planes.normal, room.planes.corners, strict=True):
        middle = turn @ corners.mean(axis=0)
        index = nearest(moved, turn @ normal, middle)
        # The small table, 2 500 points of 2 mm noise over one metre, moves most.
        assert angle_between_deg(moved.normal[index], turn @ normal) < 0.01
        assert moved.normal[index] @ middle == pytest.approx(moved.offset[index], abs=1e-4)


def test_survey_coordinates_lose_nothing(room: Hough2d.Out, tmp_path: Path) -> None:
    cloud = cloud_of(sampled(), stations=STATION, origin=SURVEY)
    moved = detect(cloud, tmp_path).planes
    np.testing.assert_array_equal(moved.normal, room.planes.normal)
    shifted = room.planes.offset + room.planes.normal @ np.array(SURVEY)
    np.testing.assert_allclose(moved.offset, shifted, atol=1e-8)  # metres; 0.05 mm are allowed
    np.testing.assert_allclose(moved.corners, room.planes.corners + SURVEY, atol=1e-8)


def test_another_origin_of_the_offsets_gives_the_same_plane(
    room: Hough2d.Out, tmp_path: Path
) -> None:
    shift = np.array([12.3, -4.56, 0.78])
    cloud = dataclasses.replace(
        cloud_of(sampled() + shift, stations=STATION + shift), origin=-shift, stations=STATION
    )
    moved = detect(cloud, tmp_path).planes
    assert angle_between_deg(moved.normal[0], room.planes.normal[0]) < 0.002
    assert moved.offset[0] == pytest.approx(room.planes.offset[0], abs=5e-5)


def test_shuffled_points_give_the_same_planes(room: Hough2d.Out, tmp_path: Path) -> None:
    order = np.random.default_rng(7).permutation(len(sampled()))
    cloud = cloud_of(sampled()[order], stations=STATION)
    planes = detect(cloud, tmp_path).planes
    np.testing.assert_allclose(planes.normal, room.planes.normal, atol=3e-5)  # 0.002 degrees
    np.testing.assert_allclose(planes.offset, room.planes.offset, atol=1e-4)


def test_the_number_of_threads_does_not_change_a_bit(tmp_path: Path) -> None:
    cloud = cloud_of(sampled())
    one = detect(cloud, tmp_path / "one", cores=1)
    three = detect(cloud, tmp_path / "three", cores=3)
    np.testing.assert_array_equal(one.labels.plane_index, three.labels.plane_index)
    for name in ("normal", "offset", "corners", "covariance", "rms_m"):
        np.testing.assert_array_equal(getattr(one.planes, name), getattr(three.planes, name))


def test_up_may_be_another_axis(room: Hough2d.Out, tmp_path: Path) -> None:
    swap = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])  # (x, y, z) -> (y, z, x): up is y
    cloud = cloud_of(sampled() @ swap.T, up=(0.0, 1.0, 0.0), stations=STATION @ swap.T)
    moved = detect(cloud, tmp_path).planes
    assert angle_between_deg(moved.normal[0], swap @ room.planes.normal[0]) < 0.005
    assert set(moved.names) == set(room.planes.names)


def test_gross_outliers_neither_hide_nor_move_the_wall(room: Hough2d.Out, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    stray = rng.uniform(-400.0, 400.0, (4_000, 3))
    planes = detect(cloud_of(np.vstack([sampled(), stray]), stations=STATION), tmp_path).planes
    assert angle_between_deg(planes.normal[0], room.planes.normal[0]) < 0.005
    assert planes.offset[0] == pytest.approx(room.planes.offset[0], abs=5e-5)


@pytest.mark.parametrize(
    "options",
    [{"accumulator": "unit"}, {"accumulator": "canny"}, {"coordinates": "raw"}],
    ids=lambda options: "-".join(options.values()),
)
def test_other_accumulators_find_the_densest_wall(
    options: dict[str, str], room: Hough2d.Out, tmp_path: Path
) -> None:
    planes = detect(cloud_of(sampled(), stations=STATION), tmp_path, **options).planes
    index = nearest(planes, ROOM[0].normal, np.array(ROOM[0].centre))
    assert angle_between_deg(planes.normal[index], room.planes.normal[0]) < 0.005
    assert planes.offset[index] == pytest.approx(room.planes.offset[0], abs=5e-5)
    if "coordinates" in options:
        assert len(planes) == 7  # "identical result, considerably longer" (markiewicz2015)


def test_the_unit_accumulator_has_the_weaker_maximum(tmp_path: Path) -> None:
    # Half of the floor's cells lie along any line through the room: a wall hardly stands out.
    search = search_in(prepared(sampled(ROOM[:5]), cell_m=0.02, counts_plan=True))
    shares = []
    for accumulator in ("counts", "unit"):
        proposer = PlanProposer(search, Hough2d.Params(accumulator=accumulator))
        proposer.propose(search)
        votes = proposer.first
        assert votes is not None
        shares.append(votes.max() / votes.sum(axis=1).max())
    assert shares[0] > 2.0 * shares[1]


def test_raw_coordinates_with_one_vote_per_cell_are_refused() -> None:
    with pytest.raises(ValidationError, match="coordinates: raw goes with accumulator: counts"):
        Hough2d.Params(coordinates="raw", accumulator="unit")


def test_floor_and_ceiling_alone_leave_no_smeared_wall(tmp_path: Path) -> None:
    planes = detect(cloud_of(sampled(ROOM[4:6])), tmp_path).planes
    assert sorted(planes.names) == ["ceiling 1", "floor 0"]


def test_the_vertical_constraint_finds_walls_only(tmp_path: Path) -> None:
    planes = detect(cloud_of(sampled(), stations=STATION), tmp_path, constraint="vertical").planes
    assert len(planes) == 4
    assert all(name.startswith("wall") for name in planes.names)


def test_a_rounded_body_is_no_wall(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    around = rng.uniform(0.0, 2.0 * np.pi, 30_000)
    barrel = np.column_stack(
        [0.6 * np.cos(around), 0.6 * np.sin(around), rng.uniform(0, 2, 30_000)]
    )
    with pytest.raises(MethodError, match=r"\(1.2 x 1.2 x 2 m\) with tolerance_m"):
        detect(cloud_of(barrel), tmp_path)
    with pytest.raises(MethodError, match=r"is small: is unit of read.scan right\? .* 0.1 m wide"):
        detect(cloud_of(0.1 * barrel), tmp_path)


def test_the_search_stops_when_few_points_remain(tmp_path: Path) -> None:
    cloud = cloud_of(sampled(), stations=STATION)
    early = detect(cloud, tmp_path / "early", stop_unclassified_share=0.6)
    share = np.mean(early.labels.plane_index < 0)
    assert share < 0.6
    smallest = early.planes.n_points[-1] / len(cloud)
    assert share + smallest >= 0.6  # one plane fewer would not have done


def test_no_more_planes_than_allowed(tmp_path: Path) -> None:
    planes = detect(cloud_of(sampled()), tmp_path, n_planes_max=2).planes
    assert len(planes) == 2


def test_exact_walls_are_exactly_vertical_and_floors_exactly_level(tmp_path: Path) -> None:
    planes = detect(cloud_of(sampled(), stations=STATION), tmp_path, exact=True).planes
    rises = np.abs(planes.normal @ planes.up)
    assert (np.minimum(rises, 1.0 - rises) < 1e-12).all()


def test_coplanar_walls_that_do_not_touch_are_one_plane_of_two_parts(tmp_path: Path) -> None:
    pair = (
        Rectangle("west", (-3, 2, 0), (1, 0, 0), (0, 0, 1.5), 8_000),
        Rectangle("east", (3, 2, 0), (1.5, 0, 0), (0, 0, 1.5), 9_000),
    )
    planes = detect(cloud_of(sampled(pair)), tmp_path).planes
    assert len(planes) == 1
    assert planes.part_corners is not None
    widths = np.linalg.norm(planes.part_corners[:, 3] - planes.part_corners[:, 0], axis=1)
    np.testing.assert_allclose(sorted(widths), [2.0, 3.0], atol=0.15)
    assert np.linalg.norm(planes.corners[0, 3] - planes.corners[0, 0]) == pytest.approx(
        8.5, abs=0.15
    )


def test_recesses_of_different_depth_are_not_joined_by_a_plane_that_leans(tmp_path: Path) -> None:
    # Near both runs a plane 2.5 degrees off that holds more points than either, even within 15 mm.
    door = Rectangle("door", (1.7, 2.12, -0.4), (0.45, 0, 0), (0, 0, 1.1), 12_000)
    niche = Rectangle("niche", (-1.5, 2.25, -0.2), (0.4, 0, 0), (0, 0, 0.9), 10_000)
    planes = detect(
        cloud_of(sampled((*ROOM, door, niche)), stations=STATION),
        tmp_path,
    ).planes
    for truth in (door, niche):
        index = nearest(planes, truth.normal, np.array(truth.centre))
        assert abs(planes.plane(index).distances_m(np.array([truth.centre]))[0]) < 2e-4
        angle = angle_between_deg(planes.normal[index], truth.normal)
        assert min(angle, 180.0 - angle) < 0.02


def test_a_pilaster_front_faces_the_room_although_the_wall_behind_is_larger(
    tmp_path: Path,
) -> None:
    scene = (*ROOM[:5], Rectangle("pilaster", (0, 1.7, 0), (0.4, 0, 0), (0, 0, 1.4), 3_000))
    out = detect(cloud_of(sampled(scene)), tmp_path)
    assert out.planes.viewpoint == "guess"
    index = nearest(out.planes, np.array([0, 1.0, 0]), np.array([0, 1.7, 0]))
    assert out.planes.normal[index] @ (0.0, 1.0, 0.0) < -0.99


def test_a_guessed_side_is_warned_about_and_names_view_from(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    out = Hough2d().run(Hough2d.In(cloud=cloud_of(sampled())), Hough2d.Params(), ctx)
    assert out.planes.viewpoint == "guess"
    assert any("set view_from of read.scan" in warning for warning in ctx.warnings)
    # Inside a room the guess is right all the same.
    assert (out.planes.normal @ STATION[0] > out.planes.offset).all()


def test_view_from_decides_the_side(tmp_path: Path) -> None:
    behind = np.array([[0.0, 9.0, 0.0]])
    cloud = cloud_of(sampled(ROOM[:1]), stations=behind, source="view_from")
    planes = detect(cloud, tmp_path).planes
    assert planes.viewpoint == "view_from"
    assert planes.normal[0] @ (0.0, 1.0, 0.0) > 0.99


def test_scan_numbers_of_the_points_outvote_a_nearer_station(tmp_path: Path) -> None:
    points = sampled(ROOM[:1])
    stations = np.array([[0.0, 2.5, 0.0], [0.0, -4.0, 0.0]])
    cloud = dataclasses.replace(
        cloud_of(points, stations=stations), scan=np.ones(len(points), dtype=np.uint16)
    )
    planes = detect(cloud, tmp_path).planes
    assert planes.normal[0] @ (0.0, 1.0, 0.0) < -0.99


@pytest.mark.usefixtures("charts")
def test_metrics_and_figures_tell_of_the_first_plane(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    out = Hough2d().run(
        Hough2d.In(cloud=cloud_of(sampled(), stations=STATION)), Hough2d.Params(), ctx
    )
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    assert metrics["n_planes"] == len(out.planes)
    assert metrics["omega_deg"] == pytest.approx(270.0, abs=0.02)
    assert metrics["phi_deg"] == pytest.approx(0.4, abs=0.02)
    assert metrics["fit_rms_mm"] == pytest.approx(2.0, rel=0.05)
    assert 0.9 < metrics["labelled_share"] <= 1.0
    assert [figure.name for figure in ctx.figures] == [
        "deviations",
        "planes",
        "thickness",
        "accumulator",
    ]
    assert all(figure.path.stat().st_size > 5_000 for figure in ctx.figures)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_points_are_refused(count: int, tmp_path: Path) -> None:
    with pytest.raises(ProductError, match=f"the cloud has {count} points, at least 3"):
        detect(cloud_of(np.zeros((count, 3))), tmp_path)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.outer(np.linspace(0, 5, 500), [1.0, 2.0, 0.5]), "lie on one line"),
        (np.ones((500, 3)), "coincide"),
    ],
    ids=["line", "point"],
)
def test_points_that_fix_no_plane_are_refused(
    points: NDArray[np.float64], message: str, tmp_path: Path
) -> None:
    with pytest.raises(MethodError, match=message):
        detect(cloud_of(points), tmp_path)


def test_coordinates_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    points = sampled()
    points[-1, 1] = np.nan
    with pytest.raises(ProductError, match=r"NaN or infinite: read it with read\.scan"):
        detect(cloud_of(points), tmp_path)


def test_a_perfectly_flat_wall_is_found(tmp_path: Path) -> None:
    planes = detect(cloud_of(sampled(ROOM[1:2], noise_m=0.0)), tmp_path).planes
    np.testing.assert_allclose(np.abs(planes.normal[0]), [0, 1, 0], atol=1e-7)
    assert abs(planes.offset[0]) == pytest.approx(2.0, abs=1e-6)


@settings(max_examples=8)
@given(
    angle_deg=st.floats(0.0, 360.0),
    distance_m=st.floats(1.0, 30.0),
    lean_deg=st.floats(-4.0, 4.0),
)
def test_a_single_wall_is_found_in_any_direction(
    angle_deg: float, distance_m: float, lean_deg: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    lean = np.radians(lean_deg)
    wall = Rectangle("wall", (0, distance_m, 1), (4, 0, 0), (0, np.sin(lean), np.cos(lean)), 12_000)
    turn = turned(angle_deg)
    planes = detect(cloud_of(sampled((wall,)) @ turn.T), tmp_path_factory.mktemp("wall")).planes
    normal = turn @ wall.normal
    angle = angle_between_deg(planes.normal[0], normal)
    assert min(angle, 180.0 - angle) < 0.02
    assert abs(planes.plane(0).distances_m(np.array([turn @ wall.centre]))[0]) < 2e-4
