"""Positions of check points in images, found as targets or by the scene, and on their walls."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect.patches import GreyImage
from orthoflow_plugins.inspect.point_places import (
    Picture,
    PointFinder,
    find_by_truth,
    point_on_surface,
)
from orthoflow_plugins.inspect.targets import find_crossing
from orthoflow_plugins.simulate.building import Extent, Paint, SceneDraft, wall_side
from scipy.ndimage import gaussian_filter

from orthoflow.geometry import WallFrame, frame_over
from orthoflow.geometry.levels import REC_601
from orthoflow.geometry.scene_views import render
from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from orthoflow.products import Truth, Wall
from orthoflow.testing.examples import example
from tests import samples
from tests.inspect_scenes import SHAPE, points_at, walls

RADIUS_M = 0.04


def wall_with(depth_m: NDArray[np.float64]) -> Wall:
    return replace(walls().walls[0], depth_m=depth_m.astype(np.float32))


@pytest.mark.parametrize(("n_known", "is_found"), [(0, False), (11, False), (12, True)])
def test_twelve_depths_make_a_surface(n_known: int, *, is_found: bool) -> None:
    depth = np.full(SHAPE, np.nan)
    rows, cols = np.unravel_index(np.arange(n_known), (3, 4))
    depth[139 + rows, 179 + cols] = 0.02
    found = point_on_surface(wall_with(depth), np.array([181.0, 140.5]), RADIUS_M)
    assert (found is not None) == is_found


# The textured wall of 1.2 m x 1 m at y = 2 has 5 mm cells.
CELL_M = 0.005
FULL: Extent = (-0.6, 0.6, -0.5, 0.5)


@cache
def painted() -> tuple[Truth, WallFrame]:
    draft = SceneDraft()
    side = wall_side(draft, omega_deg=90.0, phi_deg=0.0, distance_m=2.0)
    fresco = Paint(kind=TextureKind.FRESCO, rgb=(180.0, 170.0, 150.0), reflectance=0.5, seed=7)
    plane = side.true_plane("wall", FULL)
    side.place(FULL, 0.0, fresco, SurfaceRole.WALL, plane=plane)
    truth = example("truth")
    assert isinstance(truth, Truth)
    made = replace(truth, scene=draft.finished(spectral_gap=0.0))
    outline = draft.planes[plane]
    return made, frame_over(outline.outline, outline.plane.normal, gsd_m=CELL_M)


@cache
def shown_grey(right: float, down: float) -> GreyImage:
    """Return an image displaced by a number of cells to the right and down."""
    truth, where = painted()
    moved = -CELL_M * (right * where.u_world + down * where.v_world)
    shown = replace(where, origin_world=where.origin_world + moved)
    true = render(truth.scene, shown, front_m=0.1, behind_m=0.1)
    known = np.isfinite(true.rgb).all(axis=2)
    return GreyImage(
        grey=np.where(known, np.nan_to_num(true.rgb) @ REC_601, 0.0), valid=known, region=known
    )


def by_truth(picture: GreyImage) -> NDArray[np.float64] | None:
    truth, where = painted()
    place = np.array([120.0, 100.0])
    return find_by_truth(picture, where, place, truth, buffers_m=(0.1, 0.1), search_cells=5)


def test_light_and_contrast_do_not_matter_and_another_picture_shows_nothing() -> None:
    there = shown_grey(2.4, -1.3)
    darker = replace(there, grey=0.9 * there.grey + 7.0)
    found = by_truth(darker)
    assert found is not None
    np.testing.assert_allclose(found, [122.4, 98.7], atol=0.05)
    noise = np.random.default_rng(4).uniform(0.0, 255.0, there.grey.shape)
    assert by_truth(replace(there, grey=noise)) is None


@pytest.mark.parametrize(("reach", "is_found"), [(1, False), (9, True)])
def test_the_point_counts_and_not_what_is_far_from_it(reach: int, is_found: bool) -> None:
    # Cells within the reach are valid; a Gaussian of five cells weights them.
    there = shown_grey(0.0, 0.0)
    rows, columns = np.indices(there.grey.shape) + 0.5
    near = (np.abs(columns - 120.0) < reach + 1) & (np.abs(rows - 100.0) < reach + 1)
    found = by_truth(replace(there, valid=there.valid & near))
    assert (found is not None) == is_found
    # A displacement of ten cells elsewhere has no effect.
    far = shown_grey(10.0, 0.0)
    mixed = replace(
        there, grey=np.where(np.hypot(columns - 120, rows - 100) < 13, there.grey, far.grey)
    )
    place = by_truth(mixed)
    assert place is not None
    np.testing.assert_allclose(place, [120.0, 100.0], atol=0.1)


def finder(
    points: NDArray[np.float64], *, truth: bool = False, wall: int = -1, **known: Any
) -> PointFinder:
    """Return a finder on two parallel walls, the second 0.1 m in front of the first."""
    made, where = painted()
    frames = [where, replace(where, origin_world=where.origin_world + 0.1 * where.normal_world)]
    rasters = [samples.wall(item, plane_index=4 + k) for k, item in enumerate(frames)]
    on_both = samples.walls(*rasters, buffer_m=0.15)
    black = np.zeros((*where.shape, 3), dtype=np.uint8)
    pictures = [
        Picture(
            wall=k,
            frame=raster.frame,
            grey=shown_grey(1.5, 0.5),
            surface=raster,
            image=samples.orthoimage(raster.frame, rgb=black, plane_index=4 + k),
        )
        for k, raster in enumerate(rasters)
    ]
    checks = replace(points_at(points), wall=np.full(len(points), wall, np.int32), **known)
    return PointFinder(
        pictures=pictures,
        checkpoints=checks,
        walls=on_both,
        truth=made if truth else None,
        search_m=0.02,
        target_radius_m=0.05,
    )


def at(column: float, row: float, depth_m: float) -> NDArray[np.float64]:
    """Return a world point (1, 3) on the first wall."""
    return painted()[1].world_from_wall(np.array([[column, row]]), np.array([depth_m]))


@pytest.mark.parametrize(
    ("depth_m", "wall"),
    [(0.01, 0), (0.04, 0), (0.06, 1), (0.24, 1), (0.26, -1), (-0.14, 0), (-0.16, -1)],
)
def test_a_point_is_looked_for_on_the_nearest_wall_that_holds_it(depth_m: float, wall: int) -> None:
    found = finder(at(120.0, 100.0, depth_m), truth=True).find(0)
    assert found.wall == wall
    assert found.how == ("truth" if wall == 0 else "outside" if wall < 0 else found.how)
    if wall >= 0:
        np.testing.assert_allclose(found.expected, [120.0, 100.0], atol=1e-6)
    else:
        assert np.isnan(found.place).all()
    if wall == 0:
        np.testing.assert_allclose(found.place - found.expected, [1.5, 0.5], atol=0.05)
    assert np.isnan(found.point_world).all()
    assert found.point_world.shape == (3,)


@pytest.mark.parametrize(("off_m", "is_found"), [(0.015, True), (0.045, False)])
def test_a_target_is_found_and_back_projected(off_m: float, is_found: bool) -> None:
    # The target has quadrants of 5 cm around the middle of the wall, which project by 1 cm.
    rows, columns = np.indices((200, 240)) + 0.5
    bright = np.where((columns > 120.0) == (rows > 100.0), 220.0, 40.0)
    grey = gaussian_filter(bright, 0.8)
    known = np.ones(grey.shape, dtype=np.bool_)
    looked_for = finder(at(120.0 + off_m / CELL_M, 100.0, 0.0))
    depth = np.zeros(grey.shape, dtype=np.float32)
    depth[np.hypot(columns - 120.0, rows - 100.0) < 6.5] = 0.01
    picture = replace(
        looked_for.pictures[0],
        grey=GreyImage(grey=grey, valid=known, region=known),
        surface=replace(looked_for.pictures[0].surface, depth_m=depth),
    )
    found = replace(looked_for, pictures=[picture]).find(0)
    assert found.how == ("target" if is_found else "not found")
    if is_found:
        np.testing.assert_allclose(found.place, [120.0, 100.0], atol=0.05)
        # The depth is computed within half of the target's radius.
        np.testing.assert_allclose(found.point_world[None], at(120.0, 100.0, 0.01), atol=3e-4)


def test_places_in_metres_count_before_those_in_cells() -> None:
    where = painted()[1]
    place_m = np.array([[0.2, -0.3], [np.nan, np.nan]])
    pixels = np.array([[33.0, 44.0], [55.0, 66.0]])
    both = np.vstack([at(120.0, 100.0, 0.0)] * 2)
    found = finder(both, pixels_wall=pixels, places_m=place_m, wall=4)
    np.testing.assert_allclose(found.find(0).place, where.wall_from_raster(place_m[0]))
    np.testing.assert_array_equal(found.find(1).place, [55.0, 66.0])


SIDE = 120
CENTRE = np.array([60.0, 60.0])
RADIUS = 20.0


@cache
def quadrants(turned_deg: float = 20.0) -> NDArray[np.float64]:
    """Return four quadrants around the middle, with borders one cell wide."""
    fine = (np.arange(4 * SIDE) + 0.5) / 4.0
    columns, rows = np.meshgrid(fine - CENTRE[0], fine - CENTRE[1])
    turn = np.radians(turned_deg)
    one = columns * np.cos(turn) + rows * np.sin(turn)
    other = rows * np.cos(turn) - columns * np.sin(turn)
    bright = gaussian_filter(np.where(one * other > 0.0, 220.0, 40.0), 2.0)
    return np.asarray(bright.reshape(SIDE, 4, SIDE, 4).mean(axis=(1, 3)))


def crossing(
    grey: NDArray[np.float64],
    near: tuple[float, float] = (60.0, 60.0),
    valid: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64] | None:
    known = np.ones(grey.shape, dtype=np.bool_) if valid is None else valid
    picture = GreyImage(grey=np.where(known, grey, 0.0), valid=known, region=known)
    return find_crossing(picture, np.array(near), search_cells=8.0, radius_cells=RADIUS)


def test_edges_discs_and_even_places_are_no_targets() -> None:
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5
    edge = gaussian_filter(np.where(columns < 60.0, 40.0, 220.0), 0.7)
    disc = gaussian_filter(np.where(np.hypot(columns - 60, rows - 60) < 12.0, 40.0, 220.0), 0.7)
    # Test a single dark quadrant, and a saddle that is symmetric under a half turn but not under a
    # quarter turn.
    wedge = gaussian_filter(np.where((columns > 60.0) & (rows > 60.0), 220.0, 40.0), 0.7)
    for grey in (edge, disc, wedge, np.full((SIDE, SIDE), 90.0)):
        assert crossing(grey) is None


@pytest.mark.parametrize(("share", "is_found"), [(0.8, True), (0.35, False)])
def test_half_of_a_target_must_be_there_on_both_sides(share: float, is_found: bool) -> None:
    # There is a void strip through the middle; cells opposite void ones are not used either.
    rows = np.mgrid[:SIDE, :SIDE][0] + 0.5
    valid = np.abs(rows - 60.0) <= share * RADIUS
    assert (crossing(quadrants(), valid=valid) is not None) == is_found


@pytest.mark.parametrize("turned_deg", [0.0, 20.0, 33.0])
def test_the_centre_of_a_target_is_found_in_noise_and_holes(turned_deg: float) -> None:
    rng = np.random.default_rng(3)
    noisy = quadrants(turned_deg) + rng.normal(scale=6.0, size=(SIDE, SIDE))
    place = crossing(noisy, (55.0, 64.0), rng.random(noisy.shape) > 0.3)
    assert place is not None
    np.testing.assert_allclose(place, CENTRE, atol=0.06)  # cells
