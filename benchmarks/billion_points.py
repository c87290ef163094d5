"""Measure time per point and memory from LAZ files to orthoimages, for one room and many rooms.

    python benchmarks/great_room.py room
    python benchmarks/billion_points.py --npy room/room.npy --tiles 1 21 --folder FOLDER
    python benchmarks/billion_points.py --npy room/room.npy --tiles 21 --gsd-m 0.01 --folder FOLDER

Each file contains the great room, shifted along its main wall; 21 files form a 180 m long row of
rooms with a billion points. The engine reads them, finds the planes, computes the rasters of the
walls and projects the points onto them. The memory is the maximum of sampled sums of RssAnon over
all processes, which excludes memory-mapped files. The folder needs 18 bytes per point for the store
and 4 for the files, and about 55 bytes per raster cell (21 rooms have 660 million cells of 5 mm):
60 GB in all. `--gsd-m 0.01` reduces the number of cells to a quarter. The contents of the folder
are removed at the end.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import struct
import sys
from pathlib import Path

import numpy as np
from plane_streaming import measured, write_laz

# Shift along the main wall; it leaves a gap of a few centimetres between rooms.
STEP_M = 8.7
ALONG = np.array([0.97814760, 0.20791169, 0.0])
# Positions of the offsets and of the bounds of x, y and z in a LAS 1.4 header.
OFFSETS_AT, BOUNDS_AT = 155, 179
WORKFLOW = """\
orthoflow: 1
name: billion
inputs: {{scan: {{}}}}
steps:
  cloud: {{use: read.scan, in: {{files: inputs.scan}}}}
  plane: {{use: plane.{method}, in: {{cloud: cloud.cloud}}}}
  wall: {{use: raster.grid, in: {{cloud: cloud.cloud, planes: plane.planes}}{cells}}}
  ortho: {{use: ortho.pointcloud-direct, in: {{walls: wall.walls, cloud: cloud.cloud}}}}
  mosaic: {{use: mosaic.seams, in: {{layers: ortho.layers}}}}
"""


def main() -> None:
    """Run the workflow for each number of rooms."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--npy", type=Path, required=True, help="(n, 3) float32 points")
    parser.add_argument("--points", type=int, default=48_000_000, help="of each room")
    parser.add_argument("--tiles", type=int, nargs="+", default=[1, 21])
    parser.add_argument("--method", default="hough2d")
    parser.add_argument("--gsd-m", type=float, help="side of the rasters' cells, by itself without")
    parser.add_argument("--folder", type=Path, required=True)
    wanted = parser.parse_args()
    wanted.folder.mkdir(parents=True, exist_ok=True)
    first = wanted.folder / "room_00.laz"
    stored = np.load(wanted.npy, mmap_mode="r")
    points = stored[:: max(1, round(len(stored) / wanted.points))]
    if not first.exists():
        write_laz(first, points)
    workflow = wanted.folder / "billion.yaml"
    cells = f", params: {{gsd_m: {wanted.gsd_m}}}" if wanted.gsd_m else ""
    workflow.write_text(WORKFLOW.format(method=wanted.method, cells=cells))
    run_small(wanted.folder, workflow, points)
    per_point = []
    for n_tiles in wanted.tiles:
        files = [first, *(beside(first, tile) for tile in range(1, n_tiles))]
        n_points = n_tiles * len(points)
        store, out = wanted.folder / "store", wanted.folder / "out"
        cost = measured(run_command(workflow, files, store, out))
        per_point.append(cost.cpu_s / n_points)
        print(
            f"{n_points} points, {n_tiles} files: {cost.wall_s:.0f} s, processor "
            f"{cost.cpu_s:.0f} s = {1e9 * per_point[-1]:.0f} ns a point; anonymous "
            f"{cost.anonymous_mib:.0f} MiB",
            flush=True,
        )
        print_steps(out / "products" / "metrics.csv")
        for path in (store, out):
            shutil.rmtree(path)
        for path in files[1:]:
            path.unlink()
    print(f"per point, the last beside the first: {per_point[-1] / per_point[0]:.2f} x")
    for path in (first, workflow):
        path.unlink()


def run_small(folder: Path, workflow: Path, points: np.ndarray) -> None:
    """First run the workflow on a few points, so that no compilation is measured."""
    small, store, out = folder / "small.laz", folder / "small-store", folder / "small-out"
    write_laz(small, points[:: max(1, len(points) // 300_000)])
    measured(run_command(workflow, [small], store, out))
    small.unlink()
    for path in (store, out):
        shutil.rmtree(path)


def beside(first: Path, tile: int) -> Path:
    """Copy a file, shifted by a number of rooms: change the offsets and bounds in its header."""
    path = first.with_name(f"room_{tile:02}.laz")
    if path.exists():
        return path
    shutil.copyfile(first, path)
    shift = np.round(tile * STEP_M * ALONG, 4)
    with path.open("r+b") as file:
        for at, repeat in ((OFFSETS_AT, 1), (BOUNDS_AT, 2)):
            file.seek(at)
            values = np.array(struct.unpack(f"<{3 * repeat}d", file.read(24 * repeat)))
            file.seek(at)
            # Bounds are the largest and smallest x, then y, then z.
            file.write(struct.pack(f"<{3 * repeat}d", *(values + np.repeat(shift, repeat))))
    return path


def run_command(workflow: Path, files: list[Path], store: Path, out: Path) -> list[str]:
    """Return the command that runs the workflow."""
    pattern = files[0].parent / ("room_*.laz" if len(files) > 1 else files[0].name)
    run = ["run", str(workflow), "--input", f"scan={pattern}", "--store", str(store)]
    return [sys.executable, "-m", "orthoflow", *run, "-o", str(out)]


def print_steps(table: Path) -> None:
    """Print the cost and the results of each step."""
    wanted = {"cpu_s", "wall_s", "peak_rss_mib", "n_points", "n_planes", "n_walls", "compile_s"}
    with table.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["metric"] in wanted]
    for step in dict.fromkeys(row["step"] for row in rows):
        summary = ", ".join(
            f"{row['metric']} {float(row['value']):.6g}" for row in rows if row["step"] == step
        )
        print(f"  {step:7} {summary}", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    main()
