"""Compiled function that finds the cells of an unrolled cylinder that a photo sees.

The axis of the cylinder is parallel to the straight direction of the raster. In a plane normal to
the axis, rays are straight lines, and depths are distances from the cylinder. A ray is followed
over the relief in steps of at most one cell; the lengths of the steps change along the ray.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.camera_kernels import project_point
from orthoflow.geometry.compiling import compiled, inlined, kernel_part
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow_plugins.ortho.visibility_kernels import (
    BLOCK_CELLS,
    NO_SURFACE,
    OCCLUDED,
    OUTSIDE,
    PAINTED,
    Relief,
    TileVisibility,
    WallView,
)

# Number of times that the bound of the surface along a ray is refined.
_ROUNDS: Final = 2


class Ray(NamedTuple):
    """A ray from a cell to the camera, relative to the axis of the cylinder.

    Attributes:
        across: coordinate along the tangent at the first edge of the raster, in metres.
        lift: coordinate along the normal there, in metres.
        along: coordinate along the axis from the first edge of the raster, in metres.
        to_across: component of the vector to the camera along the tangent.
        to_lift: component of this vector along the normal.
        to_along: component of this vector along the axis.
    """

    across: float
    lift: float
    along: float
    to_across: float
    to_lift: float
    to_along: float


@compiled
def look_at_curved_cells(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    visible: TileVisibility,
    first_row: int,
    first_column: int,
) -> None:
    """Project the cells of a tile into a photo and find those that the photo sees.

    Args:
        view: the camera in the axes at the top-left corner of a curved wall.
        relief: the surface of the whole wall.
        buffer: depth buffer of objects in front of the wall.
        visible: output, in the shape of the tile.
        first_row: first row of the tile on the wall.
        first_column: first column of the tile on the wall.
    """
    n_rows, n_columns = visible.mask.shape
    radius_m, gsd_m = view.radius_m, view.gsd_m
    n_bent = n_columns if view.is_along_u else n_rows
    first_bent = first_column if view.is_along_u else first_row
    cosines, sines = np.empty(n_bent), np.empty(n_bent)
    for k in range(n_bent):
        angle = (first_bent + k + 0.5) * gsd_m / radius_m
        cosines[k], sines[k] = math.cos(angle), math.sin(angle)
    eye_along = view.row if view.is_along_u else view.column
    eye_across = view.column if view.is_along_u else view.row
    area = view.camera[12] * view.camera[13] * gsd_m * gsd_m
    for i in range(n_rows):
        for j in range(n_columns):
            depth = float(relief.depth[first_row + i, first_column + j])
            visible.u[i, j] = visible.v[i, j] = visible.quality[i, j] = np.float32(0.0)
            if math.isnan(depth):
                visible.mask[i, j] = NO_SURFACE
                continue
            k = j if view.is_along_u else i
            straight = first_row + i if view.is_along_u else first_column + j
            from_axis = radius_m - depth
            across, lift = from_axis * sines[k], -from_axis * cosines[k]
            along = (straight + 0.5) * gsd_m
            x, y = (across, along) if view.is_along_u else (along, across)
            u, v, distance = project_point(view.camera, x, y, lift + radius_m)
            visible.mask[i, j] = OUTSIDE
            if not (0.0 <= u < view.camera[21] and 0.0 <= v < view.camera[22]):
                continue
            ray = Ray(
                across,
                lift,
                along,
                (eye_across + 0.5) * gsd_m - across,
                view.height_m - radius_m - lift,
                (eye_along + 0.5) * gsd_m - along,
            )
            length = math.sqrt(ray.to_across**2 + ray.to_lift**2 + ray.to_along**2)
            cosine = (cosines[k] * ray.to_lift - sines[k] * ray.to_across) / length
            at_row = min(int(v / buffer.reduction), buffer.nearest.shape[0] - 1)
            at_column = min(int(u / buffer.reduction), buffer.nearest.shape[1] - 1)
            leaves = _reaches(ray, radius_m, view.front_m)
            leaves_m = (1.0 - leaves) * distance - view.tolerance_m
            is_hidden = cosine <= view.cosine_least
            is_hidden = is_hidden or buffer.nearest[at_row, at_column] < leaves_m
            visible.mask[i, j] = OCCLUDED
            if is_hidden or _is_covered(view, relief, ray, depth):
                continue
            width, height = view.camera[21], view.camera[22]
            inside = min(width - u, u, height - v, v) / view.border_px
            area_here = area * (1.0 - depth / radius_m) / (distance * distance)
            visible.mask[i, j] = PAINTED
            visible.u[i, j], visible.v[i, j] = u, v
            visible.quality[i, j] = cosine * area_here * min(1.0, inside)


@inlined
def _depth_at(ray, share, radius_m):  # type: ignore[no-untyped-def]  # numba infers the types
    """Return the depth of the ray at a share of its length."""
    across, lift = ray.across + share * ray.to_across, ray.lift + share * ray.to_lift
    away = math.sqrt(across * across + lift * lift)
    return radius_m - (away if radius_m > 0.0 else -away)


@kernel_part
def _place_at(ray: Ray, share: float, view: WallView, relief: Relief) -> tuple[float, float]:
    """Return the row and column of a ray at a share of its length; (0, 0) is the first centre."""
    across, lift = ray.across + share * ray.to_across, ray.lift + share * ray.to_lift
    n_bent = relief.depth.shape[1] if view.is_along_u else relief.depth.shape[0]
    side, middle = math.copysign(1.0, view.radius_m), 0.5 * n_bent * view.gsd_m / view.radius_m
    angle = math.atan2(side * across, -side * lift) - middle
    angle = middle + angle - math.tau * round(angle / math.tau)
    bent = angle * view.radius_m / view.gsd_m - 0.5
    straight = (ray.along + share * ray.to_along) / view.gsd_m - 0.5
    return (straight, bent) if view.is_along_u else (bent, straight)


@kernel_part
def _reaches(ray: Ray, radius_m: float, depth_m: float) -> float:
    """Return the share of a ray at which it first reaches a depth; 1 if it does not."""
    a = ray.to_across**2 + ray.to_lift**2
    b = ray.across * ray.to_across + ray.lift * ray.to_lift
    c = ray.across**2 + ray.lift**2 - (radius_m - depth_m) ** 2
    root = b * b - a * c
    if root < 0.0 or a == 0.0:
        return 1.0
    share = (-b - math.sqrt(root) if radius_m > 0.0 else -b + math.sqrt(root)) / a
    return min(1.0, share) if share > 0.0 else (0.0 if c * radius_m <= 0.0 else 1.0)


@kernel_part
def _is_covered(view: WallView, relief: Relief, ray: Ray, depth: float) -> bool:
    """Return whether the relief of the wall, or its opposite side, hides a cell from the camera."""
    if relief.occluding.size == 0:
        return False
    if view.radius_m > 0.0 and _is_behind_the_wall(view, relief, ray):
        return True
    top = _highest_in_the_way(view, relief, ray, depth)
    end = _reaches(ray, view.radius_m, top) if depth + view.tolerance_m < top else 0.0
    share = 0.0
    while True:
        across, lift = ray.across + share * ray.to_across, ray.lift + share * ray.to_lift
        turning = abs(across * ray.to_lift - lift * ray.to_across) / (across**2 + lift**2)
        per_share = max(turning * abs(view.radius_m), abs(ray.to_along)) / view.gsd_m
        share += 1.0 / max(per_share, 1e-6)
        if share >= end:
            return False
        row, column = _place_at(ray, share, view, relief)
        if not _is_on_wall(relief, row, column):
            return False
        level = _depth_at(ray, share, view.radius_m) + view.tolerance_m
        if _surface_at(relief.occluding, row, column) > level:
            return True


@kernel_part
def _is_behind_the_wall(view: WallView, relief: Relief, ray: Ray) -> bool:
    """Return whether a ray leaves a cylinder, seen from inside, through its opposite side."""
    a = ray.to_across**2 + ray.to_lift**2
    b = ray.across * ray.to_across + ray.lift * ray.to_lift
    root = b * b - a * (ray.across**2 + ray.lift**2 - view.radius_m**2)
    share = (-b + math.sqrt(root)) / a if root > 0.0 and b < 0.0 else 2.0
    if share >= 1.0:
        return False
    row, column = _place_at(ray, share, view, relief)
    return _is_on_wall(relief, row, column) and (
        _surface_at(relief.occluding, row, column) > -math.inf
    )


@kernel_part
def _highest_in_the_way(view: WallView, relief: Relief, ray: Ray, depth: float) -> float:
    """Return an upper bound of the surface along the part of a ray that it may interrupt."""
    top, n_rows, n_columns = relief.highest_m, relief.depth.shape[0], relief.depth.shape[1]
    row, column = _place_at(ray, 0.0, view, relief)
    for _ in range(_ROUNDS):
        if not depth + view.tolerance_m < top:
            return top
        end_row, end_column = _place_at(ray, _reaches(ray, view.radius_m, top), view, relief)
        first_row = max(0, int(min(row, end_row) - 1.0)) // BLOCK_CELLS
        last_row = max(0, min(n_rows - 1, int(max(row, end_row) + 2.0))) // BLOCK_CELLS
        first = max(0, int(min(column, end_column) - 1.0)) // BLOCK_CELLS
        last = max(0, min(n_columns - 1, int(max(column, end_column) + 2.0))) // BLOCK_CELLS
        top = -math.inf
        for i in range(first_row, last_row + 1):
            for j in range(first, last + 1):
                top = max(top, float(relief.tops[i, j]))
    return top


@inlined
def _is_on_wall(relief, row, column):  # type: ignore[no-untyped-def]  # numba infers the types
    """Return whether a position is inside the raster."""
    n_rows, n_columns = relief.depth.shape
    return -0.5 <= row <= n_rows - 0.5 and -0.5 <= column <= n_columns - 0.5


@kernel_part
def _surface_at(surface: NDArray[np.float32], row: float, column: float) -> float:
    """Interpolate a surface at a position; the edge cells extend to the edges of the raster."""
    n_rows, n_columns = surface.shape
    row, column = min(max(row, 0.0), n_rows - 1.0), min(max(column, 0.0), n_columns - 1.0)
    top, left = int(row), int(column)
    bottom, right = min(top + 1, n_rows - 1), min(left + 1, n_columns - 1)
    down, across = row - top, column - left
    total = 0.0
    for y, x, share in (
        (top, left, (1.0 - down) * (1.0 - across)),
        (top, right, (1.0 - down) * across),
        (bottom, left, down * (1.0 - across)),
        (bottom, right, down * across),
    ):
        # Minus infinity times 0 would be NaN.
        if share > 0.0:
            total += share * surface[y, x]
    return total
