"""Compiled function that finds the cells of a developed curved wall that a photo sees.

In the axes of the surface, rays are straight lines, and depths are distances from the surface. A
ray is followed over the relief in steps of at most one cell; the lengths of the steps change along
the ray.
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
    AxisView,
    Relief,
    TileVisibility,
    WallView,
)

# Number of times that the bound of the surface along a ray is refined.
_ROUNDS: Final = 2


class Ray(NamedTuple):
    """A ray from a cell to the camera, in the axes of the surface.

    Attributes:
        first: coordinate towards angle 0, in metres.
        second: coordinate towards an angle of 90 degrees.
        axial: coordinate along the axis.
        to_first: component of the vector to the camera towards angle 0.
        to_second: component of this vector towards an angle of 90 degrees.
        to_axial: component of this vector along the axis.
    """

    first: float
    second: float
    axial: float
    to_first: float
    to_second: float
    to_axial: float


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
        view: the camera in the axes at the top-left corner of a curved wall, and in those of the
            surface.
        relief: the surface of the whole wall.
        buffer: depth buffer of objects in front of the wall.
        visible: output, in the shape of the tile.
        first_row: first row of the tile on the wall.
        first_column: first column of the tile on the wall.
    """
    n_rows, n_columns = visible.mask.shape
    about, gsd_m = view.about, view.gsd_m
    area = view.camera[12] * view.camera[13] * gsd_m * gsd_m
    # On a cylinder, the angle is the same in all cells of a row or column.
    is_along_u = about.aside_x != 0.0
    n_bent = n_columns if is_along_u else n_rows
    first_bent = first_column if is_along_u else first_row
    directions = _directions(about, gsd_m, first_bent, n_bent)
    for i in range(n_rows):
        for j in range(n_columns):
            depth = float(relief.depth[first_row + i, first_column + j])
            visible.u[i, j] = visible.v[i, j] = visible.quality[i, j] = np.float32(0.0)
            if math.isnan(depth):
                visible.mask[i, j] = NO_SURFACE
                continue
            x = (first_column + j + 0.5) * gsd_m - about.place_x
            y = (first_row + i + 0.5) * gsd_m - about.place_y
            along, aside = x * about.along_x + y * about.along_y, 0.0
            if about.fan == 0.0:
                k = j if is_along_u else i
                towards_first, towards_second = directions[0, k], directions[1, k]
            else:
                aside = x * about.aside_x + y * about.aside_y
                angle = math.atan2(aside, along) / about.fan
                along = math.sqrt(along * along + aside * aside)
                towards_first, towards_second = math.cos(angle), math.sin(angle)
            widened, from_axis, axial, sine, cosine = _profile_at(along, depth, about)
            first, second = from_axis * towards_first, from_axis * towards_second
            u, v, distance = project_point(view.axial_camera, first, second, axial)
            visible.mask[i, j] = OUTSIDE
            if not (0.0 <= u < view.camera[21] and 0.0 <= v < view.camera[22]):
                continue
            ray = Ray(
                first,
                second,
                axial,
                about.first - first,
                about.second - second,
                about.axial - axial,
            )
            length = math.sqrt(ray.to_first**2 + ray.to_second**2 + ray.to_axial**2)
            outwards = towards_first * ray.to_first + towards_second * ray.to_second
            cosine = about.side * (cosine * outwards - sine * ray.to_axial) / length
            at_row = min(int(v / buffer.reduction), buffer.nearest.shape[0] - 1)
            at_column = min(int(u / buffer.reduction), buffer.nearest.shape[1] - 1)
            leaves = _reaches(ray, about, view.front_m)
            leaves_m = (1.0 - leaves) * distance - view.tolerance_m
            is_hidden = buffer.nearest[at_row, at_column] < leaves_m or cosine <= view.cosine_least
            visible.mask[i, j] = OCCLUDED
            if is_hidden or _is_covered(view, relief, ray, depth, distance):
                continue
            width, height = view.camera[21], view.camera[22]
            inside = min(width - u, u, height - v, v) / view.border_px
            area_here = area * widened / (distance * distance)
            visible.mask[i, j] = PAINTED
            visible.u[i, j], visible.v[i, j] = u, v
            visible.quality[i, j] = cosine * area_here * min(1.0, inside)


