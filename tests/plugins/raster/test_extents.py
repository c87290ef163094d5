"""Extents of walls: rooms and facades with known corners, with and without adjoining planes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster import extents
from orthoflow_plugins.raster.extents import Extent, Reach, extent_of, sampled
from orthoflow_plugins.raster.selection import frame_of

from orthoflow.products import Planes, PointCloud, Thickness
from tests import raster_scenes as scenes
from tests import samples
from tests.long_loops import long_only

# The wall is at y = 0, seen along +y, 4 m wide and 3 m high; depth is -y.
WIDTH_M, HEIGHT_M = 4.0, 3.0
STEP_M = 0.007
NOISE_M = 0.001
GSD_M = 0.01
# Near a corner, points within three sigmas of the adjoining surface are omitted, then whole cells.
CORNER_M = 3.0 * NOISE_M + GSD_M


def patch(x: tuple[float, float], depth: tuple[float, float], z: tuple[float, float]) -> NDArray:
    """Return points (n, 3) of a rectangle along two axes; both limits of the third are equal."""
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
    """Return the wall's plane with the rectangle of its points, and adjoining planes."""
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
# Adjoining surfaces are scanned up to 1.5 m; only the nearest metre is used.
SCANNED_M = (0.0, 1.5)
SIDES = (
    patch((0.0, 0.0), SCANNED_M, (0.0, HEIGHT_M)),
    patch((WIDTH_M, WIDTH_M), SCANNED_M, (0.0, HEIGHT_M)),
    patch((0.0, WIDTH_M), SCANNED_M, (0.0, 0.0)),
    patch((0.0, WIDTH_M), SCANNED_M, (HEIGHT_M, HEIGHT_M)),
)
# A cornice 12 cm in front of the wall on its topmost 30 cm, and a pilaster 10 cm in front of its
# left end.
CORNICE = patch((0.0, WIDTH_M), (0.12, 0.12), (2.7, HEIGHT_M))
PILASTER = patch((0.0, 0.25), (0.1, 0.1), (0.0, 2.7))
# The part of the plane that these leave uncovered.
BESIDE_X, BESIDE_Z = (0.25, WIDTH_M), (0.0, 2.7)


def extent(cloud: PointCloud, planes: Planes, stations: Any = None, **reach: Any) -> Extent:
    """Return the extent of the first wall."""
    sought = {"front_m": None, "behind_m": None, "least_m": 0.15, **reach}
    return extent_of(sampled(cloud), planes, 0, Reach(**sought), stations=stations, threads=1)


def assert_reaches(found: Extent, planes: Planes, *, atol: float = CORNER_M) -> None:
    """Assert that the raster of the first wall ends at the room's corners, in world x and z."""
    frame = found.widened(frame_of(planes, 0, gsd_m=GSD_M, margin_m=0.0))
    edges_m = frame.corners_world()[[1, 3]][:, [0, 2]]
    np.testing.assert_allclose(edges_m, [[0.0, 0.0], [WIDTH_M, HEIGHT_M]], atol=atol)


def test_a_wall_reaches_over_cornice_and_pilaster_to_what_adjoins_it(tmp_path: Path) -> None:
    cloud = scanned(wall(BESIDE_X, BESIDE_Z), CORNICE, PILASTER, *SIDES)
    planes = planes_of(BESIDE_X, BESIDE_Z, *ROOM)
    found, points = (
        scenes.rastered(cloud, planes, tmp_path, gsd_m=GSD_M, ranks=[0], rectangle=rectangle)[0]
        for rectangle in ("room", "points")
    )
    (one,), (other,) = found.walls, points.walls
    # Growth adds whole cells without moving the others.
    moved = one.frame.wall_from_world(other.frame.corners_world()[:1])[0, :2]
    np.testing.assert_allclose(moved, np.rint(moved), atol=1e-6)
    assert other.frame.shape == (270, 375)
    edges_m = one.frame.corners_world()[[1, 3]][:, [0, 2]]
    np.testing.assert_allclose(edges_m, [[0.0, 0.0], [WIDTH_M, HEIGHT_M]], atol=CORNER_M)
    # The tolerance is 3 mm for the median of a few points and half a step between rows of a scan.
    assert np.nanmedian(one.depth_m[2:20]) == pytest.approx(0.12, abs=0.003)
    assert np.nanmedian(one.depth_m[60:200, 2:20]) == pytest.approx(0.10, abs=0.003)
    # No part of the adjoining walls is treated as relief.
    assert np.nanmax(one.depth_m) < 0.13


