"""Measure time and anonymous memory from a LAZ file to labelled planes, compared with laspy.

    python benchmarks/plane_streaming.py                           # a room of 10 million points
    python benchmarks/plane_streaming.py --points 48000000 --npy room.npy --repeats 3
    python benchmarks/plane_streaming.py --points 48000000 --npy room.npy --tiled 5

Four tasks are measured, each in a separate process: laspy decodes all chunks and keeps nothing;
laspy reads the file (`laspy.read`, then coordinates and intensities as arrays), which is the
reference; `read.scan` and a detector run in one process; and the engine runs the same two steps.
The memory is the maximum of sampled sums of RssAnon over a process and its children, which excludes
memory-mapped files, because the system can drop their pages. `--tiled n` detects planes in n copies
of the points, in memory-mapped files, and compares the time per point with that of a single copy.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).resolve()
CHUNK = 1_000_000
SAMPLED_S = 0.02
DETECTORS = ("hough2d", "ransac")
WORKFLOW = """\
orthoflow: 1
name: streaming
inputs: {{scan: {{}}}}
steps:
  cloud: {{use: read.scan, in: {{files: inputs.scan}}}}
  plane: {{use: plane.{method}, in: {{cloud: cloud.cloud}}}}
"""


@dataclass(frozen=True)
class Cost:
    """Cost of a process: elapsed and processor seconds, peak anonymous memory."""

    wall_s: float
    cpu_s: float
    anonymous_mib: float


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--npy", type=Path, help="(n, 3) float32 points instead of the room")
    parser.add_argument("--tiled", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--folder", type=Path, help="where the files go; removed unless given")
    parser.add_argument("--child", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        run_child(options.child)
        return
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        if options.tiled:
            report_tiles(folder, options)
        else:
            report_file(folder, options)


def report_file(folder: Path, options: argparse.Namespace) -> None:
    """Print the cost of reading a LAZ file and finding its planes."""
    path, points = folder / "room.laz", room(options)
    if not path.exists():
        write_laz(path, points)
    print(f"{options.points} points, {path.stat().st_size / 2**20:.0f} MiB, {os.cpu_count()} cores")
    tasks = {
        "laspy, decoding": ["decode", str(path)],
        "laspy, reading": ["read", str(path)],
        **{
            f"{name}, one process": ["process", name, str(path), scratch]
            for name in DETECTORS
            for scratch in [str(folder)]
        },
    }
    engine = {f"{name}, engine": engine_command(name, path, folder) for name in DETECTORS}
    commands = {name: child_command(arguments) for name, arguments in tasks.items()} | engine
    small = folder / "small.laz"
    write_laz(small, points[:: max(1, len(points) // 300_000)])
    del points
    for name in DETECTORS:  # so that compilation is not measured
        measured(child_command(["process", name, str(small), str(folder)]))
        measured(engine_command(name, small, folder))
    costs: dict[str, list[Cost]] = {name: [] for name in commands}
    for _ in range(options.repeats):
        for name, command in commands.items():
            costs[name].append(measured(command))
    decoding, floor = fastest(costs["laspy, decoding"]), fastest(costs["laspy, reading"])
    for name, found in costs.items():
        best = fastest(found)
        print(
            f"  {name:22} {best.wall_s:7.2f} s = {best.wall_s / floor.wall_s:.2f} x reading, "
            f"{best.wall_s / decoding.wall_s:.2f} x decoding; "
            f"processor {best.cpu_s:7.2f} s = {best.cpu_s / floor.cpu_s:.2f} x reading; "
            f"anonymous {max(cost.anonymous_mib for cost in found):6.0f} MiB"
        )


def report_tiles(folder: Path, options: argparse.Namespace) -> None:
    """Print the cost per point of finding planes in one copy and in many, from mapped files."""
    points = room(options)
    for name in ("once", "tiled"):
        copies = 1 if name == "once" else options.tiled
        for axis in range(3):
            with (folder / f"{name}_{axis}.f32").open("wb") as file:
                for _ in range(copies):
                    np.ascontiguousarray(points[:, axis]).tofile(file)
    for method in DETECTORS:
        measured(child_command(["mapped", method, str(folder), "once"]))
        per_point = {}
        for name in ("once", "tiled"):
            copies = 1 if name == "once" else options.tiled
            command = child_command(["mapped", method, str(folder), name])
            costs = [measured(command) for _ in range(options.repeats)]
            best = fastest(costs)
            count = copies * options.points
            per_point[name] = best.cpu_s / count
            print(
                f"  {method:8} {count:11d} points {best.wall_s:6.2f} s, processor "
                f"{best.cpu_s:6.2f} s = {1e9 * best.cpu_s / count:5.1f} ns a point; anonymous "
                f"{max(cost.anonymous_mib for cost in costs):6.0f} MiB"
            )
        print(f"  {method:8} per point {per_point['tiled'] / per_point['once']:.2f} x")


def room(options: argparse.Namespace) -> NDArray[np.float32]:
    """Return the points (n, 3), generated or memory-mapped."""
    if options.npy:
        stored: NDArray[np.float32] = np.load(options.npy, mmap_mode="r")[: options.points]
        options.points = len(stored)
        return stored
    from great_room import great_room

    made = great_room(options.points, cores=os.cpu_count() or 1)
    options.points = len(made.x)
    return np.column_stack([made.x, made.y, made.z])


def write_laz(path: Path, points: NDArray[np.float32]) -> None:
    """Write points as scanner software does: format 6, scale 0.1 mm, with intensity."""
    import laspy

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-4), np.zeros(3)
    rng = np.random.default_rng(1)
    with laspy.open(path, mode="w", header=header) as file:
        for start in range(0, len(points), CHUNK):
            part = np.asarray(points[start : start + CHUNK], dtype=np.float64)
            record = laspy.ScaleAwarePointRecord.zeros(len(part), header=header)
            record.x, record.y, record.z = part.T
            record.intensity = rng.integers(2**10, 2**14, len(part)).astype(np.uint16)
            file.write_points(record)


def child_command(arguments: list[str]) -> list[str]:
    return [sys.executable, str(HERE), "--child", *arguments]


def engine_command(method: str, path: Path, folder: Path) -> list[str]:
    workflow = folder / f"{method}.yaml"
    workflow.write_text(WORKFLOW.format(method=method))
    forced = ("--force", "cloud", "--force", "plane")
    run = ["run", str(workflow), "--input", f"scan={path}", *forced, "--store", str(folder / "st")]
    # Without -o, every run has a separate folder.
    return [sys.executable, "-m", "orthoflow", *run]


def run_child(arguments: list[str]) -> None:
    """Run one of the measured tasks."""
    task, *rest = arguments
    if task in {"decode", "read"}:
        read_with_laspy(Path(rest[0]), keeps=task == "read")
    elif task == "process":
        detect_in_file(rest[0], Path(rest[1]), Path(rest[2]))
    else:
        detect_mapped(rest[0], Path(rest[1]), rest[2])


def read_with_laspy(path: Path, *, keeps: bool) -> None:
    import laspy

    if keeps:
        scan = laspy.read(path)
        kept = scan.xyz, np.asarray(scan.intensity)
        del scan, kept
        return
    with laspy.open(path) as reader:
        for chunk in reader.chunk_iterator(CHUNK):
            del chunk


def detect_in_file(method: str, path: Path, folder: Path) -> None:
    from orthoflow_plugins.read.scan import ReadScan

    from orthoflow.products import InputFiles
    from orthoflow.sdk import StepContext

    def context(scratch: Path) -> StepContext:
        return StepContext(rng=np.random.default_rng(0), cores=2, scratch=scratch)

    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        files = InputFiles(name="scan", paths=(path,))
        read = ReadScan()
        cloud = read.run(ReadScan.In(files=files), ReadScan.Params(), context(Path(scratch))).cloud
        detector = method_of(method)
        detector().run(detector.In(cloud=cloud), detector.Params(), context(Path(scratch)))


def detect_mapped(method: str, folder: Path, name: str) -> None:
    from orthoflow.products import PointCloud
    from orthoflow.sdk import StepContext

    x, y, z = (np.memmap(folder / f"{name}_{axis}.f32", np.float32, "r") for axis in range(3))
    cloud = PointCloud(origin=np.zeros(3), x=x, y=y, z=z, up=np.array([0.0, 0.0, 1.0]))
    detector = method_of(method)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        ctx = StepContext(rng=np.random.default_rng(0), cores=2, scratch=Path(scratch))
        detector().run(detector.In(cloud=cloud), detector.Params(), ctx)


def method_of(name: str):  # returns a class that is only known at run time
    from orthoflow_plugins.plane.hough2d import Hough2d
    from orthoflow_plugins.plane.ransac import Ransac

    return {"hough2d": Hough2d, "ransac": Ransac}[name]


def measured(command: list[str]) -> Cost:
    """Run a command and measure it with all its child processes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start_s = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    peaks = [0]
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(SAMPLED_S):
            peaks[0] = max(peaks[0], anonymous_bytes(process.pid))

    watcher = threading.Thread(target=watch)
    watcher.start()
    said = process.communicate()[1]
    ended.set()
    watcher.join()
    if process.returncode:
        sys.exit(f"{' '.join(command)} failed: {said.decode()}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(time.perf_counter() - start_s, cpu_s, peaks[0] / 2**20)


def anonymous_bytes(pid: int) -> int:
    """Return the anonymous memory of a process and its children; 0 if they have ended."""
    total, waiting = 0, [pid]
    while waiting:
        folder = Path("/proc") / str(waiting.pop())
        try:
            lines = (folder / "status").read_text().splitlines()
            for task in (folder / "task").iterdir():
                waiting += [int(child) for child in (task / "children").read_text().split()]
        except OSError:
            continue
        total += sum(1024 * int(line.split()[1]) for line in lines if line.startswith("RssAnon"))
    return total


def fastest(costs: list[Cost]) -> Cost:
    """Return the minimum of each cost."""
    return Cost(
        min(cost.wall_s for cost in costs),
        min(cost.cpu_s for cost in costs),
        max(cost.anonymous_mib for cost in costs),
    )


if __name__ == "__main__":
    main()
