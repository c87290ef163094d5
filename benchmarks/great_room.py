"""Build the room with which plane detectors are measured: a palace hall, scanned by ray casting.

The room follows markiewicz2015: 8.6 x 4.2 x 5 m, a leaning main wall, a niche 25 cm deep, a
fireplace, pilasters, mouldings, windows, furniture, and a leaning mirror that shows the scanner a
reflected copy of the room. The scan consists of a panorama and a detail scan of the main wall, with
points in scan order. The room is built and scanned with the same code as `simulate.room`. The
rotation, tilt and shift of the room are determined by a seed, so that no wall coincides with a
search grid.

    python benchmarks/great_room.py FOLDER        # room.npy, labels.npy and truth.json for others
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.simulate.building import (
    Extent,
    Paint,
    SceneDraft,
    Side,
    Surface,
    TruePlane,
    add_block,
    flat_side,
    wall_side,
)
from orthoflow_plugins.simulate.scanning import SPOILT, Errors, Scanned, Scanner, Sweep
from scipy.spatial.transform import Rotation

from orthoflow.geometry import Plane
from orthoflow.geometry.scene_rays import RAYS_AT_ONCE, SceneRays
from orthoflow.geometry.scenes import Scene, SurfaceRole, TextureKind, cell_states, uniforms
from orthoflow.geometry.threads import in_runs

SEED = 20150807
# Size of the paper's cloud; in clouds of other sizes, the angles between rays differ.
FULL_POINTS = 48_000_000
# Share of the points in the panorama.
PANORAMA_SHARE = 1.0 / 3.0
FLOOR_M, CEILING_M = -1.5, 3.5
MIRROR_SHARE = 0.85
STATION = np.array([-0.07, 1.31, 0.1])
ERRORS = Errors(
    noise_m=0.0018, outlier_share=0.005, beam_m=0.0, colour_noise=0.0, inversion=0.0, band_seed=0
)

_PLASTER = Paint(kind=TextureKind.PLAIN, rgb=(210, 200, 180), reflectance=0.5)
_CLOTH = Paint(kind=TextureKind.TEXTILE, rgb=(150, 60, 60), reflectance=0.35)


@dataclass(frozen=True, kw_only=True)
class GreatRoom:
    """A scanned room.

    Attributes:
        x: (n,) float32 metres; y and z likewise.
        y: see x.
        z: see x.
        plane_index: (n,) int8 true plane of each point, -1 for none.
        planes: the true planes; the first is the main wall.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    plane_index: NDArray[np.int8]
    planes: tuple[TruePlane, ...]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--points", type=int, default=FULL_POINTS)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1, help="draws where the room lies")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    room = great_room(options.points, cores=options.cores, seed=options.seed)
    np.save(options.folder / "room.npy", np.column_stack([room.x, room.y, room.z]))
    np.save(options.folder / "labels.npy", room.plane_index)
    truth = {
        str(number): {
            "name": item.name,
            "n": item.plane.normal.tolist(),
            "R": item.plane.offset_m,
        }
        for number, item in enumerate(room.planes)
    }
    (options.folder / "truth.json").write_text(json.dumps({"planes": truth}, indent=1))