def test_a_sloping_floor_ends_the_wall_at_its_highest_point(tmp_path: Path) -> None:
    rise = 0.02
    surface = wall()
    surface = surface[surface[:, 2] > rise * surface[:, 0]]
    floor = patch((0.0, WIDTH_M), (0.0, 3.0), (0.0, 0.0))
    floor[:, 2] += rise * floor[:, 0]
    _, corners = level(0.0, (0.0, 3.0), towards=1.0)
    corners[:, 2] += rise * corners[:, 0]
    normal = np.array([-rise, 0.0, 1.0]) / np.hypot(rise, 1.0)
    planes = planes_of((0.0, WIDTH_M), (0.3, HEIGHT_M), (normal, corners))
    cloud = scanned(surface, floor)
    walls, ctx = scenes.rastered(cloud, planes, tmp_path, gsd_m=GSD_M, ranks=[0])
    lowest_m = walls.walls[0].frame.corners_world()[:, 2].min()
    assert lowest_m == pytest.approx(rise * WIDTH_M, abs=CORNER_M)
    (one,) = [one for one in ctx.diagnostics if one.code == "wall-beside-an-oblique-surface"]
    assert one.values["cut_m"] == pytest.approx(0.08, abs=0.0005)


def test_where_no_plane_ends_it_a_wall_ends_with_its_points() -> None:
    planes = planes_of(BESIDE_X, BESIDE_Z)
    found = extent(scanned(wall(BESIDE_X, BESIDE_Z), CORNICE, PILASTER, *SIDES), planes)
    assert_reaches(found, planes)
    # A ceiling in edge view is not relief; the buffer is that of cornice and pilaster.
    assert found.front_m == pytest.approx(0.15, abs=0.03)


def test_a_facade_without_anything_about_it_keeps_the_rectangle_of_its_points() -> None:
    # Add ground that rises slowly towards the viewer, stray points around the wall, and a cable.
    ground = patch((-2.0, 6.0), (0.0, 2.0), (0.0, 0.0))
    ground[:, 2] -= 0.03 * ground[:, 1]
    rng = np.random.default_rng(8)
    stray = rng.uniform([-1.0, -0.5, 0.0], [5.0, 0.5, 4.0], (2000, 3))
    cable = patch((WIDTH_M, WIDTH_M + 0.9), (0.02, 0.02), (1.5, 1.52))
    planes = planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M))
    found = extent(scanned(wall(), ground, stray, cable), planes)
    # Ground at least 1 m in front of the wall is at most 3 cm lower than its foot.
    assert_reaches(found, planes, atol=0.03)
    assert (found.front_m, found.behind_m) == (0.15, 0.15)


def test_the_cornice_of_an_adjoining_wall_is_no_relief_of_this_one() -> None:
    # Two steps of a cornice run along the left wall towards the viewer, and a cupboard deeper than
    # any relief is next to the right wall.
    beside = [
        patch((0.08, 0.08), (0.0, 3.0), (2.7, 2.84)),
        patch((0.0, 0.08), (0.0, 3.0), (2.7, 2.7)),
        patch((0.15, 0.15), (0.0, 3.0), (2.84, HEIGHT_M)),
        patch((0.08, 0.15), (0.0, 3.0), (2.84, 2.84)),
        patch((3.7, WIDTH_M), (0.8, 0.8), (0.0, 2.0)),
        patch((3.7, 3.7), (0.0, 0.8), (0.0, 2.0)),
        patch((3.7, WIDTH_M), (0.0, 0.8), (2.0, 2.0)),
    ]
    planes = planes_of((0.0, WIDTH_M), BESIDE_Z, *ROOM)
    found = extent(scanned(wall(z=BESIDE_Z), CORNICE, *beside, *SIDES), planes)
    # The buffer extends beyond the wall's own cornice by half a depth step and the margin.
    assert found.front_m == pytest.approx(0.15, abs=0.03)
    assert_reaches(found, planes)


