"""The simulated scanner: stations, scan patterns, measurements and their errors.

Noise depends only on the position in the grid of angles, so it does not depend on threads.

The laser does not see a material as the eye does. Red lead, gold, wet plaster and retouchings
change order between the laser's one wavelength and the three broad bands of a camera. Per material,
reflectance falls with red and rises with green, each by a gain and a power of its own; wet patches
are darker, retro-reflecting spots blind the detector.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.hashed_numbers import cell_states, normals, uniforms
from orthoflow.geometry.rows import Rows
from orthoflow.geometry.scene_rays import RAYS_AT_ONCE, Hits, SceneRays, points_on
from orthoflow.geometry.scenes import Scene, TextureKind
from orthoflow.geometry.threads import in_runs
from orthoflow.sdk import StepContext
from orthoflow_plugins.simulate.room_model import main_wall_axes

# `Scanned.rectangle` of a ray without a hit, and of a gross outlier or a mixed distance.
_MISSED: Final = -1
SPOILT: Final = -2
_TURN: Final = 2.0 * np.pi

# No scan of the zenith: its points would crowd the ceiling above the station.
LOWEST_ELEVATION_DEG: Final = -62.0
HIGHEST_ELEVATION_DEG: Final = 62.0

# Along the main wall, towards it, and above the origin, metres; clear of all objects in the room.
_PLACES_M: Final = (
    (-1.15, -0.10, 0.0),
    (1.20, 0.15, 0.12),
    (0.10, -0.60, -0.15),
    (0.05, 0.80, 0.20),
)
# Largest distance of a drawn station from there, along the same axes.
_PLACES_DRAWN_M: Final = (0.3, 0.3, 0.15)
# Ranges of the values drawn per material: reflectance of black, decrease with red, increase with
# green.
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
# Half the length of a room, where it is bent by the whole `bending_m`.
_BENT_M: Final = 5.0
_SPOT_EVERY_M: Final = 0.4
_SPOT_SHARE: Final = 0.05
_SPOT_RADIUS_M: Final = 0.012


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """One scan: a station and its directions, in the room frame.

    Attributes:
        station: (3,) metres.
        azimuth: of column 0, radians from x towards y.
        elevation: of row 0, radians above the horizon.
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


@dataclass(frozen=True, kw_only=True)
class Errors:
    """The errors of the scanner.

    Attributes:
        noise_m: standard deviation of a distance at 3 m, perpendicular to a plain wall.
        outlier_share: share of points at a random distance.
        beam_m: diameter of the spot; where it falls on two surfaces the distance mixes.
        colour_noise: standard deviation of a colour, grey levels.
        inversion: share of inverted contrast in what the laser sees, as in `LaserBand`.
        band_seed: seed of the materials in the laser's band, and of errors that points have in
            common.
        registration_m: standard deviation of each coordinate of a station.
        bending_m: how far the room's ends are bent from its middle, as by drift along a path.
        shared_m: standard deviation of each coordinate that neighbouring points of all scans have
            in common, as in clouds from photos.
        shared_length_m: correlation length of that.
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
    """The result of a scan, one entry per ray, column by column.

    Attributes:
        x: float32 metres from the room's origin; y and z likewise.
        y: see x.
        z: see x.
        intensity: float32 0..1.
        rgb: (n, 3) uint8.
        rectangle: int32 rectangle hit, `SPOILT` or `_MISSED`.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    intensity: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    rectangle: NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Scan:
    """Several scans one after the other.

    Attributes:
        points: what was measured.
        scan: (n,) number of the scan.
        row: (n,) position in the scan's grid; column likewise.
        column: see row.
        stations: (s, 3) where each scan was made, room frame.
    """

    points: Scanned
    scan: NDArray[np.uint16]
    row: NDArray[np.uint32]
    column: NDArray[np.uint32]
    stations: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class SweepPlan:
    """How finely to scan.

    Attributes:
        stations: (s, 3) in the room frame, metres.
        scan_step_m: spacing of the detail scan of the main wall at the foot of the perpendicular.
        panorama_step_m: likewise of the panorama.
    """

    stations: NDArray[np.float64]
    scan_step_m: float
    panorama_step_m: float


