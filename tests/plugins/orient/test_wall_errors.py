"""What an uncertain pose means on a wall, for shifts whose effect there is known by algebra."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient.gates import (
    KnownWall,
    known_walls,
    sigmas_on_wall,
    wall_error,
)

from orthoflow.geometry.cameras import LensFreedom, ViewingCamera, looking_at
from orthoflow.geometry.resection import Resection
from tests import samples

DISTANCE_M = 3.0
SIZE_PX = (800, 600)


def camera(*, turn_deg: float = 0.0) -> ViewingCamera:
    """Before the middle of the wall y = 0, at y = -3, turned to the right."""
    centre = np.array([0.0, -DISTANCE_M, 0.0])
    turn = math.radians(turn_deg)
    ahead = centre + np.array([math.sin(turn), math.cos(turn), 0.0])
    return samples.camera(
        looking_at(centre, ahead, samples.UP),
        centre,
        width=SIZE_PX[0],
        height=SIZE_PX[1],
        fx=600.0,
        fy=600.0,
        cx=400.0,
        cy=300.0,
    )


def wall(half_m: tuple[float, float] = (1.0, 0.5)) -> KnownWall:
    across, up = half_m
    corners = [[-across, 0.0, up], [-across, 0.0, -up], [across, 0.0, -up], [across, 0.0, up]]
    return KnownWall(
        index=0,
        number=0,
        name="wall 0",
        corners_world=np.array(corners),
        normal=np.array([0.0, -1.0, 0.0]),
        gsd_m=0.002,
        has_side=True,
    )


def posed(
    shift_sigma_m: tuple[float, float, float], viewer: ViewingCamera | None = None
) -> Resection:
    """A pose of which nothing but the place of the camera is uncertain, along its own axes."""
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.diag(np.square(shift_sigma_m))
    return Resection(
        camera=camera() if viewer is None else viewer,
        covariance=covariance,
        sigma0=1.0,
        variance_factor=1.0,
        lens=LensFreedom(),
    )


def centres(shape: tuple[int, int], half_m: tuple[float, float]) -> NDArray[np.float64]:
    """Middles (rows, cols, 2) of a grid over a wall: right and down from its middle, metres."""
    down, right = (
        half * (2.0 * (np.arange(n) + 0.5) / n - 1.0)
        for n, half in zip(shape, half_m[::-1], strict=True)
    )
    return np.stack(np.meshgrid(right, down), axis=-1)


def test_a_camera_that_may_stand_aside_shows_the_wall_as_much_aside() -> None:
    found = wall_error(posed((0.003, 0.004, 0.0)), [wall()])
    assert found is not None
    # Of a coordinate: the root of the mean of both.
    expected = math.sqrt(0.5 * (0.003**2 + 0.004**2))
    np.testing.assert_allclose(found.sigmas_m, expected, rtol=1e-6)
    assert found.rms_m == pytest.approx(expected)
    assert found.worst_m == pytest.approx(expected)
    # The photo is 4 m x 3 m wide there: its corners show nothing of 2 m x 1 m.
    assert np.isnan(found.corners_m).all()
    assert len(found.footprint_px) == len(found.sigmas_m) == 15 * 15
    pixels = SIZE_PX / np.array([2.0, 2.0]) + 200.0 * centres((15, 15), (1.0, 0.5)).reshape(-1, 2)
    np.testing.assert_allclose(found.footprint_px, pixels, atol=1e-6)


def test_a_camera_that_may_stand_nearer_is_worst_far_from_the_middle() -> None:
    resection = posed((0.0, 0.0, 0.006))
    grid = sigmas_on_wall(resection, wall(), (4, 6))
    aside = np.linalg.norm(centres((4, 6), (1.0, 0.5)), axis=2)
    np.testing.assert_allclose(grid, 0.006 * aside / DISTANCE_M / math.sqrt(2.0), rtol=1e-6)
    found = wall_error(resection, [wall()])
    assert found is not None
    assert found.rms_m == pytest.approx(float(np.sqrt(np.mean(found.sigmas_m**2))))
    assert found.worst_m == pytest.approx(float(found.sigmas_m.max()))


def test_corners_of_the_photo_count_where_they_show_a_wall() -> None:
    # 2 m and 1.5 m from the middle, but for half a pixel.
    for half_m in ((2.5, 1.3), (1.7, 2.0)):
        found = wall_error(posed((0.0, 0.0, 0.006)), [wall(half_m)])
        assert found is not None
        assert np.isnan(found.corners_m).all()
        assert found.worst_m == pytest.approx(float(found.sigmas_m.max()))
    found = wall_error(posed((0.0, 0.0, 0.006)), [wall((2.5, 2.0))])
    assert found is not None
    aside = math.hypot(399.5, 299.5) / 600.0 * DISTANCE_M
    expected = 0.006 * aside / DISTANCE_M / math.sqrt(2.0)
    np.testing.assert_allclose(found.corners_m, expected, rtol=1e-6)
    assert found.worst_m == pytest.approx(expected)
    assert found.worst_m > found.sigmas_m.max()


def test_a_photo_that_shows_no_wall_has_no_error() -> None:
    resection = posed((0.001, 0.001, 0.001), camera(turn_deg=180.0))
    assert wall_error(resection, [wall()]) is None
    assert wall_error(resection, []) is None
    assert np.isnan(sigmas_on_wall(resection, wall(), (3, 3))).all()


@pytest.mark.parametrize(("aside_m", "is_shown"), [(29.0, True), (31.0, False)])
def test_places_seen_flatter_than_one_in_ten_are_not_shown(aside_m: float, is_shown: bool) -> None:
    # A cosine of 0.1 is a slope of 9.95 to one.
    corners = np.array([[0, 0, 0.1], [0, 0, -0.1], [0.2, 0, -0.1], [0.2, 0, 0.1]])
    strip = replace(wall(), corners_world=corners + np.array([aside_m - 0.1, 0, 0]))
    sideways = camera(turn_deg=84.0)
    found = wall_error(posed((0.001, 0.001, 0.001), sideways), [strip])
    assert (found is not None) == is_shown


def test_walls_are_as_ties_describe_them_or_through_their_points() -> None:
    rng = np.random.default_rng(2)
    places = rng.uniform(-1.0, 1.0, (40, 2)) * [2.0, 0.5]
    turn = math.radians(30.0)
    along = np.array([math.cos(turn), math.sin(turn), 0.0])
    points = np.array([5.0, 7.0, 1.0]) + places[:, :1] * along + places[:, 1:] * samples.UP
    described = replace(samples.tie_wall(wall().corners_world, 0.004), plane_index=6)
    number = np.repeat([0, 1, 2, -1], [15, 20, 2, 3]).astype(np.int32)
    ties = samples.ties(
        np.zeros((40, 2)),
        points_world=points,
        wall=number,
        sigma_px=np.ones(40),
        sigma_m=np.ones(40),
        walls=(described,),
    )
    first, second = known_walls(ties, np.ones(40, dtype=np.bool_))
    assert (first.index, first.number, first.gsd_m, first.has_side) == (0, 6, 0.004, True)
    np.testing.assert_array_equal(first.corners_world, wall().corners_world)
    np.testing.assert_array_equal(first.normal, [0.0, -1.0, 0.0])
    # Two points make no wall; of the twenty, the rectangle about them in their plane.
    assert (second.index, second.number, second.gsd_m, second.has_side) == (1, 1, None, False)
    own = points[15:35]
    across = np.cross(along, samples.UP)
    assert abs(second.normal @ across) == pytest.approx(1.0)
    np.testing.assert_allclose((second.corners_world - own[0]) @ across, 0.0, atol=1e-9)
    sides = second.corners_world[[1, 3]] - second.corners_world[0]
    shares = (own - second.corners_world[0]) @ sides.T / (sides**2).sum(axis=1)
    np.testing.assert_allclose(
        [shares.min(axis=0), shares.max(axis=0)], [[0, 0], [1, 1]], atol=1e-9
    )
    # Only chosen ties count.
    assert [item.index for item in known_walls(ties, number == 1)] == [1]
