"""Compiled ray casting in a scene of rectangles, through a tree of bounding boxes.

The nearest hit is exact: the tree only skips what a ray cannot meet, and of two rectangles at the
same distance the one with the smaller index wins, so the order of traversal does not matter.

One kernel serves scanner, cameras and truth: their rays are prepared in numpy, since every further
kernel costs a second at the first run. It releases the interpreter lock and works on a range of
rays, so that threads share the work.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part, typed_kernel_part

Index: TypeAlias = int | np.int64

# A ray does not meet the surface on which it starts.
_NEAREST: Final = 1e-9


class CastTable(NamedTuple):
    """A scene prepared for ray casting, relative to its origin, along the axes of the boxes.

    Attributes:
        axes: (3, 3) float64 rotation from the scene's axes into those of the boxes.
        rectangles: (r, 18) float64: centre, axis a, axis b, normal (3 each), extent (4), and the
            first and the last + 1 of its holes.
        holes: (h, 4) float64 extents.
        nodes: (m, 9) float64 of the tree: bounds of a box, low then high; the next node for a ray
            that misses it; the first and the last + 1 of its rectangles in `order`, none unless it
            is a leaf. Parents come before children, node 0 is the root.
        order: (r,) int64 rectangles in the order of the leaves.
    """

    axes: NDArray[np.float64]
    rectangles: NDArray[np.float64]
    holes: NDArray[np.float64]
    nodes: NDArray[np.float64]
    order: NDArray[np.int64]


class Ray(NamedTuple):
    """Start and direction, metres from the scene's origin; lengths are in units of direction."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


@kernel_part
def _hit_distance(
    rectangles: NDArray[np.float64], holes: NDArray[np.float64], index: Index, ray: Ray
) -> float:
    """Return the distance to a rectangle along a ray, in units of its direction, or inf."""
    # Scalars on purpose: a row as an array would be reference-counted with each use.
    r = rectangles
    facing = r[index, 9] * ray.dx + r[index, 10] * ray.dy + r[index, 11] * ray.dz
    if abs(facing) < 1e-12:
        return math.inf
    x, y, z = r[index, 0] - ray.x, r[index, 1] - ray.y, r[index, 2] - ray.z
    t: float = (r[index, 9] * x + r[index, 10] * y + r[index, 11] * z) / facing
    if t < _NEAREST:
        return math.inf
    x, y, z = t * ray.dx - x, t * ray.dy - y, t * ray.dz - z
    a = x * r[index, 3] + y * r[index, 4] + z * r[index, 5]
    b = x * r[index, 6] + y * r[index, 7] + z * r[index, 8]
    if a < r[index, 12] or a > r[index, 13] or b < r[index, 14] or b > r[index, 15]:
        return math.inf
    for h in range(int(r[index, 16]), int(r[index, 17])):
        if holes[h, 0] < a < holes[h, 1] and holes[h, 2] < b < holes[h, 3]:
            return math.inf
    return t


@kernel_part
def _misses_box(nodes: NDArray[np.float64], node: Index, ray: Ray, t_max: float) -> bool:
    """Whether a ray, given by its start and the inverse of its direction, stays out of a box."""
    near, far = (nodes[node, 0] - ray.x) * ray.dx, (nodes[node, 3] - ray.x) * ray.dx
    low, high = min(near, far), max(near, far)
    near, far = (nodes[node, 1] - ray.y) * ray.dy, (nodes[node, 4] - ray.y) * ray.dy
    low, high = max(low, min(near, far)), min(high, max(near, far))
    near, far = (nodes[node, 2] - ray.z) * ray.dz, (nodes[node, 5] - ray.z) * ray.dz
    low, high = max(low, min(near, far)), min(high, max(near, far))
    misses: bool = high < low or high < 0.0 or low > t_max
    return misses


@typed_kernel_part("f8(f8[:, ::1], i8, f8, f8, f8)")
def _along(axes: NDArray[np.float64], axis: int, x: float, y: float, z: float) -> float:
    length: float = axes[axis, 0] * x + axes[axis, 1] * y + axes[axis, 2] * z
    return length


@typed_kernel_part("f8(f8)")
def _inverse(value: float) -> float:
    # Not infinity: zero times infinity would be NaN for a ray inside the slab's plane.
    if abs(value) < 1e-30:
        return 1e30 if value >= 0.0 else -1e30
    return 1.0 / value


@compiled
def cast_rays(
    table: CastTable,
    starts: NDArray[np.float64],
    ways: NDArray[np.float64],
    t: NDArray[np.float64],
    rectangle: NDArray[np.int32],
) -> None:
    """Find the first rectangle that each ray meets.

    Args:
        table: the scene.
        starts: (3, n), or (3, 1) for all rays, metres from the scene's origin along its axes.
        ways: (3, n) directions along the scene's axes; their lengths are the units of t.
        t: (n,) maximum distance; set to the distance of a hit, unchanged without one.
        rectangle: (n,) filled; -1 without a hit.
    """
    rectangles, holes, nodes, axes = table.rectangles, table.holes, table.nodes, table.axes
    each = 1 if starts.shape[1] > 1 else 0
    guess = np.int64(-1)
    for i in range(ways.shape[1]):
        x, y, z = starts[0, each * i], starts[1, each * i], starts[2, each * i]
        dx, dy, dz = ways[0, i], ways[1, i], ways[2, i]
        x, y, z = _along(axes, 0, x, y, z), _along(axes, 1, x, y, z), _along(axes, 2, x, y, z)
        dx, dy, dz = (
            _along(axes, 0, dx, dy, dz),
            _along(axes, 1, dx, dy, dz),
            _along(axes, 2, dx, dy, dz),
        )
        ray = Ray(x, y, z, dx, dy, dz)
        inverse = Ray(x, y, z, _inverse(dx), _inverse(dy), _inverse(dz))
        best_t, best = t[i], np.int64(-1)
        # Trying the previous ray's hit first skips most boxes; it does not change the result.
        if guess >= 0:
            distance = _hit_distance(rectangles, holes, guess, ray)
            if distance < best_t:
                best_t, best = distance, guess
        node = np.int64(0)
        while node < nodes.shape[0]:
            if _misses_box(nodes, node, inverse, best_t):
                node = np.int64(nodes[node, 6])
                continue
            for place in range(int(nodes[node, 7]), int(nodes[node, 8])):
                index = table.order[place]
                distance = _hit_distance(rectangles, holes, index, ray)
                if distance < best_t or (distance == best_t and index < best):
                    best_t, best = distance, index
            node += 1
        t[i] = best_t
        rectangle[i] = guess = best
