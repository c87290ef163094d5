"""Scenes in the making: corners of all rectangles in the coordinates of the wall they are for."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.simulate.building import (
    Extent,
    Paint,
    SceneDraft,
    Side,
    Surface,
    add_block,
    wall_side,
)

from orthoflow.geometry.scenes import SurfaceRole, TextureKind

PAINT = Paint(kind=TextureKind.PLAIN, rgb=(10.0, 20.0, 30.0), reflectance=0.4)
EXTENT: Extent = (-0.5, 1.0, 0.25, 0.75)
Corner = tuple[float, ...]


def a_wall() -> Side:
    return wall_side(SceneDraft(), omega_deg=102.0, phi_deg=0.8, distance_m=2.4)


def corners_of(surface: Surface) -> NDArray[np.float64]:
    a0, a1, b0, b1 = surface.extent
    return np.array(
        [
            surface.centre + a * surface.axis_a + b * surface.axis_b
            for a in (a0, a1)
            for b in (b0, b1)
        ]
    )


def on_wall(side: Side, surface: Surface) -> frozenset[Corner]:
    """Corners of a rectangle: right, up and before the wall, metres."""
    off = corners_of(surface) - side.foot
    axes = np.stack([side.axis_a, side.axis_b, side.normal])
    return frozenset(tuple(np.round(corner, 9) + 0.0) for corner in off @ axes.T)


def cuboid(extent: Extent, low_m: float, high_m: float) -> dict[str, frozenset[Corner]]:
    """Faces of a box along a wall, each as its corners."""
    a0, a1, b0, b1 = extent
    corners = list(itertools.product((a0, a1), (b0, b1), (low_m, high_m)))
    places = {"left": (0, a0), "right": (0, a1), "low": (1, b0), "high": (1, b1)}
    ends = {"back": (2, low_m), "front": (2, high_m)}
    return {
        name: frozenset(corner for corner in corners if corner[axis] == value)
        for name, (axis, value) in {**places, **ends}.items()
    }


SIDES = ("left", "right", "low", "high")


def test_a_box_is_closed_but_for_its_back() -> None:
    side = a_wall()
    side.box(EXTENT, 0.1, PAINT)
    faces = cuboid(EXTENT, 0.0, 0.1)
    found = [on_wall(side, surface) for surface in side.draft.surfaces]
    assert len(found) == 5
    assert set(found) == {faces[name] for name in (*SIDES, "front")}
    assert {surface.role for surface in side.draft.surfaces} == {SurfaceRole.RELIEF}
    assert {surface.plane for surface in side.draft.surfaces} == {-1}


def test_bars_are_a_frame_without_gap_or_overlap() -> None:
    side = a_wall()
    side.bars(EXTENT, 0.1, 0.02, PAINT, base_m=0.01)
    fronts = side.draft.surfaces[::5]
    assert len(side.draft.surfaces) == 20
    inner = (-0.4, 0.9, 0.35, 0.65)
    area = sum((e[1] - e[0]) * (e[3] - e[2]) for e in (front.extent for front in fronts))
    assert area == pytest.approx(1.5 * 0.5 - 1.3 * 0.3)
    rng = np.random.default_rng(1)
    for a, b in rng.uniform([-0.6, 0.15], [1.1, 0.85], (200, 2)):
        covered = sum(e[0] < a < e[1] and e[2] < b < e[3] for e in (f.extent for f in fronts))
        is_out = EXTENT[0] < a < EXTENT[1] and EXTENT[2] < b < EXTENT[3]
        is_in = inner[0] < a < inner[1] and inner[2] < b < inner[3]
        assert covered == (is_out and not is_in)
    for front in fronts:
        assert all(corner[2] == pytest.approx(0.03) for corner in on_wall(side, front))


def test_a_recess_leads_from_the_wall_to_its_back_and_needs_a_hole_of_its_size() -> None:
    side = a_wall()
    plane = side.true_plane("niche", EXTENT, -0.25)
    assert side.recess(EXTENT, 0.25, PAINT, plane=plane) == EXTENT
    faces = cuboid(EXTENT, -0.25, 0.0)
    back, *rims = side.draft.surfaces
    assert on_wall(side, back) == faces["back"]
    assert {on_wall(side, rim) for rim in rims} == {faces[name] for name in SIDES}
    assert len(rims) == 4
    assert (back.plane, {rim.plane for rim in rims}) == (0, {-1})
    assert {surface.role for surface in (back, *rims)} == {SurfaceRole.RECESS}
    (true,) = side.draft.planes
    assert true.name == "niche"
    np.testing.assert_allclose(true.plane.distances_m(corners_of(back)), 0.0, atol=1e-12)
    np.testing.assert_allclose(true.plane.normal, side.normal)
    # From the top left for the viewer, counter-clockwise.
    a0, a1, b0, b1 = EXTENT
    expected = [
        side.foot - 0.25 * side.normal + a * side.axis_a + b * side.axis_b
        for a, b in ((a0, b1), (a0, b0), (a1, b0), (a1, b1))
    ]
    np.testing.assert_allclose(true.outline, expected, atol=1e-12)
    assert side.true_plane("next", EXTENT) == 1
    np.testing.assert_allclose(
        side.draft.planes[1].plane.distances_m(side.foot[None]), 0.0, atol=1e-12
    )


@pytest.mark.parametrize("yaw_deg", [30.0, 200.0])
def test_a_block_stands_turned_about_its_middle_and_open_below(yaw_deg: float) -> None:
    draft = SceneDraft()
    base, size_m = np.array([0.4, -0.3, -1.5]), (0.9, 0.1, 1.3)
    add_block(draft, base=base, yaw_deg=yaw_deg, size_m=size_m, paint=PAINT)
    yaw = math.radians(yaw_deg)
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0]])
    turn = np.vstack([turn, [0.0, 0.0, 1.0]])
    found = {
        frozenset(
            tuple(np.round(corner, 9) + 0.0) for corner in (corners_of(surface) - base) @ turn
        )
        for surface in draft.surfaces
    }
    faces = cuboid((-0.45, 0.45, -0.05, 0.05), 0.0, 1.3)
    assert found == {faces[name] for name in (*SIDES, "front")}
    assert len(draft.surfaces) == 5
    for surface in draft.surfaces:
        assert surface.axis_a @ surface.axis_b == pytest.approx(0.0, abs=1e-12)
        assert (surface.role, surface.plane) == (SurfaceRole.OBJECT, -1)