def station_positions(
    n_stations: int, rng: np.random.Generator | None = None
) -> NDArray[np.float64]:
    """Return stations (s, 3) in the room frame, metres; a generator moves each a little."""
    places = np.array(_PLACES_M[:n_stations])
    if rng is not None:
        places += rng.uniform(-1.0, 1.0, places.shape) * _PLACES_DRAWN_M
    along, towards = main_wall_axes()
    up = np.array([0.0, 0.0, 1.0])
    # Not as a product of matrices, whose last digit depends on the processor.
    return np.array([a * along + t * towards + h * up for a, t, h in places])


def planned_sweeps(
    plan: SweepPlan,
    main_wall: Plane,
    outline: NDArray[np.float64],
    seeds: NDArray[np.int64],
) -> list[Sweep]:
    """Plan a panorama and a detail scan of the main wall from each station.

    Args:
        plan: how finely.
        main_wall: its plane.
        outline: (4, 3) corners of the main wall in the room frame.
        seeds: two per station.
    """
    sweeps = []
    for index, station in enumerate(plan.stations):
        distance_m = float(main_wall.distances_m(station[None])[0])
        panorama = _panorama(station, plan.panorama_step_m / distance_m, int(seeds[2 * index]))
        detail = _detail(station, outline, plan.scan_step_m / distance_m, int(seeds[2 * index + 1]))
        sweeps += [panorama, detail]
    return sweeps


