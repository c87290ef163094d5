"""Ray casting in a simulated scene: the surface that a ray hits, and the colour of the surface.

Rays are traced through a tree of bounding boxes. The nearest hit is exact, because only rectangles
that a ray cannot hit are skipped. If a ray hits two rectangles at the same distance, the one with
the smaller index is returned.

Textures are functions of position rather than images, so the true orthoimage can be computed at any
resolution. Stains are value noise on hashed lattices with quintic interpolation. This noise is
twice continuously differentiable, and its shortest wavelength is about twice the lattice spacing.
Ornaments have sharp edges.

This module loads numba, so methods import it inside functions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.scenes import Scene


class Shade(NamedTuple):
    """Colour (red, green and blue, 0..255) and laser reflectance (0..1) of a point."""

    red: float
    green: float
    blue: float
    reflectance: float


class PaintTable(NamedTuple):
    """The textures of a scene.

    Attributes:
        frames: (r, 9) float64: centre, axis a and axis b of each rectangle, as in `Scene`.
        kinds: (r,) int32 `TextureKind`.
        params: (r, 8) float64 texture parameters.
        bends: (r, 5) float64 curvature, normal (3 numbers) and taper of each rectangle.
    """

    frames: NDArray[np.float64]
    kinds: NDArray[np.int32]
    params: NDArray[np.float64]
    bends: NDArray[np.float64]


class Pattern(NamedTuple):
    """The pattern at a point.

    Attributes:
        light: deviation of the brightness, about -1..1.
        warmth: deviation of the colour, from blue (-1) to red (1).
        paint: opacity of a coloured ornament, 0..1.
        hue: hue of the ornament, 0..1 around the colour circle.
        other: deviation of the brightness at the wavelength of the laser.
    """

    light: float
    warmth: float
    paint: float
    hue: float
    other: float


@kernel_part
def mixed_bits(value: np.uint64) -> np.uint64:
    """Scramble 64 bits (splitmix64's finaliser); neighbouring inputs give unrelated outputs."""
    bits = np.uint64(value)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


@kernel_part
def uniform(state: np.uint64, draw: int) -> float:
    """Return a random number in [0, 1) that depends only on a 64-bit state and an index."""
    bits = mixed_bits(np.uint64(state) + np.uint64(draw + 1) * np.uint64(0x9E3779B97F4A7C15))
    return float(bits >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel_part
def _column_state(i: int, seed: int) -> np.uint64:
    return mixed_bits(np.uint64(i) * np.uint64(0xD1B54A32D192ED03) + np.uint64(seed))


@kernel_part
def cell_state(i: int, j: int, seed: int) -> np.uint64:
    """Return the random 64-bit state of the lattice cell (i, j)."""
    return mixed_bits(_column_state(i, seed) ^ (np.uint64(j) * np.uint64(0x8CB92BA72F3D8DD7)))


@kernel_part
def _lattice_value(column: np.uint64, j: int) -> float:
    """Return a random number in [0, 1) for lattice point j of a column, given by its state."""
    bits = mixed_bits(column ^ (np.uint64(j) * np.uint64(0x8CB92BA72F3D8DD7)))
    return float(bits >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel_part
def _value_noise(a: float, b: float, seed: int) -> float:
    """Return smooth noise, -1..1, on the unit lattice."""
    i, j = math.floor(a), math.floor(b)
    s, t = a - i, b - j
    s = s * s * s * (s * (s * 6.0 - 15.0) + 10.0)
    t = t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
    left, right = _column_state(i, seed), _column_state(i + 1, seed)
    low = (1.0 - s) * _lattice_value(left, j) + s * _lattice_value(right, j)
    high = (1.0 - s) * _lattice_value(left, j + 1) + s * _lattice_value(right, j + 1)
    return 2.0 * ((1.0 - t) * low + t * high) - 1.0


@kernel_part
def _stains(a: float, b: float, period: float, seed: int) -> float:
    """Return noise of three octaves, about -1..1, with lattices down to a sixth of the period."""
    return (
        0.5 * _value_noise(a / period, b / period, seed)
        + 0.3 * _value_noise(2.7 * a / period + 7.3, 2.7 * b / period + 1.9, seed + 1)
        + 0.2 * _value_noise(6.1 * a / period + 3.1, 6.1 * b / period + 5.7, seed + 2)
    )


@kernel_part
def _wear(a: float, b: float, seed: int) -> float:
    """Return fine detail: grain on a lattice with a spacing of 11 mm, and cracks 2 to 4 mm wide."""
    grain = 0.3 * _value_noise(a / 0.011, b / 0.011, seed)
    crack = abs(_value_noise(a / 0.13, b / 0.13, seed + 1))
    return grain - 0.8 * max(0.0, 1.0 - crack / 0.03)


@kernel_part
def _rosette(a: float, b: float, period: float, seed: int) -> tuple[float, float]:
    """Return the ornament at (a, b) as (paint, 0 or 1; hue, 0..1).

    Each lattice cell contains a flower with a random number of petals, size, rotation, hue and
    position.
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
    # Around each flower, there are a painted ring and lines along the lattice, 1/40 of the period
    # wide.
    if abs(radius - 0.42) < 0.0125 and uniform(state, 6) > 0.4:
        return 1.0, uniform(state, 7)
    edge = 0.5 - max(abs(a / period - i - 0.5), abs(b / period - j - 0.5))
    if edge < 0.0125:
        return 1.0, 0.08
    return 0.0, 0.0


@kernel_part
def _motif(a: float, b: float, period: float) -> float:
    """Return an exactly periodic damask motif; every other column is shifted by half a period."""
    i = math.floor(a / period)
    x = 2.0 * (a / period - i) - 1.0
    y = b / period + 0.5 * (i % 2)
    y = 2.0 * (y - math.floor(y)) - 1.0
    leaf = abs(x) - 0.62 * (1.0 - abs(y)) * (0.75 + 0.25 * math.cos(9.42477796076938 * y))
    if leaf < 0.0:
        return 1.0 if (abs(x) + 0.35 * abs(y)) > 0.16 else 0.35
    return 0.6 if abs(x) > 0.94 else 0.0


@kernel_part
def _grain(a: float, b: float, period: float, seed: int) -> float:
    """Return wood grain along b, -1..1."""
    bend = 0.35 * _value_noise(a / period, 0.25 * b / period, seed)
    return math.sin(6.283185307179586 * (4.0 * a / period + 2.0 * bend)) * (
        0.7 + 0.3 * _value_noise(3.0 * a / period, 0.5 * b / period, seed + 1)
    )


@kernel_part
def _pattern(kind: int, params: NDArray[np.float64], a: float, b: float) -> Pattern:
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
    # Dirt in cracks is also dark at the wavelength of the laser, but less dark.
    return Pattern(light + wear, warmth, paint, hue, other + 0.5 * wear)


@kernel_part
def colour_at(kind: int, params: NDArray[np.float64], a: float, b: float) -> Shade:
    """Return the colour and reflectance at (a, b) of a texture, from its kind and parameters."""
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
    """Set `painted` (4, n) to red, green, blue (0..255) and reflectance (0..1) of points (3, n).

    Columns of points with rectangle -1 remain unchanged. A point that is not on the plane of its
    rectangle gets the colour of its projection onto that plane, or of its radial projection onto a
    bent rectangle.
    """
    frames, bends = table.frames, table.bends
    for i in range(rectangle.shape[0]):
        index = rectangle[i]
        if index < 0:
            continue
        a, b = 0.0, 0.0
        for axis in range(3):
            offset = points[axis, i] - frames[index, axis]
            a += offset * frames[index, 3 + axis]
            b += offset * frames[index, 6 + axis]
        if bends[index, 0] != 0.0:
            towards = 0.0
            for axis in range(3):
                towards += (points[axis, i] - frames[index, axis]) * bends[index, 1 + axis]
            a, b = _unrolled(bends[index, 0], bends[index, 4], a, b, towards)
            if math.isinf(bends[index, 4]):
                # Around the pole, meridians are not parallel either.
                turn = a * abs(bends[index, 0])
                a, b = b * math.cos(turn), b * math.sin(turn)
            elif bends[index, 4] != 0.0:
                # On a plane, lines that meet in the apex are not parallel.
                apart, turn = 1.0 / bends[index, 4], bends[index, 4] * a
                a, b = (apart + b) * math.sin(turn), (apart + b) * math.cos(turn) - apart
        shade = colour_at(table.kinds[index], table.params[index], a, b)
        painted[0, i] = shade.red
        painted[1, i] = shade.green
        painted[2, i] = shade.blue
        painted[3, i] = shade.reflectance


@kernel_part
def _unrolled(curvature: float, taper: float, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the position (a, b) of a point on or near a bent rectangle.

    Args:
        curvature: see `Scene`.
        taper: see `Scene`.
        x: position relative to the centre of the rectangle, along axis a.
        y: position along axis b.
        z: position along the normal.

    Returns:
        The position; b is minus infinity if the point is on the mirror image of a cone.
    """
    if math.isinf(taper):
        turn, across = abs(curvature), math.sqrt(x * x + y * y)
        return math.atan2(y, x) / turn, math.atan2(turn * across, 1.0 - curvature * z) / turn
    square = curvature * curvature + taper * taper
    turn = math.sqrt(square)
    axial = 1.0 + taper * y - curvature * z
    a = math.atan2(turn * x, axial) / turn
    if taper == 0.0:
        return a, y
    if curvature * curvature * (1.0 + taper * y) + curvature * taper * taper * z <= 0.0:
        return a, -math.inf
    reach = taper * (math.sqrt(square * x * x + axial * axial) - 1.0 + curvature * z)
    return a, (reach + curvature * curvature * y) / square


Index: TypeAlias = int | np.int64

# Number of points along the arc of a bent rectangle from which its bounding box is computed.
_RING_POINTS: Final = 33
# Minimum distance of a hit, so that rays do not hit the surface from which they start.
_NEAREST: Final = 1e-9


class CastTable(NamedTuple):
    """A scene prepared for ray casting, in coordinates along the axes of the boxes from its origin.

    Attributes:
        axes: (3, 3) float64 rotation from the scene's axes to the axes of the boxes.
        rectangles: (r, 20) float64: centre, axis a, axis b and normal (3 numbers each), extent (4),
            index of its first hole, index after its last hole, curvature and taper.
        holes: (h, 4) float64 extents of the holes.
        nodes: (m, 9) float64 nodes of the tree: lower and upper corner of the box (3 numbers each);
            next node for rays that miss the box; first index and end index of its rectangles in
            `order` (equal unless the node is a leaf). Parents precede children, and node 0 is the
            root.
        order: (r,) int64 rectangles in the order of the leaves.
    """

    axes: NDArray[np.float64]
    rectangles: NDArray[np.float64]
    holes: NDArray[np.float64]
    nodes: NDArray[np.float64]
    order: NDArray[np.int64]


class Ray(NamedTuple):
    """Start in metres from the scene's origin, and direction, whose length is the unit of t."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


@kernel_part
def _contains(
    r: NDArray[np.float64], holes: NDArray[np.float64], index: Index, a: float, b: float
) -> bool:
    """Return whether a position is inside the extent of a rectangle and in none of its holes."""
    if a < r[index, 12] or a > r[index, 13] or b < r[index, 14] or b > r[index, 15]:
        return False
    for h in range(int(r[index, 16]), int(r[index, 17])):
        if holes[h, 0] < a < holes[h, 1] and holes[h, 2] < b < holes[h, 3]:
            return False
    return True


@kernel_part
def _bent_distance(
    r: NDArray[np.float64], holes: NDArray[np.float64], index: Index, ray: Ray
) -> float:
    """Like `_hit_distance`, but for a part of a cylinder, cone or sphere."""
    bend, taper = r[index, 18], r[index, 19]
    x, y, z = ray.x - r[index, 0], ray.y - r[index, 1], ray.z - r[index, 2]
    along = x * r[index, 3] + y * r[index, 4] + z * r[index, 5]
    b = x * r[index, 6] + y * r[index, 7] + z * r[index, 8]
    towards = x * r[index, 9] + y * r[index, 10] + z * r[index, 11]
    d_along = ray.dx * r[index, 3] + ray.dy * r[index, 4] + ray.dz * r[index, 5]
    d_b = ray.dx * r[index, 6] + ray.dy * r[index, 7] + ray.dz * r[index, 8]
    d_towards = ray.dx * r[index, 9] + ray.dy * r[index, 10] + ray.dz * r[index, 11]
    # The equation of a circle is along^2 + towards^2 - 2 towards / bend = 0. That of a cone also
    # has the terms -(ratio towards)^2 - 2 ratio b towards, and that of a sphere b^2.
    is_round = math.isinf(taper)
    ratio = 0.0 if is_round else taper / bend
    square = d_along * d_along + d_towards * d_towards
    square -= ratio * d_towards * (ratio * d_towards + 2.0 * d_b)
    half = along * d_along + (towards - 1.0 / bend) * d_towards
    half -= ratio * (ratio * towards * d_towards + towards * d_b + b * d_towards)
    start = along * along + towards * (towards - 2.0 / bend)
    start -= ratio * towards * (ratio * towards + 2.0 * b)
    if is_round:
        square, half, start = square + d_b * d_b, half + b * d_b, start + b * b
    root = half * half - square * start
    if abs(square) < 1e-24 or root < 0.0:
        return math.inf
    root = math.copysign(math.sqrt(root), square)
    for sign in (-1.0, 1.0):
        t: float = (sign * root - half) / square
        if t >= _NEAREST:
            at_a, at_b = _unrolled(
                bend, taper, along + t * d_along, b + t * d_b, towards + t * d_towards
            )
            if _contains(r, holes, index, at_a, at_b):
                return t
    return math.inf


@kernel_part
def _hit_distance(
    rectangles: NDArray[np.float64], holes: NDArray[np.float64], index: Index, ray: Ray
) -> float:
    """Return the distance along a ray to a rectangle, in units of the ray's direction, or inf."""
    # Use scalars, because an array for the row would be reference-counted at each use.
    r = rectangles
    if r[index, 18] != 0.0:
        return _bent_distance(rectangles, holes, index, ray)
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
    return t if _contains(r, holes, index, a, b) else math.inf


@kernel_part
def _misses_box(nodes: NDArray[np.float64], node: Index, ray: Ray, t_max: float) -> bool:
    near, far = (nodes[node, 0] - ray.x) * ray.dx, (nodes[node, 3] - ray.x) * ray.dx
    low, high = min(near, far), max(near, far)
    near, far = (nodes[node, 1] - ray.y) * ray.dy, (nodes[node, 4] - ray.y) * ray.dy
    low, high = max(low, min(near, far)), min(high, max(near, far))
    near, far = (nodes[node, 2] - ray.z) * ray.dz, (nodes[node, 5] - ray.z) * ray.dz
    low, high = max(low, min(near, far)), min(high, max(near, far))
    misses: bool = high < low or high < 0.0 or low > t_max
    return misses


@kernel_part
def _along(axes: NDArray[np.float64], axis: int, x: float, y: float, z: float) -> float:
    length: float = axes[axis, 0] * x + axes[axis, 1] * y + axes[axis, 2] * z
    return length


@kernel_part
def _inverse(value: float) -> float:
    # Use a large number instead of infinity: for a ray in a face of a box, 0 times infinity would
    # be NaN.
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
    """Find the first rectangle that each ray hits.

    Args:
        table: the scene.
        starts: (3, n), or (3, 1) if all rays have the same start, in metres from the scene's
            origin, in its axes.
        ways: (3, n) directions in the scene's axes; the length of a direction is the unit of its t.
        t: (n,) maximum distances on input; changed to the distances of hits, and unchanged where
            there is no hit.
        rectangle: (n,) output, indices of the rectangles; -1 where there is no hit.
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
        # Start with the rectangle that the previous ray hit. The result is the same, but most boxes
        # are then too far away to be searched.
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


# Number of rays per batch. Arrays with one number per ray fit into the processor's cache.
RAYS_AT_ONCE: Final = 1 << 14


@dataclass(frozen=True, kw_only=True)
class Hits:
    """The first hits of rays in a scene.

    Attributes:
        t: (n,) float64 distance in units of the length of the ray's direction; inf if there is no
            hit.
        rectangle: (n,) int32 row of the scene; -1 if there is no hit.
    """

    t: NDArray[np.float64]
    rectangle: NDArray[np.int32]


class SceneRays:
    """A scene prepared for many rays.

    Starts and points are in metres from the scene's origin. Arrays have one row per coordinate, (3,
    n), because NumPy processes them several times as fast as arrays with one row per point.

    Args:
        scene: the scene.
    """

    def __init__(self, scene: Scene) -> None:
        self._table = _cast_table(scene)
        self._paint = PaintTable(
            frames=np.ascontiguousarray(np.hstack([scene.centre, scene.axis_a, scene.axis_b])),
            kinds=np.array(scene.texture),
            params=np.array(scene.texture_params),
            bends=np.column_stack([scene.curvatures_per_m, scene.normal, scene.tapers_per_m]),
        )

    def cast(
        self,
        starts: NDArray[np.float64],
        ways: NDArray[np.float64],
        *,
        within: NDArray[np.float64] | float = np.inf,
    ) -> Hits:
        """Find the first hit of rays.

        Args:
            starts: (3, n), or (3, 1) if all rays have the same start.
            ways: (3, n) directions; the length of a direction is the unit of distances along the
                ray.
            within: maximum distances (n,), or one distance for all rays.
        """
        n_rays = ways.shape[1]
        t = np.empty(n_rays)
        t[:] = within
        rectangle = np.empty(n_rays, dtype=np.int32)
        cast_rays(
            self._table,
            np.require(starts, np.float64, ["C", "W"]),
            np.require(ways, np.float64, ["C", "W"]),
            t,
            rectangle,
        )
        t[rectangle < 0] = np.inf
        return Hits(t=t, rectangle=rectangle)

    def colours(
        self, rectangle: NDArray[np.int32], points: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return (4, n): red, green, blue (0..255) and reflectance (0..1) of points (3, n).

        All values are 0 for points with rectangle -1.
        """
        painted = np.zeros((4, len(rectangle)), dtype=np.float32)
        paint_points(
            self._paint,
            np.ascontiguousarray(rectangle, dtype=np.int32),
            np.ascontiguousarray(points, dtype=np.float64),
            painted,
        )
        return painted


def points_on(
    starts: NDArray[np.float64], ways: NDArray[np.float64], hits: Hits
) -> NDArray[np.float64]:
    """Return the points (3, n) that rays hit; for a ray that hits nothing, its start."""
    return starts + np.where(hits.rectangle < 0, 0.0, hits.t) * ways


def _cast_table(scene: Scene) -> CastTable:
    tree = _BoxTree(scene)
    holes = np.searchsorted(scene.hole_rectangle, np.arange(len(scene) + 1))
    turned = scene.turned(tree.axes)
    return CastTable(
        axes=np.ascontiguousarray(tree.axes),
        rectangles=np.column_stack(
            [
                turned.centre,
                turned.axis_a,
                turned.axis_b,
                turned.normal,
                turned.extent,
                holes[:-1],
                holes[1:],
                turned.curvatures_per_m,
                turned.tapers_per_m,
            ]
        ),
        holes=np.array(scene.hole_extent),
        nodes=np.column_stack(
            [np.array(tree.boxes).reshape(-1, 6), np.array(tree.links).reshape(-1, 3)]
        ).astype(np.float64),
        order=np.array(tree.order, dtype=np.int64),
    )


class _BoxTree:
    """A tree of bounding boxes of rectangles, split so that the expected cost of rays is lowest.

    The axes of all boxes are those of the rectangle that makes the boxes smallest. In a room, most
    rectangles are parallel or perpendicular to this one, so their boxes are thin.
    """

    def __init__(self, scene: Scene) -> None:
        self.boxes: list[list[float]] = []
        self.links: list[tuple[int, int, int]] = []
        self.order: list[int] = []
        self.axes = np.eye(3)
        if len(scene) == 0:
            return
        self.axes = _tightest_axes(scene)
        corners = scene.corners_m() @ self.axes.T
        # Add a tolerance of 1 micrometre, so that the boxes of rectangles parallel to the axes are
        # not empty.
        self._low = corners.min(axis=1) - 1e-6
        self._high = corners.max(axis=1) + 1e-6
        for index in np.flatnonzero(scene.curvatures_per_m).tolist():
            ring = _enclosing_ring(scene, index) @ self.axes.T
            self._low[index], self._high[index] = ring.min(axis=0), ring.max(axis=0)
        self._add(np.arange(len(scene)))

    def _add(self, members: NDArray[np.int64]) -> None:
        node, first = len(self.boxes), len(self.order)
        low, high = self._low[members], self._high[members]
        self.boxes.append([*low.min(axis=0), *high.max(axis=0)])
        self.links.append((0, first, first))
        first_half = self._cheapest_half(members)
        if first_half is None:
            self.order.extend(int(member) for member in members)
            self.links[node] = (len(self.boxes), first, len(self.order))
            return
        self._add(members[first_half])
        self._add(members[~first_half])
        self.links[node] = (len(self.boxes), first, first)

    def _cheapest_half(self, members: NDArray[np.int64]) -> NDArray[np.bool_] | None:
        """Return a mask of the members of the first child; None if a leaf is cheaper.

        The cost of a child is the number of its rectangles times the surface area of its box,
        because this area is proportional to the probability of a hit (Goldsmith and Salmon 1987).
        Visiting a node costs about as much as one rectangle.
        """
        if len(members) == 1:
            return None
        low, high = self._low[members], self._high[members]
        whole = float(_surfaces_m2(high.max(axis=0) - low.min(axis=0)))
        # Process all three axes at once, because most nodes have few members.
        order = np.argsort(low + high, axis=0, kind="stable")
        heads = _running_surfaces(low[order], high[order])[:-1]
        tails = _running_surfaces(low[order[::-1]], high[order[::-1]])[:-1][::-1]
        counts = np.arange(1, len(members))[:, np.newaxis]
        costs = whole + counts * heads + (len(members) - counts) * tails
        last, axis = np.argmin(costs, axis=0), int(np.argmin(costs.min(axis=0)))
        if costs[last[axis], axis] >= len(members) * whole:
            return None
        best = np.zeros(len(members), dtype=np.bool_)
        best[order[: last[axis] + 1, axis]] = True
        return best


def _enclosing_ring(scene: Scene, index: int) -> NDArray[np.float64]:
    """Return points (n, 3) whose bounding box contains a bent rectangle: corners of prisms."""
    taper, curvature = float(scene.tapers_per_m[index]), float(scene.curvatures_per_m[index])
    if math.isinf(taper):
        # The corners of a cube around the whole sphere.
        middle = scene.centre[index] + scene.normal[index] / curvature
        cube = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]]), axis=-1).reshape(-1, 3)
        return np.asarray(middle + cube / abs(curvature))
    turn = math.hypot(curvature, taper)
    a = np.linspace(scene.extent[index, 0], scene.extent[index, 1], _RING_POINTS)
    # Between two adjacent points, the arc is inside the box around these points and their copies
    # shifted by the sagitta along each axis.
    radius_m = float((1.0 + taper * scene.extent[index, 2:]).max()) / turn
    sagitta_m = radius_m * (1.0 - math.cos(0.5 * turn * float(a[1] - a[0])))
    rectangle = np.full(2 * len(a), index)
    b = np.repeat(scene.extent[index, 2:], len(a))
    points = scene.points_m(rectangle, np.tile(a, 2), b)
    steps = (sagitta_m + 1e-6) * np.concatenate([-np.eye(3), np.eye(3)])
    return np.asarray((points[:, None] + steps).reshape(-1, 3))


def _surfaces_m2(sides: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return half the surface areas (...) of boxes with sides (..., 3)."""
    x, y, z = sides[..., 0], sides[..., 1], sides[..., 2]
    surfaces: NDArray[np.float64] = x * y + y * z + z * x
    return surfaces


def _running_surfaces(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return half the surface areas (n, k) of boxes around the first 1, 2, ..., n members."""
    return _surfaces_m2(np.maximum.accumulate(high) - np.minimum.accumulate(low))


def _tightest_axes(scene: Scene) -> NDArray[np.float64]:
    corners = scene.corners_m()
    axes = np.stack([scene.axis_a, scene.axis_b, scene.normal], axis=1)
    # Many rectangles have the same axes, so try each set of axes only once.
    _, first = np.unique(axes.reshape(-1, 9).round(9), axis=0, return_index=True)
    axes = axes[np.sort(first)]
    surfaces_m2 = [_surfaces_m2(np.ptp(corners @ turn.T, axis=1)).sum() for turn in axes]
    chosen: NDArray[np.float64] = axes[int(np.argmin(surfaces_m2))]
    return chosen
