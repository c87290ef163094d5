"""Rooms drawn by chance and scanned: walls, relief, materials, noise and stations differ."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.simulate.building import (
    Extent,
    Paint,
    SceneDraft,
    Side,
    TruePlane,
    add_block,
    flat_side,
    wall_side,
)
from orthoflow_plugins.simulate.scanning import Errors, Sweep, scan_scene

from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from orthoflow.products import PointCloud
from tests.plane_scenes import context

FLOOR_M = -1.5
PLAIN = Paint(kind=TextureKind.PLAIN, rgb=(200, 200, 190), reflectance=0.6, seed=1)
CLOTH = Paint(kind=TextureKind.TEXTILE, rgb=(120, 60, 60), reflectance=0.3, seed=2)


def random_room(
    seed: int, folder: Path, *, step_deg: float = 0.7
) -> tuple[PointCloud, list[TruePlane]]:
    """Scan a room of four leaning walls with relief, recesses, cloth and furniture.

    Relief stands 4 mm to 12 cm out of the walls, so that some of it lies inside the tolerance of
    the fit; distances mix at its edges.

    Returns:
        The cloud, and the planes of walls, floor and ceiling.
    """
    rng = np.random.default_rng(seed)
    draft = SceneDraft()
    height_m = rng.uniform(2.6, 4.0)
    top_m = FLOOR_M + height_m
    turn_deg = rng.uniform(0.0, 360.0)
    away_m = rng.uniform(1.8, 4.0, 4)
    for place in range(4):
        wall = wall_side(
            draft,
            omega_deg=turn_deg + 90.0 * place + rng.normal(0.0, 0.5),
            phi_deg=rng.normal(0.0, 0.5),
            distance_m=away_m[place],
        )
        # Past the corners, where the next walls hide it.
        wide = (-away_m[(place + 1) % 4] - 0.4, away_m[(place + 3) % 4] + 0.4)
        _furnish_wall(wall, (*wide, FLOOR_M - 0.2, top_m + 0.2), top_m, f"wall {place}", rng)
    level: Extent = (-6.0, 6.0, -6.0, 6.0)
    for name, rise, at_m in (("floor", 1.0, FLOOR_M), ("ceiling", -1.0, top_m)):
        slope = rng.normal(0.0, 0.003, 2)
        side = flat_side(draft, normal=(slope[0], slope[1], rise), height_m=at_m)
        side.place(level, 0.0, PLAIN, SurfaceRole.WALL, plane=side.true_plane(name, level))
    for _ in range(3):
        place = rng.uniform(-1.2, 1.2, 2)
        add_block(
            draft,
            base=np.array([*place, FLOOR_M]),
            yaw_deg=float(rng.uniform(0.0, 90.0)),
            size_m=(*rng.uniform(0.3, 0.9, 2), 0.7),
            paint=PLAIN,
        )
    sweeps = [_panorama(rng, step_deg) for _ in range(int(rng.integers(1, 4)))]
    errors = Errors(
        noise_m=float(rng.uniform(0.0008, 0.004)),
        outlier_share=0.005,
        beam_m=float(rng.uniform(0.002, 0.008)),
        colour_noise=1.0,
        inversion=0.0,
        band_seed=0,
    )
    scan = scan_scene(draft.finished(spectral_gap=0.0), sweeps, errors, context(folder))
    cloud = PointCloud(
        origin=np.zeros(3),
        x=scan.points.x,
        y=scan.points.y,
        z=scan.points.z,
        up=np.array([0.0, 0.0, 1.0]),
        scan=scan.scan,
        stations=scan.stations,
        stations_source="file",
    )
    return cloud, draft.planes


def _furnish_wall(
    wall: Side, full: Extent, top_m: float, name: str, rng: np.random.Generator
) -> None:
    left, right = full[0] + 0.6, full[1] - 0.6
    plane = wall.true_plane(name, full)
    spots = np.linspace(left, right, 5)
    holes: list[Extent] = []
    for start, end in itertools.pairwise(spots):
        low, high = np.sort(rng.uniform(FLOOR_M + 0.2, top_m - 0.2, 2))
        spot: Extent = (float(start + 0.1), float(end - 0.1), float(low), float(high))
        if high - low < 0.3 or end - start < 0.4:
            continue
        depth_m = float(np.exp(rng.uniform(math.log(0.004), math.log(0.12))))
        chance = rng.uniform()
        if chance < 0.25:
            holes.append(wall.recess(spot, 2.0 * depth_m, PLAIN))
        elif chance < 0.45:
            wall.place(spot, 0.0, CLOTH, SurfaceRole.WALL, plane=plane)
            holes.append(spot)
        elif chance < 0.7:
            wall.bars(spot, 0.08, depth_m, PLAIN)
        elif chance < 0.85:
            wall.box((spot[0], spot[0] + 0.2, FLOOR_M - 0.1, top_m + 0.1), depth_m, PLAIN)
    wall.place(full, 0.0, PLAIN, SurfaceRole.WALL, plane=plane, holes=holes)
    wall.box((full[0], full[1], top_m - 0.25, top_m + 0.1), 0.1, PLAIN)


def _panorama(rng: np.random.Generator, step_deg: float) -> Sweep:
    step = math.radians(step_deg)
    place: NDArray[np.float64] = rng.uniform((-1.3, -1.3, -0.2), (1.3, 1.3, 0.3))
    return Sweep(
        station=place,
        azimuth=float(rng.uniform(0.0, step)),
        elevation=math.radians(-62.0),
        step=step,
        n_columns=round(2.0 * math.pi / step),
        n_rows=round(math.radians(124.0) / step),
        seed=int(rng.integers(2**62)),
    )
