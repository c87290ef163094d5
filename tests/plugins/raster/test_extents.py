"""How far walls reach: rooms and facades of known corners, with and without what bounds them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster.extents import Extent, Reach, extent_of
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.raster.sampled_points import sampled

from orthoflow.products import Planes, PointCloud, Walls
from tests import raster_scenes as scenes
from tests import samples

# The wall is seen along +y at y = 0, 4 m wide and 3 m high; depth is -y.
WIDTH_M, HEIGHT_M = 4.0, 3.0
STEP_M = 0.006
NOISE_M = 0.001
GSD_M = 0.01
# Points beside a corner are left out by three sigmas of the adjoining surface, then whole cells.
CORNER_M = 3.0 * NOISE_M + GSD_M

Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


def patch(x: tuple[float, float], depth: tuple[float, float], z: tuple[float, float]) -> NDArray:
    """Points (n, 3) of a rectangle along two axes; the third has both ends alike."""
    ranges = [x, (-depth[1], -depth[0]), z]
    along = [np.arange(low, high + 1e-9, STEP_M) for low, high in ranges]
    grids = np.meshgrid(*along, indexing="ij")
    return np.column_stack([grid.ravel() for grid in grids])


def scanned(*patches: NDArray) -> PointCloud:
    points = np.vstack(patches)
    rng = np.random.default_rng(5)
    return scenes.cloud_of(points + rng.normal(0.0, NOISE_M, points.shape))


def wall(
    x: tuple[float, float] = (0.0, WIDTH_M), z: tuple[float, float] = (0.0, HEIGHT_M)
) -> NDArray:
    return patch(x, (0.0, 0.0), z)


def planes_of(
    x: tuple[float, float], z: tuple[float, float], *adjoining: tuple[NDArray, NDArray]
) -> Planes:
    """The wall's plane with the rectangle of its points, and planes as (normal, corners)."""
    outline = np.array([[x[0], 0, z[1]], [x[0], 0, z[0]], [x[1], 0, z[0]], [x[1], 0, z[1]]])
    normals = np.array([[0.0, -1.0, 0.0], *(normal for normal, _ in adjoining)])
    corners = np.array([outline, *(rectangle for _, rectangle in adjoining)])
    count = len(normals)
    return samples.planes(
        normal=normals,
        offset=np.einsum("ij,ij->i", normals, corners[:, 0]),
        corners=corners,
        n_points=np.full(count, int((x[1] - x[0]) * (z[1] - z[0]) / STEP_M**2)),
        rms_m=np.full(count, NOISE_M),
        names=tuple(f"plane {k}" for k in range(count)),
    )


def upright(x: float, depth: tuple[float, float], *, towards: float) -> tuple[NDArray, NDArray]:
    front, back = -depth[1], -depth[0]
    corners = [[x, back, HEIGHT_M], [x, back, 0], [x, front, 0], [x, front, HEIGHT_M]]
    return np.array([towards, 0.0, 0.0]), np.array(corners)


def level(z: float, depth: tuple[float, float], *, towards: float) -> tuple[NDArray, NDArray]:
    front, back = -depth[1], -depth[0]
    corners = [[0, back, z], [0, front, z], [WIDTH_M, front, z], [WIDTH_M, back, z]]
    return np.array([0.0, 0.0, towards]), np.array(corners)


ROOM = (
    upright(0.0, (0.0, 3.0), towards=1.0),
    upright(WIDTH_M, (0.0, 3.0), towards=-1.0),
    level(0.0, (0.0, 3.0), towards=1.0),
    level(HEIGHT_M, (0.0, 3.0), towards=-1.0),
)
SIDES = (
    patch((0.0, 0.0), (0.0, 3.0), (0.0, HEIGHT_M)),
    patch((WIDTH_M, WIDTH_M), (0.0, 3.0), (0.0, HEIGHT_M)),
    patch((0.0, WIDTH_M), (0.0, 3.0), (0.0, 0.0)),
    patch((0.0, WIDTH_M), (0.0, 3.0), (HEIGHT_M, HEIGHT_M)),
)
# A cornice 12 cm before the wall over its topmost 30 cm, and a pilaster 10 cm before its left end.
CORNICE = patch((0.0, WIDTH_M), (0.12, 0.12), (2.7, HEIGHT_M))
PILASTER = patch((0.0, 0.25), (0.1, 0.1), (0.0, 2.7))
# What of the plane's own points is left beside them.
BESIDE_X, BESIDE_Z = (0.25, WIDTH_M), (0.0, 2.7)