@kernel_part
def _profile_at(
    along: float, depth: float, about: AxisView
) -> tuple[float, float, float, float, float]:
    """Return where a cell is, given its distance along a generatrix and its depth.

    Returns:
        Its area relative to that on the raster, its distance from the axis, its coordinate along
        the axis, and sine and cosine of the angle between the axis and the generatrix.
    """
    if about.round != 0.0:
        angle, from_centre = along / about.radius_m, about.radius_m + about.side * depth
        sine, cosine = math.sin(angle), math.cos(angle)
        widened = from_centre * from_centre / (about.radius_m * about.radius_m)
        widened *= sine / angle if angle > 0.0 else 1.0
        return widened, from_centre * sine, -from_centre * cosine, cosine, sine
    radius = about.radius_m + about.sine * along
    from_axis = radius + about.side * about.cosine * depth
    axial = about.cosine * along - about.side * about.sine * depth
    return from_axis / radius, from_axis, axial, about.sine, about.cosine


@kernel_part
def _directions(about: AxisView, gsd_m: float, first: int, n_cells: int) -> NDArray[np.float64]:
    """Return the cosines and sines (2, n) of the angles of rows or columns about a cylinder."""
    directions = np.zeros((2, n_cells))
    if about.fan == 0.0:
        for k in range(n_cells):
            angle = (first + k + 0.5) * gsd_m / about.radius_m
            directions[0, k], directions[1, k] = math.cos(angle), math.sin(angle)
    return directions


@inlined
def _depth_at(ray, share, about):  # type: ignore[no-untyped-def]  # numba infers the types
    """Return the depth of the ray at a share of its length."""
    first, second = ray.first + share * ray.to_first, ray.second + share * ray.to_second
    axial = ray.axial + share * ray.to_axial
    square = first * first + second * second + about.round * axial * axial
    outwards = math.sqrt(square) - about.radius_m
    return about.side * (about.cosine * outwards - about.sine * axial)


@kernel_part
def _position_at(ray: Ray, share: float, about: AxisView) -> tuple[float, float]:
    """Return the distance along a generatrix and the angle about the axis at a share of a ray."""
    first, second = ray.first + share * ray.to_first, ray.second + share * ray.to_second
    angle = math.atan2(second, first) - about.middle_rad
    angle = about.middle_rad + angle - math.tau * round(angle / math.tau)
    across = math.sqrt(first * first + second * second)
    axial = ray.axial + share * ray.to_axial
    if about.round != 0.0:
        return about.radius_m * math.atan2(across, -axial), angle
    return about.sine * (across - about.radius_m) + about.cosine * axial, angle


@kernel_part
def _cell_at(distance: float, angle: float, about: AxisView, gsd_m: float) -> tuple[float, float]:
    """Return the row and column of a position on the surface; (0, 0) is the first centre."""
    if about.fan == 0.0:
        along, aside = distance, about.radius_m * angle
    else:
        turn = about.fan * angle
        along, aside = distance * math.cos(turn), distance * math.sin(turn)
    x = about.place_x + along * about.along_x + aside * about.aside_x
    y = about.place_y + along * about.along_y + aside * about.aside_y
    return y / gsd_m - 0.5, x / gsd_m - 0.5


@kernel_part
def _reaches(ray: Ray, about: AxisView, depth_m: float) -> float:
    """Return the share of a ray at which it first reaches a depth; 1 if it does not.

    Positions of the same depth are on a cylinder or cone with the same axis and half angle, or on a
    sphere with the same centre.
    """
    share, c, least = _crossing(ray, about, depth_m, about.side)
    if share > 0.0:
        return min(1.0, share)
    return 0.0 if about.side * c >= 0.0 and least > 0.0 else 1.0


@kernel_part
def _crossing(
    ray: Ray, about: AxisView, depth_m: float, leaves: float
) -> tuple[float, float, float]:
    """Return the share of a ray where it crosses a depth, and the values at its start.

    Args:
        ray: the ray.
        about: the surface.
        depth_m: the depth. Its radius is `least` / cosine at the start of the ray.
        leaves: 1 for the crossing away from the axis, and -1 for the one towards the axis.

    Returns:
        The share, which is infinite if there is no crossing; a number that is positive if the start
        is farther from the axis than the depth, and negative if it is nearer; and `least`.
    """
    least = about.cosine * about.radius_m + about.side * depth_m + about.sine * ray.axial
    to_least, square = about.sine * ray.to_axial, about.cosine**2
    a = square * (ray.to_first**2 + ray.to_second**2) - to_least**2
    b = square * (ray.first * ray.to_first + ray.second * ray.to_second) - least * to_least
    c = square * (ray.first**2 + ray.second**2) - least**2
    a += about.round * ray.to_axial**2
    b += about.round * ray.axial * ray.to_axial
    c += about.round * ray.axial**2
    root = b * b - a * c
    if root < 0.0 or a == 0.0:
        return math.inf, c, least
    share = (-b + leaves * math.sqrt(root)) / a
    # The equation also holds on the mirror image of a cone.
    return share if least + share * to_least > 0.0 else math.inf, c, least


