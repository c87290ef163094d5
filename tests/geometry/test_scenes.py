"""Rays, colours, paint and true orthoimages of simulated scenes, against algebra."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry import WallFrame, scene_rays
from orthoflow.geometry.scene_views import TrueOrthoimage, render
from orthoflow.geometry.scenes import (
    Scene,
    SurfaceRole,
    TextureKind,
    Viewers,
    cell_states,
    normals,
    uniforms,
)
from tests import samples, scenes
from tests.long_loops import seeds
from tests.scene_rays import a_scene, cast, colours_at


def random_scene(seed: int, n_rectangles: int = 40) -> Scene:
    rng = np.random.default_rng(seed)
    rows: list[dict[str, object]] = []
    for index in range(n_rectangles):
        turn = scenes.random_rotation(rng)
        rows.append(
            {
                "centre": rng.uniform(-3.0, 3.0, 3),
                "a": turn[0],
                "b": turn[1],
                "extent": (-0.6, 0.5, -0.4, 0.9),
                "kind": index % len(TextureKind),
            }
        )
    return a_scene(
        rows, [(3, (-0.1, 0.1, -0.1, 0.3)), (3, (0.2, 0.4, 0, 0.1)), (9, (0, 0.4, 0, 0.4))]
    )


def upright(y: float, extent: tuple[float, ...]) -> dict[str, object]:
    """A rectangle in a plane of one y."""
    return {"centre": (0, y, 0), "a": (1, 0, 0), "b": (0, 0, 1), "extent": extent}


WALL = upright(0.0, (-2, 2, -1, 1))


def wall_with_screen() -> Scene:
    """A wall in the plane y = 0 seen from y < 0, with a niche, and a screen 1 m before it."""
    niche = upright(0.2, (-1.5, -1.0, -0.5, 0.5))
    screen = {**upright(-1.0, (0.2, 0.6, -2, 2)), "role": SurfaceRole.OBJECT}
    return a_scene([WALL, niche, screen], [(0, (-1.5, -1.0, -0.5, 0.5))])


def wall_frame(gsd_m: float = 0.05) -> WallFrame:
    return samples.facing_south(gsd_m, round(4 / gsd_m), round(2 / gsd_m), (-2.0, 0.0, 1.0))


def rendered(
    scene: Scene, frame: WallFrame, buffers_m: tuple[float, float] = (0.1, 0.1), **more: Any
) -> TrueOrthoimage:
    front_m, behind_m = buffers_m
    return render(scene, frame, front_m=front_m, behind_m=behind_m, **more)


def cell_u(frame: WallFrame) -> NDArray[np.float64]:
    """World x of the cells' centres, which for this wall is the direction of u."""
    return -2.0 + frame.gsd_m * (np.arange(frame.width) + 0.5)


@pytest.mark.parametrize("seed", seeds(4))
def test_rays_hit_what_trying_every_rectangle_says(seed: int) -> None:
    scene = random_scene(seed)
    rng = np.random.default_rng(seed + 100)
    origins, directions = rng.uniform(-3, 3, (2000, 3)), rng.normal(size=(2000, 3))
    hits = cast(scene, origins, directions, cores=2)
    best, first = np.full(2000, np.inf), np.full(2000, -1)
    for index in range(len(scene)):
        normal = scene.normal[index]
        t = ((scene.centre[index] - origins) @ normal) / (directions @ normal)
        relative = origins + t[:, None] * directions - scene.centre[index]
        a, b = relative @ scene.axis_a[index], relative @ scene.axis_b[index]
        low_a, high_a, low_b, high_b = scene.extent[index]
        meets = (t > 1e-9) & (a >= low_a) & (a <= high_a) & (b >= low_b) & (b <= high_b)
        for hole in scene.hole_extent[scene.hole_rectangle == index]:
            meets &= ~((a > hole[0]) & (a < hole[1]) & (b > hole[2]) & (b < hole[3]))
        meets &= t < best
        best[meets], first[meets] = t[meets], index
    np.testing.assert_array_equal(hits.rectangle, first)
    hit = first >= 0
    assert 0.1 < hit.mean() < 0.9
    np.testing.assert_allclose(hits.t[hit], best[hit], rtol=1e-12)
    assert np.all(np.isinf(hits.t[~hit]))