def laid(cloud: PointCloud, planes: Planes, folder: Path, **params: object) -> Walls:
    chosen = {"gsd_m": GSD_M, "ranks": [0], **params}
    inputs = RasterGrid.In(cloud=cloud, planes=planes)
    ctx = scenes.context(folder)
    return RasterGrid().run(inputs, RasterGrid.Params.model_validate(chosen), ctx).walls


def edges_m(walls: Walls) -> NDArray[np.float64]:
    """Left, right, bottom and top of the first wall's raster, world x and z."""
    corners = walls.walls[0].frame.corners_world()
    return np.array(
        [corners[:, 0].min(), corners[:, 0].max(), corners[:, 2].min(), corners[:, 2].max()]
    )


def test_a_wall_reaches_over_cornice_and_pilaster_to_what_adjoins_it(tmp_path: Path) -> None:
    cloud = scanned(wall(BESIDE_X, BESIDE_Z), CORNICE, PILASTER, *SIDES)
    walls = laid(cloud, planes_of(BESIDE_X, BESIDE_Z, *ROOM), tmp_path)
    np.testing.assert_allclose(edges_m(walls), [0.0, WIDTH_M, 0.0, HEIGHT_M], atol=CORNER_M)
    found = walls.walls[0]
    # 3 mm: the median of a few points, and half a step between rows of a scan.
    assert np.nanmedian(found.depth_m[2:20]) == pytest.approx(0.12, abs=0.003)
    assert np.nanmedian(found.depth_m[60:200, 2:20]) == pytest.approx(0.10, abs=0.003)
    # Nothing of the adjoining walls is taken for the wall's relief.
    assert np.nanmax(found.depth_m) < 0.13


def test_a_floor_that_slopes_ends_the_wall_at_its_highest_place_and_this_is_said(
    tmp_path: Path,
) -> None:
    rise = 0.02
    surface = wall()
    surface = surface[surface[:, 2] > rise * surface[:, 0]]
    floor = patch((0.0, WIDTH_M), (0.0, 3.0), (0.0, 0.0))
    floor[:, 2] += rise * floor[:, 0]
    _, corners = level(0.0, (0.0, 3.0), towards=1.0)
    corners[:, 2] += rise * corners[:, 0]
    normal = np.array([-rise, 0.0, 1.0]) / np.hypot(rise, 1.0)
    said: list[str] = []
    ctx = replace(scenes.context(tmp_path), listen=lambda event: said.append(event.text))
    planes = planes_of((0.0, WIDTH_M), (0.3, HEIGHT_M), (normal, corners))
    inputs = RasterGrid.In(cloud=scanned(surface, floor), planes=planes)
    chosen = RasterGrid.Params(gsd_m=GSD_M, ranks=(0,))
    walls = RasterGrid().run(inputs, chosen, ctx).walls
    assert edges_m(walls)[2] == pytest.approx(rise * WIDTH_M, abs=CORNER_M)
    (told,) = [text for text in said if "askew" in text]
    assert told == (
        "plane 0: what adjoins it at its bottom runs askew, and its raster ends where that comes "
        "nearest: up to 80 mm of the wall are left out there; margin_m adds them"
    )


def test_growth_adds_whole_cells_and_moves_none(tmp_path: Path) -> None:
    cloud = scanned(wall(BESIDE_X, BESIDE_Z), CORNICE, PILASTER, *SIDES)
    planes = planes_of(BESIDE_X, BESIDE_Z, *ROOM)
    room = laid(cloud, planes, tmp_path).walls[0].frame
    points = laid(cloud, planes, tmp_path, rectangle="points").walls[0].frame
    moved = room.wall_from_world(points.corners_world()[:1])[0, :2]
    np.testing.assert_allclose(moved, np.rint(moved), atol=1e-6)
    assert points.shape == (270, 375)