@kernel_part
def _inside_m(ray: Ray, about: AxisView) -> float:
    """Return the distance of a ray from the outline that the surface has in the photo.

    Behind its cell, the ray continues inside a convex surface. Its largest distance below the
    surface, at the minimum of the convex function of depth, is that by which it may be shifted
    before it misses the surface. Concave surfaces have no such outline.
    """
    if about.side < 0.0:
        return math.inf
    if about.round != 0.0:
        square = ray.first**2 + ray.second**2 + ray.axial**2
        along = ray.first * ray.to_first + ray.second * ray.to_second + ray.axial * ray.to_axial
        length_square = ray.to_first**2 + ray.to_second**2 + ray.to_axial**2
        return math.sqrt(square) - math.sqrt(max(0.0, square - along * along / length_square))
    across = math.hypot(ray.to_first, ray.to_second)
    slope = about.sine * ray.to_axial
    if not abs(slope) < about.cosine * across:
        return math.inf
    # Where the depth is least, the distance from the axis changes by `turn` per metre of `across`.
    turn = slope / (about.cosine * across)
    nearest = abs(ray.first * ray.to_second - ray.second * ray.to_first) / across
    away = nearest / math.sqrt(1.0 - turn * turn)
    foot = -(ray.first * ray.to_first + ray.second * ray.to_second) / across**2
    share = foot + turn * away / across
    change = math.hypot(ray.first, ray.second) - away
    return about.cosine * change + slope * share


@kernel_part
def _is_covered(view: WallView, relief: Relief, ray: Ray, depth: float, distance: float) -> bool:
    """Return whether the relief of the wall, or its opposite side, hides a cell from the camera.

    Cells near the outline of the surface count as hidden. The distance is that along the optical
    axis.
    """
    about = view.about
    if relief.occluding.size == 0:
        return False
    pixel_m = distance / min(view.camera[12], view.camera[13])
    if _inside_m(ray, about) < view.outline_m + pixel_m:
        return True
    if about.side < 0.0 and _is_behind_the_wall(view, relief, ray):
        return True
    top = _highest_in_the_way(view, relief, ray, depth)
    end = _reaches(ray, about, top) if depth + view.tolerance_m < top else 0.0
    share = 0.0
    while True:
        share += 1.0 / max(_cells_per_share(ray, share, about, view.gsd_m), 1e-6)
        if share >= end:
            return False
        row, column = _cell_at(*_position_at(ray, share, about), about, view.gsd_m)
        if not _is_on_wall(relief, row, column):
            return False
        level = _depth_at(ray, share, about) + view.tolerance_m
        if _surface_at(relief.occluding, row, column) > level:
            return True


@kernel_part
def _cells_per_share(ray: Ray, share: float, about: AxisView, gsd_m: float) -> float:
    """Return the number of cells that a ray crosses per unit of its share."""
    first, second = ray.first + share * ray.to_first, ray.second + share * ray.to_second
    square = max(first * first + second * second, 1e-12)
    turning = abs(first * ray.to_second - second * ray.to_first) / square
    if about.fan == 0.0:
        return max(turning * about.radius_m, abs(ray.to_axial)) / gsd_m
    away, axial = math.sqrt(square), ray.axial + share * ray.to_axial
    lifting = (first * ray.to_first + second * ray.to_second) / away
    if about.round != 0.0:
        tilting = (away * ray.to_axial - axial * lifting) / (square + axial * axial)
        across = math.atan2(away, -axial) * turning
        return about.radius_m * math.hypot(across, tilting) / gsd_m
    distance = about.sine * away + about.cosine * axial
    lengthening = about.sine * lifting + about.cosine * ray.to_axial
    return math.hypot(about.sine * distance * turning, lengthening) / gsd_m


@kernel_part
def _is_behind_the_wall(view: WallView, relief: Relief, ray: Ray) -> bool:
    """Return whether a ray leaves a surface, seen from inside, through its opposite side."""
    about = view.about
    share, _, least = _crossing(ray, about, 0.0, 1.0)
    inwards = about.cosine**2 * (ray.first * ray.to_first + ray.second * ray.to_second)
    inwards += about.round * ray.axial * ray.to_axial - about.sine * least * ray.to_axial
    if not (0.0 < share < 1.0 and inwards < 0.0):
        return False
    row, column = _cell_at(*_position_at(ray, share, about), about, view.gsd_m)
    return _is_on_wall(relief, row, column) and (
        _surface_at(relief.occluding, row, column) > -math.inf
    )