@pytest.mark.parametrize("seed", seeds(2))
def test_bent_rectangles_are_hit_like_the_narrow_flat_ones_along_them(seed: int) -> None:
    rng, n_flat = np.random.default_rng(seed), 400
    extent, hole = np.array([-0.9, 1.6, -0.5, 0.7]), (0.3, 0.8, -0.2, 0.4)
    rows, bends = [], np.array([1.1, -1.3, 0.6])
    for _ in bends:
        turn = scenes.random_rotation(rng)
        centre = rng.uniform(-1.0, 1.0, 3)
        rows.append({"centre": centre, "a": turn[0], "b": turn[1], "extent": extent, "kind": 1})
    bent = replace(a_scene(rows, [(0, hole)]), curvature_per_m=bends)
    width = (extent[1] - extent[0]) / n_flat
    along = extent[0] + width * (np.arange(n_flat) + 0.5)
    flat_rows = []
    for index in range(len(bent)):
        own = np.full(n_flat, index)
        middles = bent.points_m(own, along, np.zeros(n_flat))
        for a, centre, normal in zip(along, middles, bent.normals_at(own, middles.T), strict=True):
            is_cut = index == 0 and hole[0] < a < hole[1]
            for low, high in ((-0.5, -0.2), (0.4, 0.7)) if is_cut else ((-0.5, 0.7),):
                side = {"extent": (-width / 2, width / 2, low, high)}
                axis = bent.axis_b[index]
                flat_rows.append({"centre": centre, "a": np.cross(axis, normal), "b": axis} | side)
    flat = a_scene(flat_rows, [])
    origins, directions = rng.uniform(-2, 2, (3000, 3)), rng.normal(size=(3000, 3))
    hits, near = cast(bent, origins, directions), cast(flat, origins, directions)
    is_close = np.isclose(hits.t, near.t, atol=1e-4)
    assert 0.1 < np.isfinite(hits.t).mean() < 0.9
    assert is_close.mean() > 0.995  # apart from rays along edges
    points = origins + np.where(np.isfinite(hits.t), hits.t, 0.0)[:, None] * directions
    facing = bent.normals_at(hits.rectangle, points.T)
    agree = np.abs(np.sum(facing * flat.normal[near.rectangle], axis=1))
    assert agree[is_close & np.isfinite(hits.t)].min() > 0.999


def test_a_bent_rectangle_is_painted_like_the_flat_one_that_was_bent() -> None:
    row: dict[str, object] = {**WALL, "kind": TextureKind.FRESCO}
    flat, bent = a_scene([row], []), replace(a_scene([row], []), curvature_per_m=np.array([0.7]))
    a, b = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 500))
    index = np.zeros(500, np.int32)
    colours = [colours_at(scene, index, scene.points_m(index, a, b)).rgb for scene in (flat, bent)]
    assert np.isclose(*colours, atol=0.1).mean() > 0.99


def test_the_true_orthoimage_shows_the_first_surface_within_the_buffer() -> None:
    frame = wall_frame()
    image = rendered(wall_with_screen(), frame, (0.5, 0.3))
    x = cell_u(frame)
    z = 1.0 - frame.gsd_m * (np.arange(frame.height) + 0.5)
    in_niche = ((x > -1.5) & (x < -1.0))[None, :] & (np.abs(z) < 0.5)[:, None]
    np.testing.assert_array_equal(image.rectangle, np.where(in_niche, 1, 0))
    np.testing.assert_allclose(image.depth_m, np.where(in_niche, -0.2, 0.0), atol=1e-7)


def test_surfaces_beyond_the_buffer_do_not_exist_for_the_true_orthoimage() -> None:
    image = rendered(wall_with_screen(), wall_frame(), (1.5, 0.1))
    x = cell_u(image.frame)
    on_screen = (x > 0.2) & (x < 0.6)
    assert np.all(image.rectangle[:, on_screen] == 2)
    np.testing.assert_allclose(image.depth_m[:, on_screen], 1.0, atol=1e-6)
    assert np.all(image.rectangle[15:25, (x > -1.5) & (x < -1.0)] == -1)
    assert np.all(np.isnan(image.rgb[15:25, (x > -1.5) & (x < -1.0)]))


def test_a_screen_hides_from_a_viewer_just_its_shadow() -> None:
    viewers = Viewers(positions_world=np.array([[0.0, -2.0, 0.0]]), up=scenes.UP_Z)
    image = rendered(wall_with_screen(), wall_frame(), (0.5, 0.1), viewers=viewers)
    x = cell_u(image.frame)
    # The screen is half way to the wall: its shadow from 0.2..0.6 is twice as far, 0.4..1.2.
    shadow = (x > 0.4) & (x < 1.2)
    wall_row = image.rectangle[5] == 0
    np.testing.assert_array_equal(image.seen[5][wall_row], ~shadow[wall_row])


def test_viewers_see_only_their_elevations() -> None:
    viewers = Viewers(
        positions_world=np.array([[-1.8, -1.0, 0.0]]), up=scenes.UP_Z, highest_elevation_deg=30.0
    )
    image = rendered(wall_with_screen(), wall_frame(), viewers=viewers)
    z = 1.0 - image.frame.gsd_m * (np.arange(image.frame.height) + 0.5)
    column = 3  # x = -1.825, 1.0003 m from the viewer
    limit = np.tan(np.radians(30.0)) * np.hypot(1.0, 0.025)
    np.testing.assert_array_equal(image.seen[:, column], z < limit)