def test_the_underside_of_a_cornice_does_not_end_the_wall() -> None:
    # There is a cornice of 0.2 m, whose underside forms one detected plane with that of the left
    # wall's cornice.
    cornice = patch((0.0, WIDTH_M), (0.2, 0.2), (2.6, HEIGHT_M))
    under = patch((0.0, WIDTH_M), (0.0, 0.2), (2.6, 2.6))
    beside = patch((0.0, 0.2), (0.2, 3.0), (2.6, 2.6))
    underside = level(2.6, (0.0, 3.0), towards=-1.0)
    planes = planes_of((0.0, WIDTH_M), (0.0, 2.6), *ROOM, underside)
    found = extent(scanned(wall(z=(0.0, 2.6)), cornice, under, beside, *SIDES), planes)
    assert_reaches(found, planes)


def quiet(*patches: NDArray, **reach: float | None) -> Extent:
    """Return the extent of a wall from a quarter of the points, without noise."""
    cloud = scenes.cloud_of(np.vstack(patches)[::4])
    return extent(cloud, planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M)), **reach)


def part(x: tuple[float, float], depth_m: float, z: tuple[float, float]) -> NDArray:
    return patch(x, (depth_m, depth_m), z)


def test_a_wall_grows_by_a_metre_at_most_where_a_fifth_of_a_line_of_cells_is_covered() -> None:
    strips = (
        part((-0.8, 0.0), 0.0, (0.0, HEIGHT_M)),
        # A fifth of 3 m is 0.6 m.
        part((WIDTH_M, WIDTH_M + 0.5), 0.0, (1.0, 1.45)),
        part((0.0, WIDTH_M), 0.0, (HEIGHT_M, HEIGHT_M + 1.4)),
        part((1.0, 2.2), 0.0, (-0.4, 0.0)),
    )
    # A fiftieth of the outermost points is ignored, because these may be stray points.
    found = quiet(wall(), *strips)
    np.testing.assert_allclose(found.growth_m, [0.8, 0.0, 1.0, 0.4], atol=0.03)


@pytest.mark.parametrize(
    ("depths_m", "front_m", "behind_m"),
    [
        ((0.12,), 0.14, 0.14),
        # Five steps of 2.5 cm are bridged, six are not.
        ((0.16,), 0.1, 0.1),
        ((0.1, 0.2, 0.3, 0.4), 0.42, 0.42),
        # A column that extends beyond the limit, 0.5 m in front and 1 m behind, is not relief.
        ((0.1, 0.2, 0.3, 0.4, 0.5, 0.58), 0.1, 0.6),
        ((0.1, 0.3), 0.12, 0.12),
    ],
    ids=str,
)
def test_relief_is_connected_over_small_steps(
    depths_m: tuple[float, ...], front_m: float, behind_m: float
) -> None:
    before = [part((0.8, 1.8), depth, (1.0, 2.0)) for depth in depths_m]
    behind = [part((2.2, 3.2), -depth, (1.0, 2.0)) for depth in depths_m]
    found = quiet(wall(), *before, *behind, least_m=0.1)
    # The buffer includes a depth step of 2.5 cm, and extends 2 cm beyond the relief.
    assert (found.front_m, found.behind_m) == pytest.approx((front_m, behind_m), abs=0.03)
    assert found.front_m == round(found.front_m, 3)


def test_what_is_set_is_not_looked_for() -> None:
    step = part((1.0, 2.0), 0.12, (1.0, 2.0))
    found = quiet(wall(), step, front_m=0.07)
    assert (found.front_m, found.behind_m) == (0.07, 0.15)
    back = part((1.0, 2.0), -0.11, (1.0, 2.0))
    # The buffer ends 2 cm beyond the farther end of a depth step of 2.5 cm.
    found = quiet(wall(), back, least_m=0.06)
    assert (found.front_m, found.behind_m) == (0.06, pytest.approx(0.14, abs=0.03))
    # Tiny relief does not influence the buffer.
    boss = part((1.5, 1.59), 0.11, (1.5, 1.59))
    assert quiet(wall(), boss, least_m=0.05).front_m < 0.1
    elsewhere = part((0.0, WIDTH_M), 0.8, (0.0, HEIGHT_M))
    assert quiet(elsewhere, least_m=0.2) == Extent(front_m=0.2, behind_m=0.2)


def test_a_frame_is_widened_by_whole_cells() -> None:
    frame = samples.facing_south(0.1, 20, 10, (1.0, 2.0, 3.0))
    grown = Extent(growth_m=(0.25, 0.3, 0.0, 0.59), front_m=0.1, behind_m=0.1).widened(frame)
    assert (grown.width, grown.height) == (20 + 2 + 3, 10 + 5)
    np.testing.assert_allclose(grown.origin_world, frame.origin_world - [0.2, 0.0, 0.0])