def scan_scene(scene: Scene, sweeps: list[Sweep], errors: Errors, ctx: StepContext) -> Scan:
    """Scan a scene whose origin is the room's."""
    scanner = Scanner(scene, errors)
    sizes = [sweep.n_columns * sweep.n_rows for sweep in sweeps]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    points = _allocated(int(starts[-1]), ctx)
    scan = np.asarray(ctx.allocate("cloud", "scan", (len(points.x),), np.uint16))
    row = np.asarray(ctx.allocate("cloud", "row", (len(points.x),), np.uint32))
    column = np.asarray(ctx.allocate("cloud", "column", (len(points.x),), np.uint32))
    for index, sweep in enumerate(sweeps):
        ctx.progress(0.5 * index / len(sweeps), f"scan {index + 1} of {len(sweeps)}")
        span = slice(int(starts[index]), int(starts[index + 1]))
        in_runs(
            partial(_sweep, scanner, sweep, points.take(span)),
            sweep.n_columns,
            n_per_run=max(1, RAYS_AT_ONCE // sweep.n_rows),
            threads=ctx.cores,
        )
        scan[span] = index
        row[span] = np.tile(np.arange(sweep.n_rows, dtype=np.uint32), sweep.n_columns)
        column[span] = np.repeat(np.arange(sweep.n_columns, dtype=np.uint32), sweep.n_rows)
    stations = np.array([sweep.station for sweep in sweeps])
    return _only_hits(Scan(points=points, scan=scan, row=row, column=column, stations=stations))


class Scanner:
    """Scans a scene.

    Args:
        scene: the scene, its origin at (0, 0, 0).
        errors: errors of the scanner.
    """

    def __init__(self, scene: Scene, errors: Errors) -> None:
        self._rays = SceneRays(scene)
        self._normal = scene.normal
        self._is_cloth = scene.texture == TextureKind.TEXTILE
        self._errors = errors
        self._band = LaserBand(scene=scene, inversion=errors.inversion, seed=errors.band_seed)

    def sweep(self, sweep: Sweep, first: int, last: int, scanned: Scanned) -> None:
        """Scan some columns; every ray's noise is a function of seed, column and row alone.

        Args:
            sweep: the scan.
            first: column.
            last: last column, exclusive.
            scanned: output, entries of the whole scan.
        """
        echoes = self._echoes(sweep, first, last)
        into = scanned.take(slice(first * sweep.n_rows, last * sweep.n_rows))
        start = sweep.station[:, None]
        into.rectangle[:] = echoes.hits.rectangle
        measured = self._measured(sweep, echoes, into.rectangle)
        points = points_on(start, echoes.ways, echoes.hits)
        off = shared_errors(points, sweep.station, self._errors)
        for coordinate, along in zip((into.x, into.y, into.z), range(3), strict=True):
            coordinate[:] = sweep.station[along] + measured * echoes.ways[along] + off[along]
        colours = self._rays.colours(echoes.hits.rectangle, points)
        seen = self._band.reflectance(echoes.hits.rectangle, points, colours)
        bright = seen * echoes.cosine**0.7
        bright *= np.sqrt(2.0 / np.maximum(1.0, echoes.distance))
        bright *= 1.0 + 0.03 * normals(echoes.states, 12)
        into.intensity[:] = np.clip(bright, 0.0, 1.0)
        for channel in range(3):
            noise = self._errors.colour_noise * normals(echoes.states, 14 + 2 * channel)
            into.rgb[:, channel] = np.clip(np.floor(colours[channel] + noise + 0.5), 0.0, 255.0)

    def _echoes(self, sweep: Sweep, first: int, last: int) -> _Echoes:
        columns, rows = np.arange(first, last), np.arange(sweep.n_rows)
        shape = (len(columns), len(rows))
        azimuth = np.broadcast_to((sweep.azimuth + columns * sweep.step)[:, None], shape).ravel()
        elevation = np.broadcast_to(sweep.elevation + rows * sweep.step, shape).ravel()
        ways = _directions(azimuth, elevation)
        hits = self._rays.cast(sweep.station[:, None], ways)
        normal = self._normal[hits.rectangle]
        return _Echoes(
            azimuth=azimuth,
            elevation=elevation,
            ways=ways,
            hits=hits,
            states=cell_states(columns[:, None], rows, sweep.seed).ravel(),
            distance=np.where(hits.rectangle < 0, 1.0, hits.t),
            cosine=np.abs(np.einsum("ni,in->n", normal, ways)),
        )

    def _measured(
        self, sweep: Sweep, echoes: _Echoes, rectangle: NDArray[np.int32]
    ) -> NDArray[np.float64]:
        """Return distances as measured; marks gross outliers and mixed distances as spoilt."""
        states, distance = echoes.states, echoes.distance
        sigma = _range_sigma(
            distance, echoes.cosine, self._is_cloth[rectangle], self._errors.noise_m
        )
        measured = distance + sigma * normals(states, 10)
        is_hit = rectangle >= 0
        if self._errors.beam_m > 0.0:
            mixed = self._mixed(sweep, echoes)
            is_mixed = np.isfinite(mixed) & is_hit
            measured[is_mixed] = mixed[is_mixed]
            rectangle[is_mixed] = SPOILT
        is_gross = (uniforms(states, 0) < self._errors.outlier_share) & is_hit
        measured[is_gross] = _gross(states[is_gross], distance[is_gross])
        rectangle[is_gross] = SPOILT
        return measured

    def _mixed(self, sweep: Sweep, echoes: _Echoes) -> NDArray[np.float64]:
        """Mixed distances where the edge of the spot, at a hashed side, meets another depth."""
        states, distance = echoes.states, echoes.distance
        turn, reach = _TURN * uniforms(states, 3), 0.5 * self._errors.beam_m / distance
        aside = reach * np.cos(turn) / np.maximum(0.05, np.cos(echoes.elevation))
        rims = _directions(echoes.azimuth + aside, echoes.elevation + reach * np.sin(turn))
        other = self._rays.cast(sweep.station[:, None], rims).t
        mixed = np.full(len(distance), np.nan)
        apart = np.abs(other - distance)
        beside = np.flatnonzero(np.isfinite(other) & (apart > 0.02 + 0.02 * distance))
        share = 0.5 * uniforms(states[beside], 4)
        mixed[beside] = (1.0 - share) * distance[beside] + share * other[beside]
        return mixed


def shared_errors(
    points: NDArray[np.float64], station: NDArray[np.float64], errors: Errors
) -> NDArray[np.float64]:
    """Return the common errors of points (3, n) of a station, metres."""
    off = np.zeros_like(points)
    if errors.registration_m:
        place_mm = np.rint(1e3 * station).astype(np.int64) % 2**31
        of_station = np.random.default_rng([errors.band_seed, *place_mm.tolist()])
        off += errors.registration_m * of_station.normal(size=(3, 1))
    if errors.bending_m:
        # A parabola along the longer axis of the room, upwards and sideways.
        along = (points[0] / _BENT_M) ** 2
        off[1:] += errors.bending_m * along / math.sqrt(2.0)
    if errors.shared_m:
        # Waves of random directions: their sum is practically Gaussian, with a Gaussian
        # correlation.
        waves = np.random.default_rng([errors.band_seed, 1])
        for axis in range(3):
            ways = waves.normal(size=(_WAVES, 3)) / errors.shared_length_m
            phases = waves.uniform(0.0, _TURN, _WAVES)
            field = np.zeros(points.shape[1])
            for way, phase in zip(ways, phases, strict=True):
                field += np.cos(way @ points + phase)
            off[axis] += errors.shared_m * math.sqrt(2.0 / _WAVES) * field
    return off


def _sweep(  # the range comes last, as `in_runs` gives it
    scanner: Scanner, sweep: Sweep, scanned: Scanned, first: int, last: int
) -> None:
    scanner.sweep(sweep, first, last, scanned)


def _allocated(n_points: int, ctx: StepContext) -> Scanned:
    def array(name: str, dtype: type, *more: int) -> NDArray[np.generic]:
        return ctx.allocate("cloud", name, (n_points, *more), dtype)

    return Scanned(
        x=cast("NDArray[np.float32]", array("x", np.float32)),
        y=cast("NDArray[np.float32]", array("y", np.float32)),
        z=cast("NDArray[np.float32]", array("z", np.float32)),
        intensity=cast("NDArray[np.float32]", array("intensity", np.float32)),
        rgb=cast("NDArray[np.uint8]", array("rgb", np.uint8, 3)),
        rectangle=cast("NDArray[np.int32]", array("rectangle", np.int32)),
    )


def _only_hits(scan: Scan) -> Scan:
    """Drop rays without a hit; a closed room has none, then nothing is copied."""
    hit = scan.points.rectangle != _MISSED
    if bool(hit.all()):
        return scan
    return Scan(
        points=scan.points.take(hit),
        scan=scan.scan[hit],
        row=scan.row[hit],
        column=scan.column[hit],
        stations=scan.stations,
    )


def _panorama(station: NDArray[np.float64], step: float, seed: int) -> Sweep:
    lowest, highest = math.radians(LOWEST_ELEVATION_DEG), math.radians(HIGHEST_ELEVATION_DEG)
    return Sweep(
        station=station,
        azimuth=0.0,
        elevation=lowest,
        step=step,
        n_columns=max(1, math.floor(2.0 * math.pi / step)),
        n_rows=max(1, math.floor((highest - lowest) / step)),
        seed=seed,
    )


def _detail(
    station: NDArray[np.float64], outline: NDArray[np.float64], step: float, seed: int
) -> Sweep:
    """Scan the smallest window of angles that contains the main wall."""
    _, towards = main_wall_axes()
    forward = math.atan2(towards[1], towards[0])
    # Along the edges too: seen from below, the middle of an upper edge is higher than its ends.
    shares = np.linspace(0.0, 1.0, 33)[:, None]
    edges = [a + shares * (b - a) for a, b in zip(outline, np.roll(outline, -1, 0), strict=True)]
    rays = np.concatenate(edges) - station
    azimuths = np.arctan2(rays[:, 1], rays[:, 0]) - forward
    azimuths = (azimuths + math.pi) % (2.0 * math.pi) - math.pi
    elevations = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    return Sweep(
        station=station,
        azimuth=forward + float(azimuths.min()),
        elevation=float(elevations.min()),
        step=step,
        n_columns=max(1, math.ceil(float(np.ptp(azimuths)) / step)),
        n_rows=max(1, math.ceil(float(np.ptp(elevations)) / step)),
        seed=seed,
    )


@dataclass(frozen=True, kw_only=True)
class _Echoes:
    """The rays of some columns and their hits, one entry per ray.

    Attributes:
        azimuth: radians; elevation likewise.
        elevation: see azimuth.
        ways: (3, n) unit directions.
        hits: what they meet.
        states: random states of their positions in the grid.
        distance: metres to the hit, arbitrary without one.
        cosine: of the angle of incidence.
    """

    azimuth: NDArray[np.float64]
    elevation: NDArray[np.float64]
    ways: NDArray[np.float64]
    hits: Hits
    states: NDArray[np.uint64]
    distance: NDArray[np.float64]
    cosine: NDArray[np.float64]


def _directions(
    azimuth: NDArray[np.float64], elevation: NDArray[np.float64]
) -> NDArray[np.float64]:
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def _range_sigma(
    distance: NDArray[np.float64],
    cosine: NDArray[np.float64],
    is_cloth: NDArray[np.bool_],
    noise_m: float,
) -> NDArray[np.float64]:
    """Return the standard deviation of a distance: it grows with range and slope, and on cloth."""
    slope = 1.0 + 0.45 * np.minimum(1.0 / np.maximum(cosine, 0.05) - 1.0, 4.0)
    cloth = np.where(is_cloth, 1.4, 1.0)
    return noise_m * slope * cloth * np.sqrt(0.5 + (distance / 3.0) ** 2 / 2)


def _gross(states: NDArray[np.uint64], distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return distances of gross outliers: most are too short, some too long."""
    short = distance * (0.3 + 0.68 * uniforms(states, 2))
    far = distance + 2.0 * uniforms(states, 2)
    return np.where(uniforms(states, 1) < 0.8, short, far)


@dataclass(frozen=True, kw_only=True)
class LaserBand:
    """The laser's band in one scene.

    Attributes:
        scene: the scene with the rectangles; its origin at (0, 0, 0).
        inversion: 0 if the laser sees what the scene's textures show, 1 if all contrast follows
            from the materials' own response.
        seed: of materials, patches and spots.
    """

    scene: Scene
    inversion: float
    seed: int

    def reflectance(
        self,
        rectangle: NDArray[np.int32],
        points: NDArray[np.float64],
        colours: NDArray[np.float32],
    ) -> NDArray[np.float64]:
        """Return what the laser sees of points.

        Args:
            rectangle: (n,) rectangle of each point.
            points: (3, n) metres.
            colours: (4, n) red, green, blue 0..255, and the texture's own reflectance.

        Returns:
            (n,) 0..1.
        """
        plain: NDArray[np.float64] = colours[3].astype(np.float64)
        if self.inversion == 0.0:
            return plain
        material = self.scene.texture_params[rectangle, 6].astype(np.int64)
        states = cell_states(material, np.zeros_like(material), self.seed)

        def drawn(limits: tuple[float, float], draw: int) -> NDArray[np.float64]:
            share = uniforms(states, draw)
            return np.asarray(limits[0] + (limits[1] - limits[0]) * share, dtype=np.float64)

        red, green = colours[0] / 255.0, colours[1] / 255.0
        own = (
            drawn(_BLACK, 0)
            - drawn(_RED, 1) * red ** drawn(_RED_POWER, 2)
            + drawn(_GREEN, 3) * green ** drawn(_GREEN_POWER, 4)
            + _OWN_PATTERN * (plain - self.scene.texture_params[rectangle, 3])
        )
        a, b = self._places(rectangle, points)
        wet = _smooth_noise(a / _WET_M, b / _WET_M, material + self.seed)
        own *= 1.0 - _WET_DARKER * np.clip((wet - _WET_FROM) / 0.1, 0.0, 1.0)
        own[_is_spot(a, b, material + self.seed)] = 1.0
        mixed = (1.0 - self.inversion) * plain + self.inversion * own
        return np.asarray(np.clip(mixed, 0.01, 1.0), dtype=np.float64)

    def _places(
        self, rectangle: NDArray[np.int32], points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        offsets = points.T - self.scene.centre[rectangle]
        a, b = (
            np.einsum("ni,ni->n", offsets, axis[rectangle])
            for axis in (self.scene.axis_a, self.scene.axis_b)
        )
        return a, b


def _smooth_noise(
    x: NDArray[np.float64], y: NDArray[np.float64], seed: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return noise 0..1 that is smooth between the points of a lattice, and differs per seed."""
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    s, t = x - column, y - row
    s, t = s * s * (3.0 - 2.0 * s), t * t * (3.0 - 2.0 * t)
    total = np.zeros_like(x)
    for right in (0, 1):
        for down in (0, 1):
            weight = (s if right else 1.0 - s) * (t if down else 1.0 - t)
            total += weight * uniforms(_lattice(column + right, row + down, seed), 5)
    return total


def _is_spot(
    a: NDArray[np.float64], b: NDArray[np.float64], seed: NDArray[np.int64]
) -> NDArray[np.bool_]:
    column = np.floor(a / _SPOT_EVERY_M).astype(np.int64)
    row = np.floor(b / _SPOT_EVERY_M).astype(np.int64)
    states = _lattice(column, row, seed)
    distance = np.hypot(
        a / _SPOT_EVERY_M - column - 0.2 - 0.6 * uniforms(states, 6),
        b / _SPOT_EVERY_M - row - 0.2 - 0.6 * uniforms(states, 7),
    )
    is_near = distance < _SPOT_RADIUS_M / _SPOT_EVERY_M
    return np.asarray(is_near & (uniforms(states, 8) < _SPOT_SHARE), dtype=np.bool_)


def _lattice(
    column: NDArray[np.int64], row: NDArray[np.int64], seed: NDArray[np.int64]
) -> NDArray[np.uint64]:
    return cell_states(column, row + 1_000_003 * seed, 0)
