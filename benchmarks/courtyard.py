"""Orient photos of a courtyard whose four facades repeat one window, and check their positions.

    python benchmarks/courtyard.py [--seeds 1 2 3] [--photos 16]

Four plastered facades enclose a courtyard of 12 x 10 m, which is scanned from one station; each has
rows of identical windows 0.25 m deep. Stains, viewpoints and noise are determined by a seed. Photos
are taken 4 to 6 m in front of a facade and show two or three windows per row, so only the stains
distinguish the windows. Photos are processed by the steps of `photos-on-scan.yaml`, with a focal
length from EXIF: `match.sift`, a bundle adjustment with relaxed gates, `match.guided`, and a bundle
adjustment. The output lists the facades found, the oriented photos with their errors (of the
centre, and per coordinate on the wall, next to the expected error), the reasons for rejecting the
others, and the number of accepted photos with a wrong position.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from orientation_truth import ROUGHLY, context, orient, rematched, sifted
from orthoflow_plugins.inspect.orientation_errors import PoseError, pose_errors
from orthoflow_plugins.orient.bundle import OrientColmapBundle
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.building import (
    Paint,
    SceneDraft,
    Side,
    flat_side,
    wall_side,
)
from orthoflow_plugins.simulate.deliverables import Delivery, cloud_of, truth_of
from orthoflow_plugins.simulate.photographs import Film, Shot, take_photos
from orthoflow_plugins.simulate.room_model import Room
from orthoflow_plugins.simulate.scanning import Errors, Sweep, scan_scene

from orthoflow.geometry.cameras import looking_at
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from orthoflow.products import Intrinsics, Photos, Planes, PointCloud, TakenPhoto, Truth

NAMES: Final = ("east", "north", "west", "south")
_OMEGA_DEG: Final = (1.3, 91.3, 181.3, 271.3)
_AWAY_M: Final = (6.0, 5.0, 6.0, 5.0)
_FLOOR_M: Final = -1.6
_EAVES_M: Final = 4.2
_PITCH_M: Final = (1.9, 2.4)
_WINDOW_M: Final = (0.95, 1.4)
_RECESS_M: Final = 0.25
_STEP_RAD: Final = 0.0016
_SIZE_PX: Final = (1000, 750)
_FOCAL_PX: Final = 1000.0
_GSD_M: Final = 0.01


@dataclass(frozen=True, kw_only=True)
class Courtyard:
    """A courtyard, its scan and its photos."""

    cloud: PointCloud
    photos: Photos
    truth: Truth


def courtyard(seed: int, n_photos: int, coarser: float = 1.0) -> Courtyard:
    """Build a courtyard, scan it once and photograph its facades in turn.

    Args:
        seed: seed of stains, viewpoints and noise.
        n_photos: number of photos, a quarter of them of each facade.
        coarser: factor of the spacing of points and pixels.
    """
    rng = np.random.default_rng(seed)
    draft = SceneDraft()
    sides = [
        wall_side(draft, omega_deg=omega, phi_deg=0.0, distance_m=away)
        for omega, away in zip(_OMEGA_DEG, _AWAY_M, strict=True)
    ]
    for side, name, half in zip(sides, NAMES, (_AWAY_M[1], _AWAY_M[0]) * 2, strict=True):
        _build_facade(side, name, half, rng)
    floor = flat_side(draft, normal=(0.0, 0.0, 1.0), height_m=_FLOOR_M)
    wide = (-_AWAY_M[0], _AWAY_M[0], -_AWAY_M[1], _AWAY_M[1])
    paving = Paint(
        kind=TextureKind.TILES, rgb=(140, 135, 128), reflectance=0.4, period_m=0.6, seed=7
    )
    floor.place(wide, 0.0, paving, SurfaceRole.WALL, plane=floor.true_plane("floor", wide))
    scene = draft.finished(spectral_gap=0.3)
    low, high = math.radians(-55.0), math.radians(50.0)
    sweep = Sweep(
        station=np.array([0.7, -0.4, 0.0]),
        azimuth=0.0,
        elevation=low,
        step=coarser * _STEP_RAD,
        n_columns=math.floor(2.0 * math.pi / (coarser * _STEP_RAD)),
        n_rows=math.floor((high - low) / (coarser * _STEP_RAD)),
        seed=int(rng.integers(0, 2**62)),
    )
    errors = Errors(
        noise_m=0.002,
        outlier_share=0.002,
        beam_m=0.004,
        colour_noise=2.0,
        inversion=0.0,
        band_seed=seed,
    )
    delivery = Delivery(
        room=Room(scene=scene, planes=tuple(draft.planes)),
        scan=scan_scene(scene, [sweep], errors, context(seed)),
        world_from_room=np.eye(3),
        shift_world_m=np.zeros(3),
    )
    cloud = cloud_of(delivery)
    shots = tuple(_shot(nth, sides[nth % 4], coarser, rng) for nth in range(n_photos))
    film = Film(noise_grey=1.5, vignetting=0.1, supersample=2, exposures=0.2)
    photos = take_photos(SceneCameras(scene, cores=2), shots, film, context(seed), rng)
    return Courtyard(cloud=cloud, photos=photos, truth=truth_of(delivery, cloud, shots, {}))


def _build_facade(side: Side, name: str, half_m: float, rng: np.random.Generator) -> None:
    """Build a plastered facade with its own stains and identical windows."""
    plaster = Paint(
        kind=TextureKind.PLAIN,
        rgb=(188, 176, 150),
        reflectance=0.6,
        contrast=0.5,
        period_m=0.35,
        seed=int(rng.integers(1, 10**6)),
    )
    glass = Paint(kind=TextureKind.PLAIN, rgb=(46, 52, 60), reflectance=0.15, contrast=0.1)
    stone = Paint(kind=TextureKind.PLAIN, rgb=(214, 208, 196), reflectance=0.75, contrast=0.15)
    full = (-half_m, half_m, _FLOOR_M, _EAVES_M)
    holes = []
    n_columns = int((2.0 * half_m - 1.0) / _PITCH_M[0])
    for column in range(n_columns):
        for row in range(2):
            a = (column - 0.5 * (n_columns - 1)) * _PITCH_M[0]
            b = -0.1 + row * _PITCH_M[1]
            hole = (a - 0.5 * _WINDOW_M[0], a + 0.5 * _WINDOW_M[0], b, b + _WINDOW_M[1])
            holes.append(side.recess(hole, _RECESS_M, glass))
            around = (hole[0] - 0.12, hole[1] + 0.12, hole[2] - 0.12, hole[3] + 0.12)
            side.bars(around, 0.12, 0.04, stone)
    plane = side.true_plane(name, full)
    side.place(full, 0.0, plaster, SurfaceRole.WALL, plane=plane, holes=holes)


def _shot(nth: int, side: Side, coarser: float, rng: np.random.Generator) -> Shot:
    away_m = rng.uniform(4.0, 6.0)
    a, b = rng.uniform(-2.2, 2.2), rng.uniform(0.4, 1.8)
    aim = side.foot + a * side.axis_a + b * side.axis_b
    aside = rng.uniform(-0.35, 0.35)
    centre = aim + away_m * (side.normal + aside * side.axis_a) / math.hypot(1.0, aside)
    centre[2] = rng.uniform(-0.1, 0.3)
    rotation = looking_at(centre, aim, np.array([0.0, 0.0, 1.0]))
    width, height = (round(side_px / coarser) for side_px in _SIZE_PX)
    focal_px = _FOCAL_PX / coarser
    lens = Intrinsics(
        width=width,
        height=height,
        fx=focal_px,
        fy=focal_px,
        cx=0.5 * width + 3.0,
        cy=0.5 * height - 2.0,
        distortion=(-0.06, 0.01, 0.0, 0.0, 0.0),
        source="truth",
    )
    name = NAMES[nth % 4]
    taken = TakenPhoto(
        photo=f"{name}-{nth // 4}.jpg",
        wall=name,
        gsd_m=away_m / focal_px,
        obliquity_deg=math.degrees(math.acos(min(1.0, float(-rotation[2] @ side.normal)))),
        roll_deg=0.0,
    )
    return Shot(taken=taken, camera=lens.posed(rotation, -rotation @ centre))


def n_found(planes: Planes) -> int:
    """Count the facades with a detected plane within one degree and 2 cm at the centre."""
    count = 0
    for omega, away in zip(np.radians(_OMEGA_DEG), _AWAY_M, strict=True):
        inwards = -np.array([math.cos(omega), math.sin(omega), 0.0])
        is_along = planes.normal @ inwards > math.cos(math.radians(1.0))
        apart_m = np.abs(planes.normal @ (-away * inwards) - planes.offset)
        count += bool((is_along & (apart_m < 0.02)).any())
    return count


def oriented(built: Courtyard, coarser: float = 1.0) -> tuple[int, tuple[PoseError, ...]]:
    """Return the number of facades found, and each photo's error or reason for rejection."""
    cloud, photos = built.cloud, built.photos
    planes = Hough2d().run(Hough2d.In(cloud=cloud), Hough2d.Params(), context(1)).planes
    rule = RasterGrid.Params(gsd_m=coarser * _GSD_M)
    walls = RasterGrid().run(RasterGrid.In(cloud=cloud, planes=planes), rule, context(1)).walls
    first = orient(OrientColmapBundle, sifted(photos, walls), photos, **ROUGHLY)
    cameras = orient(OrientColmapBundle, rematched("guided", photos, walls, first), photos)
    views = SceneCameras(built.truth.scene, cores=2)
    return n_found(planes), pose_errors(cameras, walls, built.truth, views)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--photos", type=int, default=16)
    chosen = parser.parse_args()
    for seed in chosen.seeds:
        built = courtyard(seed, chosen.photos)
        n_facades, errors = oriented(built)
        print(
            f"courtyard {seed}: {n_facades} of 4 facades, {len(built.cloud) / 1e6:.1f} M points; "
            f"{sum(e.status == 'ok' for e in errors)} of {len(errors)} photos oriented, "
            f"{sum(e.is_wrong for e in errors)} wrong"
        )
        for error in errors:
            if error.status == "ok":
                centre, on_wall, stated = (
                    1e3 * (value or math.nan)
                    for value in (error.centre_m, error.wall_m, error.sigma_wall_m)
                )
                print(
                    f"  {error.photo}: centre {centre:.1f} mm, wall {on_wall:.2f} mm, "
                    f"{stated:.2f} stated"
                )
            else:
                print(f"  {error.photo}: {error.status}")


if __name__ == "__main__":
    main()