@pytest.mark.parametrize(
    ("surfaces", "detected", "top_m"),
    [
        ((0, 1, 2), (0, 1, 2), HEIGHT_M),
        ((0, 1, 2, 3), (0, 1, 2), HEIGHT_M),
        ((0, 1, 2, 3), (), HEIGHT_M),
    ],
    ids=["no ceiling", "a ceiling that was not detected", "nothing detected"],
)
def test_where_no_plane_ends_it_a_wall_ends_with_its_points(
    tmp_path: Path, surfaces: tuple[int, ...], detected: tuple[int, ...], top_m: float
) -> None:
    patches = [SIDES[k] for k in surfaces]
    cloud = scanned(wall(BESIDE_X, BESIDE_Z), CORNICE, PILASTER, *patches)
    planes = planes_of(BESIDE_X, BESIDE_Z, *(ROOM[k] for k in detected))
    walls = laid(cloud, planes, tmp_path)
    np.testing.assert_allclose(edges_m(walls), [0.0, WIDTH_M, 0.0, top_m], atol=CORNER_M)
    # A ceiling seen along is no relief: the buffer stays that of cornice and pilaster.
    assert walls.slab(0).front_m == pytest.approx(0.15, abs=0.03)


def test_a_facade_without_anything_about_it_keeps_the_rectangle_of_its_points(
    tmp_path: Path,
) -> None:
    # Ground that rises slowly towards the viewer, and stray points about the wall.
    ground = patch((-2.0, 6.0), (0.0, 2.0), (0.0, 0.0))
    ground[:, 2] -= 0.03 * ground[:, 1]
    rng = np.random.default_rng(8)
    stray = rng.uniform([-1.0, -0.5, 0.0], [5.0, 0.5, 4.0], (2000, 3))
    cloud = scanned(wall(), ground, stray)
    walls = laid(cloud, planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M)), tmp_path)
    # Ground 1 m and more before the wall lies 3 cm lower than its foot at most.
    np.testing.assert_allclose(edges_m(walls), [0.0, WIDTH_M, 0.0, HEIGHT_M], atol=0.03)
    assert walls.slab(0).front_m == pytest.approx(0.15)
    assert walls.slab(0).behind_m == pytest.approx(0.15)


def test_a_wall_that_ends_in_the_room_ends_there(tmp_path: Path) -> None:
    # Another wall, 2 m behind, goes on where this one ends; a post stands beyond, apart from it.
    beyond = patch((WIDTH_M, 7.0), (-2.0, -2.0), (0.0, HEIGHT_M))
    post = patch((WIDTH_M + 0.4, WIDTH_M + 0.6), (0.05, 0.05), (0.0, HEIGHT_M))
    cloud = scanned(wall(), beyond, post, *SIDES[2:], SIDES[0])
    planes = planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M), ROOM[0], *ROOM[2:])
    walls = laid(cloud, planes, tmp_path)
    np.testing.assert_allclose(edges_m(walls), [0.0, WIDTH_M, 0.0, HEIGHT_M], atol=CORNER_M)


def test_a_cable_that_leaves_the_wall_does_not_widen_it(tmp_path: Path) -> None:
    cable = patch((WIDTH_M, WIDTH_M + 0.9), (0.02, 0.02), (1.5, 1.52))
    walls = laid(scanned(wall(), cable), planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M)), tmp_path)
    np.testing.assert_allclose(edges_m(walls), [0.0, WIDTH_M, 0.0, HEIGHT_M], atol=CORNER_M)


def with_door(depth_m: float) -> PointCloud:
    """A wall with a door set back, its jamb on one side seen, and a room 3 m behind a window."""
    whole = wall()
    in_door = (abs(whole[:, 0] - 1.0) < 0.4) & (whole[:, 2] < 2.0)
    in_window = (abs(whole[:, 0] - 3.0) < 0.4) & (abs(whole[:, 2] - 1.5) < 0.4)
    jamb = patch((0.6, 0.6), (-depth_m, 0.0), (0.0, 2.0))
    leaf = patch((0.6, 1.4), (-depth_m, -depth_m), (0.0, 2.0))
    outside = patch((2.6, 3.4), (-3.0, -3.0), (1.1, 1.9))
    return scanned(whole[~in_door & ~in_window], jamb, leaf, outside)


