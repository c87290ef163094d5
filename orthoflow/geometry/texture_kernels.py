"""Compiled procedural textures: the colour and laser reflectance of a rectangle at (a, b).

Every texture is a fixed function of position, without grids or images, so that an orthoimage's
truth can be evaluated at any resolution. Stains are value noise on hashed lattices with quintic
interpolation: twice continuously differentiable, shortest wave about twice the lattice spacing.
Ornaments have sharp edges.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part, typed_kernel_part

# The small functions have explicit types: otherwise each constant argument would compile a version
# of its own, which costs seconds at the first run.


class Shade(NamedTuple):
    """Colour of a spot: red, green, blue 0..255, and its laser reflectance 0..1."""

    red: float
    green: float
    blue: float
    reflectance: float


class PaintTable(NamedTuple):
    """The textures of a scene.

    Attributes:
        frames: (r, 9) float64: centre, axis a, axis b of each rectangle, as `Scene` has them.
        kinds: (r,) int32 `TextureKind`.
        params: (r, 8) float64 texture parameters.
    """

    frames: NDArray[np.float64]
    kinds: NDArray[np.int32]
    params: NDArray[np.float64]


class Pattern(NamedTuple):
    """The pattern at a point.

    Attributes:
        light: lighter or darker, about -1..1.
        warmth: redder or bluer, about -1..1.
        paint: how much of the ground a coloured ornament covers, 0..1.
        hue: colour of that ornament, 0..1 round the colour circle.
        other: `light` as seen at another wavelength.
    """

    light: float
    warmth: float
    paint: float
    hue: float
    other: float


@typed_kernel_part("u8(u8)")
def mixed_bits(value: np.uint64) -> np.uint64:
    """Scramble 64 bits (splitmix64's finaliser); neighbouring inputs give unrelated outputs."""
    bits = np.uint64(value)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


@typed_kernel_part("f8(u8, i8)")
def uniform(state: np.uint64, draw: int) -> float:
    """Return a number in [0, 1) that depends only on the 64-bit state and the index of the draw."""
    bits = mixed_bits(np.uint64(state) + np.uint64(draw + 1) * np.uint64(0x9E3779B97F4A7C15))
    return float(bits >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@typed_kernel_part("u8(i8, i8)")
def _column_state(i: int, seed: int) -> np.uint64:
    return mixed_bits(np.uint64(i) * np.uint64(0xD1B54A32D192ED03) + np.uint64(seed))


@typed_kernel_part("u8(i8, i8, i8)")
def cell_state(i: int, j: int, seed: int) -> np.uint64:
    """Random state (64 bits) of the lattice cell (i, j)."""
    return mixed_bits(_column_state(i, seed) ^ (np.uint64(j) * np.uint64(0x8CB92BA72F3D8DD7)))


@typed_kernel_part("f8(u8, i8)")
def _lattice_value(column: np.uint64, j: int) -> float:
    """Return a number in [0, 1) of the lattice point j of a column."""
    bits = mixed_bits(column ^ (np.uint64(j) * np.uint64(0x8CB92BA72F3D8DD7)))
    return float(bits >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@typed_kernel_part("f8(f8, f8, i8)")
def _value_noise(a: float, b: float, seed: int) -> float:
    """Return smooth noise -1..1 on the unit lattice."""
    i, j = math.floor(a), math.floor(b)
    s, t = a - i, b - j
    s = s * s * s * (s * (s * 6.0 - 15.0) + 10.0)
    t = t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
    left, right = _column_state(i, seed), _column_state(i + 1, seed)
    low = (1.0 - s) * _lattice_value(left, j) + s * _lattice_value(right, j)
    high = (1.0 - s) * _lattice_value(left, j + 1) + s * _lattice_value(right, j + 1)
    return 2.0 * ((1.0 - t) * low + t * high) - 1.0


@typed_kernel_part("f8(f8, f8, f8, i8)")
def _stains(a: float, b: float, period: float, seed: int) -> float:
    """Return three octaves of noise, about -1..1; the finest lattice is a sixth of the period."""
    return (
        0.5 * _value_noise(a / period, b / period, seed)
        + 0.3 * _value_noise(2.7 * a / period + 7.3, 2.7 * b / period + 1.9, seed + 1)
        + 0.2 * _value_noise(6.1 * a / period + 3.1, 6.1 * b / period + 5.7, seed + 2)
    )


@typed_kernel_part("f8(f8, f8, i8)")
def _wear(a: float, b: float, seed: int) -> float:
    """Return the fine detail of a surface: grain on a lattice of 11 mm, cracks 2 to 4 mm wide."""
    grain = 0.3 * _value_noise(a / 0.011, b / 0.011, seed)
    crack = abs(_value_noise(a / 0.13, b / 0.13, seed + 1))
    return grain - 0.8 * max(0.0, 1.0 - crack / 0.03)


@typed_kernel_part("UniTuple(f8, 2)(f8, f8, f8, i8)")
def _rosette(a: float, b: float, period: float, seed: int) -> tuple[float, float]:
    """Return the ornament of the lattice cell at (a, b): (paint 0 or 1, its hue 0..1).

    Each cell has a flower of its own: number of petals, size, rotation, hue and position are
    hashed.
    """
    i, j = math.floor(a / period), math.floor(b / period)
    state = cell_state(i, j, seed)
    x = a / period - i - 0.5 - 0.12 * (uniform(state, 0) - 0.5)
    y = b / period - j - 0.5 - 0.12 * (uniform(state, 1) - 0.5)
    radius = math.sqrt(x * x + y * y)
    petals = 3.0 + math.floor(5.0 * uniform(state, 2))
    outline = 0.22 + 0.14 * uniform(state, 3)
    turn = 6.283185307179586 * uniform(state, 4)
    wave = math.cos(petals * math.atan2(y, x) + turn)
    if radius < 0.3 * outline:
        return 1.0, (uniform(state, 5) + 0.5) % 1.0
    if radius < outline * (0.72 + 0.28 * wave):
        return 1.0, uniform(state, 5)
    # A painted ring and the lines of a lattice around the flowers, a fortieth of the period wide.
    if abs(radius - 0.42) < 0.0125 and uniform(state, 6) > 0.4:
        return 1.0, uniform(state, 7)
    edge = 0.5 - max(abs(a / period - i - 0.5), abs(b / period - j - 0.5))
    if edge < 0.0125:
        return 1.0, 0.08
    return 0.0, 0.0


@typed_kernel_part("f8(f8, f8, f8)")
def _motif(a: float, b: float, period: float) -> float:
    """Damask motif, exactly periodic in both directions, every other column half a step down."""
    i = math.floor(a / period)
    x = 2.0 * (a / period - i) - 1.0
    y = b / period + 0.5 * (i % 2)
    y = 2.0 * (y - math.floor(y)) - 1.0
    leaf = abs(x) - 0.62 * (1.0 - abs(y)) * (0.75 + 0.25 * math.cos(9.42477796076938 * y))
    if leaf < 0.0:
        return 1.0 if (abs(x) + 0.35 * abs(y)) > 0.16 else 0.35
    return 0.6 if abs(x) > 0.94 else 0.0


@typed_kernel_part("f8(f8, f8, f8, i8)")
def _grain(a: float, b: float, period: float, seed: int) -> float:
    """Wood grain -1..1 along b."""
    bend = 0.35 * _value_noise(a / period, 0.25 * b / period, seed)
    return math.sin(6.283185307179586 * (4.0 * a / period + 2.0 * bend)) * (
        0.7 + 0.3 * _value_noise(3.0 * a / period, 0.5 * b / period, seed + 1)
    )


@kernel_part
def _pattern(kind: int, params: NDArray[np.float64], a: float, b: float) -> Pattern:
    """Return the pattern at (a, b)."""
    period, seed = params[5], int(params[6])
    light = _stains(a, b, period, seed)
    warmth = 0.7 * _value_noise((a + 11.0) / period, (b - 7.0) / period, seed + 10)
    wear = _wear(a, b, seed + 50)
    paint, hue, other = 0.0, 0.0, warmth
    if kind == 1:
        paint, hue = _rosette(a, b, 0.9 * period, seed + 20)
        other = 0.6 * warmth + paint * (1.6 * ((3.7 * hue) % 1.0) - 0.8)
        light = 0.6 * light - paint * (0.35 + 0.5 * hue)
    elif kind == 2:
        motif = _motif(a, b, period)
        other = 0.2 * warmth + 0.7 * (1.0 - 2.0 * motif)
        light, paint, hue = 0.15 * light + 0.9 * motif - 0.4, 0.5 * motif, 0.13
    elif kind == 3:
        i, j = math.floor(a / period), math.floor(b / period)
        shade = uniform(cell_state(i, j, seed + 30), 0)
        joint = 0.5 - max(abs(a / period - i - 0.5), abs(b / period - j - 0.5))
        tone = 0.75 if (i + j) % 2 == 0 else -0.75
        light = 0.25 * light + tone + 0.3 * (shade - 0.5) if joint > 0.012 else -0.95
        other = 0.4 * warmth + 0.8 * (shade - 0.5)
    elif kind == 4:
        light = _grain(a, b, period, seed + 40)
        other = 0.5 * light + 0.5 * warmth
    # Dirt in cracks is dark for the laser too, but less so.
    return Pattern(light + wear, warmth, paint, hue, other + 0.5 * wear)


@kernel_part
def colour_at(kind: int, params: NDArray[np.float64], a: float, b: float) -> Shade:
    """Colour and reflectance at (a, b) of a texture: `TextureKind` and its 8 parameters."""
    light, warmth, paint, hue, other = _pattern(kind, params, a, b)
    contrast, gap = params[4], params[7]
    gain = 1.0 + contrast * light
    shift = 22.0 * contrast * warmth
    red = params[0] * gain + shift
    green = params[1] * gain + 0.3 * shift
    blue = params[2] * gain - shift
    if paint > 0.0:
        turn = 6.283185307179586 * hue
        share = 0.75 * paint * contrast
        red += share * (120.0 + 90.0 * math.cos(turn) - red)
        green += share * (95.0 + 80.0 * math.cos(turn - 2.0943951023931953) - green)
        blue += share * (90.0 + 85.0 * math.cos(turn + 2.0943951023931953) - blue)
    seen = (1.0 - gap) * light + gap * other
    reflectance = params[3] * (1.0 + 0.9 * contrast * seen)
    return Shade(
        min(255.0, max(0.0, red)),
        min(255.0, max(0.0, green)),
        min(255.0, max(0.0, blue)),
        min(1.0, max(0.01, reflectance)),
    )


@compiled
def paint_points(
    table: PaintTable,
    rectangle: NDArray[np.int32],
    points: NDArray[np.float64],
    painted: NDArray[np.float32],
) -> None:
    """Fill `painted` (4, n) = red, green, blue 0..255, reflectance 0..1 of points (3, n).

    Points on rectangle -1 are unchanged; one off its rectangle gets the colour of its projection
    onto it.
    """
    frames = table.frames
    for i in range(rectangle.shape[0]):
        index = rectangle[i]
        if index < 0:
            continue
        a, b = 0.0, 0.0
        for axis in range(3):
            offset = points[axis, i] - frames[index, axis]
            a += offset * frames[index, 3 + axis]
            b += offset * frames[index, 6 + axis]
        shade = colour_at(table.kinds[index], table.params[index], a, b)
        painted[0, i] = shade.red
        painted[1, i] = shade.green
        painted[2, i] = shade.blue
        painted[3, i] = shade.reflectance