def great_room(n_points: int, *, cores: int, seed: int = 1) -> GreatRoom:
    """Build the room, scan it with about the given number of rays, and move it at random."""
    draft = SceneDraft()
    mirror = _build(draft)
    scene = draft.finished(spectral_gap=0.0)
    sweeps = _sweeps(n_points)
    sizes = [sweep.n_columns * sweep.n_rows for sweep in sweeps]
    count = sum(sizes)
    points = Scanned(
        x=np.empty(count, dtype=np.float32),
        y=np.empty(count, dtype=np.float32),
        z=np.empty(count, dtype=np.float32),
        intensity=np.empty(count, dtype=np.float32),
        rgb=np.empty((count, 3), dtype=np.uint8),
        rectangle=np.empty(count, dtype=np.int32),
    )
    scanner = Scanner(scene, ERRORS)
    start = 0
    for sweep, size in zip(sweeps, sizes, strict=True):
        part = points.take(slice(start, start + size))
        columns = max(1, RAYS_AT_ONCE // sweep.n_rows)
        in_runs(
            partial(scanner.sweep, sweep, part),
            sweep.n_columns,
            n_per_run=columns,
            threads=cores,
        )
        _mirrored(scene, mirror, sweep, part)
        start += size
    plane_index = np.append(scene.plane_index, -1).astype(np.int8)[np.maximum(points.rectangle, -1)]
    room = GreatRoom(
        x=points.x, y=points.y, z=points.z, plane_index=plane_index, planes=tuple(draft.planes)
    )
    rng = np.random.default_rng(seed)
    angles_deg = [rng.uniform(0.0, 360.0), *rng.uniform(-0.5, 0.5, 2)]
    turn = Rotation.from_euler("ZYX", angles_deg, degrees=True).as_matrix()
    return _moved(room, turn, rng.uniform(-1.0, 1.0, 3))


def _moved(room: GreatRoom, turn: NDArray[np.float64], shift_m: NDArray[np.float64]) -> GreatRoom:
    """Rotate and shift a room; its points are changed in place."""
    for first in range(0, len(room.x), RAYS_AT_ONCE):
        part = slice(first, first + RAYS_AT_ONCE)
        points = np.column_stack([room.x[part], room.y[part], room.z[part]]).astype(np.float64)
        room.x[part], room.y[part], room.z[part] = (points @ turn.T + shift_m).T
    planes = []
    for item in room.planes:
        normal = turn @ item.plane.normal
        offset_m = item.plane.offset_m + float(normal @ shift_m)
        moved = Plane(normal=normal, offset_m=offset_m)
        planes.append(replace(item, plane=moved, outline=item.outline @ turn.T + shift_m))
    return replace(room, planes=tuple(planes))


def _sweeps(n_points: int) -> list[Sweep]:
    """Return a panorama from near the origin, and a scan of the main wall from the origin."""
    sweeps = []
    for number, (station, azimuths, elevations, share) in enumerate(
        (
            (STATION, (0.0, 360.0), (-62.0, 89.9), PANORAMA_SHARE),
            (np.zeros(3), (51.0, 153.0), (-24.0, 47.0), 1.0 - PANORAMA_SHARE),
        )
    ):
        width, height = azimuths[1] - azimuths[0], elevations[1] - elevations[0]
        step_deg = math.sqrt(width * height / (share * n_points))
        sweeps.append(
            Sweep(
                station=station,
                azimuth=math.radians(azimuths[0]),
                elevation=math.radians(elevations[0]),
                step=math.radians(step_deg),
                n_columns=math.floor(width / step_deg),
                n_rows=math.floor(height / step_deg),
                seed=SEED + number,
            )
        )
    return sweeps


def _mirrored(scene: Scene, mirror: int, sweep: Sweep, points: Scanned) -> None:
    """Move most points on the mirror to the positions of their reflections."""
    index = np.flatnonzero(points.rectangle == mirror)
    states = cell_states(index // sweep.n_rows, index % sweep.n_rows, sweep.seed + 77)
    index = index[uniforms(states, 0) < MIRROR_SHARE]
    ends = np.stack([points.x[index], points.y[index], points.z[index]]).astype(np.float64)
    rays = ends - sweep.station[:, None]
    ways = rays / np.linalg.norm(rays, axis=0)
    normal = scene.normal[mirror]
    back = ways - 2.0 * normal[:, None] * (normal @ ways)
    # Start slightly in front of the mirror, so that noise does not move the start behind it.
    seen = SceneRays(scene).cast(ends - 0.05 * ways, back)
    is_seen = seen.rectangle >= 0
    index, further = index[is_seen], (ways * seen.t)[:, is_seen]
    for coordinate, along in zip((points.x, points.y, points.z), further, strict=True):
        coordinate[index] += along.astype(np.float32)
    points.rectangle[index] = SPOILT


def _build(draft: SceneDraft) -> int:
    """Build the room; return the number of the mirror's rectangle."""
    wide: Extent = (-6.0, 6.0, FLOOR_M - 0.5, CEILING_M + 0.5)
    main = wall_side(draft, omega_deg=102.0, phi_deg=0.8, distance_m=3.7)
    mirror = _build_main_wall(main, wide)
    opposite = wall_side(draft, omega_deg=282.4, phi_deg=-0.2, distance_m=0.5)
    windows: list[Extent] = [(-2.6, -1.2, -0.6, 2.4), (1.0, 2.4, -0.6, 2.4)]
    _build_wall(opposite, "opposite wall", wide, windows, 0.4, (-3.2, -0.3, 3.2))
    right = wall_side(draft, omega_deg=12.2, phi_deg=0.3, distance_m=4.5)
    _build_wall(right, "right wall", wide, [(-2.2, -1.0, FLOOR_M - 0.3, 0.8)], 0.25, (-3.2, 0.2))
    left = wall_side(draft, omega_deg=191.7, phi_deg=-0.3, distance_m=4.1)
    _build_wall(left, "left wall", wide, [], 0.0, (3.2, -0.2))
    for name, omega, phi, height_m in (
        ("floor", 0.0, 89.9, FLOOR_M),
        ("ceiling", 40.0, -89.8, CEILING_M),
    ):
        o, p = math.radians(omega), math.radians(phi)
        normal = (math.cos(p) * math.cos(o), math.cos(p) * math.sin(o), math.sin(p))
        side = flat_side(draft, normal=normal, height_m=height_m)
        far: Extent = (-9.0, 9.0, -9.0, 9.0)
        number = side.true_plane(name, far)
        side.place(far, 0.0, _PLASTER, SurfaceRole.WALL, plane=number)
    _furnish(draft)
    return mirror


def _build_main_wall(wall: Side, wide: Extent) -> int:
    number = wall.true_plane("main wall", wide)
    niche: Extent = (-2.9, -1.7, FLOOR_M - 0.3, 0.9)
    hole = wall.recess(niche, 0.25, _PLASTER, plane=wall.true_plane("niche", niche, -0.25))
    wall.place(wide, 0.0, _CLOTH, SurfaceRole.WALL, plane=number, holes=[hole])
    wall.box((0.3, 0.7, FLOOR_M - 0.1, -0.3), 0.35, _PLASTER)
    wall.box((1.7, 2.1, FLOOR_M - 0.1, -0.3), 0.35, _PLASTER)
    wall.box((0.7, 1.7, -0.65, -0.3), 0.35, _PLASTER)
    wall.box((0.2, 2.2, -0.3, -0.22), 0.42, _PLASTER)
    lean = math.radians(2.0)
    wall.draft.surfaces.append(
        Surface(
            centre=wall.foot + 0.02 * wall.normal - 0.2 * wall.axis_b,
            axis_a=wall.axis_a,
            axis_b=math.cos(lean) * wall.axis_b + math.sin(lean) * wall.normal,
            extent=(0.6, 1.8, 0.0, 1.8),
            paint=_PLASTER,
            role=SurfaceRole.OBJECT,
        )
    )
    mirror = len(wall.draft.surfaces) - 1
    wall.bars((0.5, 1.9, -0.22, 1.72), 0.1, 0.08, _PLASTER)
    for middle in (-3.75, -1.35, -0.25, 2.65, 3.95):
        wall.box((middle - 0.17, middle + 0.17, FLOOR_M, 3.0), 0.08, _PLASTER)
        wall.box((middle - 0.21, middle + 0.21, FLOOR_M, -1.2), 0.11, _PLASTER)
        wall.box((middle - 0.21, middle + 0.21, 2.75, 3.0), 0.12, _PLASTER)
    for left, right in ((-3.5, -3.05), (-1.1, -0.5), (2.95, 3.7)):
        wall.bars((left, right, -0.5, 2.6), 0.05, 0.03, _PLASTER)
    wall.bars((0.1, 2.3, 1.9, 2.6), 0.05, 0.03, _PLASTER)
    _add_mouldings(wall, 5.0)
    return mirror


def _build_wall(
    wall: Side,
    name: str,
    wide: Extent,
    recesses: list[Extent],
    depth_m: float,
    pilasters: tuple[float, ...],
) -> None:
    number = wall.true_plane(name, wide)
    holes = [wall.recess(extent, depth_m, _PLASTER) for extent in recesses]
    wall.place(wide, 0.0, _PLASTER, SurfaceRole.WALL, plane=number, holes=holes)
    for middle in pilasters:
        wall.box((middle - 0.15, middle + 0.15, FLOOR_M, 3.0), 0.07, _PLASTER)
    _add_mouldings(wall, 5.0)


def _add_mouldings(wall: Side, half_m: float) -> None:
    """Add a cornice of two steps below the ceiling, and a skirting board."""
    wall.box((-half_m, half_m, 3.1, 3.6), 0.08, _PLASTER)
    wall.box((-half_m, half_m, 3.28, 3.6), 0.16, _PLASTER)
    wall.box((-half_m, half_m, FLOOR_M - 0.1, FLOOR_M + 0.2), 0.03, _PLASTER)


def _furnish(draft: SceneDraft) -> None:
    azimuth = math.radians(12.0)
    along = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    across = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    for place, towards, size, yaw_deg in (
        (-2.8, 0.55, (1.2, 0.7, 0.75), 4.0),
        (3.2, 0.35, (0.6, 0.5, 1.2), -7.0),
        (3.8, 2.8, (0.6, 0.8, 1.7), 1.0),
        (-1.15, 3.0, (0.5, 0.4, 0.5), 20.0),
        (1.1, 1.9, (0.6, 0.6, 0.4), 9.0),
        (-3.6, 2.8, (0.4, 0.8, 1.6), 2.0),
    ):
        base = place * along + towards * across + FLOOR_M * np.array([0.0, 0.0, 1.0])
        add_block(draft, base=base, yaw_deg=12.0 + yaw_deg, size_m=size, paint=_PLASTER)


if __name__ == "__main__":
    main()
