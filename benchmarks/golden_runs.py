"""Make golden runs with the installed code, and list the differences between two sets of them.

    python benchmarks/golden_runs.py make FOLDER [--only quickstart,hall]
    python benchmarks/golden_runs.py compare BEFORE AFTER

`make` runs the quickstart with three seeds, `plane-methods.yaml` and, if the real data are in
../shared/data, the hall (coloured scan only) and the fountain with and without a calibration. It
keeps the output of each command and, if Chromium is installed, a picture of each report. `compare`
prints, for each run, the planes, poses and orthoimages that changed, and the metrics that changed
by more than rounding errors. Make the runs of an earlier commit in a worktree of that commit. The
repository contains no real data.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import rasterio

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from tests.browser import IS_HERE, Page, started  # noqa: E402

DATA = ROOT.parent / "shared" / "data"
FOUNTAIN = DATA / "fountain-p11"
# The cloud of the fountain comes from the other six photos.
FOUNTAIN_PHOTOS = [f"{k:04d}.jpg" for k in (0, 3, 6, 9, 10)]
FOUNTAIN_LENS = (
    'cameras: {"*": {width: 3072, height: 2048, fx: 2759.48, fy: 2764.16,'
    " cx: 1520.69, cy: 1006.81, distortion: [0, 0, 0, 0, 0]}}\n"
)
# Suffixes of costs, which differ between runs.
COSTS = ("_s", "_mib", "_bytes")
ROUNDING = 1e-6


def runs(folder: Path) -> dict[str, list[str]]:
    """Return the arguments of `orthoflow run` for each golden run possible here."""
    quickstart = (ROOT / "workflows" / "quickstart.yaml").read_text()
    found = {"quickstart": ["quickstart.yaml"], "planes": ["plane-methods.yaml"]}
    for seed in (41, 42):
        path = folder / f"room{seed}.yaml"
        path.write_text(quickstart.replace("\nseed: 1729\n", f"\nseed: {seed}\n"))
        found[f"room{seed}"] = [str(path)]
    if not DATA.is_dir():
        return found
    photos, lens = folder / "fountain-photos", folder / "lens.yaml"
    photos.mkdir(exist_ok=True)
    for name in FOUNTAIN_PHOTOS:
        if not (photos / name).exists():
            (photos / name).symlink_to(FOUNTAIN / "images" / name)
    lens.write_text(FOUNTAIN_LENS)
    fountain = [
        *("photos-on-scan.yaml", "--input", f"scan={FOUNTAIN / 'cloud_from_photos.laz'}"),
        *("--input", f"photos={photos}", "--set", "cloud.up=-z", "--set", "wall.gsd_m=0.01"),
    ]
    wall = DATA / "heritage-hall-west-wall" / "west_wall.laz"
    return {
        **found,
        "hall": ["direct.yaml", "--input", f"scan={wall}", "--set", "wall.gsd_m=0.01"],
        "fountain": fountain,
        "fountain_k": [*fountain, "--input", f"calibration={lens}"],
    }


def make(folder: Path, only: set[str]) -> None:
    """Make the golden runs in a folder with a common store."""
    folder.mkdir(parents=True, exist_ok=True)
    folder = folder.resolve()
    for name, words in runs(folder).items():
        if only and name not in only:
            continue
        command = [sys.executable, "-m", "orthoflow", "run", *words]
        command += ["-o", str(folder / name), "--store", str(folder / "store")]
        begun = time.monotonic()
        with (folder / f"{name}.txt").open("w") as transcript:
            code = subprocess.call(command, stdout=transcript, stderr=subprocess.STDOUT)
        print(f"{name}: exit code {code}, {time.monotonic() - begun:.1f} s", flush=True)
        if code == 0 and IS_HERE:
            with started() as browser:
                page = Page(browser)
                page.show_as(1440)
                page.open(folder / name / "report.html")
                (folder / f"{name}.png").write_bytes(page.screenshot(whole=True))


def compare(before: Path, after: Path) -> None:
    """Print the differences between two sets of golden runs."""
    for folder in sorted(path.parent for path in after.glob("*/run.h5")):
        name = folder.name
        if not (before / name / "run.h5").exists():
            print(f"## {name}: only in {after}")
            continue
        print(f"## {name}")
        products = {
            path.relative_to(root / "products")
            for root in (before / name, folder)
            for path in (root / "products").rglob("*")
            if path.name in ("planes.json", "cameras.json") or path.name.endswith("_ortho.tif")
        }
        for product in sorted(products):
            pair = [root / "products" / product for root in (before / name, folder)]
            missing = [str(path) for path in pair if not path.exists()]
            moved = f"missing: {missing[0]}" if missing else of_product(*pair)
            if moved:
                print(f"{product}: {moved}")
        of_metrics(metrics(before / name), metrics(folder))


def of_product(first: Path, second: Path) -> str:
    """Describe the changes of a product; empty if there are none."""
    if first.name.endswith(".tif"):
        with rasterio.open(first) as one, rasterio.open(second) as other:
            if one.shape != other.shape:
                return f"{one.shape} -> {other.shape} cells"
            grey = [np.asarray(f.read(), float) for f in (one, other)]
            painted = [f.dataset_mask() > 0 for f in (one, other)]
        both = painted[0] & painted[1]
        far = np.abs(grey[0] - grey[1]).max(axis=0)[both]
        if painted[0].sum() == painted[1].sum() == both.sum() and not far.any():
            return ""
        shares = " -> ".join(f"{100 * mask.mean():.2f} %" for mask in painted)
        return f"painted {shares}; {100 * (far > 8).mean():.2f} % of both differ by over 8 grey"
    old, new = (json.loads(path.read_text()) for path in (first, second))
    if first.name == "planes.json":
        return of_planes(old["planes"], new["planes"])
    lines = []
    for photo in sorted(old["cameras"].keys() | new["cameras"].keys()):
        one, other = (cameras["cameras"].get(photo, {}) for cameras in (old, new))
        states = [str(camera.get("status")) for camera in (one, other)]
        if states[0] != states[1]:
            lines.append(f"{photo} {states[0]} -> {states[1]}")
        elif states[0] == "ok":
            apart = 1000 * np.linalg.norm(centre(one) - centre(other))
            if apart > ROUNDING:
                lines.append(f"{photo} {apart:.2f} mm apart")
    return "; ".join(lines)


def of_planes(old: list[dict[str, object]], new: list[dict[str, object]]) -> str:
    """Describe how much planes changed relative to the nearest earlier plane."""
    if old == new:
        return ""
    lines = [f"{len(old)} -> {len(new)} planes"] if len(old) != len(new) else []
    normals = np.array([plane["normal"] for plane in old])
    offsets = np.array([plane["offset_m"] for plane in old])
    for k, plane in enumerate(new):
        cosines = normals @ np.asarray(plane["normal"])
        apart = np.abs(offsets * np.sign(cosines) - float(str(plane["offset_m"])))
        nearest = int(np.argmin(apart + 10.0 * (1.0 - np.abs(cosines))))
        turned = np.degrees(np.arccos(min(1.0, abs(cosines[nearest]))))
        if turned > 1e-5 or apart[nearest] > 1e-7:
            lines.append(f"{k}: {turned:.4f} deg, {1000 * apart[nearest]:.3f} mm")
    return "; ".join(lines)


def centre(camera: dict[str, object]) -> np.ndarray:
    """Return the world position of a photo's camera."""
    rotation = np.asarray(camera["R_camera_from_world"])
    return -rotation.T @ np.asarray(camera["t_camera_from_world"])


