"""Map a coloured cloud in survey coordinates, and check the borders of the map.

    python benchmarks/plan_of_cloud.py FOLDER --scan CLOUD.laz --up -z [--scale 1] [--mirrored]

Some points of the cloud are selected, and their survey coordinates are computed by a rotation, a
scale and a shift to (634512, 486215, 112). With these pairs, `orthoflow run plan.yaml` is run as
from the command line, for the whole cloud (`plane.part_min_share=0`) and in EPSG:32635. Four more
points are check points, whose positions measured in the map are 13 mm east and 8 mm south of the
true ones. The output contains the distances of the borders of the map from the outermost points, in
cells, without the points that the map omits, and the results for the check points and the scale.
`--mirrored` reverses the sign of the survey eastings.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from orthoflow.geometry import UpDirection, basis_from_up, up_vector

CORNER = np.array([634512.0, 486215.0, 112.0])
GSD_M, N_PAIRS, N_CHECKS = 0.02, 8, 4
EAST_M, SOUTH_M = 0.013, 0.008


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scan", type=Path, required=True)
    parser.add_argument("--up", default="z")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--mirrored", action="store_true")
    options = parser.parse_args()
    folder = options.folder
    folder.mkdir(parents=True, exist_ok=True)
    las = laspy.read(options.scan)
    cloud = np.column_stack([las.x, las.y, las.z])
    site = options.scale * cloud @ turn(options.up).T + CORNER
    rng = np.random.default_rng(3)
    picked, checks = np.split(rng.choice(len(cloud), N_PAIRS + N_CHECKS, replace=False), [N_PAIRS])
    surveyed = site[picked] * ([-1, 1, 1] if options.mirrored else [1, 1, 1])
    write(folder / "points.csv", "name,x,y,z", cloud[picked])
    write(folder / "control.csv", "name,x,y,z", surveyed)
    measured = site[checks, :2] + [EAST_M, -SOUTH_M]
    write(folder / "checks.csv", "name,x,y,z,map_x,map_y", np.hstack([site[checks], measured]))
    run(folder, options.scan, options.up)
    report(folder, site)


def turn(up: UpDirection) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from the cloud's up axis to z, followed by 40 degrees about z."""
    return Rotation.from_euler("z", 40, degrees=True).as_matrix() @ basis_from_up(up_vector(up))


def write(path: Path, header: str, rows: NDArray[np.float64]) -> None:
    lines = [f"P{k}," + ",".join(f"{value:.5f}" for value in row) for k, row in enumerate(rows)]
    path.write_text("\n".join([header, *lines]) + "\n")


def run(folder: Path, scan: Path, up: str) -> None:
    command = [sys.executable, "-m", "orthoflow", "run", "plan.yaml", "-o", str(folder / "run")]
    for name, file in (("points", "points"), ("control", "control"), ("checkpoints", "checks")):
        command += ["--input", f"{name}={folder / file}.csv"]
    command += ["--input", f"scan={scan}", "--store", str(folder / "store")]
    for setting in (f"cloud.up={up}", "wall.crs=EPSG:32635", "plane.part_min_share=0"):
        command += ["--set", setting]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def report(folder: Path, site: NDArray[np.float64]) -> None:
    with rasterio.open(folder / "run/products/mosaic/wall_0_ortho.tif") as dataset:
        bounds, system = np.reshape(dataset.bounds, (2, 2)), dataset.crs
    inside = ((site[:, :2] > bounds[0]) & (site[:, :2] < bounds[1])).all(axis=1)
    most = np.array([site[inside, :2].min(axis=0), site[inside, :2].max(axis=0)])
    west, south, east, north = ((bounds - most) / GSD_M).ravel()
    print(f"{system}: borders off the outermost points inside, in cells of {1e3 * GSD_M:.0f} mm:")
    print(f"west {west:+.2f}, south {south:+.2f}, east {east:+.2f}, north {north:+.2f}")
    print(f"{np.count_nonzero(~inside)} of {len(site)} points lie outside")
    with (folder / "run/products/metrics.csv").open() as stream:
        found = {(row["step"], row["metric"]): row["value"] for row in csv.DictReader(stream)}
    print(f"scale {float(found['register', 'scale']):.7f}")
    for metric in ("n_found", "mean_x_mm", "mean_y_mm"):
        print(f"check points: {metric} {float(found['points', metric]):.2f}")


if __name__ == "__main__":
    main()
