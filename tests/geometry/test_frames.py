"""Planes, rotations and rasters on walls: places there and back, distances, axes and angles."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from orthoflow.errors import GeometryError
from orthoflow.files.geotiff import GridPlace
from orthoflow.files.sidecars import frame_json, frame_of_raster
from orthoflow.geometry import (
    Cone,
    ConeBend,
    CurvedShape,
    Cylinder,
    CylinderBend,
    Sphere,
    SphereBend,
    basis_from_up,
    up_vector,
)
from orthoflow.geometry.frames import (
    UP_VECTORS,
    Plane,
    UpDirection,
    WallFrame,
    angle_between_deg,
    frame_over,
    omega_phi_deg,
    plane_through,
    rotation_from_vector,
    signed_area,
    wall_axes,
)
from orthoflow.products import Product
from tests import samples, scenes
from tests.long_loops import seeds

UP = np.array([0.0, 0.0, 1.0])
# 0.5 x 0.3 m, its corner at (1, 2, 3); x is to the right, down is down, the viewer in the south.
FRAME = samples.facing_south(0.1, 5, 3, (1.0, 2.0, 3.0))


@dataclass(frozen=True, kw_only=True)
class Unrolled(Product):
    """A product that holds a frame."""

    type_name: ClassVar[str] = "unrolled"
    frame: WallFrame


def turned() -> WallFrame:
    turn = scenes.random_rotation(np.random.default_rng(4))
    return replace(
        FRAME,
        u_world=turn @ FRAME.u_world,
        v_world=turn @ FRAME.v_world,
        normal_world=turn @ FRAME.normal_world,
    )


def test_places_on_a_wall_are_metres_to_the_right_down_and_before_it() -> None:
    assert FRAME.shape == (3, 5)
    points = FRAME.world_from_wall(np.array([[0.0, 0.0], [5.0, 3.0], [2.0, 1.0]]), 0.25)
    np.testing.assert_allclose(points, [[1.0, 1.75, 3.0], [1.5, 1.75, 2.7], [1.2, 1.75, 2.9]])
    np.testing.assert_allclose(
        FRAME.corners_world(), [[1, 2, 3], [1, 2, 2.7], [1.5, 2, 2.7], [1.5, 2, 3]]
    )
    assert FRAME.plane.offset_m == -2.0
    for frame in (FRAME, turned()):
        placed = np.array([[0.5, 2.5, 0.1], [7.0, -4.0, -3.0], [1.0, 1.0, 0.0]])
        points = frame.world_from_wall(placed[:, :2], placed[:, 2])
        np.testing.assert_allclose(frame.wall_from_world(points), placed, atol=1e-9)
        np.testing.assert_allclose(frame.plane.distances_m(points), placed[:, 2], atol=1e-12)


CONE = {"apex_m": (2.0, -1.0), "slants_m": (0.9, 8.0), "half_sector_rad": 1.5}
BENDS: list[Any] = [
    CylinderBend(along="u", radius_m=3.0),
    CylinderBend(along="u", radius_m=-1.0),
    CylinderBend(along="v", radius_m=3.0),
    CylinderBend(along="v", radius_m=-2.0),
    ConeBend(toward_rad=1.6, half_angle_rad=0.5, is_inside=False, **CONE),
    ConeBend(toward_rad=1.5, half_angle_rad=1.1, is_inside=True, **CONE),
    SphereBend(pole_m=(2.0, -1.0), radius_m=3.0, is_inside=True, most_m=8.0),
    SphereBend(pole_m=(0.0, 0.0), radius_m=4.0, is_inside=False, most_m=9.0),
]
NAMES = ("inside", "outside", "vault", "above", "spire", "funnel", "dome", "ball")
CURVED = [replace(turned(), gsd_m=0.1, width=60, height=50, bend=bend) for bend in BENDS]


def shape_of(frame: WallFrame) -> CurvedShape:
    """The surface of a frame, as its sidecar describes it."""
    chart: Any = frame_json(frame)
    is_concave = chart["concave"]
    if chart["chart"] == "sphere":
        centre, radius_m = np.array(chart["centre"]), chart["radius_m"]
        return Sphere(centre_world=centre, radius_m=radius_m, is_concave=is_concave)
    axis = np.array(chart["axis"])
    axis /= np.linalg.norm(axis)
    if chart["chart"] == "cone":
        half = math.radians(chart["half_angle_deg"])
        apex = np.array(chart["apex"])
        return Cone(apex_world=apex, axis_world=axis, half_angle_rad=half, is_concave=is_concave)
    point = np.array(chart["point"])
    return Cylinder(
        point_world=point, axis_world=axis, radius_m=chart["radius_m"], is_concave=is_concave
    )


@pytest.mark.parametrize("frame", CURVED, ids=NAMES)
def test_curved_surfaces_are_unrolled_without_stretching(frame: WallFrame) -> None:
    """A sphere is stretched across its meridians, by the angle from the pole over its sine."""
    random = np.random.default_rng(7)
    cells = random.uniform([0.0, 0.0], [frame.width, frame.height], (200, 2))
    depths_m = random.uniform(-0.15, 0.15, 200)
    points, shape = frame.world_from_wall(cells, depths_m), shape_of(frame)
    assert frame.shows(cells).all()
    np.testing.assert_allclose(
        frame.wall_from_world(points), np.column_stack([cells, depths_m]), atol=1e-9
    )
    np.testing.assert_allclose(shape.distances_m(points), depths_m, atol=1e-8)
    # Axes are the derivatives: scaled by the depth along the arc, right-handed as on a plane.
    local = frame.axes_at(cells)
    np.testing.assert_allclose(np.cross(local[:, 0], local[:, 1]), -local[:, 2], atol=1e-12)
    np.testing.assert_allclose(local[:, 2], shape.normals(points), atol=1e-8)
    jacobians = np.stack(
        [
            (
                frame.world_from_wall(cells + step, depths_m)
                - frame.world_from_wall(cells - step, depths_m)
            )
            / 2e-6
            for step in 1e-6 * np.eye(2)
        ],
        axis=1,
    )
    lengths_m = np.linalg.norm(jacobians, axis=2)
    np.testing.assert_allclose(lengths_m, frame.metres_per_cell(cells, depths_m), atol=1e-9)
    # Between near positions on the surface, distances and angles are those on the raster.
    ends = cells[:, None] + 0.01 * np.array([[0.0, 0.0], [1.0, 0.0], [0.6, 0.8]])
    stretches: dict[tuple[int, int], Any] = {(0, 1): 1.0, (0, 2): 1.0, (1, 2): 1.0}
    if isinstance(frame.bend, SphereBend):
        from_pole_m = 0.1 * cells - frame.bend.pole_m
        away_m = np.linalg.norm(from_pole_m, axis=1)
        along = from_pole_m / away_m[:, None]
        ends = np.stack([cells, cells + 1e-3 * along[:, ::-1] * [-1, 1], cells + 1e-3 * along], 1)
        angles = away_m / frame.bend.radius_m
        stretches = {(0, 1): angles / np.sin(angles), (0, 2): 1.0}
    at = frame.world_from_wall(ends.reshape(-1, 2)).reshape(-1, 3, 3)
    for (first, second), stretch in stretches.items():
        apart_m = np.linalg.norm(at[:, first] - at[:, second], axis=1)
        on_raster = 0.1 * np.linalg.norm(ends[:, first] - ends[:, second], axis=1)
        np.testing.assert_allclose(stretch * apart_m, on_raster, rtol=1e-5)
    # Rays from the viewer's side meet the positions on the surface that face them.
    start, places = points[0] + 0.3 * local[0, 2], frame.world_from_wall(cells)
    faces = np.einsum("ij,ij->i", start - places, local[:, 2]) > 0.05
    assert faces.sum() > 20
    met = frame.met_by(start, places[faces] - start)
    np.testing.assert_allclose(met, places[faces], atol=1e-8)


@pytest.mark.parametrize("frame", CURVED, ids=NAMES)
def test_parts_of_a_curved_surface_have_its_cells(frame: WallFrame) -> None:
    part = frame.part((4.0, 7.0), width=11, height=20)
    cells = np.array([[0.0, 0.0], [3.0, 4.0], [11.0, 20.0]])
    expected = frame.world_from_wall(cells + np.array([4.0, 7.0]), 0.1)
    np.testing.assert_allclose(part.world_from_wall(cells, 0.1), expected, atol=1e-12)
    rows = frame.of_rows(slice(7, 27))
    assert rows.has_cells_of(frame.part((0.0, 7.0), width=frame.width, height=20))
    assert not rows.has_cells_of(rows.flat)
    np.testing.assert_allclose(rows.plane.normal, rows.facing_world)
    np.testing.assert_allclose(rows.distances_m(rows.middle_world[None]), [0.0], atol=1e-9)
    content = json.loads(json.dumps(frame_json(part)))
    left_m, top_m = part.raster_corner_m
    place = GridPlace(gsd_m=0.1, corner_m=(left_m + 0.3, top_m - 0.4))
    read = frame_of_raster(content, raster=place, shape=(5, 6), name="wall_3.json")
    assert read.has_cells_of(frame.part((7.0, 11.0), width=6, height=5))
    assert isinstance(part.bend, CylinderBend) or part.crs == frame.crs == read.crs
    ring = frame.outline_world()
    assert np.linalg.norm(np.diff(ring, axis=0), axis=1).max() < 0.8
    np.testing.assert_allclose(shape_of(part).distances_m(ring), 0.0, atol=1e-8)
    payload = Unrolled(frame=part).to_payload()
    assert Unrolled.from_payload(payload).frame.bend == part.bend
    assert "bend" not in str(Unrolled(frame=part.flat).to_payload().metadata)


def test_towers_are_walls_and_vaults_have_axes_of_their_own() -> None:
    up = {"up": (0.0, 0.0, 1.0)}
    tower = replace(FRAME, **up, bend=CylinderBend(along="u", radius_m=-2.0))  # type: ignore[arg-type]
    assert (tower.raster_axes, tower.raster_corner_m) == ("wall", (0.0, 3.0))
    vault = replace(FRAME, **up, bend=CylinderBend(along="v", radius_m=2.0))  # type: ignore[arg-type]
    assert (vault.raster_axes, vault.raster_corner_m) == ("plane", (0.0, 0.0))
    assert len({frame.crs for frame in (tower, vault, FRAME)}) == 3


@pytest.mark.parametrize("frame", [FRAME, turned()], ids=["upright", "turned"])
def test_points_are_as_far_from_a_raster_as_from_its_rectangle(frame: WallFrame) -> None:
    # Above, beside, in front of and inside a rectangle of 5 x 3 cells of 0.1 m.
    places = np.random.default_rng(2).uniform([-5, -5, -0.5], [10, 8, 0.5], (200, 3))
    cells, depths_m = places[:, :2], places[:, 2]
    beyond = np.maximum(0.0, np.maximum(-cells, cells - [5, 3]))
    expected = np.hypot(0.1 * np.hypot(*beyond.T), depths_m)
    found = frame.distances_m(frame.world_from_wall(cells, depths_m))
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize(("crs", "corner"), [(None, (0.0, 0.0)), ("EPSG:32632", (1.0, 2.0))])
def test_origins_of_rasters_and_maps_differ(crs: str | None, corner: tuple[float, float]) -> None:
    frame = replace(FRAME, map_crs=crs)
    assert frame.raster_corner_m == corner
    places = frame.raster_from_wall(np.array([[0.0, 0.0], [2.0, 3.0]]))
    np.testing.assert_allclose(places, np.array(corner) + np.array([[0.0, 0.0], [0.2, -0.3]]))
    np.testing.assert_allclose(frame.wall_from_raster(places), [[0.0, 0.0], [2.0, 3.0]], atol=1e-9)


def test_frames_have_the_same_cells_to_a_thousandth_of_one() -> None:
    def moved(by_m: float) -> WallFrame:
        return replace(FRAME, origin_world=FRAME.origin_world + np.array([by_m, 0.0, 0.0]))

    assert FRAME.has_cells_of(moved(0.99e-4))
    assert not FRAME.has_cells_of(moved(1.01e-4))
    assert not FRAME.has_cells_of(replace(FRAME, width=6))
    # Cells that grow by so little shift the last corner: five cells by 0.2 thousandths of one.
    assert FRAME.has_cells_of(replace(FRAME, gsd_m=0.1 * (1 + 1.9e-4)))
    assert not FRAME.has_cells_of(replace(FRAME, gsd_m=0.1 * (1 + 2.2e-4)))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"gsd_m": 0.0}, "needs a positive cell size and at least one cell, got 0.0 m and 5 x 3"),
        ({"width": 0}, "at least one cell, got 0.1 m and 0 x 3"),
        ({"height": 0}, "at least one cell, got 0.1 m and 5 x 0"),
        ({"gsd_m": math.nan}, "needs a positive cell size"),
        ({"u_world": np.zeros(2)}, "an origin and three axes, each with 3 coordinates"),
        ({"v_world": -FRAME.v_world}, "these axes mirror the image"),
        ({"bend": CylinderBend(along="u", radius_m=0.05)}, "must not exceed one turn, got 5 cells"),
        ({"bend": CylinderBend(along="u", radius_m=1.0), "map_crs": "site"}, "cannot be a map"),
    ],
)
def test_what_is_no_frame_is_refused(change: dict[str, object], sentence: str) -> None:
    with pytest.raises(GeometryError, match=sentence):
        replace(FRAME, **change)  # type: ignore[arg-type]


def leaning(deg: float) -> NDArray[np.float64]:
    """A normal to the south that rises by so much."""
    return np.array([0.0, -math.cos(math.radians(deg)), math.sin(math.radians(deg))])


@pytest.mark.parametrize("direction", UP_VECTORS, ids=str)
@pytest.mark.parametrize("rise_deg", [0.0, 45.0, 79.9, -79.9])
def test_on_walls_u_is_level_and_to_the_right(rise_deg: float, direction: UpDirection) -> None:
    up = up_vector(direction)
    normal = leaning(rise_deg) @ basis_from_up(up)
    u, v = wall_axes(normal, up)
    assert u @ up == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(np.cross(u, v), -normal, atol=1e-12)
    # Downwards as far as the plane lets it.
    assert v @ up == pytest.approx(-math.cos(math.radians(rise_deg)))


@pytest.mark.parametrize("rise_deg", [80.1, 90.0, -80.1])
def test_floors_read_like_a_map_whichever_way_they_lean(rise_deg: float) -> None:
    for around_deg in (0.0, 77.0, 200.0):
        turn = math.radians(around_deg)
        south = leaning(rise_deg)
        normal = np.array([-math.sin(turn) * south[1], math.cos(turn) * south[1], south[2]])
        u, v = wall_axes(normal, UP)
        # e1 laid into the plane: within ten degrees of it.
        assert u[0] > math.cos(math.radians(10.0))
        assert u @ normal == pytest.approx(0.0, abs=1e-12)
        assert np.linalg.norm(u) == pytest.approx(1.0)
        np.testing.assert_allclose(np.cross(u, v), -normal, atol=1e-12)


@pytest.mark.parametrize(
    ("size_m", "cells"),
    [
        ((0.5, 0.3), (5, 3)),
        ((0.5 + 9e-8, 0.3), (5, 3)),
        ((0.5 + 2e-7, 0.3), (6, 3)),
        ((0.51, 0.39), (6, 4)),
        ((0.01, 0.02), (1, 1)),
        ((1e-9, 0.3), (1, 3)),
    ],
)
def test_grids_cover_their_rectangles(size_m: tuple[float, float], cells: tuple[int, int]) -> None:
    frame = over_rectangle(*size_m)
    assert (frame.width, frame.height) == cells
    np.testing.assert_array_equal(frame.origin_world, FRAME.origin_world)
    np.testing.assert_allclose(frame.u_world, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(frame.v_world, [0.0, 0.0, -1.0])


def over_rectangle(width_m: float, height_m: float) -> WallFrame:
    steps_m = np.array([[0, 0, 0], [0, 0, -height_m], [width_m, 0, -height_m], [width_m, 0, 0]])
    return frame_over(FRAME.origin_world + steps_m, FRAME.normal_world, gsd_m=FRAME.gsd_m)


@pytest.mark.parametrize("flat", [(1.0, 0.0), (0.0, 1.0), (0.0, 0.0)])
def test_a_rectangle_without_an_area_is_refused(flat: tuple[float, float]) -> None:
    with pytest.raises(GeometryError, match="the area of a rectangle must not be 0"):
        over_rectangle(*flat)


# Two metres along (0.6, 0, 0.8).
PLANE = Plane(normal=np.array([0.6, 0.0, 0.8]), offset_m=2.0)


def test_distances_are_positive_on_the_side_of_the_normal() -> None:
    points = np.array([[1.2, 7.0, 1.6], [0.0, 0.0, 0.0], [3.0, -1.0, 4.0]])
    np.testing.assert_allclose(PLANE.distances_m(points), [0.0, -2.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(PLANE.flipped().distances_m(points), [0.0, 2.0, -3.0], atol=1e-12)


def test_a_plane_is_turned_towards_who_looks() -> None:
    assert PLANE.towards(np.array([3.0, 0.0, 4.0])) is PLANE
    # Who stands in it sees it as it is.
    assert PLANE.towards(np.array([2.0, 5.0, 1.0])) is PLANE
    turned = PLANE.towards(np.zeros(3))
    np.testing.assert_array_equal(turned.normal, -PLANE.normal)
    assert turned.offset_m == -2.0


@pytest.mark.parametrize("seed", seeds(3))
def test_a_plane_runs_through_its_three_points_by_the_right_hand_rule(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 5.0, (3, 3))
    plane = plane_through(points)
    np.testing.assert_allclose(plane.distances_m(points), 0.0, atol=1e-9)
    sides = np.array([points[1] - points[0], points[2] - points[0], plane.normal])
    assert np.linalg.det(sides) > 0.0


@pytest.mark.parametrize(
    "points",
    [
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [1, 0, 0], [2, 1e-9, 0]],
        [[0, 0, 0], [1, 0, 0], [math.nan, 1, 0]],
    ],
)
def test_points_on_a_line_span_no_plane(points: list[list[float]]) -> None:
    with pytest.raises(GeometryError, match="three points must define a plane"):
        plane_through(np.array(points, dtype=np.float64))


def test_points_nearly_on_a_line_span_one() -> None:
    # Of a triangle two metres long five micrometres high.
    plane = plane_through(np.array([[0.0, 0.0, 0.0], [1.0, 5e-6, 0.0], [2.0, 0.0, 0.0]]))
    np.testing.assert_allclose(plane.normal, [0.0, 0.0, -1.0])


@pytest.mark.parametrize("deg", [0.0, 1e-7, 30.0, 90.0, 179.999, 180.0])
def test_angles_are_exact_near_none_and_near_a_half_turn(deg: float) -> None:
    turn = math.radians(deg)
    rotation = scenes.random_rotation(np.random.default_rng(1))
    first = rotation @ np.array([1.0, 0.0, 0.0])
    second = rotation @ np.array([math.cos(turn), math.sin(turn), 0.0])
    assert angle_between_deg(first, second) == pytest.approx(deg, abs=1e-12, rel=1e-6)


@pytest.mark.parametrize("omega_deg", [0.0, 45.0, 135.0, 200.0, 315.0, 359.0])
@pytest.mark.parametrize("phi_deg", [-89.0, -30.0, 0.0, 60.0])
def test_normals_have_a_direction_and_an_inclination(omega_deg: float, phi_deg: float) -> None:
    omega, phi = math.radians(omega_deg), math.radians(phi_deg)
    normal = np.array(
        [math.cos(phi) * math.cos(omega), math.cos(phi) * math.sin(omega), math.sin(phi)]
    )
    found = omega_phi_deg(normal, UP)
    assert found[0] % 360.0 == found[0]
    assert (found[0] - omega_deg + 180.0) % 360.0 == pytest.approx(180.0, abs=1e-9)
    assert found[1] == pytest.approx(phi_deg, abs=1e-9)


def test_straight_up_is_ninety_degrees_though_rounding_goes_beyond() -> None:
    assert omega_phi_deg(np.array([0.0, 0.0, 1.0 + 1e-12]), UP)[1] == 90.0
    assert omega_phi_deg(np.array([0.0, 0.0, -1.0 - 1e-12]), UP)[1] == -90.0


_L_SHAPE = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [1.0, 1.0], [1.0, 2.0], [0.0, 2.0]])


def test_an_area_has_the_sign_of_its_turn() -> None:
    assert signed_area(_L_SHAPE) == pytest.approx(4.0)
    assert signed_area(_L_SHAPE[::-1]) == pytest.approx(-4.0)
    assert signed_area(np.roll(_L_SHAPE, 2, axis=0) - np.array([7.0, 3.0])) == pytest.approx(4.0)
    assert signed_area(_L_SHAPE[:2]) == 0.0


ANGLES = [0.0, 1e-9, 0.9e-8, 1.1e-8, 1e-3, 1.0, 3.0, np.pi, 4.0]


@pytest.mark.parametrize("angle", ANGLES)
def test_rotation_vectors_turn_about_themselves(angle: float) -> None:
    vector = angle * np.array([0.48, -0.6, 0.64])
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_from_vector(vector), expected, atol=1e-15)


@pytest.mark.parametrize("direction", UP_VECTORS, ids=str)
def test_the_frame_of_an_up_direction_is_right_handed(direction: UpDirection) -> None:
    basis = basis_from_up(up_vector(direction))
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(basis) == pytest.approx(1.0)
    np.testing.assert_array_equal(basis[2], up_vector(direction))
    if direction == "z":
        np.testing.assert_array_equal(basis, np.eye(3))
