"""The simulated scanner: where it stands, what it sweeps, and the points that come of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.scene_rays import RAYS_AT_ONCE
from orthoflow.geometry.scenes import Scene
from orthoflow.geometry.threads import in_runs
from orthoflow.sdk import StepContext
from orthoflow_plugins.simulate.palace import main_wall_axes
from orthoflow_plugins.simulate.sweeping import MISSED, Errors, Scanned, Scanner, Sweep

# No scan of the zenith: its points would crowd the ceiling over the station.
LOWEST_ELEVATION_DEG: Final = -62.0
HIGHEST_ELEVATION_DEG: Final = 62.0

# Along the main wall, towards it, and over the origin, metres; clear of everything in the room.
_PLACES_M: Final = (
    (-1.15, -0.10, 0.0),
    (1.20, 0.15, 0.12),
    (0.10, -0.60, -0.15),
    (0.05, 0.80, 0.20),
)


@dataclass(frozen=True, kw_only=True)
class Scan:
    """Several scans one after the other.

    Attributes:
        points: what was measured.
        scan: (n,) number of the scan.
        row: (n,) place in the scan's grid; column alike.
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
        n_stations: number of stations.
        scan_step_m: step of the detail scan of the main wall at the foot of the perpendicular.
        panorama_step_m: likewise of the panorama.
    """

    n_stations: int
    scan_step_m: float
    panorama_step_m: float


def station_positions(n_stations: int) -> NDArray[np.float64]:
    """Stations (s, 3) in the room frame, metres."""
    along, towards = main_wall_axes()
    up = np.array([0.0, 0.0, 1.0])
    return np.array([a * along + t * towards + h * up for a, t, h in _PLACES_M[:n_stations]])


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
    for index, station in enumerate(station_positions(plan.n_stations)):
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
            partial(_sweep, scanner, sweep, points.part(span)),
            sweep.n_columns,
            n_per_run=max(1, RAYS_AT_ONCE // sweep.n_rows),
            threads=ctx.cores,
        )
        scan[span] = index
        row[span] = np.tile(np.arange(sweep.n_rows, dtype=np.uint32), sweep.n_columns)
        column[span] = np.repeat(np.arange(sweep.n_columns, dtype=np.uint32), sweep.n_rows)
    stations = np.array([sweep.station for sweep in sweeps])
    return _only_hits(Scan(points=points, scan=scan, row=row, column=column, stations=stations))


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
    """Leave out rays that met nothing; a closed room has none, then nothing is copied."""
    hit = scan.points.rectangle != MISSED
    if bool(hit.all()):
        return scan
    return Scan(
        points=scan.points.part(hit),
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
    """Scan the window of angles that just holds the main wall."""
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
