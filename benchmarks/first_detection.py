"""Test whether the times of a plane detector depend on compilation.

    python benchmarks/repeated_times.py FOLDER --runs 1
    python benchmarks/first_detection.py FOLDER [--methods plane.ransac ...] [--warm 2]

Each method processes the cloud of `FOLDER/1`, first in a process that loads and compiles everything
itself, then in processes that find compiled kernels. The output contains `first_plane_s` and
`detection_s`, which are measured like `StepContext.clock_s` but in processor time, which other load
on the machine hardly affects.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine.measuring import LoadingMeter
from orthoflow.engine.store import Store
from orthoflow.products import PointCloud
from orthoflow.records.open import open_run
from orthoflow.sdk import StepContext

METHODS = ("plane.hough2d", "plane.hough3d", "plane.ransac", "plane.region")
TIMES = ("first_plane_s", "detection_s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--warm", type=int, default=2)
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        print(measured(options.folder, options.methods[0]))
        return
    for method in options.methods:
        with tempfile.TemporaryDirectory() as kernels:
            command = [sys.executable, __file__, str(options.folder), "--here", "--methods", method]
            for number in range(1 + options.warm):
                said = subprocess.run(
                    command,
                    check=True,
                    capture_output=True,
                    text=True,
                    env={**os.environ, "NUMBA_CACHE_DIR": kernels},
                )
                print(f"{method:16s} {'warm' if number else 'cold'}  {said.stdout.strip()}")


def measured(folder: Path, method: str) -> str:
    """Run a method in this process; return processor seconds with and without loading."""
    room = open_run(folder / "1").cell("room")
    given = {"cloud": Store(folder / "store").get_product(room.outputs["cloud"].digest, PointCloud)}
    cls = discover_catalog().method(method).load()
    meter = LoadingMeter()
    with meter, tempfile.TemporaryDirectory() as scratch:
        ctx = StepContext(
            rng=np.random.default_rng(7),
            cores=2,
            scratch=Path(scratch),
            clock_s=lambda: time.process_time() - meter.processor_s,
        )
        cls().run(cls.In(**given), cls.Params(), ctx)
    found = {metric.name: metric.value for metric in ctx.metrics}
    times = ", ".join(f"{name} {found[name]:.2f}" for name in TIMES)
    return f"{times}, loading and compiling {meter.processor_s:.1f} s of processor time"


if __name__ == "__main__":
    main()
