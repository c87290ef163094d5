"""Measure orthoimages of curved walls that `photos-on-scan.yaml` makes from simulated files.

    python benchmarks/curved_orthoimages.py FOLDER --subjects barrel-vault apse
        [--seed 7] [--photos 9] [--stations 1] [--scan-step-m 0.005] [--gsd-m 0.004]
        [--only-curved] [--exif] [--known-poses]

For each subject, `simulate.curved` makes a scan (E57, with rows and columns) and photos of which
only those nearest to the middle of the curved surface are kept. The recipe reads these files, finds
the surfaces, orients the photos and makes the orthoimages, which are compared with the scene. `u`
and `v` are RMS errors on the wall, and `limit` is 0.35 mm plus a tenth of a cell. With
`--only-curved`, only the curved wall is rasterised; with `--exif`, the calibration is withheld;
with `--known-poses`, the photos have their true poses. `within_1_sigma_share` and
`within_2_sigma_share` are the shares of errors below one and two expected standard deviations (0.68
and 0.95 for a normal distribution).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from orientation_truth import context
from orthoflow_plugins.inspect.orientation_errors import pose_errors
from orthoflow_plugins.inspect.truth import InspectTruth
from orthoflow_plugins.simulate.curved import SimulateCurved
from scan_formats import write_e57

from orthoflow.files.calibration import write_calibration
from orthoflow.files.publishing import publish_cameras
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import Surface, Truth
from orthoflow.records.open import open_run

RECIPE = "photos-on-scan.yaml"
SHOWN = (
    *("rmse_u_mm", "rmse_v_mm", "nmad_u_mm", "nmad_v_mm"),
    *("patch_rmse_u_mm", "patch_rmse_v_mm", "completeness"),
    *("within_1_sigma_share", "within_2_sigma_share"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    subjects = ["barrel-vault", "apse", "column", "tower"]
    parser.add_argument("--subjects", nargs="+", default=subjects)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--photos", type=int, default=9)
    parser.add_argument("--stations", type=int)
    parser.add_argument("--scan-step-m", type=float, default=0.005)
    parser.add_argument("--photo-gsd-m", type=float, default=0.003)
    parser.add_argument("--gsd-m", type=float, default=0.004)
    parser.add_argument("--only-curved", action="store_true")
    parser.add_argument("--exif", action="store_true")
    parser.add_argument("--known-poses", action="store_true")
    options = parser.parse_args()
    for subject in options.subjects:
        folder = options.folder.resolve() / f"{subject}-{options.seed}"
        made(folder, subject, options)


def made(folder: Path, subject: str, options: argparse.Namespace) -> None:
    """Simulate a subject, run the recipe and print the errors."""
    params = SimulateCurved.Params.model_validate(
        {
            "subject": subject,
            "scan_step_m": options.scan_step_m,
            "max_stations": options.stations,
            "photo_gsd_m": options.photo_gsd_m,
        }
    )
    room = SimulateCurved().run(SimulateCurved.In(), params, context(options.seed))
    surface = room.truth.surfaces.surfaces[0]
    place = front_of(surface, room.truth)
    (folder / "photos").mkdir(parents=True, exist_ok=True)
    cameras = room.cameras.cameras
    apart = [float(np.linalg.norm(one.viewing().centre_world - place)) for one in cameras]
    for index in np.argsort(apart)[: options.photos].tolist():
        photo = room.photos.photos[index]
        (folder / "photos" / photo.name).write_bytes(photo.encoded)
    write_e57(folder / "scan.e57", room.cloud, np.arange(len(room.cloud)), is_grid=True)
    write_calibration(folder / "calibration.yaml", room.calibration)
    given = [f"scan={folder / 'scan.e57'}", f"photos={folder / 'photos'}"]
    if not options.exif:
        given.append(f"calibration={folder / 'calibration.yaml'}")
    if options.known_poses:
        publish_cameras(room.cameras, folder, "")
        given.append(f"cameras={folder / 'cameras.json'}")
    recipe = Path(__file__).parents[1] / "workflows" / RECIPE
    command = [sys.executable, "-m", "orthoflow", "run", str(recipe)]
    command += [word for each in given for word in ("--input", each)]
    command += ["--set", f"wall.gsd_m={options.gsd_m}"]
    if options.only_curved:
        command += ["--set", f"wall.near=[{np.round(place, 2).tolist()}]"]
    command += ["-o", str(folder / f"run-{os.getpid()}"), "--store", str(folder / "store")]
    subprocess.run(command, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    judged(folder / f"run-{os.getpid()}", subject, room.truth, options)


def front_of(surface: Surface, truth: Truth) -> np.ndarray:
    """Return the point of a surface nearest to the first station, at the middle of its length."""
    shape = surface.shape
    axis_point = surface.middle_world
    towards = truth.stations[0] - axis_point
    towards -= (towards @ surface.axis_world) * surface.axis_world
    if shape.is_concave:
        middle = sum(surface.arc_rad) / 2.0
        beside = np.cross(surface.axis_world, surface.zero_world)
        towards = np.cos(middle) * surface.zero_world + np.sin(middle) * beside
    return np.asarray(axis_point + surface.radius_m * towards / np.linalg.norm(towards))


def judged(run_folder: Path, subject: str, truth: Truth, options: argparse.Namespace) -> None:
    """Print the errors of the photos and of each curved wall."""
    run = open_run(run_folder)
    cells = {cell.step: cell for cell in run.cells.values()}
    failed = [step for step, cell in cells.items() if cell.status == "failed"]
    if failed or cells["mosaic"].status != "ok":
        print(f"{subject}: no orthoimage; failed: {', '.join(failed) or 'none'}", flush=True)
        return
    walls, orthoimages = run.product("wall", "walls"), run.product("mosaic", "orthoimages")
    cameras = run.product("placed" if options.known_poses else "orient", "cameras")
    oriented = [one.photo for one in cameras.cameras if one.status == "ok"]
    print(f"{subject}: {len(oriented)} of {len(cameras.cameras)} photos oriented")
    for error in pose_errors(cameras, walls, truth, SceneCameras(truth.scene, cores=2)):
        if error.status == "ok" and error.wall_m is not None:
            stated = f", expected {1e3 * error.sigma_wall_m:.2f}" if error.sigma_wall_m else ""
            print(f"  {error.photo}: on the wall {1e3 * error.wall_m:.2f} mm{stated}")
    curved = [place for place, wall in enumerate(walls.walls) if wall.frame.bend is not None]
    kept = replace(
        orthoimages,
        images=tuple(one for one in orthoimages.images if one.frame.bend is not None),
    )
    inputs = InspectTruth.In(truth=truth, orthoimages=kept, walls=walls, cameras=cameras)
    found = InspectTruth().run(inputs, InspectTruth.Params(), context(1)).inspection.findings
    for place in curved:
        values = {item.name: item.value for item in found if item.wall == place}
        shown = ", ".join(f"{name} {values[name]:.3f}" for name in SHOWN if name in values)
        limit = 0.35 + 100.0 * options.gsd_m
        print(f"  {walls.walls[place].name}: {shown}; limit {limit:.2f} mm", flush=True)


if __name__ == "__main__":
    main()
