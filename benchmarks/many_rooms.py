"""Run many rooms with several detectors on two executors, and compare digests and times.

    python benchmarks/many_rooms.py FOLDER [--rooms 24] [--photos]

A workflow with simulated rooms, four plane detectors, rasters, orthoimages and their comparison
with the truth is run with `--executor local --jobs 2` and with `--executor dask --jobs 4`, each
with a separate store, after all code has been compiled with one room. With `--photos`, orthoimages
are made from photos that the workflow orients, otherwise from points. The output is the elapsed and
the processor time of both; the exit code is 1 if a digest differs or a cell fails.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from pathlib import Path

import orthoflow

EXECUTORS = {
    "local": ("--executor", "local", "--jobs", "2"),
    "dask": ("--executor", "dask", "--jobs", "4"),
}
WORKFLOW = """\
orthoflow: 1
name: many-rooms
seed: 1729
steps:
  room:
    use: simulate.room
    params: {ROOM}
  plane:
    in: {cloud: room.cloud}
    variants:
      hough2d: {use: plane.hough2d}
      hough3d: {use: plane.hough3d}
      ransac: {use: plane.ransac}
      region: {use: plane.region}
  wall:
    use: raster.grid
    in: {cloud: room.cloud, planes: plane.planes}
    params: {gsd_m: GSD, buffer_m: 0.3, n_walls_max: 1}
PAINTING
  mosaic: {use: mosaic.seams, in: {layers: ortho.layers}}
  check:
    use: inspect.truth
    in:
      orthoimages: mosaic.orthoimages
      walls: wall.walls
      planes: plane.planes
      labels: plane.labels
      truth: room.truth
compare: {design: product, baseline: {plane: hough2d}, metrics: ["check.*"]}
"""
FROM_POINTS = "  ortho: {use: ortho.pointcloud-direct, in: {walls: wall.walls, cloud: room.cloud}}"
FROM_PHOTOS = """\
  ties: {use: match.sift, in: {photos: room.photos, walls: wall.walls}}
  first: {use: orient.pnp, in: {ties: ties.ties, photos: room.photos}}
  reties:
    use: match.guided
    in: {photos: room.photos, walls: wall.walls, cameras: first.cameras}
  orient: {use: orient.pnp, in: {ties: reties.ties, photos: room.photos}}
  ortho:
    use: ortho.dsm-backward
    in: {walls: wall.walls, cloud: room.cloud, photos: room.photos, cameras: orient.cameras}"""


def main() -> None:
    """Run with both executors and compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rooms", type=int, default=24)
    parser.add_argument("--photos", action="store_true")
    wanted = parser.parse_args()
    folder: Path = wanted.folder
    folder.mkdir(parents=True, exist_ok=True)
    write_workflow(folder, n_rooms=wanted.rooms, has_photos=wanted.photos)
    run(folder, "warm", ("--only-data", "room00"))
    seconds = {name: run(folder, name, chosen) for name, chosen in EXECUTORS.items()}
    ours, theirs = (orthoflow.open_run(folder / name) for name in EXECUTORS)
    bad = [
        address
        for address, cell in ours.cells.items()
        if cell.status != "ok"
        or {port: item.digest for port, item in cell.outputs.items()}
        != {port: item.digest for port, item in theirs.cells[address].outputs.items()}
    ]
    print(f"{len(ours.cells)} cells, {len(bad)} failed or with other digests: {bad[:5]}")
    print(f"dask over local: {seconds['dask'] / seconds['local']:.2f} x")
    sys.exit(1 if bad or set(ours.cells) != set(theirs.cells) else 0)


def write_workflow(folder: Path, *, n_rooms: int, has_photos: bool) -> None:
    """Write the workflow, and a table of rooms with different designs, noise and stations."""
    scan = "{scan_step_m: 0.02, panorama_step_m: 0.03, decoration: drawn}"
    shot = "{scan_step_m: 0.008, panorama_step_m: 0.03, photo_layout: quick, photo_gsd_m: 0.006}"
    text = WORKFLOW.replace("{ROOM}", shot if has_photos else scan)
    text = text.replace("GSD", "0.01" if has_photos else "0.02")
    text = text.replace("PAINTING", FROM_PHOTOS if has_photos else FROM_POINTS)
    (folder / "rooms.yaml").write_text(text)
    columns = "name,room.noise_m,room.n_stations" + ("" if has_photos else ",room.design_seed")
    rows = [
        f"room{k:02},{0.0005 + 0.0002 * k:.4f},{1 + k % 2}" + ("" if has_photos else f",{k}")
        for k in range(n_rooms)
    ]
    (folder / "rooms.csv").write_text("\n".join([columns, *rows]) + "\n")


def run(folder: Path, name: str, chosen: tuple[str, ...]) -> float:
    """Run the workflow; return the elapsed seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    started_s = time.monotonic()
    command = [sys.executable, "-m", "orthoflow", "run", "rooms.yaml", "--datasets", "rooms.csv"]
    places = ("--store", f"store-{name}", "-o", name)
    subprocess.run([*command, *places, *chosen], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    wall_s = time.monotonic() - started_s
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{name}: {wall_s:.0f} s, processor {cpu_s:.0f} s", flush=True)
    return wall_s


if __name__ == "__main__":
    main()
