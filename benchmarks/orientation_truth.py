"""Orient photos of simulated rooms; compare ties, poses and expected errors with the truth.

    python benchmarks/orientation_truth.py [--rooms 5] [--gaps easy hard] [--layout quick]
    # six photos of 6 MP on a wall of 3 million cells:
    python benchmarks/orientation_truth.py --rooms 1 --gsd-m 0.0026 --photo-gsd-m 0.00085
    # ties matched as in markiewicz2015, most of them wrong:
    python benchmarks/orientation_truth.py --ties unmasked masked

Each room has its own scan noise, camera and viewpoints. All have 4 mm cells, a point spacing of 2.6
mm, 2 mm range noise, photos with 2 mm pixels, and textile on a third of the main wall. Photos are
matched (`match.sift`), oriented by a bundle adjustment, matched again (`match.guided`) and oriented
by both estimators, with a calibration and with EXIF data only. `wrong` is the share of kept ties
that are off by more than 1.5 cells; `wall` is the error per coordinate on the wall, RMS over the
photos; `ratio` is that error divided by the expected one, pooled (ideally 1). Seconds are CPU
seconds per room.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from orthoflow_plugins.inspect.orientation_errors import pose_errors, tie_findings
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.match.sift import MatchSift
from orthoflow_plugins.orient.bundle import OrientColmapBundle
from orthoflow_plugins.orient.pnp import OrientPnp
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import Cameras, Photos, Ties, Truth, Walls
from orthoflow.sdk import StepContext

Estimator = type[OrientPnp] | type[OrientColmapBundle]
# Folders with memory-mapped clouds of 16 million points, which are deleted when the process ends.
_SCRATCH: list[tempfile.TemporaryDirectory[str]] = []
# As in the shipped workflows, a first pose only needs to be accurate to a few cells.
ROUGHLY = {
    "min_quadrant_ties": 0,
    "min_hull_ratio": 0.1,
    "max_sigma_wall_cells": 4.0,
    "max_sigma_corner_cells": 8.0,
}
TIES = ("unmasked", "masked", "guided")
ESTIMATORS: dict[str, Estimator] = {"pnp": OrientPnp, "bundle": OrientColmapBundle}


@dataclass(kw_only=True)
class Score:
    """Results of all rooms of one type."""

    n_photos: int = 0
    errors_m: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    wrong: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def row(self) -> str:
        def rms(values: list[float]) -> float:
            return float(np.sqrt(np.mean(np.square(values))))

        return (
            f"{len(self.errors_m):3d}/{self.n_photos:<3d} {100 * max(self.wrong):8.2f} "
            f"{1000 * rms(self.errors_m):8.3f} {1000 * max(self.errors_m):8.3f} "
            f"{rms(self.ratios):7.2f} {max(self.ratios):7.1f} {np.median(self.seconds):7.1f}"
        )


def context(seed: int) -> StepContext:
    folder = tempfile.TemporaryDirectory()
    _SCRATCH.append(folder)
    return StepContext(rng=np.random.default_rng(seed), cores=2, scratch=Path(folder.name))


def room(seed: int, gap: str, chosen: argparse.Namespace) -> tuple[Photos, Walls, Truth]:
    params = SimulateRoom.Params.model_validate(
        {
            "scan_step_m": 0.0026,
            "panorama_step_m": 0.012,
            "noise_m": 0.002,
            "photo_layout": chosen.layout,
            "photo_gsd_m": chosen.photo_gsd_m,
            "spectral_gap": gap,
            "spectral_inversion_share": getattr(chosen, "inverted", None),
            "textile_share": 0.33,
            "decoration": getattr(chosen, "decoration", "designed"),
        }
    )
    built = SimulateRoom().run(SimulateRoom.In(), params, context(seed))
    planes = Hough2d().run(Hough2d.In(cloud=built.cloud), Hough2d.Params(), context(1)).planes
    rastered = RasterGrid().run(
        RasterGrid.In(cloud=built.cloud, planes=planes),
        RasterGrid.Params(
            gsd_m=chosen.gsd_m,
            buffer_m=0.3,
            n_walls_max=4 if chosen.layout == "variant1" else 1,
        ),
        context(1),
    )
    return built.photos, rastered.walls, built.truth


def orient(method: Estimator, ties: Ties, photos: Photos, **params: float) -> Cameras:
    inputs, chosen = method.In(ties=ties, photos=photos), method.Params.model_validate(params)
    return method().run(inputs, chosen, context(1)).cameras


def chains(photos: Photos, walls: Walls, kinds: list[str]) -> Iterator[tuple[str, float, Cameras]]:
    """Return the name, CPU seconds and cameras of each chain."""
    from_exif = Photos(photos=tuple(replace(photo, intrinsics=None) for photo in photos.photos))
    started = time.process_time()
    ties = sifted(photos, walls)
    matched_s = time.process_time() - started
    for known, shots in (("calibrated", photos), ("exif", from_exif)):
        started = time.process_time()
        first = orient(OrientColmapBundle, ties, shots, **ROUGHLY)
        first_s = matched_s + time.process_time() - started
        for kind in kinds:
            started = time.process_time()
            again = rematched(kind, shots, walls, first)
            before_s = first_s + time.process_time() - started
            for name, method in ESTIMATORS.items():
                started = time.process_time()
                cameras = orient(method, again, shots)
                spent_s = before_s + time.process_time() - started
                yield f"{known} {kind} {name}", spent_s, cameras


def sifted(photos: Photos, walls: Walls, **params: str | bool) -> Ties:
    inputs = MatchSift.In(photos=photos, walls=walls)
    chosen = MatchSift.Params.model_validate(params)
    return MatchSift().run(inputs, chosen, context(1)).ties


def rematched(kind: str, photos: Photos, walls: Walls, first: Cameras) -> Ties:
    if kind == "unmasked":
        return sifted(photos, walls, preset="paper")
    inputs = MatchGuided.In(photos=photos, walls=walls, cameras=first)
    params = MatchGuided.Params(preset="paper" if kind == "masked" else "none")
    return MatchGuided().run(inputs, params, context(1)).ties


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", type=int, default=5, help="rooms per gap")
    parser.add_argument("--first", type=int, default=1, help="seed of the first room")
    parser.add_argument("--gaps", nargs="+", default=["easy", "hard"])
    parser.add_argument("--ties", nargs="+", default=["guided"], choices=TIES)
    parser.add_argument("--layout", default="quick", help="quick, variant1 or variant2")
    parser.add_argument("--gsd-m", type=float, default=0.004, help="cell of the wall")
    parser.add_argument("--photo-gsd-m", type=float, default=0.002, help="pixel on the wall")
    chosen = parser.parse_args()
    scores: dict[tuple[str, str], Score] = {}
    for gap in chosen.gaps:
        for seed in range(chosen.first, chosen.first + chosen.rooms):
            photos, walls, truth = room(seed, gap, chosen)
            views = SceneCameras(truth.scene, cores=2)
            for name, seconds, cameras in chains(photos, walls, chosen.ties):
                score = scores.setdefault((gap, name), Score())
                errors = pose_errors(cameras, walls, truth, views)
                good = [e for e in errors if e.status == "ok" and e.wall_m and e.sigma_wall_m]
                score.n_photos += len(errors)
                score.errors_m += [e.wall_m or 0.0 for e in good]
                score.ratios += [(e.wall_m or 0.0) / (e.sigma_wall_m or 1.0) for e in good]
                findings = {f.name: f.value for f in tie_findings(cameras, walls, truth)}
                score.wrong.append(findings["tie_wrong_share"])
                score.seconds.append(seconds)
                for error in errors:
                    if error.status != "ok":
                        print(f"{gap} {seed} {name} {error.photo}: {error.status}", flush=True)
                print(f"{gap} {seed} {name:26s} {score.row()}", flush=True)
    header = "oriented wrong[%] wall[mm] worst[mm]  ratio  worst  cpu[s]"
    print(f"\n{'':32s} {header}")
    for (gap, name), score in scores.items():
        print(f"{gap:5s} {name:26s} {score.row()}")


if __name__ == "__main__":
    main()