# --- adjoining surfaces and their reports ---


def rectangle_of(planes: Planes) -> Any:
    return extents.frame_of(planes, 0, gsd_m=1.0, margin_m=0.0)


def bound_by(adjoining: tuple[NDArray, NDArray], **changes: Any) -> Any:
    planes = replace(planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M), adjoining), **changes)
    return extents.adjoining_bound(planes, 1, rectangle_of(planes), (WIDTH_M, HEIGHT_M))


def beside(side: str, beyond_m: float, towards: float) -> tuple[NDArray, NDArray]:
    if side in ("left", "right"):
        x = -beyond_m if side == "left" else WIDTH_M + beyond_m
        return upright(x, (0.0, 3.0), towards=towards)
    z = -beyond_m if side == "bottom" else HEIGHT_M + beyond_m
    return level(z, (0.0, 3.0), towards=towards)


@pytest.mark.parametrize(("beyond_m", "towards"), [(-0.09, 1.0), (0.99, -1.0)])
@pytest.mark.parametrize("side", ["left", "right", "top", "bottom"])
def test_a_plane_bounds_the_side_next_to_it(side: str, beyond_m: float, towards: float) -> None:
    # Planes farther inside or outside than these limits do not bound the wall.
    for far_m in (-0.11, 1.01):
        assert bound_by(beside(side, far_m, towards)) is None
    place = beside(side, beyond_m, towards)
    found = bound_by(place)
    assert found.side == side
    assert found.beyond_m == pytest.approx(beyond_m)
    assert found.askew_m == pytest.approx(0.0, abs=1e-9)
    # The noise is three sigmas of its points, but at most 2 cm.
    assert found.noise_m == pytest.approx(3.0 * NOISE_M)
    assert found.line_m == pytest.approx(beyond_m - 3.0 * NOISE_M)
    assert bound_by(place, rms_m=np.full(2, 0.01)).noise_m == 0.02
    # It is based on the thickness of the plane without relief, if known.
    thick = Thickness(sigma_m=0.002, width_95_m=0.008, scan_step_m=0.01)
    for thickness, noise_m in (((None, thick), 0.006), ((thick, None), 3.0 * NOISE_M)):
        assert bound_by(place, thickness=thickness).noise_m == pytest.approx(noise_m)
    # Distances are positive inside, here at the middle of the wall.
    middle = found.offset_m + found.slopes @ [0.5 * WIDTH_M, 0.5 * HEIGHT_M, 0.2]
    away = 0.5 * (WIDTH_M if side in ("left", "right") else HEIGHT_M) + beyond_m
    assert middle == pytest.approx(away)


@pytest.mark.parametrize("turn_deg", [0.0, -5.0, 24.0, 28.0])
def test_a_plane_that_runs_askew_is_farther_at_one_end(turn_deg: float) -> None:
    turn = np.radians(turn_deg)
    # The plane passes through the middle of the left side, and is rotated about the wall's normal.
    normal = np.array([np.cos(turn), 0.0, np.sin(turn)])
    corners = upright(0.0, (0.0, 3.0), towards=1.0)[1]
    point = np.array([-0.7, 0.0, 0.5 * HEIGHT_M])
    found = bound_by((normal, corners), offset=np.array([0.0, normal @ point]))
    # If the sine is less than 0.9, the plane is neither beside nor above the wall.
    if abs(np.cos(turn)) < 0.9:
        assert found is None
        return
    half_m = 0.5 * HEIGHT_M * abs(np.tan(turn))
    assert found.side == "left"
    assert found.beyond_m == pytest.approx(0.7 - half_m)
    assert found.askew_m == pytest.approx(2.0 * half_m, abs=1e-9)


