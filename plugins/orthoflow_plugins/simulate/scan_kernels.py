"""The compiled scanner: rays over a grid of angles; noise hangs on the place in the grid only."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from orthoflow.geometry.scene_kernels import CastTable, Index, Ray, nearest_hit, shade_of_hit
from orthoflow.geometry.texture_kernels import cell_state, uniform

# `Scanned.rectangle` of a ray that met nothing, and of a gross outlier or a mixed distance.
MISSED: Final = -1
SPOILT: Final = -2


class Sweep(NamedTuple):
    """One scan: a station and the angles it looks along, in the room frame.

    Attributes:
        station: (3,) metres.
        azimuth: of column 0, radians from x towards y.
        elevation: of row 0, radians over the horizon.
        step: between columns and between rows, radians.
        n_columns: number of columns.
        n_rows: number of rows.
        seed: for all noise of this scan.
    """

    station: NDArray[np.float64]
    azimuth: float
    elevation: float
    step: float
    n_columns: int
    n_rows: int
    seed: int


class Errors(NamedTuple):
    """How wrong the scanner is.

    Attributes:
        noise_m: standard deviation of a distance at 3 m, square onto a plain wall.
        outlier_share: share of points at a random distance.
        beam_m: diameter of the spot; where it falls on two surfaces the distance mixes.
        colour_noise: standard deviation of a colour, grey levels.
    """

    noise_m: float
    outlier_share: float
    beam_m: float
    colour_noise: float


class Columns(NamedTuple):
    """A run of columns, the last one not included."""

    first: int
    last: int


class Scanned(NamedTuple):
    """What a scan gives, one entry per ray, column by column.

    Attributes:
        x: float32 metres from the room's origin; y and z alike.
        y: see x.
        z: see x.
        intensity: float32 0..1.
        rgb: (n, 3) uint8.
        rectangle: int32 rectangle hit, `SPOILT` or `MISSED`.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    intensity: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    rectangle: NDArray[np.int32]


@njit("f8(u8, i8)", cache=True)
def _normal(state: np.uint64, draw: int) -> float:
    """Normally distributed number (Box and Muller), one per even number of a draw."""
    length = math.sqrt(-2.0 * math.log(1.0 - uniform(state, draw)))
    value: float = length * math.cos(6.283185307179586 * uniform(state, draw + 1))
    return value


@njit(cache=True)
def _direction(azimuth: float, elevation: float, station: NDArray[np.float64]) -> Ray:
    level = math.cos(elevation)
    return Ray(
        station[0],
        station[1],
        station[2],
        level * math.cos(azimuth),
        level * math.sin(azimuth),
        math.sin(elevation),
    )


@njit(cache=True)
def _cosine(table: CastTable, index: Index, ray: Ray) -> float:
    """Cosine of the angle of incidence."""
    r = table.rectangles
    cosine: float = abs(r[index, 9] * ray.dx + r[index, 10] * ray.dy + r[index, 11] * ray.dz)
    return cosine


@njit("f8(i8, f8, f8, f8)", cache=True)
def _range_sigma(kind: int, distance: float, cosine: float, noise_m: float) -> float:
    """Standard deviation of a distance: grows with range and slope, and on cloth."""
    slope = 1.0 + 0.45 * min(1.0 / max(cosine, 0.05) - 1.0, 4.0)
    cloth = 1.4 if kind == 2 else 1.0
    return noise_m * slope * cloth * math.sqrt(0.5 + 0.5 * (distance / 3.0) ** 2)


@njit(cache=True)
def _spoilt_distance(
    table: CastTable, ray: Ray, index: Index, distance: float, state: np.uint64, errors: Errors
) -> float:
    """Distance of a gross outlier or a mixed pixel; -1 when the ray is neither."""
    if uniform(state, 0) < errors.outlier_share:
        if uniform(state, 1) < 0.8:
            return distance * (0.3 + 0.68 * uniform(state, 2))
        return distance + 2.0 * uniform(state, 2)
    if errors.beam_m > 0.0:
        # The rim of the spot, at a hashed side: where it meets another depth, the echoes mix.
        turn, reach = 6.283185307179586 * uniform(state, 3), 0.5 * errors.beam_m / distance
        azimuth, elevation = math.atan2(ray.dy, ray.dx), math.asin(ray.dz)
        azimuth += reach * math.cos(turn) / max(0.05, math.cos(elevation))
        station = np.array([ray.x, ray.y, ray.z])
        rim = _direction(azimuth, elevation + reach * math.sin(turn), station)
        other, meets = nearest_hit(table, rim, 1e-6, 1e6, index)
        if meets >= 0 and abs(other - distance) > 0.02 + 0.02 * distance:
            share = 0.5 * uniform(state, 4)
            return (1.0 - share) * distance + share * other
    return -1.0


@njit("i8(f8, f8)", cache=True)
def _grey(value: float, noise: float) -> int:
    return int(min(255.0, max(0.0, math.floor(value + noise + 0.5))))


@njit(cache=True)
def _measure(
    table: CastTable, ray: Ray, state: np.uint64, errors: Errors, point: int, scanned: Scanned
) -> None:
    """Fill one entry of a scan; its rectangle holds a guess at first, or -1."""
    guess = np.int64(scanned.rectangle[point])
    distance, index = nearest_hit(table, ray, 1e-6, 1e6, guess)
    scanned.rectangle[point] = index
    if index < 0:
        return
    red, green, blue, reflectance = shade_of_hit(table, index, ray, distance)
    cosine = _cosine(table, index, ray)
    measured = _spoilt_distance(table, ray, index, distance, state, errors)
    if measured >= 0.0:
        scanned.rectangle[point] = SPOILT
    else:
        sigma = _range_sigma(table.kinds[index], distance, cosine, errors.noise_m)
        measured = distance + sigma * _normal(state, 10)
    bright = reflectance * cosine**0.7 * math.sqrt(2.0 / max(1.0, distance))
    bright *= 1.0 + 0.03 * _normal(state, 12)
    scanned.x[point] = ray.x + measured * ray.dx
    scanned.y[point] = ray.y + measured * ray.dy
    scanned.z[point] = ray.z + measured * ray.dz
    scanned.intensity[point] = min(1.0, max(0.0, bright))
    scanned.rgb[point, 0] = _grey(red, errors.colour_noise * _normal(state, 14))
    scanned.rgb[point, 1] = _grey(green, errors.colour_noise * _normal(state, 16))
    scanned.rgb[point, 2] = _grey(blue, errors.colour_noise * _normal(state, 18))


@njit(cache=True, nogil=True)
def sweep_columns(
    table: CastTable, sweep: Sweep, errors: Errors, scanned: Scanned, columns: Columns
) -> None:
    """Scan some columns; every ray's noise is a function of seed, column and row alone."""
    for column in range(columns.first, columns.last):
        guess = np.int64(MISSED)
        for row in range(sweep.n_rows):
            point = column * sweep.n_rows + row
            ray = _direction(
                sweep.azimuth + column * sweep.step,
                sweep.elevation + row * sweep.step,
                sweep.station,
            )
            scanned.rectangle[point] = guess
            state = cell_state(column, row, sweep.seed)
            _measure(table, ray, state, errors, point, scanned)
            guess = max(np.int64(MISSED), np.int64(scanned.rectangle[point]))