@kernel_part
def _highest_in_the_way(view: WallView, relief: Relief, ray: Ray, depth: float) -> float:
    """Return an upper bound of the surface along the part of a ray that it may interrupt."""
    about = view.about
    top, n_rows, n_columns = relief.highest_m, relief.depth.shape[0], relief.depth.shape[1]
    row, column = _cell_at(*_position_at(ray, 0.0, about), about, view.gsd_m)
    for _ in range(_ROUNDS):
        if not depth + view.tolerance_m < top:
            return top
        end = _reaches(ray, about, top)
        low_row, high_row, low_column, high_column = _cells_along(
            ray, end, row, column, about, view.gsd_m
        )
        first_row = max(0, int(low_row - 1.0)) // BLOCK_CELLS
        last_row = max(0, min(n_rows - 1, int(high_row + 2.0))) // BLOCK_CELLS
        first = max(0, int(low_column - 1.0)) // BLOCK_CELLS
        last = max(0, min(n_columns - 1, int(high_column + 2.0))) // BLOCK_CELLS
        top = -math.inf
        for i in range(first_row, last_row + 1):
            for j in range(first, last + 1):
                top = max(top, float(relief.tops[i, j]))
    return top


@kernel_part
def _cells_along(
    ray: Ray, end: float, row: float, column: float, about: AxisView, gsd_m: float
) -> tuple[float, float, float, float]:
    """Return bounds of the rows and columns of a ray up to a share: two rows, two columns.

    Args:
        ray: the ray.
        end: the share.
        row: row of the cell in which the ray starts; (0, 0) is the first centre.
        column: its column.
        about: the surface.
        gsd_m: side of a cell.
    """
    far, angle = _position_at(ray, end, about)
    end_row, end_column = _cell_at(far, angle, about, gsd_m)
    low_row, high_row = min(row, end_row), max(row, end_row)
    low_column, high_column = min(column, end_column), max(column, end_column)
    if about.fan == 0.0:
        return low_row, high_row, low_column, high_column
    # The distance from the apex is a convex function of the share, so it is largest at an end. A
    # lower bound follows from the smallest distance from the axis and the lowest position along it.
    across = ray.to_first * ray.to_first + ray.to_second * ray.to_second
    middle = -(ray.first * ray.to_first + ray.second * ray.to_second) / max(across, 1e-12)
    middle = min(max(middle, 0.0), end)
    first, second = ray.first + middle * ray.to_first, ray.second + middle * ray.to_second
    nearest = math.sqrt(first * first + second * second)
    axial = min(ray.axial, ray.axial + end * ray.to_axial)
    least = (about.sine * nearest + about.cosine * axial) / gsd_m
    apex_row = about.place_y / gsd_m - 0.5
    apex_column = about.place_x / gsd_m - 0.5
    down, right = row - apex_row, column - apex_column
    end_down, end_right = end_row - apex_row, end_column - apex_column
    near, far = math.hypot(down, right), math.hypot(end_down, end_right)
    near, far = max(near, 1e-9), max(far, 1e-9)
    most = max(near, far)
    if about.round != 0.0:
        # By the triangle inequality: on a sphere, no position between two ends is nearer to the
        # pole, or farther from it, than their distances and that between them permit.
        apart = _arc_along(ray, end) * about.radius_m / gsd_m
        least = max(0.0, 0.5 * (near + far - apart))
        most = max(most, 0.5 * (near + far + apart))
    # The box contains the points at both distances on both generatrices, and the arcs between them.
    for towards_down, towards_right in (
        (down / near, right / near),
        (end_down / far, end_right / far),
    ):
        for distance in (least, most):
            at_row = apex_row + distance * towards_down
            at_column = apex_column + distance * towards_right
            low_row, high_row = min(low_row, at_row), max(high_row, at_row)
            low_column, high_column = min(low_column, at_column), max(high_column, at_column)
    cosine = (down * end_down + right * end_right) / (near * far)
    beyond = most * (1.0 - math.sqrt(max(0.0, 0.5 + 0.5 * cosine)))
    return low_row - beyond, high_row + beyond, low_column - beyond, high_column + beyond


@kernel_part
def _arc_along(ray: Ray, end: float) -> float:
    """Return the angle at the centre of a sphere between both ends of a part of a ray."""
    start_square = ray.first**2 + ray.second**2 + ray.axial**2
    along = ray.first * ray.to_first + ray.second * ray.to_second + ray.axial * ray.to_axial
    square = ray.to_first**2 + ray.to_second**2 + ray.to_axial**2
    across = math.sqrt(max(0.0, start_square * square - along * along))
    return math.atan2(end * across, start_square + end * along)


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