@pytest.mark.parametrize(
    ("share", "off_m", "depth_m", "left_m"),
    [
        # The wall's own points are between the planes at 0.1 and 0.3 m, along most of the side.
        (0.4, 0.2, 0.01, 0.3),
        (0.28, 0.2, 0.01, 0.1),
        (0.4, 0.35, 0.01, 0.1),
        # Relief is included; points farther in front are not part of the wall.
        (0.4, 0.2, 0.14, 0.3),
        (0.4, 0.2, 0.16, 0.1),
    ],
)
def test_a_plane_ends_no_wall_that_goes_on_behind_it_to_the_next(
    monkeypatch: pytest.MonkeyPatch, share: float, off_m: float, depth_m: float, left_m: float
) -> None:
    monkeypatch.setattr(extents, "stands_beside", lambda *_: True)
    planes = planes_of(
        (0.0, WIDTH_M),
        (0.0, HEIGHT_M),
        *(upright(-beyond, (0.0, 3.0), towards=1.0) for beyond in (0.3, 0.1)),
    )
    up = np.arange(0.05, HEIGHT_M * share, 0.1)
    points = np.column_stack([np.full(len(up), -off_m), np.full(len(up), -depth_m), up])
    rectangle, size_m = rectangle_of(planes), (WIDTH_M, HEIGHT_M)
    around = extents.PointsAround.of(sampled(scenes.cloud_of(points)), rectangle, size_m)
    (found,) = extents.adjoining_bounds(planes, 0, rectangle, size_m, around)
    assert found.beyond_m == pytest.approx(left_m)


# A basin 2.4 m deep and 0.9 m high that hides the middle of the wall.
BASIN_X, BASIN_Z, BASIN_M = (1.2, 2.8), (0.3, 1.2), 2.4


def basin(first_m: float = 0.0) -> list[NDArray]:
    """Return its top, front and sides, from a given depth on, and the wall behind it."""
    points = wall()
    x, z = points[:, 0], points[:, 2]
    hidden = (x > BASIN_X[0]) & (x < BASIN_X[1]) & (z > BASIN_Z[0]) & (z < BASIN_Z[1])
    return [
        points[~hidden],
        patch(BASIN_X, (first_m, BASIN_M), (BASIN_Z[1], BASIN_Z[1])),
        patch(BASIN_X, (BASIN_M, BASIN_M), BASIN_Z),
        *(patch((x, x), (first_m, BASIN_M), BASIN_Z) for x in BASIN_X),
    ]


@pytest.mark.parametrize(
    ("case", "front_m"),
    [
        ("joined to the wall", BASIN_M),
        ("apart from it", 0.0),
        *long_only(("joined by the ground", 0.0)),
        ("before a wall that faces it", 0.0),
        ("behind a part of it that faces it, as guessed", BASIN_M),
        ("before a scanner", 0.0),
    ],
)
def test_deep_relief_belongs_to_the_wall_it_is_connected_to(case: str, front_m: float) -> None:
    is_apart = case in {"apart from it", "joined by the ground"}
    patches = basin(1.0 if is_apart else 0.0)
    if case == "joined by the ground":
        patches.append(patch((0.0, WIDTH_M), (0.0, 2.9), (0.0, 0.0)))
        patches.append(patch(BASIN_X, (BASIN_M, BASIN_M), (0.0, BASIN_Z[0])))
    # The opposite side of a room, or the step of a basin with a wrong side.
    y, height_m = (-0.5, 0.2) if "guessed" in case else (-3.0, HEIGHT_M)
    facing = np.array([[0, y, height_m], [0, y, 0], [WIDTH_M, y, 0], [WIDTH_M, y, height_m]])
    others = [(np.array([0.0, 1.0, 0.0]), facing)] if "faces" in case else []
    planes = planes_of((0.0, WIDTH_M), (0.0, HEIGHT_M), *others)
    stations = np.array([[2.0, -4.0, 1.5]]) if case == "before a scanner" else None
    found_m = extent(scanned(*patches), planes, stations).front_m
    assert found_m == pytest.approx(BASIN_M, abs=0.06) if front_m else found_m <= 0.5


def test_what_stands_on_a_floor_is_no_part_of_it() -> None:
    normal, corners = level(0.0, (0.0, 4.0), towards=1.0)
    planes = samples.planes(
        normal=normal[None],
        offset=np.zeros(1),
        corners=corners[None],
        n_points=np.array([100_000]),
        rms_m=np.full(1, NOISE_M),
        names=("floor 0",),
    )
    points = patch((0.0, WIDTH_M), (0.0, 4.0), (0.0, 0.0))
    on_chest = (np.abs(points[:, :2] - [1.75, -1.75]) < 0.75).all(axis=1)
    points[on_chest, 2] = 1.2
    assert extent(scanned(points), planes).front_m <= 0.5