def test_the_buffer_follows_a_door_that_stands_back(tmp_path: Path) -> None:
    planes = planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M))
    walls = laid(with_door(0.36), planes, tmp_path)
    # A step in depth, and what is added beyond the relief.
    assert walls.slab(0).behind_m == pytest.approx(0.36, abs=0.06)
    assert walls.slab(0).front_m == pytest.approx(0.15)
    leaf = walls.walls[0].depth_m[120:290, 65:135]
    np.testing.assert_allclose(leaf, -0.36, atol=6.0 * NOISE_M)


def test_the_cornice_of_an_adjoining_wall_is_no_relief_of_this_one(tmp_path: Path) -> None:
    # Two steps, as cornices have them, run along the left wall towards the viewer, and a cupboard
    # that is deeper than any relief stands beside the right wall.
    beside = [
        patch((0.08, 0.08), (0.0, 3.0), (2.7, 2.84)),
        patch((0.0, 0.08), (0.0, 3.0), (2.7, 2.7)),
        patch((0.15, 0.15), (0.0, 3.0), (2.84, HEIGHT_M)),
        patch((0.08, 0.15), (0.0, 3.0), (2.84, 2.84)),
        patch((3.7, WIDTH_M), (0.8, 0.8), (0.0, 2.0)),
        patch((3.7, 3.7), (0.0, 0.8), (0.0, 2.0)),
        patch((3.7, WIDTH_M), (0.0, 0.8), (2.0, 2.0)),
    ]
    cloud = scanned(wall(z=BESIDE_Z), CORNICE, *beside, *SIDES)
    walls = laid(cloud, planes_of((0.0, WIDTH_M), BESIDE_Z, *ROOM), tmp_path)
    # Of the wall's own cornice: half a step in depth, and what is added beyond the relief.
    assert walls.slab(0).front_m == pytest.approx(0.15, abs=0.03)
    np.testing.assert_allclose(edges_m(walls), [0.0, WIDTH_M, 0.0, HEIGHT_M], atol=CORNER_M)


@pytest.mark.parametrize("is_set", [False, True], ids=["found", "set"])
def test_the_underside_of_a_cornice_does_not_end_the_wall(tmp_path: Path, is_set: bool) -> None:
    # A cornice of 0.2 m: its underside and that of the left wall's make one plane, found as such.
    cornice = patch((0.0, WIDTH_M), (0.2, 0.2), (2.6, HEIGHT_M))
    under = patch((0.0, WIDTH_M), (0.0, 0.2), (2.6, 2.6))
    beside = patch((0.0, 0.2), (0.2, 3.0), (2.6, 2.6))
    cloud = scanned(wall(z=(0.0, 2.6)), cornice, under, beside, *SIDES)
    underside = level(2.6, (0.0, 3.0), towards=-1.0)
    planes = planes_of((0.0, WIDTH_M), (0.0, 2.6), *ROOM, underside)
    walls = laid(cloud, planes, tmp_path, **({"buffer_m": 0.25} if is_set else {}))
    np.testing.assert_allclose(edges_m(walls), [0.0, WIDTH_M, 0.0, HEIGHT_M], atol=CORNER_M)


def test_a_buffer_that_is_set_is_kept(tmp_path: Path) -> None:
    planes = planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M))
    both = laid(with_door(0.36), planes, tmp_path, buffer_m=0.1).slab(0)
    assert (both.front_m, both.behind_m) == (0.1, 0.1)
    behind = laid(with_door(0.36), planes, tmp_path, buffer_behind_m=0.2).slab(0)
    assert (behind.front_m, behind.behind_m) == (pytest.approx(0.15), 0.2)


def test_what_stands_apart_before_a_wall_is_no_relief(tmp_path: Path) -> None:
    screen = patch((1.0, 2.0), (0.4, 0.4), (0.0, 1.5))
    walls = laid(scanned(wall(), screen), planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M)), tmp_path)
    assert walls.slab(0).front_m == pytest.approx(0.15)


def extent(*patches: NDArray, planes: Planes | None = None, **reach: float | None) -> Extent:
    """How far the wall of a cloud without noise reaches."""
    # A fourth of the points shows as much.
    cloud = scenes.cloud_of(np.vstack(patches)[::4])
    found = planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M)) if planes is None else planes
    sought: dict[str, Any] = {"front_m": None, "behind_m": None, "least_m": 0.15, **reach}
    return extent_of(sampled(cloud), found, 0, Reach(**sought), threads=1)


