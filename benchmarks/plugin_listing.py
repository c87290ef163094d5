"""Measure `orthoflow --help` and `orthoflow plugins list` with many plugins installed.

python benchmarks/plugin_listing.py [--plugins 30] [--runs 7]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

HOOKS = """\
from orthoflow.sdk import MethodSpec, hookimpl


@hookimpl
def orthoflow_methods():
    return [MethodSpec(id="plane.many{n}", target="many{n}.method:Many", summary="one of many")]
"""


@dataclass(frozen=True)
class Took:
    """Times of one run, in seconds."""

    wall_s: float
    cpu_s: float


def install(site: Path, n_plugins: int) -> None:
    """Write the given number of distributions to a folder, as pip would."""
    for n in range(n_plugins):
        package, info = site / f"many{n}", site / f"many_{n}-1.0.dist-info"
        package.mkdir()
        info.mkdir()
        (package / "__init__.py").write_text("")
        (package / "hooks.py").write_text(HOOKS.format(n=n))
        (package / "method.py").write_text("import numpy\n")
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: many-{n}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[orthoflow.plugins]\nmany{n} = many{n}.hooks\n")


def run(command: list[str], site: Path) -> Took:
    """Run an orthoflow command once."""
    path = os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    started = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "orthoflow", *command],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
    )
    output = process.stdout.read() if process.stdout else b""
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(output.decode())
    return Took(time.perf_counter() - started, usage.ru_utime + usage.ru_stime)


def main() -> None:
    """Print the medians of some runs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plugins", type=int, default=30)
    parser.add_argument("--runs", type=int, default=7)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        site = Path(folder)
        install(site, arguments.plugins)
        for command in (["--help"], ["plugins", "list"]):
            run(command, site)  # writes the bytecode
            runs = [run(command, site) for _ in range(arguments.runs)]
            cpu = sorted(took.cpu_s for took in runs)
            wall = sorted(took.wall_s for took in runs)
            middle = len(runs) // 2
            print(
                f"orthoflow {' '.join(command):14} with {arguments.plugins} plugins: "
                f"{cpu[middle]:.2f} s CPU ({cpu[0]:.2f} to {cpu[-1]:.2f}), "
                f"{wall[middle]:.2f} s wall"
            )


if __name__ == "__main__":
    main()
