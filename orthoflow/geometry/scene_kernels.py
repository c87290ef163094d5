"""Compiled ray casting in a scene of rectangles, through a tree of bounding boxes.

The nearest hit is exact: the tree only skips what a ray cannot meet, and of two rectangles at the
same distance the one with the smaller index wins, so no order of visiting shows.

The kernels release the GIL and work on a range of rays or rows, so that plain threads share the
work; numba's own parallel loops would double the time to compile.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from orthoflow.geometry.texture_kernels import colour_at

Index: TypeAlias = int | np.int64

_NOTHING: Final = np.int64(-1)
# A point counts as seen when nothing is hit more than this before it, metres.
_SEEN_WITHIN_M: Final = 0.0005


class CastTable(NamedTuple):
    """A scene laid out for ray casting, relative to the scene's origin.

    Attributes:
        rectangles: (r, 16) float64: centre, axis a, axis b, normal (3 each), extent (4).
        kinds: (r,) int32 `TextureKind`.
        params: (r, 8) float64 texture parameters.
        holes: (h, 4) float64 extents.
        first_hole: (r + 1,) int64; rectangle i has the holes first_hole[i] to first_hole[i + 1].
        box_axes: (3, 3) float64 rotation into the axes that the boxes are along.
        boxes: (m, 6) float64 bounds of the tree's nodes in those axes, low then high; parents
            come before children, node 0 is the root.
        links: (m, 3) int64: the next node for a ray that misses the box, and the first and the
            last + 1 of the node's rectangles in `order` (none unless it is a leaf).
        order: (r,) int64 rectangles in the order of the leaves.
    """

    rectangles: NDArray[np.float64]
    kinds: NDArray[np.int32]
    params: NDArray[np.float64]
    holes: NDArray[np.float64]
    first_hole: NDArray[np.int64]
    box_axes: NDArray[np.float64]
    boxes: NDArray[np.float64]
    links: NDArray[np.int64]
    order: NDArray[np.int64]


class Ray(NamedTuple):
    """Start and direction, metres from the scene's origin; lengths are in units of direction."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


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
    """

    corner: NDArray[np.float64]
    step_u: NDArray[np.float64]
    step_v: NDArray[np.float64]
    normal: NDArray[np.float64]
    front_m: float
    behind_m: float
    n_sub: int


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
def _safe_inverse(value: float) -> float:
    # Not infinity: zero times infinity would be NaN for a ray inside the slab's plane.
    if abs(value) < 1e-30:
        return 1e30 if value >= 0.0 else -1e30
    return 1.0 / value


@njit(cache=True)
def _hit_distance(table: CastTable, index: Index, ray: Ray, t_min: float) -> float:
    """Distance at which a ray meets one rectangle, in units of its direction; -1 if it does not."""
    # Single numbers on purpose: a row as an array would be counted in and out of use each time.
    r = table.rectangles
    facing = r[index, 9] * ray.dx + r[index, 10] * ray.dy + r[index, 11] * ray.dz
    if abs(facing) < 1e-12:
        return -1.0
    x, y, z = r[index, 0] - ray.x, r[index, 1] - ray.y, r[index, 2] - ray.z
    t: float = (r[index, 9] * x + r[index, 10] * y + r[index, 11] * z) / facing
    if t < t_min:
        return -1.0
    x, y, z = t * ray.dx - x, t * ray.dy - y, t * ray.dz - z
    a = x * r[index, 3] + y * r[index, 4] + z * r[index, 5]
    if a < r[index, 12] or a > r[index, 13]:
        return -1.0
    b = x * r[index, 6] + y * r[index, 7] + z * r[index, 8]
    if b < r[index, 14] or b > r[index, 15]:
        return -1.0
    for hole in range(table.first_hole[index], table.first_hole[index + 1]):
        h = table.holes
        if h[hole, 0] < a < h[hole, 1] and h[hole, 2] < b < h[hole, 3]:
            return -1.0
    return t


@njit(cache=True)
def _enters_box(table: CastTable, node: int, ray: Ray, t_min: float, t_max: float) -> bool:
    """Whether a ray, given by its start and the inverse of its direction, meets a box in time."""
    box = table.boxes
    near, far = (box[node, 0] - ray.x) * ray.dx, (box[node, 3] - ray.x) * ray.dx
    low, high = min(near, far), max(near, far)
    near, far = (box[node, 1] - ray.y) * ray.dy, (box[node, 4] - ray.y) * ray.dy
    low, high = max(low, min(near, far)), min(high, max(near, far))
    near, far = (box[node, 2] - ray.z) * ray.dz, (box[node, 5] - ray.z) * ray.dz
    low, high = max(low, min(near, far)), min(high, max(near, far))
    meets: bool = high >= low and high >= t_min and low <= t_max
    return meets


@njit(cache=True)
def _ray_in_boxes(table: CastTable, ray: Ray) -> Ray:
    """Start of the ray and inverse of its direction, in the axes of the boxes."""
    m = table.box_axes
    return Ray(
        m[0, 0] * ray.x + m[0, 1] * ray.y + m[0, 2] * ray.z,
        m[1, 0] * ray.x + m[1, 1] * ray.y + m[1, 2] * ray.z,
        m[2, 0] * ray.x + m[2, 1] * ray.y + m[2, 2] * ray.z,
        _safe_inverse(m[0, 0] * ray.dx + m[0, 1] * ray.dy + m[0, 2] * ray.dz),
        _safe_inverse(m[1, 0] * ray.dx + m[1, 1] * ray.dy + m[1, 2] * ray.dz),
        _safe_inverse(m[2, 0] * ray.dx + m[2, 1] * ray.dy + m[2, 2] * ray.dz),
    )


@njit(cache=True)
def nearest_hit(
    table: CastTable, ray: Ray, t_min: float, t_max: float, guess: Index
) -> tuple[float, Index]:
    """First rectangle a ray meets between two distances: (t, index), or (t_max, -1).

    The guess, -1 for none, changes no result: trying first what a neighbouring ray hit spares the
    boxes behind it.
    """
    best_t, best = t_max, np.int64(_NOTHING)
    if guess >= 0:
        t = _hit_distance(table, guess, ray, t_min)
        if 0.0 <= t < best_t:
            best_t, best = t, np.int64(guess)
    inverse = _ray_in_boxes(table, ray)
    node, n_nodes = 0, table.boxes.shape[0]
    while node < n_nodes:
        if not _enters_box(table, node, inverse, t_min, best_t):
            node = table.links[node, 0]
            continue
        for place in range(table.links[node, 1], table.links[node, 2]):
            index = table.order[place]
            t = _hit_distance(table, index, ray, t_min)
            if t >= 0.0 and (t < best_t or (t == best_t and (best < 0 or index < best))):
                best_t, best = t, index
        node += 1
    return best_t, best


@njit(cache=True, nogil=True)
def cast_rays(
    table: CastTable,
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    t: NDArray[np.float64],
    rectangle: NDArray[np.int32],
) -> None:
    """Fill t (n,) and rectangle (n,) for rays (n, 3) from the scene's origin; inf and -1 = none."""
    guess: Index = _NOTHING
    for i in range(directions.shape[0]):
        ray = Ray(
            origins[i, 0],
            origins[i, 1],
            origins[i, 2],
            directions[i, 0],
            directions[i, 1],
            directions[i, 2],
        )
        t[i], guess = nearest_hit(table, ray, 1e-9, np.inf, guess)
        rectangle[i] = guess


