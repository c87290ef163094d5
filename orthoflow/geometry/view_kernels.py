"""Compiled rendering of true orthoimages: what each cell of a wall frame shows, and who sees it."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from orthoflow.geometry.scene_kernels import (
    NOTHING,
    CastTable,
    Index,
    Ray,
    hit_distance,
    nearest_hit,
    shade_of_hit,
)

# Cells of a frame are rendered in tiles of so many rows and columns.
TILE: Final = 8
# A point counts as seen when nothing is hit more than this before it, metres.
_SEEN_WITHIN_M: Final = 0.0005


class Grid(NamedTuple):
    """A wall frame from the scene's origin: point = corner + column * step_u + row * step_v + d n.

    Attributes:
        corner: (3,) metres.
        step_u: (3,) metres per column; step_v per row.
        step_v: see step_u.
        normal: (3,) unit vector.
        front_m: depth at which looking begins.
        behind_m: depth at which it ends, positive behind the plane.
        n_sub: rays per side of a cell.
        bounds: (r, 6) float64 of each rectangle: first and last column, row and depth it reaches.
    """

    corner: NDArray[np.float64]
    step_u: NDArray[np.float64]
    step_v: NDArray[np.float64]
    normal: NDArray[np.float64]
    front_m: float
    behind_m: float
    n_sub: int
    bounds: NDArray[np.float64]


class Stations(NamedTuple):
    """Viewers from the scene's origin: (s, 3) metres, up (3,), sines of the elevations seen."""

    positions: NDArray[np.float64]
    up: NDArray[np.float64]
    lowest_sine: float
    highest_sine: float


class ViewedScene(NamedTuple):
    """A scene, its free-standing objects alone, and who looks at it."""

    table: CastTable
    objects: CastTable
    stations: Stations


class CellTruth(NamedTuple):
    """What is seen in each cell, filled by `look_at_cells`; shapes (rows, columns[, 3])."""

    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    rectangle: NDArray[np.int32]
    seen: NDArray[np.bool_]
    behind_object: NDArray[np.bool_]


@njit(cache=True)
def _cell_ray(grid: Grid, column: float, row: float) -> Ray:
    c, u, v, n, f = grid.corner, grid.step_u, grid.step_v, grid.normal, grid.front_m
    return Ray(
        c[0] + column * u[0] + row * v[0] + f * n[0],
        c[1] + column * u[1] + row * v[1] + f * n[1],
        c[2] + column * u[2] + row * v[2] + f * n[2],
        -n[0],
        -n[1],
        -n[2],
    )


@njit(cache=True)
def _look_from_stations(
    table: CastTable, objects: CastTable, stations: Stations, point: Ray
) -> tuple[bool, bool]:
    """Whether a station sees a surface point, and whether an object hides it from one."""
    seen, hidden = False, False
    up = stations.up
    for station in range(stations.positions.shape[0]):
        x = stations.positions[station, 0]
        y = stations.positions[station, 1]
        z = stations.positions[station, 2]
        dx, dy, dz = point.x - x, point.y - y, point.z - z
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        sine = (dx * up[0] + dy * up[1] + dz * up[2]) / length
        if sine < stations.lowest_sine or sine > stations.highest_sine:
            continue
        ray = Ray(x, y, z, dx / length, dy / length, dz / length)
        _, blocker = nearest_hit(table, ray, 1e-9, length - _SEEN_WITHIN_M, NOTHING)
        if blocker < 0:
            seen = True
        elif not hidden:
            _, blocker = nearest_hit(objects, ray, 1e-9, length - _SEEN_WITHIN_M, NOTHING)
            hidden = bool(blocker >= 0)
    return seen, hidden


@njit(cache=True)
def _candidates(grid: Grid, first_column: int, first_row: int, found: NDArray[np.int64]) -> int:
    """Collect the rectangles that reach into a tile and the buffer, ascending; give their number.

    Rays square to the wall can meet no others, which makes them far cheaper than rays in general.
    """
    n_found = 0
    bounds = grid.bounds
    for index in range(bounds.shape[0]):
        if (
            bounds[index, 0] <= first_column + TILE
            and bounds[index, 1] >= first_column
            and bounds[index, 2] <= first_row + TILE
            and bounds[index, 3] >= first_row
            and bounds[index, 4] <= grid.front_m
            and bounds[index, 5] >= -grid.behind_m
        ):
            found[n_found] = index
            n_found += 1
    return n_found


