"""Directions, planes and wall frames against algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry import (
    Plane,
    WallFrame,
    angle_between_deg,
    basis_from_up,
    frame_over,
    omega_phi_deg,
    plane_through,
    up_vector,
    wall_axes,
)
from orthoflow.geometry.frames import UP_VECTORS, UpDirection
from tests.long_loops import seeds

Z_UP = np.array([0.0, 0.0, 1.0])


def unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    scaled: NDArray[np.float64] = vector / np.linalg.norm(vector)
    return scaled


@pytest.mark.parametrize("direction", UP_VECTORS, ids=str)
def test_the_frame_of_an_up_direction_is_right_handed(direction: UpDirection) -> None:
    basis = basis_from_up(up_vector(direction))
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(basis) == pytest.approx(1.0)
    np.testing.assert_array_equal(basis[2], up_vector(direction))


def test_with_z_up_the_frame_is_the_world() -> None:
    np.testing.assert_array_equal(basis_from_up(Z_UP), np.eye(3))


@pytest.mark.parametrize("seed", seeds(8))
def test_a_plane_through_three_points_contains_them(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(3, 3)) + 1e5
    plane = plane_through(points)
    np.testing.assert_allclose(plane.distances_m(points), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    "points",
    [np.zeros((3, 3)), np.outer([0.0, 1.0, 2.0], [1.0, 2.0, 3.0])],
    ids=["one point thrice", "on a line"],
)
def test_points_that_span_no_plane_are_refused(points: NDArray[np.float64]) -> None:
    with pytest.raises(GeometryError, match="lie on one line"):
        plane_through(points)


def test_a_plane_turned_towards_a_viewpoint_has_it_in_front() -> None:
    plane = Plane(normal=np.array([0.0, 1.0, 0.0]), offset_m=5.0)
    viewer = np.array([1.0, 2.0, 3.0])
    turned = plane.towards(viewer)
    assert turned.distances_m(viewer[None])[0] == pytest.approx(3.0)
    np.testing.assert_array_equal(turned.normal, [0.0, -1.0, 0.0])


def test_a_normal_that_is_not_of_unit_length_is_refused() -> None:
    with pytest.raises(GeometryError, match="unit normal"):
        Plane(normal=np.array([0.0, 2.0, 0.0]), offset_m=5.0)


@pytest.mark.parametrize("angle_deg", [1e-6, 0.01, 45.0, 179.0])
def test_angles_between_vectors_are_exact_also_when_small(angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    turned = np.array([np.cos(angle), np.sin(angle), 0.0])
    measured = angle_between_deg(np.array([1.0, 0.0, 0.0]), turned)
    assert measured == pytest.approx(angle_deg, rel=1e-9)


@pytest.mark.parametrize(("omega", "phi"), [(102.0, 0.8), (282.4, -0.2), (0.0, 45.0), (359.5, 80)])
def test_omega_and_phi_are_those_of_the_papers_equation(omega: float, phi: float) -> None:
    o, p = np.radians([omega, phi])
    normal = np.array([np.cos(p) * np.cos(o), np.cos(p) * np.sin(o), np.sin(p)])
    assert omega_phi_deg(normal, Z_UP) == pytest.approx((omega, phi))


@pytest.mark.parametrize("direction", UP_VECTORS, ids=str)
@pytest.mark.parametrize("seed", seeds(4))
def test_wall_axes_run_right_and_down_for_the_viewer(direction: UpDirection, seed: int) -> None:
    up = up_vector(direction)
    normal = np.random.default_rng(seed).normal(size=3)
    normal = unit(normal - 0.95 * (normal @ up) * up)  # a wall that leans a little
    u, v = wall_axes(normal, up)
    np.testing.assert_allclose(np.cross(u, v), -normal, atol=1e-12)
    assert u @ up == pytest.approx(0.0, abs=1e-12)  # horizontal
    assert v @ up < 0.0  # downwards


def test_a_floor_seen_from_above_reads_like_a_map() -> None:
    u, v = wall_axes(Z_UP, Z_UP)
    np.testing.assert_allclose(u, [1.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(v, [0.0, -1.0, 0.0], atol=1e-15)


def rectangle(normal: NDArray[np.float64], width_m: float, height_m: float) -> NDArray[np.float64]:
    u, v = wall_axes(normal, Z_UP)
    top_left = np.array([634512.0, 486215.0, 112.0])
    steps = [0 * u, height_m * v, height_m * v + width_m * u, width_m * u]
    return top_left + np.array(steps)


@pytest.mark.parametrize("seed", seeds(4))
def test_world_and_wall_coordinates_are_inverse(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normal = unit(np.append(rng.normal(size=2), 0.02))
    frame = frame_over(rectangle(normal, 3.0, 2.0), normal, gsd_m=0.003)
    wall = np.column_stack([rng.uniform(0, 1000, 50), rng.uniform(0, 600, 50), rng.normal(size=50)])
    world = frame.world_from_wall(wall[:, :2], wall[:, 2])
    # 1e-6 columns are 3 nm; float64 resolves 1e-10 m at these coordinates.
    np.testing.assert_allclose(frame.wall_from_world(world), wall, atol=1e-6)


def test_places_in_the_raster_count_up_from_its_corner_or_its_place_on_the_map() -> None:
    frame = framed(4.0, 3.0, 0.5)
    pixels = np.array([[0.0, 0.0], [2.0, 5.0]])
    np.testing.assert_allclose(frame.raster_from_wall(pixels), [[0.0, 0.0], [1.0, -2.5]])
    mapped = replace(frame, map_crs="site", origin_world=np.array([634512.0, 486215.0, 112.0]))
    places = mapped.raster_from_wall(pixels)
    np.testing.assert_allclose(places, [[634512.0, 486215.0], [634513.0, 486212.5]])
    for of in (frame, mapped):
        np.testing.assert_allclose(of.wall_from_raster(of.raster_from_wall(pixels)), pixels)


def test_the_corners_of_a_frame_are_those_of_its_rectangle() -> None:
    normal = np.array([0.0, -1.0, 0.0])
    corners = rectangle(normal, 3.0, 2.1)
    frame = frame_over(corners, normal, gsd_m=0.1)
    assert (frame.width, frame.height) == (30, 21)
    np.testing.assert_allclose(frame.corners_world(), corners, atol=1e-9)


def test_a_rectangle_without_area_is_refused() -> None:
    with pytest.raises(GeometryError, match="needs an area"):
        frame_over(np.zeros((4, 3)), Z_UP, gsd_m=0.1)


# --- limits ---


@pytest.mark.parametrize(("tilt_deg", "is_level"), [(9.9, True), (10.1, False)])
def test_planes_within_ten_degrees_of_level_read_like_a_map(
    tilt_deg: float, is_level: bool
) -> None:
    lean = np.radians(tilt_deg)
    for side in (1.0, -1.0):
        normal = side * np.array([0.0, np.sin(lean), np.cos(lean)])
        u, _ = wall_axes(normal, np.array([0.0, 0.0, 1.0]))
        # For a viewer on the side that it leans to, right is west.
        np.testing.assert_allclose(u, [1.0 if is_level else -side, 0.0, 0.0], atol=1e-12)


def framed(width_m: float, height_m: float, gsd_m: float) -> WallFrame:
    corners = np.array(
        [[0, 0, height_m], [0, 0, 0], [width_m, 0, 0], [width_m, 0, height_m]], dtype=np.float64
    )
    return frame_over(corners, np.array([0.0, -1.0, 0.0]), gsd_m=gsd_m)


def test_grids_cover_their_rectangle_but_for_a_millionth_of_a_cell() -> None:
    assert framed(3.0, 1.5, 0.003).shape == (500, 1000)
    assert framed(3.0 + 2e-9, 1.5, 0.003).shape == (500, 1000)
    assert framed(3.0 + 2e-8, 1.5, 0.003).shape == (500, 1001)
    assert framed(3.0, 1.5 + 2e-8, 0.003).shape == (501, 1000)
    assert framed(0.001, 0.002, 1.0).shape == (1, 1)


def test_frames_have_the_same_cells_to_a_thousandth() -> None:
    frame = framed(1.0, 0.5, 0.01)
    for shift_m, is_same in ((0.9e-5, True), (1.1e-5, False), (-1.1e-5, False)):
        moved = replace(frame, origin_world=frame.origin_world + np.array([shift_m, 0.0, 0.0]))
        assert frame.has_cells_of(moved) is is_same
    assert not frame.has_cells_of(replace(frame, width=frame.width - 1))


@pytest.mark.parametrize("change", [{"gsd_m": 0.0}, {"gsd_m": -1.0}, {"width": 0}, {"height": 0}])
def test_a_frame_without_cells_is_refused(change: dict[str, float]) -> None:
    frame = framed(1.0, 0.5, 0.01)
    with pytest.raises(GeometryError, match="positive cell size and at least one cell"):
        replace(frame, **change)
    with pytest.raises(GeometryError, match="mirror the image"):
        replace(frame, u_world=-frame.u_world)


def test_the_plane_of_a_frame_holds_its_corners() -> None:
    frame = replace(framed(1.0, 0.5, 0.01), origin_world=np.array([3.0, 4.0, 5.0]))
    np.testing.assert_allclose(frame.plane.distances_m(frame.corners_world()), 0.0, atol=1e-12)
    assert frame.plane.flipped().offset_m == -frame.plane.offset_m == 4.0
    # On the plane, either side is as good: it stays.
    plane = frame.plane
    assert plane.towards(frame.origin_world) is plane
