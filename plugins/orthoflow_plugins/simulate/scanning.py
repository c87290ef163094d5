"""The simulated scanner: stations, scan patterns, measurements and their errors.

Noise depends only on the position in the angular grid, not on the number of threads.

A laser and a camera measure different reflectances: sorted by brightness, red lead, gold, wet
plaster and retouchings have a different order at the single wavelength of a laser than in the three
broad bands of a camera. In the simulation, laser reflectance decreases with the level of red and
increases with the level of green; the gain and the exponent of both depend on the material. Wet
patches are darker, and retroreflecting spots saturate the detector.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.rows import Rows
from orthoflow.geometry.scene_rays import RAYS_AT_ONCE, SceneRays, points_on
from orthoflow.geometry.scenes import Scene, TextureKind, cell_states, normals, uniforms
from orthoflow.geometry.threads import in_runs
from orthoflow.sdk import StepContext
from orthoflow_plugins.simulate.room_model import main_wall_axes

# Value of `Scanned.rectangle` for a ray that hits nothing.
_MISSED: Final = -1
# Value of `Scanned.rectangle` for a gross outlier or a mixed distance.
SPOILT: Final = -2
_TURN: Final = 2.0 * np.pi

# Names and types of the arrays of a cloud: measurements (`Scanned`), and positions in the scan
# grids.
_MEASURED: Final = (
    ("x", np.float32),
    ("y", np.float32),
    ("z", np.float32),
    ("intensity", np.float32),
    ("rgb", np.uint8, 3),
    ("rectangle", np.int32),
)
_PLACES: Final = (("scan", np.uint16), ("row", np.uint32), ("column", np.uint32))

# The zenith is not scanned, because the points on the ceiling above the station would be too dense.
LOWEST_ELEVATION_DEG: Final = -62.0
HIGHEST_ELEVATION_DEG: Final = 62.0

# Coordinates of the stations in metres: along the main wall, towards it, and above the origin. No
# station is close to an object.
_STATIONS_M: Final = (
    (-1.15, -0.10, 0.0),
    (1.20, 0.15, 0.12),
    (0.10, -0.60, -0.15),
    (0.05, 0.80, 0.20),
)
# Maximum random displacements of a station along these axes, in metres.
_STATIONS_DRAWN_M: Final = (0.3, 0.3, 0.15)
# Ranges of the random values of a material: reflectance of black, decrease with red, increase with
# green, and exponents of the decrease and the increase.
_BLACK: Final = (0.75, 0.9)
_RED: Final = (0.6, 0.85)
_GREEN: Final = (0.4, 0.65)
_RED_POWER: Final = (0.8, 1.3)
_GREEN_POWER: Final = (1.2, 1.8)
_OWN_PATTERN: Final = 0.35
_WET_M: Final = 0.7
_WET_FROM: Final = 0.6
_WET_DARKER: Final = 0.45
_WAVES: Final = 24
# Distance from the middle of the room at which the displacement is `bending_m`.
_BENT_M: Final = 5.0
_SPOT_EVERY_M: Final = 0.4
_SPOT_SHARE: Final = 0.05
_SPOT_RADIUS_M: Final = 0.012


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """A scan: a station and ray directions, in the room frame.

    Attributes:
        station: (3,) position in metres.
        azimuth: azimuth of column 0, radians from x towards y.
        elevation: elevation of row 0, radians above the horizon.
        step: angle between columns and between rows, radians.
        n_columns: number of columns.
        n_rows: number of rows.
        seed: seed of all noise of this scan.
    """

    station: NDArray[np.float64]
    azimuth: float
    elevation: float
    step: float
    n_columns: int
    n_rows: int
    seed: int


@dataclass(frozen=True, kw_only=True)
class Errors:
    """The errors of the scanner.

    Attributes:
        noise_m: standard deviation of a distance of 3 m, measured perpendicular to a plain wall.
        outlier_share: share of points with a random distance.
        beam_m: diameter of the laser spot; distances are mixed if the spot covers two surfaces.
        colour_noise: standard deviation of the noise of each colour channel, grey levels.
        inversion: share of the laser reflectance that follows from the materials (see
            `laser_reflectance`).
        band_seed: seed for the laser reflectances of materials and the common errors of points.
        registration_m: standard deviation of the registration error of a scan, per coordinate.
        bending_m: displacement 5 m from the middle of the room, as caused by drift along a path.
        shared_m: standard deviation, per coordinate, of errors common to neighbouring points, as in
            clouds computed from photos; all scans have the same errors.
        shared_length_m: correlation length of the errors common to neighbouring points.
    """

    noise_m: float
    outlier_share: float
    beam_m: float
    colour_noise: float
    inversion: float
    band_seed: int
    registration_m: float = 0.0
    bending_m: float = 0.0
    shared_m: float = 0.0
    shared_length_m: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Scanned(Rows):
    """Measurements of a scan, one entry per ray, column by column.

    Attributes:
        x: float32 x coordinates, metres from the room's origin.
        y: float32 y coordinates, metres from the room's origin.
        z: float32 z coordinates, metres from the room's origin.
        intensity: float32 intensity, 0..1.
        rgb: (n, 3) uint8 colours.
        rectangle: int32 index of the rectangle that the ray hit, `SPOILT` or `_MISSED`.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    intensity: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    rectangle: NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Scan:
    """Measurements of several scans, one scan after the other.

    Attributes:
        points: the measurements.
        scan: (n,) index of the scan.
        row: (n,) row in the grid of the scan.
        column: (n,) column in the grid of the scan.
        stations: (s, 3) position of the station of each scan, in the room frame, metres.
    """

    points: Scanned
    scan: NDArray[np.uint16]
    row: NDArray[np.uint32]
    column: NDArray[np.uint32]
    stations: NDArray[np.float64]


