"""How many photos are oriented as laser and camera see ever less alike: the curve over the gap.

    python benchmarks/gap_curve.py --rooms 6 --first 301
    python benchmarks/gap_curve.py --rooms 40 --first 301 --photo-gsd-m 0.00085

Each room draws from its seed how much of the contrast that its laser sees is inverted (0 to 1),
besides scan noise, camera and viewpoints: the rooms of `orientation_truth.py`, six photos of the
main wall, 4 mm cells, a scan step of 2.6 mm. Photos go the way of `photos-on-scan.yaml`:
`match.sift`, a bundle with loose gates, `match.guided`, a bundle. `wall` is the error of a
coordinate on the wall, `wrong` a photo that is called oriented and off by more than five stated
deviations or two cells. Seconds are CPU seconds of both matchers per photo.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np
from orientation_truth import ROUGHLY, orient, rematched, room, sifted
from orthoflow_plugins.inspect.orientation_errors import PoseError, pose_errors
from orthoflow_plugins.orient.bundle import OrientColmapBundle

from orthoflow.errors import MethodError
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import Photos, Truth, Walls

_WRONG_CELLS = 2.0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of one room.

    Attributes:
        share: of the contrast that is inverted.
        n_photos: taken.
        n_wrong: called oriented and far off.
        walls_mm: errors on the wall, of the photos oriented.
        photo_s: CPU seconds of both matchers per photo.
    """

    share: float
    n_photos: int
    n_wrong: int
    walls_mm: tuple[float, ...]
    photo_s: float

    def row(self) -> str:
        usual = (
            f"{np.median(self.walls_mm):6.2f} {max(self.walls_mm):6.2f}" if self.walls_mm else ""
        )
        n_oriented = len(self.walls_mm)
        return f"{n_oriented:3d}/{self.n_photos:<3d} {self.n_wrong:5d} {self.photo_s:6.1f} {usual}"


def outcome(
    share: float, photos: Photos, walls: Walls, truth: Truth, *, by_structure: bool
) -> Outcome:
    """Orient the photos of one room and compare them with the truth."""
    started = time.process_time()
    ties = sifted(photos, walls, tries_structure=by_structure)
    spent_s = time.process_time() - started
    first = orient(OrientColmapBundle, ties, photos, **ROUGHLY)
    errors: tuple[PoseError, ...] = ()
    try:
        started = time.process_time()
        again = rematched("guided", photos, walls, first)
        spent_s += time.process_time() - started
        cameras = orient(OrientColmapBundle, again, photos)
        errors = pose_errors(cameras, walls, truth, SceneCameras(truth.scene, cores=2))
    except MethodError as error:
        print(f"  {error}", flush=True)
    good = [error for error in errors if error.status == "ok"]
    cell_m = walls.walls[0].frame.gsd_m
    return Outcome(
        share=share,
        n_photos=len(photos.photos),
        n_wrong=sum(
            error.is_wrong or (error.wall_m or 0.0) > _WRONG_CELLS * cell_m for error in good
        ),
        walls_mm=tuple(1000.0 * (error.wall_m or 0.0) for error in good),
        photo_s=spent_s / len(photos.photos),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", type=int, default=6)
    parser.add_argument("--first", type=int, default=301, help="seed of the first room")
    parser.add_argument("--bins", type=int, default=5, help="points of the curve")
    parser.add_argument("--gsd-m", type=float, default=0.004, help="cell of the wall")
    parser.add_argument("--photo-gsd-m", type=float, default=0.0025, help="pixel on the wall")
    parser.add_argument("--exif", action="store_true", help="without calibration")
    parser.add_argument("--structure", action="store_true", help="with `tries_structure`")
    parser.add_argument("--share", type=float, help="the same gap in every room")
    chosen = parser.parse_args()
    chosen.layout = "quick"
    outcomes = []
    for seed in range(chosen.first, chosen.first + chosen.rooms):
        drawn = float(np.random.default_rng(seed).uniform())
        chosen.inverted = drawn if chosen.share is None else chosen.share
        photos, walls, truth = room(seed, "easy", chosen)
        if chosen.exif:
            photos = Photos(photos=tuple(replace(each, intrinsics=None) for each in photos.photos))
        found = outcome(chosen.inverted, photos, walls, truth, by_structure=chosen.structure)
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


if __name__ == "__main__":
    main()