@njit(cache=True)
def shade_of_hit(
    table: CastTable, index: Index, ray: Ray, t: float
) -> tuple[float, float, float, float]:
    """Red, green, blue, reflectance where a ray hits a rectangle."""
    r = table.rectangles
    x = ray.x + t * ray.dx - r[index, 0]
    y = ray.y + t * ray.dy - r[index, 1]
    z = ray.z + t * ray.dz - r[index, 2]
    a = x * r[index, 3] + y * r[index, 4] + z * r[index, 5]
    b = x * r[index, 6] + y * r[index, 7] + z * r[index, 8]
    shade = colour_at(table.kinds[index], table.params[index], a, b)
    return shade.red, shade.green, shade.blue, shade.reflectance


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
        _, blocker = nearest_hit(table, ray, 1e-9, length - _SEEN_WITHIN_M, _NOTHING)
        if blocker < 0:
            seen = True
        elif not hidden:
            _, blocker = nearest_hit(objects, ray, 1e-9, length - _SEEN_WITHIN_M, _NOTHING)
            hidden = bool(blocker >= 0)
    return seen, hidden


@njit(cache=True)
def _covers_cell(table: CastTable, grid: Grid, column: Index, row: Index, index: Index) -> bool:
    """Whether the rays through the corners of a cell all meet one rectangle first."""
    reach = grid.front_m + grid.behind_m
    for corner in range(4):
        ray = _cell_ray(grid, column + float(corner % 2), row + float(corner // 2))
        _, met = nearest_hit(table, ray, 0.0, reach, index)
        if met != index:
            return False
    return True


@njit(cache=True)
def _mean_colour(
    table: CastTable, grid: Grid, column: Index, row: Index, guess: Index
) -> tuple[float, float, float]:
    """Mean colour of the rays of a cell that hit something; -1 when none does.

    A rectangle met at the centre and at all corners is taken to fill the cell: what hides between
    is narrower than the cell, and casting nine rays instead of five might miss it as well.
    """
    n_hits, red, green, blue = 0, 0.0, 0.0, 0.0
    is_covered = guess >= 0 and _covers_cell(table, grid, column, row, guess)
    reach = grid.front_m + grid.behind_m
    n_sub = grid.n_sub
    for sub in range(n_sub * n_sub):
        # A sheared grid: n^2 different positions in either direction, so that edges along rows or
        # columns, which walls are full of, are not rounded to thirds of a cell.
        i, j = sub % n_sub, sub // n_sub
        u = column + (i + (j + 0.5) / n_sub) / n_sub
        v = row + (j + (n_sub - i - 0.5) / n_sub) / n_sub
        ray = _cell_ray(grid, u, v)
        t, index = -1.0, guess
        if is_covered:
            t = _hit_distance(table, guess, ray, 0.0)
        if t < 0.0:
            t, index = nearest_hit(table, ray, 0.0, reach, guess)
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
def _look_at_cell(
    scene: ViewedScene, grid: Grid, truth: CellTruth, column: Index, row: Index
) -> None:
    table = scene.table
    guess = np.int64(truth.rectangle[row, column - 1]) if column > 0 else _NOTHING
    ray = _cell_ray(grid, column + 0.5, row + 0.5)
    t, index = nearest_hit(table, ray, 0.0, grid.front_m + grid.behind_m, guess)
    red, green, blue = _mean_colour(table, grid, column, row, index)
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
    _, blocker = nearest_hit(scene.objects, point, t + 1e-9, np.inf, _NOTHING)
    truth.seen[row, column] = seen
    truth.behind_object[row, column] = hidden or blocker >= 0


@njit(cache=True, nogil=True)
def look_at_cells(
    scene: ViewedScene, grid: Grid, truth: CellTruth, first_row: int, last_row: int
) -> None:
    """Fill rows of `truth` with what is seen orthogonally in each cell; untouched where nothing is.

    rgb is the mean over those rays of the cell that hit something; the rest holds for the ray
    through the cell's centre.
    """
    for row in range(first_row, last_row):
        for column in range(truth.rectangle.shape[1]):
            _look_at_cell(scene, grid, truth, column, row)