def test_a_part_of_a_true_orthoimage_is_that_part_of_the_whole() -> None:
    viewers = Viewers(positions_world=np.array([[0.0, -2.0, 0.0]]), up=scenes.UP_Z)
    scene, frame = wall_with_screen(), wall_frame()
    rng = np.random.default_rng(4)
    coloured, judged = rng.random((2, *frame.shape)) < 0.4
    reach: dict[str, Any] = {"front_m": 0.5, "behind_m": 0.3, "viewers": viewers}
    masks = {"coloured": coloured, "judged": judged}
    whole, part = (render(scene, frame, **reach, **some) for some in ({}, masks))
    np.testing.assert_array_equal(part.depth_m, whole.depth_m)
    np.testing.assert_array_equal(part.rgb, np.where(coloured[:, :, None], whole.rgb, np.nan))
    np.testing.assert_array_equal(part.seen, whole.seen & judged)
    assert 0 < np.count_nonzero(part.seen) < np.count_nonzero(whole.seen)


def test_a_scene_with_arrays_that_disagree_is_refused() -> None:
    scene = wall_with_screen()
    with pytest.raises(GeometryError, match=r"scene.extent must have shape \(3, 4\), got \(2, 4\)"):
        replace(scene, extent=scene.extent[:2])
    with pytest.raises(GeometryError, match="hole_rectangle must be in ascending"):
        replace(
            scene, hole_rectangle=np.array([1, 0], dtype=np.int32), hole_extent=np.zeros((2, 4))
        )


@pytest.mark.parametrize("supersample", [1, 3])
def test_the_edge_of_a_surface_is_as_bright_as_its_middle(supersample: int) -> None:
    """Rays of a cell that miss it do not count, and the first rectangle is one as any other."""
    scene = a_scene([upright(0.0, (-0.28, 2, -0.9, 1))], [])
    scene = replace(scene, texture_params=scene.texture_params * [1, 1, 1, 1, 0, 1, 1, 1])
    frame = wall_frame(0.25)
    image = rendered(scene, frame, supersample=supersample)
    # The wall begins in the seventh cell, left of its middle, and ends in the last row below it.
    shown = np.zeros(frame.shape, dtype=np.bool_)
    shown[:, 7:] = True
    np.testing.assert_array_equal(image.rectangle >= 0, shown)
    np.testing.assert_array_equal(image.rectangle[~shown], -1)
    expected = np.where(shown[..., None], [200.0, 160.0, 120.0], np.nan)
    np.testing.assert_allclose(image.rgb, expected, atol=1e-3)


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_straight_up_and_straight_down_are_seen(up: float) -> None:
    # Before the middle of a cell, which lies above its head or below its feet.
    viewers = Viewers(positions_world=np.array([[0.25, -2.0, 0.25]]), up=np.array([0.0, up, 0.0]))
    scene, frame = a_scene([WALL], []), wall_frame(0.5)
    assert rendered(scene, frame, viewers=viewers).seen.all()


@pytest.mark.parametrize(("gap_m", "is_seen"), [(0.0003, True), (0.0008, False)])
def test_what_hides_a_wall_stands_half_a_millimetre_before_it(gap_m: float, is_seen: bool) -> None:
    film = {**upright(-gap_m, (-2, 2, -1, 1)), "role": SurfaceRole.OBJECT}
    scene = a_scene([WALL, film], [])
    viewers = Viewers(positions_world=np.array([[0.0, -2.0, 0.0]]), up=scenes.UP_Z)
    image = rendered(scene, wall_frame(0.5), (1e-4, 0.1), viewers=viewers)
    assert (image.rectangle == 0).all()
    middle = image.seen[1:3, 3:5]
    assert (middle == is_seen).all()


@pytest.mark.parametrize("n_sub", [1, 2, 3])
def test_a_cell_on_an_edge_shows_both_sides_by_their_shares(n_sub: int) -> None:
    """Its rays cross it in as many different rows, and columns, as there are rays."""
    shares = (np.arange(n_sub**2) + 0.5) / n_sub**2 < 0.4
    expected = 100.0 + 100.0 * shares.mean()
    # Two fifths of the fifth cell, from the left and from above.
    x, z = -2.0 + 0.25 * 4.4, 1.0 - 0.25 * 4.4
    for first, second, at in (
        ((-2, x, -1, 1), (x, 2, -1, 1), (2, 4)),
        ((-2, 2, z, 1), (-2, 2, -1, z), (4, 2)),
    ):
        scene = a_scene([upright(0.0, first), upright(0.0, second)], [])
        params = scene.texture_params * [1, 1, 1, 1, 0, 1, 1, 1]
        params[1, :3] = 100.0
        scene = replace(scene, texture_params=params)
        image = rendered(scene, wall_frame(0.25), supersample=n_sub)
        assert image.rgb[at][0] == pytest.approx(expected, abs=1e-3)


