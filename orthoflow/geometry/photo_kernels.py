"""Compiled cameras in a simulated scene: the ray of a pixel, what it hits, and whole photos."""

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
from orthoflow.geometry.texture_kernels import cell_state, uniform

# Pixels per side of a tile, and how many tiles' pixels in a row make a block.
TILE: Final = 8
BLOCK: Final = 64
_NEWTON_STEPS: Final = 20


class Exposure(NamedTuple):
    """How a photo is taken.

    Attributes:
        camera: `ViewingCamera.flat`, metres from the scene's origin.
        n_sub: rays per side of a pixel, each at a hashed place in its part of the pixel.
        seed: of those places.
    """

    camera: NDArray[np.float64]
    n_sub: int
    seed: int


class Area(NamedTuple):
    """A rectangle of pixels: first row and column, and how many."""

    first_row: int
    first_column: int
    n_rows: int
    n_columns: int


class Candidates(NamedTuple):
    """Rectangles that some area may show.

    Attributes:
        rectangle: (r,) int64, the first `number` entries ascend.
        near: (r,) float64 how near they come.
        number: (1,) int64 how many there are.
    """

    rectangle: NDArray[np.int64]
    near: NDArray[np.float64]
    number: NDArray[np.int64]


class Workspace(NamedTuple):
    """What one thread needs for rows of tiles.

    Attributes:
        everything: all rectangles of the scene.
        in_block: room for those of a block of tiles.
        in_tile: room for those of a tile.
        directions: (TILE + 1, TILE + 1, 3) room for the corners of its pixels.
    """

    everything: Candidates
    in_block: Candidates
    in_tile: Candidates
    directions: NDArray[np.float64]


def workspace(n_rectangles: int) -> Workspace:
    """Make room for working on a scene of so many rectangles."""
    everything, in_block, in_tile = (
        Candidates(np.arange(n_rectangles), np.empty(n_rectangles), np.full(1, n_rectangles))
        for _ in range(3)
    )
    return Workspace(everything, in_block, in_tile, np.empty((TILE + 1, TILE + 1, 3)))


@njit("UniTuple(f8, 3)(f8[::1], f8, f8)", cache=True)
def pixel_direction(camera: NDArray[np.float64], u: float, v: float) -> tuple[float, float, float]:
    """Direction in world axes, one metre deep along the optical axis, of a pixel.

    The distortion of `camera_kernels.project_point` is undone by Newton steps.
    """
    wanted_a, wanted_b = (u - camera[14]) / camera[12], (v - camera[15]) / camera[13]
    k1, k2, p1, p2, k3 = camera[16], camera[17], camera[18], camera[19], camera[20]
    a, b = wanted_a, wanted_b
    for _ in range(_NEWTON_STEPS):
        r2 = a * a + b * b
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        error_a = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a) - wanted_a
        error_b = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b - wanted_b
        aa = radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
        ab = a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
        bb = radial + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a
        determinant = aa * bb - ab * ab
        step_a = (bb * error_a - ab * error_b) / determinant
        step_b = (aa * error_b - ab * error_a) / determinant
        a -= step_a
        b -= step_b
        if abs(step_a) + abs(step_b) < 1e-13:
            break
    return (
        camera[0] * a + camera[3] * b + camera[6],
        camera[1] * a + camera[4] * b + camera[7],
        camera[2] * a + camera[5] * b + camera[8],
    )


@njit("UniTuple(f8, 3)(f8[::1])", cache=True)
def _centre(camera: NDArray[np.float64]) -> tuple[float, float, float]:
    return (
        -(camera[0] * camera[9] + camera[3] * camera[10] + camera[6] * camera[11]),
        -(camera[1] * camera[9] + camera[4] * camera[10] + camera[7] * camera[11]),
        -(camera[2] * camera[9] + camera[5] * camera[10] + camera[8] * camera[11]),
    )


@njit(cache=True, nogil=True)
def hit_pixels(
    table: CastTable,
    camera: NDArray[np.float64],
    pixels: NDArray[np.float64],
    points: NDArray[np.float64],
    rectangle: NDArray[np.int32],
) -> None:
    """Fill points (n, 3) from the scene's origin and rectangle (n,) that pixels (n, 2) look at.

    Pixels that are NaN or look at nothing are left as they are.
    """
    x, y, z = _centre(camera)
    guess: Index = NOTHING
    for i in range(pixels.shape[0]):
        if math.isnan(pixels[i, 0]) or math.isnan(pixels[i, 1]):
            continue
        dx, dy, dz = pixel_direction(camera, pixels[i, 0], pixels[i, 1])
        t, guess = nearest_hit(table, Ray(x, y, z, dx, dy, dz), 1e-9, np.inf, guess)
        if guess >= 0:
            rectangle[i] = guess
            points[i, 0], points[i, 1], points[i, 2] = x + t * dx, y + t * dy, z + t * dz


