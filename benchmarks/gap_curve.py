"""Count oriented photos while laser intensity and photos become less similar.

    python benchmarks/gap_curve.py --rooms 6 --first 301
    python benchmarks/gap_curve.py --rooms 40 --first 301 --photo-gsd-m 0.00085
    # the gap spread evenly over the rooms, half of them from EXIF, half with drawn mouldings:
    python benchmarks/gap_curve.py --rooms 40 --first 7001 --mixed

The share of the contrast that is inverted in the laser intensity (0 to 1), the scan noise, the
camera and the viewpoints of a room are determined by its seed. Rooms are those of
`orientation_truth.py`: six photos of the main wall, 4 mm cells, a point spacing of 2.6 mm. Photos
are processed as in `photos-on-scan.yaml`: `match.sift`, a bundle adjustment with relaxed gates,
`match.guided`, and a bundle adjustment. `wall` is the error per coordinate on the wall; `wrong`
counts accepted photos whose error exceeds five expected standard deviations or two cells. Seconds
are CPU seconds of both matching steps per photo. Photos that are rejected or have an error above
0.5 mm are listed with the area of the wall that they truly show.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np
from orientation_truth import ROUGHLY, orient, rematched, room, sifted
from orthoflow_plugins.inspect.orientation_errors import PoseError, pose_errors, true_camera
from orthoflow_plugins.match.warping import project_walls
from orthoflow_plugins.orient.bundle import OrientColmapBundle

from orthoflow.errors import MethodError
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import Cameras, Photos, Truth, Walls

_WRONG_CELLS = 2.0
# Limits of the error for 95 % of the photos, with calibration and with EXIF.
_ASKED_MM = {True: 0.5, False: 0.8}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of one room.

    Attributes:
        share: share of the contrast that is inverted.
        n_photos: number of photos taken.
        n_wrong: number of photos accepted with a wrong pose.
        walls_mm: errors of the accepted photos on the wall.
        photo_s: CPU seconds of both matching steps per photo.
    """

    share: float
    n_photos: int
    n_wrong: int
    walls_mm: tuple[float, ...]
    photo_s: float
    is_calibrated: bool = True

    def row(self) -> str:
        usual = (
            f"{np.median(self.walls_mm):6.2f} {max(self.walls_mm):6.2f}" if self.walls_mm else ""
        )
        n_oriented = len(self.walls_mm)
        return f"{n_oriented:3d}/{self.n_photos:<3d} {self.n_wrong:5d} {self.photo_s:6.1f} {usual}"


def outcome(share: float, photos: Photos, walls: Walls, truth: Truth, *, structure: str) -> Outcome:
    """Orient the photos of one room and compare them with the truth."""
    started = time.process_time()
    ties = sifted(photos, walls, structure=structure)
    spent_s = time.process_time() - started
    first = orient(OrientColmapBundle, ties, photos, **ROUGHLY)
    _name_unplaced(first, "first", walls, truth)
    errors: tuple[PoseError, ...] = ()
    cameras = first
    try:
        started = time.process_time()
        again = rematched("guided", photos, walls, first)
        spent_s += time.process_time() - started
        cameras = orient(OrientColmapBundle, again, photos)
        errors = pose_errors(cameras, walls, truth, SceneCameras(truth.scene, cores=2))
    except MethodError as error:
        print(f"  {error}", flush=True)
        _name_unplaced(cameras, "last", walls, truth)
    good = [error for error in errors if error.status == "ok"]
    for error in good:
        if error.is_wrong or (error.wall_m or 0.0) > 0.0005:
            stated_mm = 1000.0 * (error.sigma_wall_m or 0.0)
            off_mm = 1000.0 * (error.wall_m or 0.0)
            print(f"  {error.photo}: off by {off_mm:.2f} mm, stated {stated_mm:.2f}", flush=True)
    cell_m = walls.walls[0].frame.gsd_m
    return Outcome(
        share=share,
        n_photos=len(photos.photos),
        n_wrong=sum(
            error.is_wrong or (error.wall_m or 0.0) > _WRONG_CELLS * cell_m for error in good
        ),
        walls_mm=tuple(1000.0 * (error.wall_m or 0.0) for error in good),
        photo_s=spent_s / len(photos.photos),
        is_calibrated=photos.photos[0].intrinsics is not None,
    )