def station_positions(
    n_stations: int, rng: np.random.Generator | None = None
) -> NDArray[np.float64]:
    """Return stations (s, 3) in the room frame, metres; `rng` displaces them at random."""
    places = np.array(_STATIONS_M[:n_stations])
    if rng is not None:
        places += rng.uniform(-1.0, 1.0, places.shape) * _STATIONS_DRAWN_M
    along, towards = main_wall_axes()
    up = np.array([0.0, 0.0, 1.0])
    # Do not use a matrix product, because its rounding depends on the processor.
    return np.array([a * along + t * towards + h * up for a, t, h in places])


def planned_sweeps(
    stations: NDArray[np.float64],
    steps_m: tuple[float, float],
    main_wall: Plane,
    outline: NDArray[np.float64],
    seeds: NDArray[np.int64],
) -> list[Sweep]:
    """Plan a panorama and a detail scan of the main wall from each station.

    Args:
        stations: (s, 3) in the room frame, metres.
        steps_m: point spacings of the panorama and of the detail scan, at the foot of the
            perpendicular from the station to the main wall.
        main_wall: plane of the main wall.
        outline: (4, 3) corners of the main wall in the room frame.
        seeds: two seeds per station.
    """
    lowest, highest = math.radians(LOWEST_ELEVATION_DEG), math.radians(HIGHEST_ELEVATION_DEG)
    _, towards = main_wall_axes()
    forward = math.atan2(towards[1], towards[0])
    # Use points along the edges, because seen from a station, the middle of an upper edge is at a
    # higher elevation than its ends.
    shares = np.linspace(0.0, 1.0, 33)[:, None]
    rim = np.concatenate(
        [a + shares * (b - a) for a, b in zip(outline, np.roll(outline, -1, 0), strict=True)]
    )
    sweeps = []
    for index, station in enumerate(stations):
        distance_m = float(main_wall.distances_m(station[None])[0])
        coarse, fine = (step_m / distance_m for step_m in steps_m)
        panorama = Sweep(
            station=station,
            azimuth=0.0,
            elevation=lowest,
            step=coarse,
            n_columns=max(1, math.floor(2.0 * math.pi / coarse)),
            n_rows=max(1, math.floor((highest - lowest) / coarse)),
            seed=int(seeds[2 * index]),
        )
        # Determine the smallest angular window that contains the main wall.
        rays = rim - station
        azimuths = np.arctan2(rays[:, 1], rays[:, 0]) - forward
        azimuths = (azimuths + math.pi) % (2.0 * math.pi) - math.pi
        elevations = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
        detail = Sweep(
            station=station,
            azimuth=forward + float(azimuths.min()),
            elevation=float(elevations.min()),
            step=fine,
            n_columns=max(1, math.ceil(float(np.ptp(azimuths)) / fine)),
            n_rows=max(1, math.ceil(float(np.ptp(elevations)) / fine)),
            seed=int(seeds[2 * index + 1]),
        )
        sweeps += [panorama, detail]
    return sweeps


