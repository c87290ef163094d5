"""Measure the orientation of six 6 MP photos on a wall of 3 million cells, step by step.

    python benchmarks/orientation_time.py [--cores 2] [--gap easy] [--exif] [--gsd-m 0.00215]

A simulated room is made before the clock starts. Then the steps of the shipped recipes run:
`match.sift`, a bundle adjustment with relaxed gates, `match.guided`, and the final bundle
adjustment. With an empty numba cache, a run takes some seconds longer because of compilation.
Elapsed times require an idle machine; CPU times do not.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from orientation_truth import ROUGHLY, room
from orthoflow_plugins.inspect.orientation_errors import pose_errors
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.match.sift import MatchSift
from orthoflow_plugins.orient.bundle import OrientColmapBundle

from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import Cameras, Photos, Ties
from orthoflow.sdk import StepContext

T = TypeVar("T")


class Clock:
    """Prints the duration of each step and the total."""

    def __init__(self) -> None:
        self.wall_s = self.cpu_s = 0.0

    def timed(self, name: str, step: Callable[[], T]) -> T:
        """Run a step."""
        wall, cpu = time.perf_counter(), time.process_time()
        result = step()
        wall_s, cpu_s = time.perf_counter() - wall, time.process_time() - cpu
        print(f"{name:24s} {wall_s:7.1f} s {cpu_s:7.1f} CPU s", flush=True)
        self.wall_s, self.cpu_s = self.wall_s + wall_s, self.cpu_s + cpu_s
        return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--gap", default="easy", help="spectral gap: easy or hard")
    parser.add_argument("--exif", action="store_true", help="lenses from EXIF alone")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--gsd-m", type=float, default=0.00215, help="cell of the wall")
    chosen = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: chosen.cores])
    size = argparse.Namespace(layout="quick", gsd_m=chosen.gsd_m, photo_gsd_m=0.00085)
    photos, walls, truth = room(chosen.seed, chosen.gap, size)
    if chosen.exif:
        photos = Photos(photos=tuple(replace(each, intrinsics=None) for each in photos.photos))
    pixels = [photo.width * photo.height / 1e6 for photo in photos.photos]
    cells = [wall.frame.width * wall.frame.height / 1e6 for wall in walls.walls]
    print(f"{len(pixels)} photos of {np.median(pixels):.1f} MP, wall of {max(cells):.1f} M cells")

    def context() -> StepContext:
        folder = Path(tempfile.mkdtemp())
        return StepContext(rng=np.random.default_rng(1), cores=chosen.cores, scratch=folder)

    def oriented(ties: Ties, **gates: float) -> Cameras:
        inputs = OrientColmapBundle.In(ties=ties, photos=photos)
        params = OrientColmapBundle.Params.model_validate(gates)
        return OrientColmapBundle().run(inputs, params, context()).cameras

    clock, sift, guided = Clock(), MatchSift(), MatchGuided()
    seen = sift.In(photos=photos, walls=walls)
    ties = clock.timed("match.sift", lambda: sift.run(seen, sift.Params(), context())).ties
    first = clock.timed("bundle, wide gates", lambda: oriented(ties, **ROUGHLY))
    known = guided.In(photos=photos, walls=walls, cameras=first)
    again = clock.timed("match.guided", lambda: guided.run(known, guided.Params(), context())).ties
    last = clock.timed("bundle", lambda: oriented(again))
    errors = pose_errors(last, walls, truth, SceneCameras(truth.scene, cores=chosen.cores))
    off_mm = [1e3 * error.wall_m for error in errors if error.status == "ok" and error.wall_m]
    rms_mm = float(np.sqrt(np.mean(np.square(off_mm))))
    print(f"{len(off_mm)} oriented, off by {rms_mm:.3f} mm on the wall (RMS)")
    print(f"{clock.wall_s:.1f} s, {clock.cpu_s:.1f} CPU s")


if __name__ == "__main__":
    main()