def _name_unplaced(cameras: Cameras, when: str, walls: Walls, truth: Truth) -> None:
    """Print the rejected photos and the area of the main wall that they truly show."""
    for camera in cameras.cameras:
        if camera.status == "ok":
            continue
        shown = project_walls(true_camera(truth, camera.photo), walls.walls)[0]
        cell_m2 = walls.walls[0].frame.gsd_m ** 2
        area_m2 = 0.0 if shown is None else cell_m2 * float(np.isfinite(shown.u).sum())
        print(f"  {when}: {camera.photo} shows {area_m2:.1f} m2: {camera.status}", flush=True)


def _shares(outcomes: list[Outcome]) -> None:
    """Print the shares of oriented and of accurate photos, with calibration and with EXIF."""
    for is_calibrated, asked_mm in _ASKED_MM.items():
        some = [each for each in outcomes if each.is_calibrated is is_calibrated]
        walls_mm = np.array([value for each in some for value in each.walls_mm])
        if len(walls_mm):
            near = float((walls_mm <= asked_mm).mean())
            share = len(walls_mm) / sum(each.n_photos for each in some)
            name = "calibrated" if is_calibrated else "from EXIF"
            print(f"{name}: {share:.3f} oriented, {near:.3f} of these within {asked_mm} mm")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", type=int, default=6)
    parser.add_argument("--first", type=int, default=301, help="seed of the first room")
    parser.add_argument("--bins", type=int, default=5, help="points of the curve")
    parser.add_argument("--gsd-m", type=float, default=0.004, help="cell of the wall")
    parser.add_argument("--photo-gsd-m", type=float, default=0.0025, help="pixel on the wall")
    parser.add_argument("--exif", action="store_true", help="without calibration")
    parser.add_argument(
        "--structure", default="confirmed", help="never or confirmed, as `match.sift` has it"
    )
    parser.add_argument("--share", type=float, help="the same gap in every room")
    parser.add_argument(
        "--mixed",
        action="store_true",
        help="gap spread evenly, every second room from EXIF, two of four with drawn mouldings",
    )
    chosen = parser.parse_args()
    chosen.layout = "quick"
    outcomes = []
    for nth, seed in enumerate(range(chosen.first, chosen.first + chosen.rooms)):
        drawn = float(np.random.default_rng(seed).uniform())
        chosen.inverted = drawn if chosen.share is None else chosen.share
        if chosen.mixed:
            # Neighbouring rooms are of different kinds, and each kind covers the whole range of the
            # gap.
            chosen.inverted = nth / max(1, chosen.rooms - 1)
            chosen.decoration = "drawn" if nth // 2 % 2 else "designed"
        photos, walls, truth = room(seed, "easy", chosen)
        if chosen.exif or (chosen.mixed and nth % 2):
            photos = Photos(photos=tuple(replace(each, intrinsics=None) for each in photos.photos))
        found = outcome(chosen.inverted, photos, walls, truth, structure=chosen.structure)
        outcomes.append(found)
        print(f"room {seed} gap {chosen.inverted:.2f} {outcomes[-1].row()}", flush=True)
    print(f"\n{'gap':11s} oriented wrong  cpu[s] wall[mm] worst[mm]")
    for nth in range(chosen.bins):
        low, high = nth / chosen.bins, (nth + 1) / chosen.bins
        some = [each for each in outcomes if low <= each.share < high or each.share == high == 1.0]
        if some:
            joined = Outcome(
                share=low,
                n_photos=sum(each.n_photos for each in some),
                n_wrong=sum(each.n_wrong for each in some),
                walls_mm=tuple(value for each in some for value in each.walls_mm),
                photo_s=float(np.mean([each.photo_s for each in some])),
            )
            print(f"{low:.2f}-{high:.2f}   {joined.row()}")
    _shares(outcomes)


if __name__ == "__main__":
    main()
