"""`plane.given` lays the plane where it is stated, with a rectangle about the points near it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.plane.given import GivenPlane
from pydantic import ValidationError

from orthoflow.errors import MethodError, ProductError
from orthoflow.products import PointCloud
from tests.plane_scenes import ROOM, Rectangle, cloud_of, detect, sampled

SURVEY = (634512.347, 486215.781, 112.193)
# The wall at y = -2, and the floor.
TRIPLE: dict[str, Any] = {"points": ((-3.0, -2.0, -1.5), (3.0, -2.0, -1.5), (0.0, -2.0, 1.5))}
FAR: dict[str, Any] = {"normal": (0.0, 1.0, 0.0), "offset_m": 10.0}
TWO: tuple[dict[str, Any], ...] = (TRIPLE, {"horizontal": True, "height_m": -1.5})


def lay(cloud: PointCloud, folder: Path, **params: Any) -> Any:
    return detect(GivenPlane, cloud, folder, **params)[0]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_given_normal_is_kept_with_its_side_and_what_is_near_is_labelled(
    side: float, tmp_path: Path
) -> None:
    points = np.vstack([sampled(), [[40.0, -2.0, 0.0], [-60.0, -2.0, 1.0], [0.0, -2.0, 50.0]]])
    stated = {"normal": (0.0, 4.0 * side, 0.0), "offset_m": -2.0 * side, "tolerance_m": 0.03}
    out = lay(cloud_of(points), tmp_path, **stated)
    np.testing.assert_array_equal(out.planes.normal[0], [0.0, side, 0.0])
    assert out.planes.offset[0] == -2.0 * side
    assert out.planes.viewpoint == "given"
    assert not out.planes.covariance.any()
    near = np.abs(points[:, 1] + 2.0) <= 0.03
    labels = out.labels.plane_index
    assert np.count_nonzero((labels == 0) != near) <= 3  # float32 offsets at the very border
    assert out.planes.n_points[0] == np.count_nonzero(labels == 0)
    rms_m = np.sqrt(np.mean((points[near, 1] + 2.0) ** 2))
    assert out.planes.rms_m[0] == pytest.approx(rms_m, abs=1e-5)
    # Stray echoes do not widen the rectangle.
    assert np.abs(out.planes.corners).max() < 3.2


def test_three_points_face_the_station_or_else_the_other_points(tmp_path: Path) -> None:
    for y, side in ((1.0, 1.0), (-9.0, -1.0)):
        out = lay(cloud_of(sampled(), stations=np.array([[0.0, y, 0.0]])), tmp_path, **TRIPLE)
        np.testing.assert_allclose(out.planes.normal[0], [0.0, side, 0.0], atol=1e-12)
        assert out.planes.viewpoint == "stations"
    out, ctx = detect(GivenPlane, cloud_of(sampled()), tmp_path, **TRIPLE)
    np.testing.assert_allclose(out.planes.normal[0], [0.0, 1.0, 0.0], atol=1e-12)
    assert out.planes.viewpoint == "guess"
    assert any("view_from" in warning for warning in ctx.warnings)


def test_a_horizontal_plane_lies_below_the_scene_or_at_the_height_given(tmp_path: Path) -> None:
    planes = lay(cloud_of(sampled()), tmp_path).planes
    np.testing.assert_array_equal(planes.normal[0], [0.0, 0.0, 1.0])
    assert planes.offset[0] == pytest.approx(-1.5, abs=0.01)
    assert planes.names == ("floor 0",)
    # The front wall leans outwards by 1 cm.
    np.testing.assert_allclose(planes.corners[0].min(axis=0)[:2], [-3.0, -2.0], atol=0.02)
    np.testing.assert_allclose(planes.corners[0].max(axis=0)[:2], [3.0, 2.0], atol=0.02)
    cloud = cloud_of(sampled(), origin=SURVEY)
    planes = lay(cloud, tmp_path, horizontal=True, height_m=SURVEY[2] - 1.5).planes
    assert planes.offset[0] == pytest.approx(SURVEY[2] - 1.5, abs=1e-9)
    assert planes.n_points[0] >= ROOM[4].n_points
    swap = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])
    planes = lay(cloud_of(sampled() @ swap.T, up=(0.0, 1.0, 0.0)), tmp_path, horizontal=True).planes
    np.testing.assert_array_equal(planes.normal[0], [0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"normal": (0, 0, 1.0), "offset_m": 0.0, "horizontal": True}, "got normal and horizontal"),
        ({**TRIPLE, "height_m": 2.0}, "points and horizontal"),
        ({"normal": (0, 0, 0.0), "offset_m": 1.0}, "normal must not be"),
        ({"planes": TWO, "height_m": 2.0}, "got horizontal and planes: move it into"),
        ({"planes": ({"normal": (0, 0, 1.0)},)}, "normal and offset_m together, got only one"),
    ],
)
def test_contradicting_parameters_are_refused(params: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        GivenPlane.Params.model_validate(params)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"points": ((0, 0, 0), (1, 1, 1), (2, 2, 2))}, "three points that define a plane"),
        (FAR, r"no point .* within 0.15 m .* between -12.0\d\d m and"),
        ({"planes": (TRIPLE, FAR)}, r"planes\[1\]: no point of the cloud is within"),
    ],
)
def test_planes_without_points_are_refused(
    params: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(MethodError, match=message):
        lay(cloud_of(sampled()), tmp_path, **params)
    with pytest.raises(ProductError, match="the cloud has 0 points"):
        lay(cloud_of(np.zeros((0, 3))), tmp_path, **params)


def test_several_planes_are_those_that_each_alone_would_be(tmp_path: Path) -> None:
    points = sampled()
    cloud = cloud_of(points, stations=np.array([[0.0, 1.0, 0.0]]))
    both = lay(cloud, tmp_path / "both", planes=TWO, tolerance_m=0.05)
    # By the number of their points, as everywhere: the floor has more.
    assert both.planes.names == ("floor 0", "wall 1")
    for place, stated in zip((1, 0), TWO, strict=True):
        alone = lay(cloud, tmp_path, tolerance_m=0.05, **stated)
        for name in ("normal", "offset", "corners"):
            np.testing.assert_array_equal(
                getattr(both.planes, name)[place], getattr(alone.planes, name)[0], err_msg=name
            )
    assert set(both.planes.part_plane.tolist()) == {0, 1}
    # A point near both belongs to the nearer.
    to_wall, to_floor = np.abs(points[:, 1] + 2.0), np.abs(points[:, 2] + 1.5)
    disputed = (to_wall < 0.049) & (to_floor < 0.049) & (np.abs(to_wall - to_floor) > 1e-5)
    assert disputed.sum() > 10
    labels = both.labels.plane_index
    np.testing.assert_array_equal(labels[disputed] == 1, (to_wall < to_floor)[disputed])
    assert both.planes.n_points.tolist() == [np.count_nonzero(labels == k) for k in (0, 1)]


@pytest.mark.parametrize(
    ("params", "right_m"),
    # By default three tolerances: 15 cm, 36 cm.
    [({}, 1.0), ({"tolerance_m": 0.12}, 2.0), ({"tolerance_m": 0.12, "buffer_m": 0.2}, 1.0)],
)
def test_the_rectangle_spans_what_lies_within_the_buffer(
    params: dict[str, float], right_m: float, tmp_path: Path
) -> None:
    wall = Rectangle("wall", (0, 2, 0), (1, 0, 0), (0, 0, 1), 20_000)
    beside = Rectangle("beside", (1.5, 2.3, 0), (0.5, 0, 0), (0, 0, 1), 10_000)
    cloud = cloud_of(sampled((wall, beside)))
    three = ((0.0, 2.0, 0.0), (1.0, 2.0, 0.0), (0.0, 2.0, 1.0))
    corners = lay(cloud, tmp_path, points=three, **params).planes.corners
    assert corners[0, :, 0].max() == pytest.approx(right_m, abs=0.01)


def test_a_plan_reports_parts_that_it_leaves_out_and_takes_them_when_asked(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    ground = rng.uniform([0.0, 0.0, 0.0], [6.0, 4.0, 0.02], (60_000, 3))
    # A hut apart from the rest, on half a per cent of the area.
    hut = rng.uniform([8.0, 6.0, 0.0], [8.4, 6.3, 0.02], (400, 3))
    cloud = cloud_of(np.vstack([ground, hut, [[8.4, 6.3, 0.0]]]))
    for params, corner, n_warnings in (({}, [6.0, 4.0], 1), ({"part_min_share": 0}, [8.4, 6.3], 0)):
        out, ctx = detect(GivenPlane, cloud, tmp_path, horizontal=True, **params)
        assert out.planes.corners[0].max(axis=0)[:2] == pytest.approx(corner, abs=1e-3)
        assert len(ctx.warnings) == n_warnings
        for warning in ctx.warnings:
            assert "401 points (0.66%) are outside the rectangle of the plane" in warning
