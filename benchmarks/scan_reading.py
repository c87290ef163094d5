"""Measure time and memory of reading large scans with one and two cores; compare the clouds.

    python benchmarks/scan_reading.py FOLDER [--points 12000000] [--files 2]

writes files of points with intensity, as E57 and as PLY, and reads the files of each format with
`read.scan`, alternately, each time in a new process. The output is the elapsed time, the processor
time and the anonymous memory, over all processes, of the fastest of `--repeats` runs.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np
from exported_clouds import mapped_room
from orthoflow_plugins.read.scan import ReadScan
from plane_streaming import fastest, measured

from orthoflow.engine.store import digest_of
from orthoflow.files.clouds.attributes import AttributedCloud
from orthoflow.files.clouds.neighbourhoods import neighbourhoods_of
from orthoflow.files.clouds.writers import write_e57, write_ply
from orthoflow.products import InputFiles
from orthoflow.sdk import StepContext

WRITERS = {"e57": write_e57, "ply": write_ply}


def main() -> None:
    """Write the files, read them and compare the clouds; with --read, only read in this process."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--points", type=int, default=12_000_000, help="of each file")
    parser.add_argument("--files", type=int, default=2, help="of each format")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--read", nargs=2, metavar=("FORMAT", "CORES"), help=argparse.SUPPRESS)
    wanted = parser.parse_args()
    if wanted.read:
        print(read(wanted.folder, wanted.read[0], int(wanted.read[1])))
        return
    wanted.folder.mkdir(parents=True, exist_ok=True)
    write(wanted.folder, wanted.points, wanted.files)
    for name in WRITERS:
        command = [sys.executable, __file__, str(wanted.folder), "--read", name]
        digests = {subprocess.check_output([*command, cores]) for cores in "12"}
        costs: dict[str, list] = {"1": [], "2": []}
        for _ in range(wanted.repeats):
            for cores, found in costs.items():
                found.append(measured([*command, cores]))
        for cores, found in costs.items():
            cost = fastest(found)
            print(
                f"{name}, {wanted.files} x {wanted.points} points, {cores} cores: "
                f"{cost.wall_s:.2f} s, processor {cost.cpu_s:.2f} s, anonymous "
                f"{cost.anonymous_mib:.0f} MiB",
                flush=True,
            )
        print(f"{name}: {'the same' if len(digests) == 1 else 'OTHER'} clouds", flush=True)
        if len(digests) > 1:
            sys.exit(1)


def write(folder: Path, n_points: int, n_files: int) -> None:
    """Write a room, and links to it in place of other files."""
    cloud = mapped_room(folder, n_points)
    attributed = AttributedCloud(
        cloud=cloud, colouring="intensity", neighbourhoods=neighbourhoods_of(cloud)
    )
    for name, write_cloud in WRITERS.items():
        first = folder / f"room_0.{name}"
        if not first.exists():
            write_cloud(first, attributed)
        for k in range(1, n_files):
            other = folder / f"room_{k}.{name}"
            if not other.exists():
                other.hardlink_to(first)


def read(folder: Path, name: str, cores: int) -> str:
    """Read all files of a format; return the digest of the cloud."""
    scratch = folder / f"scratch-{name}-{cores}"
    scratch.mkdir(exist_ok=True)
    ctx = StepContext(rng=np.random.default_rng(0), cores=cores, scratch=scratch)
    files = InputFiles(name="scan", paths=tuple(sorted(folder.glob(f"room_*.{name}"))))
    return digest_of(ReadScan().run(ReadScan.In(files=files), ReadScan.Params(), ctx).cloud)


if __name__ == "__main__":
    main()