GOLDEN = 0x9E3779B97F4A7C15


def test_draws_of_a_state_are_the_numbers_of_splitmix64_from_there() -> None:
    bits = (0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F)
    # Of the state itself, and of one that is a number further.
    states = np.array([0, GOLDEN], dtype=np.uint64)
    for draw in (0, 1):
        expected = [(number >> 11) / 2.0**53 for number in bits[draw : draw + 2]]
        np.testing.assert_array_equal(uniforms(states, draw), expected)


def test_a_place_has_its_number_whatever_is_asked_with_it() -> None:
    columns, rows = np.arange(-40, 60), np.arange(1000, 1070)
    whole = uniforms(cell_states(columns[:, None], rows, 7), 3)
    part = uniforms(cell_states(columns[10:12, None], rows[::-5], 7), 3)
    np.testing.assert_array_equal(part, whole[10:12, ::-5])
    assert np.mean(whole == uniforms(cell_states(columns[:, None], rows, 8), 3)) < 1e-3


@pytest.mark.parametrize("seed", [0, 1, 2**62, -5])
def test_numbers_are_fairly_distributed_and_draws_independent(seed: int) -> None:
    states = cell_states(np.arange(400)[:, None], np.arange(500), seed).ravel()
    n = states.size
    even = uniforms(states, 0)
    assert even.min() >= 0.0
    assert even.max() < 1.0
    counts = np.bincount((even * 20).astype(int), minlength=20)
    # Five standard deviations of a count.
    np.testing.assert_allclose(counts, n / 20, atol=5.0 * np.sqrt(n / 20))
    bell = normals(states, 10)
    assert bell.mean() == pytest.approx(0.0, abs=5.0 / np.sqrt(n))
    assert bell.std() == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * n))
    assert np.mean(np.abs(bell) > 2.0) == pytest.approx(0.0455, abs=5.0 * np.sqrt(0.0455 / n))
    together = np.corrcoef([even, bell, normals(states, 12), np.roll(bell, 1)])
    np.testing.assert_allclose(together, np.eye(4), atol=5.0 / np.sqrt(n))


SEED = 7


@numba.njit
def colour_at(kind: int, params: NDArray[np.float64], a: float, b: float) -> tuple[float, ...]:
    """Parts of kernels have no way in from Python."""
    return scene_rays.colour_at(kind, params, a, b)


@pytest.mark.parametrize("kind", list(TextureKind))
def test_colours_stay_within_what_a_photo_and_a_laser_tell(kind: TextureKind) -> None:
    params = np.array([250.0, 5.0, 120.0, 0.9, 1.0, 0.2, 3.0, 0.5])
    places = np.random.default_rng(SEED).uniform(0.0, 2.0, (400, 2))
    shades = np.array([colour_at(np.int32(kind), params, a, b) for a, b in places])
    assert (shades[:, :3] >= 0.0).all()
    assert (shades[:, :3] <= 255.0).all()
    assert shades[:, 0].max() == 255.0
    assert (shades[:, 3] >= 0.01).all()
    assert (shades[:, 3] <= 1.0).all()
    # Without contrast nothing but the ground is left.
    plain = params * [1, 1, 1, 1, 0, 1, 1, 1]
    ground = np.array([colour_at(np.int32(kind), plain, a, b) for a, b in places])
    np.testing.assert_allclose(ground, np.tile([250.0, 5.0, 120.0, 0.9], (400, 1)))


@pytest.mark.parametrize("gap", [0.0, 1.0])
def test_light_is_seen_by_eye_and_laser_alike_unless_there_is_a_gap(gap: float) -> None:
    params = np.array([120.0, 120.0, 120.0, 0.5, 0.3, 0.2, 3.0, gap])
    places = np.random.default_rng(SEED).uniform(0.0, 20.0, (2000, 2))
    shades = np.array([colour_at(0, params, a, b) for a, b in places])
    # Warmth takes from blue what it gives to red: their mean is the light alone.
    light = (shades[:, 0] + shades[:, 2]) / 2.0 / 120.0 - 1.0
    laser = shades[:, 3] / 0.5 - 1.0
    if gap == 0.0:
        np.testing.assert_allclose(laser, 0.9 * light, atol=1e-9)
    else:
        assert abs(np.corrcoef(light, laser)[0, 1]) < 0.5
    warm = (shades[:, 0] - shades[:, 2]) / 2.0
    np.testing.assert_allclose(shades[:, 1] / 120.0 - 1.0 - light, 0.3 * warm / 120.0, atol=1e-9)