def part(x: tuple[float, float], depth_m: float, z: tuple[float, float]) -> NDArray:
    return patch(x, (depth_m, depth_m), z)


@pytest.mark.parametrize(("beyond_m", "grown_m"), [(0.8, 0.8), (1.4, 1.0)])
@pytest.mark.parametrize("side", [0, 1, 2, 3])
def test_a_wall_grows_by_a_metre_at_most(side: int, beyond_m: float, grown_m: float) -> None:
    strips = (
        part((-beyond_m, 0.0), 0.0, (0.0, HEIGHT_M)),
        part((WIDTH_M, WIDTH_M + beyond_m), 0.0, (0.0, HEIGHT_M)),
        part((0.0, WIDTH_M), 0.0, (HEIGHT_M, HEIGHT_M + beyond_m)),
        part((0.0, WIDTH_M), 0.0, (-beyond_m, 0.0)),
    )
    found = extent(wall(), strips[side])
    # But for a fiftieth of the outermost points, which may be stray.
    expected = np.zeros(4)
    expected[side] = grown_m
    np.testing.assert_allclose(found.growth_m, expected, atol=0.03)


@pytest.mark.parametrize(("high_m", "grows"), [(0.45, False), (0.9, True)])
def test_a_fifth_of_a_line_of_cells_must_be_covered(high_m: float, grows: bool) -> None:
    strip = part((WIDTH_M, WIDTH_M + 0.5), 0.0, (1.0, 1.0 + high_m))
    assert (extent(wall(), strip).growth_m[1] > 0.4) == grows


@pytest.mark.parametrize(
    ("depths_m", "front_m"),
    [
        ((0.12,), 0.14),
        ((0.1, 0.2, 0.3, 0.4), 0.42),
        # Where a column ends beyond reach, nothing of it is relief.
        ((0.1, 0.2, 0.3, 0.4, 0.5, 0.58), 0.1),
        ((0.2,), 0.1),
        ((0.1, 0.3), 0.12),
    ],
    ids=str,
)
def test_relief_hangs_together_over_steps_of_a_tenth_of_a_metre(
    depths_m: tuple[float, ...], front_m: float
) -> None:
    steps = [part((1.0, 2.0), depth, (1.0, 2.0)) for depth in depths_m]
    found = extent(wall(), *steps, least_m=0.1)
    # A step in depth of 2.5 cm, and 2 cm beyond the relief.
    assert found.front_m == pytest.approx(front_m, abs=0.03)
    assert found.behind_m == 0.1


@pytest.mark.parametrize(("side_m", "counts"), [(0.09, False), (0.2, True)])
def test_tiny_relief_decides_no_buffer(side_m: float, counts: bool) -> None:
    boss = part((1.5, 1.5 + side_m), 0.11, (1.5, 1.5 + side_m))
    assert (extent(wall(), boss, least_m=0.05).front_m > 0.1) == counts


def test_what_is_set_is_not_looked_for() -> None:
    step = part((1.0, 2.0), 0.12, (1.0, 2.0))
    found = extent(wall(), step, front_m=0.07)
    assert (found.front_m, found.behind_m) == (0.07, 0.15)
    both = Reach(front_m=0.07, behind_m=0.3, least_m=0.15)
    assert both.is_set
    assert both.as_set.buffer_m == (0.07, 0.3)
    assert not Reach(front_m=None, behind_m=0.3, least_m=0.15).is_set


def test_a_cloud_without_the_wall_gives_it_what_is_set() -> None:
    elsewhere = part((0.0, WIDTH_M), 0.8, (0.0, HEIGHT_M))
    found = extent(elsewhere, least_m=0.2)
    assert (found.growth_m, found.buffer_m) == ((0.0, 0.0, 0.0, 0.0), (0.2, 0.2))


def test_a_frame_is_widened_by_whole_cells() -> None:
    frame = samples.facing_south(0.1, 20, 10, (1.0, 2.0, 3.0))
    grown = Extent(growth_m=(0.25, 0.3, 0.0, 0.59), front_m=0.1, behind_m=0.1).widened(frame)
    assert (grown.width, grown.height) == (20 + 2 + 3, 10 + 5)
    np.testing.assert_allclose(grown.origin_world, frame.origin_world - [0.2, 0.0, 0.0])