@njit(cache=True)
def _fill_directions(
    camera: NDArray[np.float64], area: Area, directions: NDArray[np.float64]
) -> None:
    """Fill the directions (rows + 1, columns + 1, 3) of the corners of an area's pixels."""
    for row in range(area.n_rows + 1):
        for column in range(area.n_columns + 1):
            x, y, z = pixel_direction(
                camera, float(area.first_column + column), float(area.first_row + row)
            )
            directions[row, column, 0] = x
            directions[row, column, 1] = y
            directions[row, column, 2] = z


@njit(cache=True)
def _look_through_corners(
    table: CastTable, index: Index, start: Ray, ends: NDArray[np.float64]
) -> tuple[bool, bool, float, float]:
    """Whether an area may show a rectangle, whether that fills it, and from and to what distance.

    The rays (4, 3) through the corners meet the rectangle's plane in a quadrangle that contains
    what the area sees of the plane.
    """
    r, h = table.rectangles, table.holes
    x, y, z = r[index, 0] - start.x, r[index, 1] - start.y, r[index, 2] - start.z
    ahead = r[index, 9] * x + r[index, 10] * y + r[index, 11] * z
    near, far, n_before = np.inf, 0.0, 0
    low_a, high_a, low_b, high_b = np.inf, -np.inf, np.inf, -np.inf
    for corner in range(4):
        d = ends[corner]
        facing = r[index, 9] * d[0] + r[index, 10] * d[1] + r[index, 11] * d[2]
        if facing * ahead <= 0.0:
            continue
        n_before += 1
        t = ahead / facing
        u, v, w = t * d[0] - x, t * d[1] - y, t * d[2] - z
        a = u * r[index, 3] + v * r[index, 4] + w * r[index, 5]
        b = u * r[index, 6] + v * r[index, 7] + w * r[index, 8]
        near, far = min(near, t), max(far, t)
        low_a, high_a = min(low_a, a), max(high_a, a)
        low_b, high_b = min(low_b, b), max(high_b, b)
    if n_before < 4:
        # Some rays run away from the plane: nothing is known, unless all do.
        return n_before > 0, False, 0.0, np.inf
    e = r[index, 12:16]
    may_show = high_a >= e[0] and low_a <= e[1] and high_b >= e[2] and low_b <= e[3]
    fills = low_a >= e[0] and high_a <= e[1] and low_b >= e[2] and high_b <= e[3]
    for hole in range(table.first_hole[index], table.first_hole[index + 1]):
        apart_a = high_a < h[hole, 0] or low_a > h[hole, 1]
        apart_b = high_b < h[hole, 2] or low_b > h[hole, 3]
        fills = fills and (apart_a or apart_b)
    return may_show, fills, near, far


