"""Find the targets of a real scan in intensity orthoimages, and compute their 3D positions.

    python benchmarks/scan_targets.py FOLDER [--targets T1 T2 T3] [--gsd-m 0.0013]

FOLDER contains scan patches around targets, `T1.1.txt` and so on (x y z r g b intensity, metres),
and `target_centers_SP1.json`, the centres measured by operators: for each target, a list with one
point per patch. For each patch, a plane is fitted, then `scan_targets.yaml` is run as from the
command line. This workflow computes an intensity orthoimage, the intersection of the quadrants, and
the position on the surface. The output is the RMS and the maximum of the distances from the
operators' centres, in the plane and in space.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

WORKFLOW = Path(__file__).with_name("scan_targets.yaml")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--targets", nargs="+", default=["T1", "T2", "T3"])
    parser.add_argument("--gsd-m", type=float, default=0.0013, help="cell of the intensity")
    parser.add_argument("--keep", type=Path, help="folder for the runs, with their pictures")
    chosen = parser.parse_args()
    centres = json.loads((chosen.folder / "target_centers_SP1.json").read_text())
    apart_mm = []
    with tempfile.TemporaryDirectory() as scratch:
        runs = chosen.keep or Path(scratch)
        runs.mkdir(parents=True, exist_ok=True)
        print(f"{'patch':6s} {'in the plane[mm]':>17s} {'in space[mm]':>13s}")
        for name in chosen.targets:
            for repeat, centre in enumerate(centres[name], start=1):
                patch = f"{name}.{repeat}"
                found = _metrics(chosen.folder / f"{patch}.txt", centre, runs, chosen.gsd_m)
                apart_mm.append((found["rms_mm"], found["max_3d_mm"]))
                print(f"{patch:6s} {apart_mm[-1][0]:17.2f} {apart_mm[-1][1]:13.2f}", flush=True)
    plane_mm, space_mm = np.array(apart_mm).T
    for kind, values in (("in the plane", plane_mm), ("in space", space_mm)):
        rms_mm = float(np.sqrt(np.mean(values**2)))
        print(f"{kind}: {len(values)} patches, RMS {rms_mm:.2f} mm, largest {values.max():.2f} mm")


def _metrics(patch: Path, centre: list[float], runs: Path, gsd_m: float) -> dict[str, float]:
    """Run the workflow for one patch; return the metrics of its check point."""
    run = runs / patch.stem
    survey = runs / f"{patch.stem}.csv"
    survey.write_text("name,x,y,z\n" + ",".join([patch.stem, *map(repr, centre)]) + "\n")
    normal, offset_m = paper_plane(np.loadtxt(patch, comments="//", usecols=(0, 1, 2)))
    inputs = ["--input", f"scan={patch}", "--input", f"checkpoints={survey}"]
    inputs += ["--set", f"plane.normal={normal.tolist()}", "--set", f"plane.offset_m={offset_m}"]
    # Use a new store each time, so that no results of an earlier run are used.
    command = ["-m", "orthoflow", "run", str(WORKFLOW), *inputs, "-o", str(run)]
    command += ["--set", f"wall.gsd_m={gsd_m}", "--store", str(runs / "store")]
    ended = subprocess.run([sys.executable, *command], capture_output=True, text=True, check=False)
    if ended.returncode:
        raise SystemExit(f"{patch.name}: {ended.stdout}{ended.stderr}")
    with (run / "products" / "metrics.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["step"] == "points"]
    return {row["metric"]: float(row["value"]) for row in rows}


def paper_plane(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Fit the plane of the paper without its holder: normal towards the scanner, and offset."""
    near = np.ones(len(points), dtype=np.bool_)
    for _ in range(10):
        middle = points[near].mean(axis=0)
        normal = np.linalg.svd(points[near] - middle, full_matrices=False)[2][2]
        off = (points - middle) @ normal
        near = np.abs(off) < max(4.0 * float(np.median(np.abs(off[near]))), 0.001)
    normal = -normal * np.sign(normal @ middle)
    return normal, float(normal @ middle)


if __name__ == "__main__":
    main()