def metrics(run: Path) -> dict[tuple[str, str], float]:
    """Return the metrics of a run by cell and name, without costs."""
    with (run / "products" / "metrics.csv").open(newline="") as file:
        return {
            (row["cell"], row["metric"]): float(row["value"])
            for row in csv.DictReader(file)
            if not row["metric"].endswith(COSTS)
        }


def of_metrics(old: dict[tuple[str, str], float], new: dict[tuple[str, str], float]) -> None:
    """Print metrics that changed, and those that only one of the runs has."""
    moved = [
        f"  {cell} {name}: {old[cell, name]:.6g} -> {new[cell, name]:.6g}"
        for cell, name in sorted(old.keys() & new.keys())
        if not np.isclose(old[cell, name], new[cell, name], rtol=ROUNDING, equal_nan=True)
    ]
    print(f"{len(moved)} of {len(old.keys() & new.keys())} metrics moved", *moved, sep="\n")
    for what, names in (("gone", old.keys() - new.keys()), ("new", new.keys() - old.keys())):
        if names:
            print(f"{what}: {', '.join(sorted({name for _, name in names}))}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make")
    making.add_argument("folder", type=Path)
    making.add_argument("--only", default="", help="names of runs, with commas between")
    comparing = commands.add_parser("compare")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    given = parser.parse_args()
    if given.command == "make":
        make(given.folder, set(filter(None, given.only.split(","))))
    else:
        compare(given.before, given.after)


if __name__ == "__main__":
    main()