def scan_scene(scene: Scene, sweeps: list[Sweep], errors: Errors, ctx: StepContext) -> Scan:
    """Scan a scene whose origin is that of the room; rays without a hit give no points."""
    scanner = Scanner(scene, errors)
    starts = np.concatenate([[0], np.cumsum([sweep.n_columns * sweep.n_rows for sweep in sweeps])])
    arrays = {
        name: np.asarray(ctx.allocate("cloud", name, (int(starts[-1]), *more), dtype))
        for name, dtype, *more in (*_MEASURED, *_PLACES)
    }
    points = Scanned(**{name: arrays[name] for name, *_ in _MEASURED})
    for index, sweep in enumerate(sweeps):
        ctx.progress(0.5 * index / len(sweeps), f"scan {index + 1} of {len(sweeps)}")
        span = slice(int(starts[index]), int(starts[index + 1]))
        in_runs(
            partial(scanner.sweep, sweep, points.take(span)),
            sweep.n_columns,
            n_per_run=max(1, RAYS_AT_ONCE // sweep.n_rows),
            threads=ctx.cores,
        )
        arrays["scan"][span] = index
        arrays["row"][span] = np.tile(np.arange(sweep.n_rows, dtype=np.uint32), sweep.n_columns)
        arrays["column"][span] = np.repeat(
            np.arange(sweep.n_columns, dtype=np.uint32), sweep.n_rows
        )
    places = {name: arrays[name] for name, *_ in _PLACES}
    hit = points.rectangle != _MISSED
    # In a closed room, all rays hit a surface, so nothing needs to be copied.
    if not bool(hit.all()):
        points, places = points.take(hit), {name: values[hit] for name, values in places.items()}
    stations = np.array([sweep.station for sweep in sweeps])
    return Scan(points=points, stations=stations, **places)


class Scanner:
    """Scans a scene.

    Args:
        scene: the scene, with its origin at (0, 0, 0).
        errors: errors of the scanner.
    """

    def __init__(self, scene: Scene, errors: Errors) -> None:
        self._rays = SceneRays(scene)
        self._is_cloth = scene.texture == TextureKind.TEXTILE
        self._errors = errors
        self._scene = scene

    def sweep(self, sweep: Sweep, scanned: Scanned, first: int, last: int) -> None:
        """Scan some columns; the noise of a ray depends only on seed, column and row.

        Args:
            sweep: plan of the scan.
            scanned: output, with entries for the whole scan.
            first: first column.
            last: last column, exclusive.
        """
        errors, start = self._errors, sweep.station[:, None]
        columns, rows = np.arange(first, last), np.arange(sweep.n_rows)
        shape = (len(columns), len(rows))
        azimuth = np.broadcast_to((sweep.azimuth + columns * sweep.step)[:, None], shape).ravel()
        elevation = np.broadcast_to(sweep.elevation + rows * sweep.step, shape).ravel()
        states = cell_states(columns[:, None], rows, sweep.seed).ravel()
        ways = _directions(azimuth, elevation)
        hits = self._rays.cast(start, ways)
        is_hit = hits.rectangle >= 0
        distance = np.where(is_hit, hits.t, 1.0)
        points = points_on(start, ways, hits)
        facing = self._scene.normals_at(hits.rectangle, points)
        cosine = np.abs(np.einsum("ni,in->n", facing, ways))
        into = scanned.take(slice(first * sweep.n_rows, last * sweep.n_rows))
        into.rectangle[:] = hits.rectangle
        # Noise increases with range and incidence angle, and is higher on cloth.
        slope = 1.0 + 0.45 * np.minimum(1.0 / np.maximum(cosine, 0.05) - 1.0, 4.0)
        cloth = np.where(self._is_cloth[into.rectangle], 1.4, 1.0)
        sigma = errors.noise_m * slope * cloth * np.sqrt(0.5 + (distance / 3.0) ** 2 / 2)
        measured = distance + sigma * normals(states, 10)
        if errors.beam_m > 0.0:
            mixed = self._mixed(sweep.station, azimuth, elevation, states, distance)
            is_mixed = np.isfinite(mixed) & is_hit
            measured[is_mixed] = mixed[is_mixed]
            into.rectangle[is_mixed] = SPOILT
        # The distances of most gross outliers are too short; those of the others are too long.
        short = distance * (0.3 + 0.68 * uniforms(states, 2))
        gross = np.where(uniforms(states, 1) < 0.8, short, distance + 2.0 * uniforms(states, 2))
        is_gross = (uniforms(states, 0) < errors.outlier_share) & is_hit
        measured[is_gross] = gross[is_gross]
        into.rectangle[is_gross] = SPOILT
        off = shared_errors(points, sweep.station, errors)
        for along, coordinate in enumerate((into.x, into.y, into.z)):
            coordinate[:] = sweep.station[along] + measured * ways[along] + off[along]
        colours = self._rays.colours(hits.rectangle, points)
        seen = laser_reflectance(
            self._scene, hits.rectangle, points, colours, errors.inversion, errors.band_seed
        )
        bright = seen * cosine**0.7
        bright *= np.sqrt(2.0 / np.maximum(1.0, distance))
        bright *= 1.0 + 0.03 * normals(states, 12)
        into.intensity[:] = np.clip(bright, 0.0, 1.0)
        for channel in range(3):
            noise = errors.colour_noise * normals(states, 14 + 2 * channel)
            into.rgb[:, channel] = np.clip(np.floor(colours[channel] + noise + 0.5), 0.0, 255.0)

    def _mixed(
        self,
        station: NDArray[np.float64],
        azimuth: NDArray[np.float64],
        elevation: NDArray[np.float64],
        states: NDArray[np.uint64],
        distance: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return mixed distances (n,) where the laser spot covers two depths, and NaN elsewhere."""
        turn, reach = _TURN * uniforms(states, 3), 0.5 * self._errors.beam_m / distance
        aside = reach * np.cos(turn) / np.maximum(0.05, np.cos(elevation))
        rims = _directions(azimuth + aside, elevation + reach * np.sin(turn))
        other = self._rays.cast(station[:, None], rims).t
        mixed = np.full(len(distance), np.nan)
        apart = np.abs(other - distance)
        beside = np.flatnonzero(np.isfinite(other) & (apart > 0.02 + 0.02 * distance))
        share = 0.5 * uniforms(states[beside], 4)
        mixed[beside] = (1.0 - share) * distance[beside] + share * other[beside]
        return mixed


def shared_errors(
    points: NDArray[np.float64], station: NDArray[np.float64], errors: Errors
) -> NDArray[np.float64]:
    """Return the correlated errors, in metres, of points (3, n) measured from a station."""
    off = np.zeros_like(points)
    if errors.registration_m:
        place_mm = np.rint(1e3 * station).astype(np.int64) % 2**31
        of_station = np.random.default_rng([errors.band_seed, *place_mm.tolist()])
        off += errors.registration_m * of_station.normal(size=(3, 1))
    if errors.bending_m:
        # Displace points upwards and sideways; displacements form a parabola along the longer axis
        # of the room.
        along = (points[0] / _BENT_M) ** 2
        off[1:] += errors.bending_m * along / math.sqrt(2.0)
    if errors.shared_m:
        # A sum of waves with random directions is practically Gaussian, with a Gaussian correlation
        # function.
        waves = np.random.default_rng([errors.band_seed, 1])
        for axis in range(3):
            ways = waves.normal(size=(_WAVES, 3)) / errors.shared_length_m
            phases = waves.uniform(0.0, _TURN, _WAVES)
            field = np.zeros(points.shape[1])
            for way, phase in zip(ways, phases, strict=True):
                field += np.cos(way @ points + phase)
            off[axis] += errors.shared_m * math.sqrt(2.0 / _WAVES) * field
    return off


def _directions(
    azimuth: NDArray[np.float64], elevation: NDArray[np.float64]
) -> NDArray[np.float64]:
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def laser_reflectance(
    scene: Scene,
    rectangle: NDArray[np.int32],
    points: NDArray[np.float64],
    colours: NDArray[np.float32],
    inversion: float,
    seed: int,
) -> NDArray[np.float64]:
    """Return the laser reflectance (n,), 0..1, of points of a scene.

    Args:
        scene: the scene with the rectangles, with its origin at (0, 0, 0).
        rectangle: (n,) rectangle of each point.
        points: (3, n) metres.
        colours: (4, n) red, green and blue (0..255), and reflectance of the texture (0..1).
        inversion: 0 if the laser measures the reflectance of the textures, 1 if the contrast is
            entirely that of the materials, computed from their colours.
        seed: seed for the materials, wet patches and spots.
    """
    plain: NDArray[np.float64] = colours[3].astype(np.float64)
    if inversion == 0.0:
        return plain
    material = scene.texture_params[rectangle, 6].astype(np.int64)
    states = cell_states(material, np.zeros_like(material), seed)
    black, red, red_power, green, green_power = (
        low + (high - low) * uniforms(states, draw)
        for draw, (low, high) in enumerate((_BLACK, _RED, _RED_POWER, _GREEN, _GREEN_POWER))
    )
    own = (
        black
        - red * (colours[0] / 255.0) ** red_power
        + green * (colours[1] / 255.0) ** green_power
        + _OWN_PATTERN * (plain - scene.texture_params[rectangle, 3])
    )
    offsets = points.T - scene.centre[rectangle]
    a, b = (
        np.einsum("ni,ni->n", offsets, axis[rectangle]) for axis in (scene.axis_a, scene.axis_b)
    )
    wet = smooth_noise(a / _WET_M, b / _WET_M, material + seed)
    own *= 1.0 - _WET_DARKER * np.clip((wet - _WET_FROM) / 0.1, 0.0, 1.0)
    column, row = np.floor(np.stack([a, b]) / _SPOT_EVERY_M).astype(np.int64)
    spots = _lattice(column, row, material + seed)
    distance = np.hypot(
        a / _SPOT_EVERY_M - column - 0.2 - 0.6 * uniforms(spots, 6),
        b / _SPOT_EVERY_M - row - 0.2 - 0.6 * uniforms(spots, 7),
    )
    is_near = distance < _SPOT_RADIUS_M / _SPOT_EVERY_M
    own[is_near & (uniforms(spots, 8) < _SPOT_SHARE)] = 1.0
    mixed = (1.0 - inversion) * plain + inversion * own
    return np.asarray(np.clip(mixed, 0.01, 1.0), dtype=np.float64)


def smooth_noise(
    x: NDArray[np.float64], y: NDArray[np.float64], seed: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return noise (0..1) that is smooth between lattice points; its values depend on the seed."""
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    s, t = x - column, y - row
    s, t = s * s * (3.0 - 2.0 * s), t * t * (3.0 - 2.0 * t)
    total = np.zeros_like(x)
    for right in (0, 1):
        for down in (0, 1):
            weight = (s if right else 1.0 - s) * (t if down else 1.0 - t)
            total += weight * uniforms(_lattice(column + right, row + down, seed), 5)
    return total


def _lattice(
    column: NDArray[np.int64], row: NDArray[np.int64], seed: NDArray[np.int64]
) -> NDArray[np.uint64]:
    return cell_states(column, row + 1_000_003 * seed, 0)