@njit(cache=True)
def _nearest_candidate(
    table: CastTable, candidates: NDArray[np.int64], ray: Ray, t_max: float
) -> tuple[float, Index]:
    """First of the candidates that a ray meets up to a distance: (t, index), or (t_max, -1)."""
    best_t, best = t_max, np.int64(NOTHING)
    for place in range(candidates.shape[0]):
        t = hit_distance(table, candidates[place], ray, 0.0)
        if 0.0 <= t < best_t:
            best_t, best = t, candidates[place]
    return best_t, best


@njit(cache=True)
def _mean_colour(
    table: CastTable, grid: Grid, candidates: NDArray[np.int64], column: int, row: int
) -> tuple[float, float, float]:
    """Mean colour of the rays of a cell that hit something; -1 when none does."""
    n_hits, red, green, blue = 0, 0.0, 0.0, 0.0
    reach = grid.front_m + grid.behind_m
    n_sub = grid.n_sub
    for sub in range(n_sub * n_sub):
        # A sheared grid: n^2 different positions in either direction, so that edges along rows or
        # columns, which walls are full of, are not rounded to thirds of a cell.
        i, j = sub % n_sub, sub // n_sub
        u = column + (i + (j + 0.5) / n_sub) / n_sub
        v = row + (j + (n_sub - i - 0.5) / n_sub) / n_sub
        ray = _cell_ray(grid, u, v)
        t, index = _nearest_candidate(table, candidates, ray, reach)
        if index >= 0:
            r, g, b, _ = shade_of_hit(table, index, ray, t)
            red += r
            green += g
            blue += b
            n_hits += 1
    if n_hits == 0:
        return -1.0, -1.0, -1.0
    return red / n_hits, green / n_hits, blue / n_hits


@njit(cache=True)
def _look_at_cell(  # one cell of `look_at_cells`
    scene: ViewedScene,
    grid: Grid,
    truth: CellTruth,
    candidates: NDArray[np.int64],
    column: int,
    row: int,
) -> None:
    table = scene.table
    ray = _cell_ray(grid, column + 0.5, row + 0.5)
    t, index = _nearest_candidate(table, candidates, ray, grid.front_m + grid.behind_m)
    red, green, blue = _mean_colour(table, grid, candidates, column, row)
    if index < 0 or red < 0.0:
        return
    truth.rgb[row, column, 0] = red
    truth.rgb[row, column, 1] = green
    truth.rgb[row, column, 2] = blue
    truth.depth_m[row, column] = grid.front_m - t
    truth.rectangle[row, column] = index
    # The surface point; its direction is back to the front.
    point = Ray(
        ray.x + t * ray.dx, ray.y + t * ray.dy, ray.z + t * ray.dz, -ray.dx, -ray.dy, -ray.dz
    )
    seen, hidden = _look_from_stations(table, scene.objects, scene.stations, point)
    # Beyond the buffer, seen straight from the front: an object before the wall.
    _, blocker = nearest_hit(scene.objects, point, t + 1e-9, np.inf, NOTHING)
    truth.seen[row, column] = seen
    truth.behind_object[row, column] = hidden or blocker >= 0


@njit(cache=True, nogil=True)
def look_at_cells(scene: ViewedScene, grid: Grid, truth: CellTruth, first_row: int) -> None:
    """Fill `TILE` rows of `truth` with what is seen orthogonally; untouched where nothing is.

    rgb is the mean over those rays of the cell that hit something; the rest holds for the ray
    through the cell's centre.
    """
    n_rows, n_columns = truth.rectangle.shape
    found = np.empty(grid.bounds.shape[0], dtype=np.int64)
    for first_column in range(0, n_columns, TILE):
        candidates = found[: _candidates(grid, first_column, first_row, found)]
        for row in range(first_row, min(n_rows, first_row + TILE)):
            for column in range(first_column, min(n_columns, first_column + TILE)):
                _look_at_cell(scene, grid, truth, candidates, column, row)