@njit(cache=True)
def _sides(ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inward normals (4, 3) of the pyramid whose edges (4, 3) go clockwise round the image."""
    sides = np.empty((4, 3))
    for side in range(4):
        p, q = ends[side], ends[(side + 1) % 4]
        sides[side, 0] = p[1] * q[2] - p[2] * q[1]
        sides[side, 1] = p[2] * q[0] - p[0] * q[2]
        sides[side, 2] = p[0] * q[1] - p[1] * q[0]
    return sides


@njit(cache=True)
def _is_outside(table: CastTable, index: Index, start: Ray, sides: NDArray[np.float64]) -> bool:
    """Whether a rectangle lies wholly outside one side of a pyramid."""
    r = table.rectangles
    x, y, z = r[index, 0] - start.x, r[index, 1] - start.y, r[index, 2] - start.z
    for side in range(4):
        n = sides[side]
        most = n[0] * x + n[1] * y + n[2] * z
        along_a = n[0] * r[index, 3] + n[1] * r[index, 4] + n[2] * r[index, 5]
        along_b = n[0] * r[index, 6] + n[1] * r[index, 7] + n[2] * r[index, 8]
        most += max(along_a * r[index, 12], along_a * r[index, 13])
        most += max(along_b * r[index, 14], along_b * r[index, 15])
        if most < 0.0:
            return True
    return False


@njit(cache=True)
def _find_candidates(
    table: CastTable,
    camera: NDArray[np.float64],
    area: Area,
    given: Candidates,
    found: Candidates,
) -> None:
    """Choose from the given rectangles those that an area may show.

    Half a pixel is added to the area, since distortion bends its sides by a tenth. What lies
    behind a rectangle that fills the area is left out.
    """
    x, y, z = _centre(camera)
    start = Ray(x, y, z, 0.0, 0.0, 0.0)
    ends = np.empty((4, 3))
    for corner in range(4):
        u = area.first_column + (area.n_columns + 0.5 if corner in (1, 2) else -0.5)
        v = area.first_row + (area.n_rows + 0.5 if corner in (2, 3) else -0.5)
        ends[corner, 0], ends[corner, 1], ends[corner, 2] = pixel_direction(camera, u, v)
    sides = _sides(ends)
    count, background = 0, np.inf
    for candidate in range(given.number[0]):
        index = given.rectangle[candidate]
        may_show, fills, near, far = _look_through_corners(table, index, start, ends)
        if may_show and not (near == 0.0 and _is_outside(table, index, start, sides)):
            found.rectangle[count], found.near[count] = index, near
            count += 1
        if fills:
            background = min(background, far)
    kept = 0
    for candidate in range(count):
        if found.near[candidate] <= background:
            found.rectangle[kept], found.near[kept] = (
                found.rectangle[candidate],
                found.near[candidate],
            )
            kept += 1
    found.number[0] = kept


@njit(cache=True)
def _nearest_candidate(table: CastTable, found: Candidates, ray: Ray) -> tuple[float, Index]:
    distance, met = np.inf, NOTHING
    for candidate in range(found.number[0]):
        index = found.rectangle[candidate]
        hit = hit_distance(table, index, ray, 1e-9)
        if 0.0 <= hit < distance:
            distance, met = hit, index
    return distance, met


@njit(cache=True)
def _expose_pixel(
    table: CastTable,
    exposure: Exposure,
    found: Candidates,
    corners: NDArray[np.float64],
    state: np.uint64,
) -> tuple[float, float, float]:
    """Mean colour of the rays of a pixel; rays between those of its corners are interpolated.

    The lens bends them by less than 1e-5 of a pixel from that.
    """
    x, y, z = _centre(exposure.camera)
    p = corners
    red, green, blue = 0.0, 0.0, 0.0
    n_sub = exposure.n_sub
    for sub in range(n_sub * n_sub):
        s = (sub % n_sub + uniform(state, 2 * sub)) / n_sub
        t = (sub // n_sub + uniform(state, 2 * sub + 1)) / n_sub
        a, b, c, d = (1.0 - s) * (1.0 - t), s * (1.0 - t), (1.0 - s) * t, s * t
        ray = Ray(
            x,
            y,
            z,
            a * p[0, 0, 0] + b * p[0, 1, 0] + c * p[1, 0, 0] + d * p[1, 1, 0],
            a * p[0, 0, 1] + b * p[0, 1, 1] + c * p[1, 0, 1] + d * p[1, 1, 1],
            a * p[0, 0, 2] + b * p[0, 1, 2] + c * p[1, 0, 2] + d * p[1, 1, 2],
        )
        distance, met = _nearest_candidate(table, found, ray)
        if met >= 0:
            shade = shade_of_hit(table, met, ray, distance)
            red += shade[0]
            green += shade[1]
            blue += shade[2]
    n_rays = n_sub * n_sub
    return red / n_rays, green / n_rays, blue / n_rays


@njit(cache=True, nogil=True)
def expose_rows(
    table: CastTable,
    exposure: Exposure,
    image: NDArray[np.float32],
    first_row: int,
    work: Workspace,
) -> None:
    """Fill TILE rows of a photo (rows, columns, 3), grey 0..255; black where nothing is.

    Candidates are found for a block of tiles, then for each tile among those.
    """
    n_rows, n_columns = min(TILE, image.shape[0] - first_row), image.shape[1]
    for first_column in range(0, n_columns, TILE):
        if first_column % BLOCK == 0:
            block = Area(first_row, first_column, TILE, BLOCK)
            _find_candidates(table, exposure.camera, block, work.everything, work.in_block)
        tile = Area(first_row, first_column, TILE, TILE)
        _find_candidates(table, exposure.camera, tile, work.in_block, work.in_tile)
        _fill_directions(exposure.camera, tile, work.directions)
        for row in range(n_rows):
            for column in range(min(TILE, n_columns - first_column)):
                state = cell_state(first_column + column, first_row + row, exposure.seed)
                corners = work.directions[row : row + 2, column : column + 2]
                shade = _expose_pixel(table, exposure, work.in_tile, corners, state)
                for channel in range(3):
                    image[first_row + row, first_column + column, channel] = shade[channel]
