"""Measure a run of `photos-on-scan.yaml` step by step, on a simulated room of any size.

    python benchmarks/photos_on_scan.py FOLDER [--points 16e6] [--photo-gsd-m 0.00085]
        [--gsd-m 0.004] [--runs 1]

First, a simulated room is made, which is not timed: `scan.e57` from one station, `photos` (by
default six of 6 MP) and `calibration.yaml`. Then `orthoflow warm photos-on-scan.yaml` is run, and
the workflow as often as requested, each time with a new store. The output contains the elapsed and
processor time of each step, its compilation, and the remaining time of the run: process starts,
storage of products, record and report. Processor times include the command and all its processes.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from orientation_truth import context
from orthoflow_plugins.simulate.room import SimulateRoom
from scan_formats import write_e57

from orthoflow.files.calibration import write_calibration
from orthoflow.products import Calibration
from orthoflow.records.open import open_run

RECIPE = "photos-on-scan.yaml"
INPUTS = {"scan": "scan.e57", "photos": "photos", "calibration": "calibration.yaml"}
# The number of points is predicted from a scan with this step; it is proportional to the inverse
# square of the step.
_COARSE_M = 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--points", type=float, default=16e6)
    parser.add_argument("--photo-gsd-m", type=float, default=0.00085)
    parser.add_argument("--gsd-m", type=float, default=0.004)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    folder = options.folder.resolve()
    if not (folder / "calibration.yaml").exists():
        folder.mkdir(parents=True, exist_ok=True)
        make(folder, options)
    variables = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "kernels")}

    def orthoflow(*words: str) -> None:
        command = [sys.executable, "-m", "orthoflow", *words]
        subprocess.run(command, check=True, env=variables, stdout=subprocess.DEVNULL)

    orthoflow("warm", RECIPE)
    given = [f"{name}={folder / path}" for name, path in INPUTS.items()]
    asked = [part for each in given for part in ("--input", each)]
    asked += ["--set", f"wall.gsd_m={options.gsd_m}"]
    for number in range(1, options.runs + 1):
        target, store = folder / f"run-{number}", folder / "store"
        for old in (target, store):
            shutil.rmtree(old, ignore_errors=True)
        clock, used = time.perf_counter(), processor_s()
        orthoflow("run", RECIPE, *asked, "-o", str(target), "--store", str(store))
        tell(target, time.perf_counter() - clock, processor_s() - used)


def make(folder: Path, options: argparse.Namespace) -> None:
    """Write the inputs, with the calibration last, which shows that all are complete."""

    def room(step_m: float, **more: object) -> SimulateRoom.Out:
        params = {"scan_step_m": step_m, "n_stations": 1, **more}
        chosen = SimulateRoom.Params.model_validate(params)
        return SimulateRoom().run(SimulateRoom.In(), chosen, context(options.seed))

    coarse = len(room(_COARSE_M, panorama_step_m=_COARSE_M, photo_layout="none").cloud)
    step_m = _COARSE_M * (coarse / options.points) ** 0.5
    made = room(
        step_m,
        panorama_step_m=step_m,
        photo_layout="quick",
        photo_gsd_m=options.photo_gsd_m,
    )
    write_e57(folder / "scan.e57", made.cloud, np.arange(len(made.cloud)), is_grid=True)
    photos = made.photos.photos
    (folder / "photos").mkdir(exist_ok=True)
    for photo in photos:
        (folder / "photos" / photo.name).write_bytes(photo.encoded)
    lenses = [photo.intrinsics for photo in photos if photo.intrinsics is not None]
    calibration = Calibration(
        patterns=tuple(photo.name for photo in photos), intrinsics=tuple(lenses)
    )
    write_calibration(folder / "calibration.yaml", calibration)
    pixels = np.median([photo.width * photo.height / 1e6 for photo in photos])
    print(
        f"{len(made.cloud) / 1e6:.1f} M points {1e3 * step_m:.2f} mm apart before the station, "
        f"{(folder / 'scan.e57').stat().st_size / 1e6:.0f} MB; {len(photos)} photos of "
        f"{pixels:.1f} MP"
    )


def processor_s() -> float:
    """Return the processor seconds of all finished child processes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def tell(run: Path, wall_s: float, cpu_s: float) -> None:
    """Print the steps of a run, longest first, and the time between them."""
    cells = [cell for cell in open_run(run).cells.values() if cell.status == "ok"]
    print(f"\n{'':10s} {'clock':>7s} {'processor':>9s} {'compiling':>9s}")
    for cell in sorted(cells, key=lambda cell: -cell.wall_s):
        compiling = cell.compile_s or 0.0
        print(f"{cell.step:10s} {cell.wall_s:7.1f} {cell.cpu_s:9.1f} {compiling:9.1f}")
    between = wall_s - sum(cell.wall_s for cell in cells)
    beside = cpu_s - sum(cell.cpu_s for cell in cells)
    print(f"{'the rest':10s} {between:7.1f} {beside:9.1f}")
    print(f"{'in all':10s} {wall_s:7.1f} {cpu_s:9.1f}", flush=True)


if __name__ == "__main__":
    main()
