"""`plane.given` lays the plane where it is told, with a rectangle about the points near it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.plane.given import GivenPlane
from pydantic import ValidationError

from orthoflow.errors import MethodError, ProductError
from orthoflow.products import Planes, PointCloud
from tests.plane_scenes import ROOM, Rectangle, cloud_of, context, sampled

SURVEY = (634512.347, 486215.781, 112.193)


def lay(cloud: PointCloud, folder: Path, **params: object) -> GivenPlane.Out:
    return GivenPlane().run(
        GivenPlane.In(cloud=cloud), GivenPlane.Params(**params), context(folder)
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_given_normal_is_kept_with_its_side(side: float, tmp_path: Path) -> None:
    out = lay(cloud_of(sampled()), tmp_path, normal=(0.0, 4.0 * side, 0.0), offset_m=-2.0 * side)
    np.testing.assert_array_equal(out.planes.normal[0], [0.0, side, 0.0])
    assert out.planes.offset[0] == -2.0 * side
    assert out.planes.viewpoint == "given"
    assert not out.planes.covariance.any()


def test_points_within_the_tolerance_are_labelled(tmp_path: Path) -> None:
    points = sampled()
    out = lay(cloud_of(points), tmp_path, normal=(0.0, 1.0, 0.0), offset_m=-2.0, tolerance_m=0.03)
    near = np.abs(points[:, 1] + 2.0) <= 0.03
    labels = out.labels.plane_index
    assert np.count_nonzero((labels == 0) != near) <= 3  # float32 offsets at the very border
    assert out.planes.n_points[0] == np.count_nonzero(labels == 0)
    assert out.planes.rms_m[0] == pytest.approx(
        np.sqrt(np.mean((points[near, 1] + 2.0) ** 2)), abs=1e-5
    )


def test_three_points_face_the_station(tmp_path: Path) -> None:
    triple = ((-3.0, -2.0, -1.5), (3.0, -2.0, -1.5), (0.0, -2.0, 1.5))
    inside, outside = np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, -9.0, 0.0]])
    for name, station, side in (("in", inside, 1.0), ("out", outside, -1.0)):
        out = lay(cloud_of(sampled(), stations=station), tmp_path / name, points=triple)
        np.testing.assert_allclose(out.planes.normal[0], [0.0, side, 0.0], atol=1e-12)
        assert out.planes.viewpoint == "stations"


def test_three_points_without_stations_face_the_other_points(tmp_path: Path) -> None:
    triple = ((-3.0, -2.0, -1.5), (3.0, -2.0, -1.5), (0.0, -2.0, 1.5))
    ctx = context(tmp_path)
    out = GivenPlane().run(
        GivenPlane.In(cloud=cloud_of(sampled())), GivenPlane.Params(points=triple), ctx
    )
    np.testing.assert_allclose(out.planes.normal[0], [0.0, 1.0, 0.0], atol=1e-12)
    assert out.planes.viewpoint == "guess"
    assert any("view_from" in warning for warning in ctx.warnings)


def test_by_default_the_plane_is_horizontal_below_the_scene(tmp_path: Path) -> None:
    out = lay(cloud_of(sampled()), tmp_path)
    np.testing.assert_array_equal(out.planes.normal[0], [0.0, 0.0, 1.0])
    assert out.planes.offset[0] == pytest.approx(-1.5, abs=0.01)
    low, high = out.planes.corners[0].min(axis=0), out.planes.corners[0].max(axis=0)
    # The front wall leans outwards by 1 cm.
    np.testing.assert_allclose(low[:2], [-3.0, -2.0], atol=0.02)
    np.testing.assert_allclose(high[:2], [3.0, 2.0], atol=0.02)
    assert out.planes.names == ("floor 0",)


def test_a_horizontal_plane_lies_at_the_height_given(tmp_path: Path) -> None:
    cloud = cloud_of(sampled(), origin=SURVEY)
    out = lay(cloud, tmp_path, horizontal=True, height_m=SURVEY[2] - 1.5)
    assert out.planes.offset[0] == pytest.approx(SURVEY[2] - 1.5, abs=1e-9)
    assert out.planes.n_points[0] >= ROOM[4].n_points


def test_up_decides_what_horizontal_is(tmp_path: Path) -> None:
    swap = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])
    out = lay(cloud_of(sampled() @ swap.T, up=(0.0, 1.0, 0.0)), tmp_path, horizontal=True)
    np.testing.assert_array_equal(out.planes.normal[0], [0.0, 1.0, 0.0])


def test_stray_echoes_do_not_widen_the_rectangle(tmp_path: Path) -> None:
    stray = np.array([[40.0, -2.0, 0.0], [-60.0, -2.0, 1.0], [0.0, -2.0, 50.0]])
    cloud = cloud_of(np.vstack([sampled(), stray]))
    out = lay(cloud, tmp_path, normal=(0.0, 1.0, 0.0), offset_m=-2.0)
    assert np.abs(out.planes.corners).max() < 3.2


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"normal": (0, 0, 1.0), "offset_m": 0.0, "horizontal": True}, "got normal and horizontal"),
        ({"points": ((0, 0, 0), (1, 0, 0), (0, 1, 0)), "height_m": 2.0}, "points and horizontal"),
        ({"normal": (0, 0, 1.0)}, "normal and offset_m together, got only one"),
        ({"offset_m": 1.0}, "normal and offset_m together, got only one"),
        ({"normal": (0, 0, 0.0), "offset_m": 1.0}, "normal must have a length"),
    ],
    ids=["two ways", "points and height", "no offset", "no normal", "no length"],
)
def test_contradicting_parameters_are_refused(params: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        GivenPlane.Params(**params)


def test_three_points_on_a_line_are_refused(tmp_path: Path) -> None:
    line = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (2.0, 2.0, 2.0))
    with pytest.raises(MethodError, match="three points that span a plane"):
        lay(cloud_of(sampled()), tmp_path, points=line)


def test_a_plane_far_from_every_point_says_where_the_points_are(tmp_path: Path) -> None:
    with pytest.raises(MethodError, match=r"no point .* within 0.15 m .* between -12.0\d\d m and"):
        lay(cloud_of(sampled()), tmp_path, normal=(0.0, 1.0, 0.0), offset_m=10.0)


def test_an_empty_cloud_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProductError, match="the cloud has 0 points"):
        lay(cloud_of(np.zeros((0, 3))), tmp_path)


TRIPLES = (
    {"points": ((-3.0, -2.0, -1.5), (3.0, -2.0, -1.5), (0.0, -2.0, 1.5))},
    {"horizontal": True, "height_m": -1.5},
)


def test_several_planes_are_those_that_each_alone_would_be(tmp_path: Path) -> None:
    cloud = cloud_of(sampled(), stations=np.array([[0.0, 1.0, 0.0]]))
    both = lay(cloud, tmp_path / "both", planes=TRIPLES)
    singles = [lay(cloud, tmp_path / str(k), **stated) for k, stated in enumerate(TRIPLES)]
    # By the number of their points, as everywhere: the floor has more.
    assert both.planes.n_points[0] > both.planes.n_points[1]
    assert both.planes.names == ("floor 0", "wall 1")
    for place, alone in zip((1, 0), singles, strict=True):
        for name in ("normal", "offset", "corners"):
            np.testing.assert_array_equal(
                getattr(both.planes, name)[place], getattr(alone.planes, name)[0], err_msg=name
            )
    assert both.planes.part_plane is not None
    assert set(both.planes.part_plane.tolist()) == {0, 1}


def test_a_point_near_two_planes_belongs_to_the_nearer(tmp_path: Path) -> None:
    points = sampled()
    out = lay(cloud_of(points), tmp_path, planes=TRIPLES, tolerance_m=0.05)
    to_wall, to_floor = np.abs(points[:, 1] + 2.0), np.abs(points[:, 2] + 1.5)
    disputed = (to_wall < 0.049) & (to_floor < 0.049) & (np.abs(to_wall - to_floor) > 1e-5)
    assert disputed.sum() > 10
    wall = out.planes.names.index("wall 1")
    labels = out.labels.plane_index
    np.testing.assert_array_equal(labels[disputed] == wall, (to_wall < to_floor)[disputed])
    assert out.planes.n_points.tolist() == [np.count_nonzero(labels == k) for k in (0, 1)]


def test_the_one_of_several_planes_that_no_point_is_near_is_named(tmp_path: Path) -> None:
    beside = {"normal": (0.0, 1.0, 0.0), "offset_m": 10.0}
    with pytest.raises(MethodError, match=r"planes\[1\]: no point of the cloud lies within"):
        lay(cloud_of(sampled()), tmp_path, planes=(TRIPLES[0], beside))


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"planes": TRIPLES, "height_m": 2.0}, "got horizontal beside planes: move it into"),
        ({"planes": ({"normal": (0, 0, 1.0)},)}, "normal and offset_m together, got only one"),
    ],
    ids=["one and several", "half of one"],
)
def test_contradicting_lists_of_planes_are_refused(params: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        GivenPlane.Params(**params)


def test_the_rectangle_spans_what_lies_within_the_buffer(tmp_path: Path) -> None:
    wall = Rectangle("wall", (0, 2, 0), (1, 0, 0), (0, 0, 1), 20_000)
    beside = Rectangle("beside", (1.5, 2.3, 0), (0.5, 0, 0), (0, 0, 1), 10_000)
    cloud = cloud_of(sampled((wall, beside)))

    def right_m(name: str, **params: object) -> float:
        asked = {"normal": (0.0, -1.0, 0.0), "offset_m": -2.0, **params}
        return float(lay(cloud, tmp_path / name, **asked).planes.corners[0, :, 0].max())

    # By default three tolerances: 15 cm, 36 cm.
    assert right_m("usual") == pytest.approx(1.0, abs=0.01)
    assert right_m("tolerant", tolerance_m=0.12) == pytest.approx(2.0, abs=0.01)
    assert right_m("wide", buffer_m=0.4) == pytest.approx(2.0, abs=0.01)
    assert right_m("narrow", tolerance_m=0.12, buffer_m=0.2) == pytest.approx(1.0, abs=0.01)
    points = ((0.0, 2.0, 0.0), (1.0, 2.0, 0.0), (0.0, 2.0, 1.0))
    three = lay(cloud, tmp_path / "three", points=points, buffer_m=0.4).planes
    assert three.corners[0, :, 0].max() == pytest.approx(2.0, abs=0.01)
    three = lay(cloud, tmp_path / "usual three", points=points).planes
    assert three.corners[0, :, 0].max() == pytest.approx(1.0, abs=0.01)


def test_a_plan_tells_of_parts_that_it_leaves_out_and_takes_them_when_asked(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(3)
    ground = rng.uniform([0.0, 0.0, 0.0], [6.0, 4.0, 0.02], (60_000, 3))
    # A hut apart from the rest, on half a per cent of the area.
    hut = rng.uniform([8.0, 6.0, 0.0], [8.4, 6.3, 0.02], (400, 3))
    cloud = cloud_of(np.vstack([ground, hut, [[8.4, 6.3, 0.0]]]))

    def planes(**params: object) -> tuple[Planes, list[str]]:
        ctx = context(tmp_path)
        given = GivenPlane.Params.model_validate({"horizontal": True, **params})
        out = GivenPlane().run(GivenPlane.In(cloud=cloud), given, ctx)
        return out.planes, list(ctx.warnings)

    found, warnings = planes()
    assert found.corners[0].max(axis=0)[:2] == pytest.approx([6.0, 4.0], abs=1e-3)
    assert "401 points (0.66%) lie beside the rectangle of the plane" in warnings[0]
    found, warnings = planes(part_min_share=0)
    assert found.corners[0].max(axis=0)[:2] == pytest.approx([8.4, 6.3], abs=1e-6)
    assert warnings == []
