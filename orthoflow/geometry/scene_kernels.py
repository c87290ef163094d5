"""Compiled ray casting in a scene of rectangles, through a tree of bounding boxes.

The nearest hit is exact: the tree only skips what a ray cannot meet, and of two rectangles at the
same distance the one with the smaller index wins, so no order of visiting shows.

The kernels release the GIL and work on a range of rays or rows, so that plain threads share the
work; numba's own parallel loops would double the time to compile.
"""

from __future__ import annotations

from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from orthoflow.geometry.texture_kernels import colour_at

Index: TypeAlias = int | np.int64


NOTHING: Final = np.int64(-1)


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


@njit(cache=True)
def _safe_inverse(value: float) -> float:
    # Not infinity: zero times infinity would be NaN for a ray inside the slab's plane.
    if abs(value) < 1e-30:
        return 1e30 if value >= 0.0 else -1e30
    return 1.0 / value


@njit(cache=True)
def hit_distance(table: CastTable, index: Index, ray: Ray, t_min: float) -> float:
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
    best_t, best = t_max, np.int64(NOTHING)
    if guess >= 0:
        t = hit_distance(table, guess, ray, t_min)
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
            t = hit_distance(table, index, ray, t_min)
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
    guess: Index = NOTHING
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
