"""Measure the overhead of a run apart from its methods, with cells that do nothing, by executor.

    python -m benchmarks.many_cells [--cells 1000] [--executor local] [--jobs 2]

The output is the elapsed time, in total and per cell, and the peak memory of the coordinator.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

from tests.engine_world import toy_world


def main() -> None:
    """Run the given number of cells in a new store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=1000)
    parser.add_argument("--executor", default="local")
    parser.add_argument("--jobs", type=int, default=2)
    wanted = parser.parse_args()
    steps = f"""
steps:
  first: {{use: make.range}}
  noise: {{use: work.noise, in: {{numbers: first.numbers}}, repeat: {wanted.cells - 1}}}
"""
    with (
        tempfile.TemporaryDirectory(prefix="orthoflow-cells-") as name,
        toy_world(Path(name)) as world,
    ):
        started = time.monotonic()
        outcome = world.run(steps, executor=wanted.executor, jobs=wanted.jobs)
        wall_s = time.monotonic() - started
    n_cells = len(outcome.results)
    n_failed = len(outcome.failed)
    mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{n_cells} cells, {n_failed} failed, {wanted.executor}, {wanted.jobs} at a time: "
        f"{wall_s:.0f} s, {wall_s / n_cells:.2f} s per cell, coordinator {mib:.0f} MiB"
    )


if __name__ == "__main__":
    main()
