"""Measure how often errors of an orthoimage are within one and two expected standard deviations.

    python benchmarks/expected_errors.py [--rooms 6] [--first 11] [--fountain] [--store FOLDER]

Each drawn room runs through all steps of `quickstart.yaml`, from points and photos, and is compared
with the truth of the simulation (`inspect.truth`). `--fountain` uses five photos in
../shared/data/fountain-p11 instead and compares with their reference poses, at the depths that were
found, so depth errors are not included. For a normal distribution, the shares are 0.68 and 0.95.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.products import Camera, Cameras, Orthoimages, Walls
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run

ROOT = Path(__file__).resolve().parents[1]
FOUNTAIN = ROOT.parent / "shared" / "data" / "fountain-p11"
PHOTOS = ("0000", "0003", "0006", "0009", "0010")
CAMERA_MATRIX = np.array([[2759.48, 0.0, 1520.69], [0.0, 2764.16, 1006.81], [0.0, 0.0, 1.0]])
LENS = (
    'cameras: {"*": {width: 3072, height: 2048, fx: 2759.48, fy: 2764.16, cx: 1520.69,'
    " cy: 1006.81, distortion: [0, 0, 0, 0, 0]}}\n"
)
_ASKED = 50_000


def main() -> None:
    """Print a row for each room, or for each photo of the fountain."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=6)
    parser.add_argument("--first", type=int, default=11)
    parser.add_argument("--fountain", action="store_true")
    parser.add_argument("--store", type=Path, default=Path(".orthoflow"))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        if given.fountain:
            fountain(Path(name), given.store)
            return
        for seed in range(given.first, given.first + given.rooms):
            drawn = ("room.decoration=drawn", f"room.design_seed={seed}")
            folder = orthoflow_run(
                "quickstart.yaml", drawn, (), Path(name) / str(seed), given.store
            )
            with (folder / "products" / "metrics.csv").open(encoding="utf-8") as stream:
                found = {row["metric"]: row["value"] for row in csv.DictReader(stream)}
            shares = [float(found[f"within_{n}_sigma_share"]) for n in (1, 2)]
            print(f"room {seed}: {shares[0]:.3f} {shares[1]:.3f}", flush=True)


def orthoflow_run(
    workflow: str, settings: tuple[str, ...], inputs: tuple[str, ...], folder: Path, store: Path
) -> Path:
    """Run a workflow; return its folder."""
    command = [sys.executable, "-m", "orthoflow", "run", str(ROOT / "workflows" / workflow)]
    command += [word for item in settings for word in ("--set", item)]
    command += [word for item in inputs for word in ("--input", item)]
    command += ["-o", str(folder), "--store", str(store)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return folder


def fountain(folder: Path, store: Path) -> None:
    """Compare the photos of the fountain with their reference poses."""
    photos = folder / "photos"
    photos.mkdir()
    for name in PHOTOS:
        (photos / f"{name}.jpg").symlink_to(FOUNTAIN / "images" / f"{name}.jpg")
    (folder / "lens.yaml").write_text(LENS, encoding="utf-8")
    inputs = (
        f"scan={FOUNTAIN / 'cloud_from_photos.laz'}",
        f"photos={photos}",
        f"calibration={folder / 'lens.yaml'}",
    )
    settings = ("cloud.up=-z", "wall.gsd_m=0.01")
    run = open_run(orthoflow_run("photos-on-scan.yaml", settings, inputs, folder / "run", store))
    cameras = {item.photo: item for item in last(run, Cameras).cameras}
    walls = {wall.name: wall for wall in last(run, Walls).walls}
    errors, counts = [], []
    for image in last(run, Orthoimages).images:
        if image.error_m is None:
            continue
        for index, photo in enumerate(image.sources):
            rows, columns = np.nonzero((image.source == index) & np.isfinite(image.error_m))
            if not len(rows):
                continue
            asked = np.random.default_rng(1).permutation(len(rows))[:_ASKED]
            places = np.column_stack([columns[asked], rows[asked]]) + 0.5
            depths_m = walls[image.name].depth_m[rows[asked], columns[asked]].astype(np.float64)
            apart_m = moved_m(image.frame, places, np.nan_to_num(depths_m), cameras[photo])
            sigmas = np.abs(apart_m) / image.error_m[rows[asked], columns[asked], None]
            rms = 1e3 * np.sqrt(np.mean(apart_m**2, axis=0))
            stated = 1e3 * float(np.median(image.error_m[rows[asked], columns[asked]]))
            print(f"{image.name}, {photo}: RMS {rms[0]:.2f}, {rms[1]:.2f} mm, stated {stated:.2f}")
            errors.append(sigmas)
            counts.append(len(rows))
    for limit in (1.0, 2.0):
        shares = [float(np.mean(item < limit)) for item in errors]
        print(f"within {limit:g} sigma: {np.average(shares, weights=counts):.3f}")


def last(run: Run, kind: type) -> object:
    """Return the last product of a type in the record."""
    for address in reversed(list(run.cells)):
        for port, output in run.cells[address].outputs.items():
            if output.type_name == kind.type_name and output.embedded:
                return run.product(address, port)
    raise SystemExit(f"the run has no {kind.type_name}")


def moved_m(
    frame: WallFrame, places: NDArray[np.float64], depths_m: NDArray[np.float64], camera: Camera
) -> NDArray[np.float64]:
    """Return the displacements (n, 2) of a photo's content at cells, by its reference pose."""
    points = frame.world_from_wall(places, depths_m)
    pixels = camera.viewing().project(points)[:, :2] - 0.5
    words = (FOUNTAIN / "images" / f"{camera.photo}.camera").read_text(encoding="utf-8").split()
    rotation = np.array(words[12:21], dtype=np.float64).reshape(3, 3)
    centre = np.array(words[21:24], dtype=np.float64)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(CAMERA_MATRIX).T
    rays = rays @ rotation.T
    along = ((points - centre) @ frame.normal_world) / (rays @ frame.normal_world)
    met = centre + along[:, None] * rays
    return np.asarray((met - points) @ np.array([frame.u_world, frame.v_world]).T)


if __name__ == "__main__":
    main()
