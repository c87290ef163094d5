"""Measure accuracy and time of `surface.*`, and of other programs, on simulated buildings.

As in the recipes, spheres, cylinders and cones are searched in all buildings, in this order; times
are those of `surface.cylinder`. Spheres have no axis, and `place` is the error of their centre.

    python benchmarks/surface_detectors.py                        # 10 drawn buildings of each kind
    python benchmarks/surface_detectors.py --rooms 50             # rooms of planes: none found
    python benchmarks/surface_detectors.py --points 10000000      # time in F
    python benchmarks/surface_detectors.py --peers

F is the time of one pass over separate x, y and z arrays at full memory bandwidth, measured in the
same run (`plane_detectors.py`). Code has been compiled, and points are in memory.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
import typing
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.simulate.curved import SimulateCurved
from orthoflow_plugins.simulate.curved_model import Subject
from orthoflow_plugins.simulate.room import SimulateRoom
from orthoflow_plugins.surface.cylinder import SurfaceCylinder
from orthoflow_plugins.surface.detection import Detection, detect
from orthoflow_plugins.surface.search import Form
from plane_detectors import pass_s

from orthoflow.geometry import Cone, Sphere
from orthoflow.products import PointCloud, Surface, Surfaces, Truth
from orthoflow.sdk import Method, StepContext

SUBJECTS = ("barrel-vault", "cross-vault", "apse", "tower", "column")


def simulated(method: type[Method], seed: int, **params: object) -> tuple[PointCloud, Truth]:
    with tempfile.TemporaryDirectory() as folder:
        ctx = StepContext(rng=np.random.default_rng(seed), cores=2, scratch=Path(folder))
        made = method().run(method.In(), method.Params.model_validate(params), ctx)
    return made.cloud, made.truth


def detected(
    cloud: PointCloud,
    seed: int = 0,
    *,
    form: Form = "cylinder",
    earlier: tuple[Surfaces | None, NDArray[np.int16] | None] = (None, None),
    **params: object,
) -> Detection:
    known = SurfaceCylinder.Params.model_validate(params)
    ctx = StepContext(rng=np.random.default_rng(seed), cores=2, scratch=Path())
    return detect(cloud, earlier[1], earlier[0], known, ctx, form=form)


def detected_in_turn(cloud: PointCloud, seed: int) -> tuple[Surface, ...]:
    """Return the surfaces of all forms, found in the order of the recipes."""
    found, labels = Surfaces(surfaces=(), up=cloud.up), None
    for form in typing.get_args(Form):
        new = detected(cloud, seed, form=form, earlier=(found, labels))
        found, labels = replace(found, surfaces=found.surfaces + new.surfaces), new.labels
    return found.surfaces


def errors(found: Surface, true: Surface) -> tuple[float, float, float]:
    """Return errors of axis (degrees), radius and place of the axis (mm) at the found middle."""
    apart = found.middle_world - true.middle_world
    if isinstance(true.shape, Sphere):
        off = float(np.linalg.norm(apart))
        return 0.0, 1000.0 * (found.radius_m - true.radius_m), 1000.0 * off
    axis, radius_m = true.axis_world, true.radius_m
    sine = float(np.linalg.norm(np.cross(found.axis_world, axis)))
    turn = math.degrees(math.asin(min(1.0, sine)))
    if isinstance(true.shape, Cone):
        radius_m += float(apart @ axis) * math.tan(true.shape.half_angle_rad)
    apart = apart - float(apart @ axis) * axis
    return turn, 1000.0 * (found.radius_m - radius_m), 1000.0 * float(np.linalg.norm(apart))


def report_accuracy(options: argparse.Namespace) -> None:
    print("| building | seeds | found, more | axis deg | radius mm | place mm | error / expected |")
    print("|---|---|---|---|---|---|---|")
    for subject in options.subject or SUBJECTS:
        rows, n_true, n_more = [], 0, 0
        for seed in range(options.seeds):
            cloud, truth = simulated(
                SimulateCurved,
                seed,
                subject=subject,
                scan_step_m=options.step,
                noise_m=options.noise_mm / 1000.0,
            )
            found = list(detected_in_turn(cloud, seed))
            for true in truth.surfaces.surfaces:
                n_true += 1
                own = [
                    item
                    for item in found
                    if isinstance(item.shape, type(true.shape)) and errors(item, true)[0] < 1.0
                ]
                if own:
                    best = min(own, key=lambda item: errors(item, true)[2])
                    found = [item for item in found if item is not best]
                    measured = errors(best, true)
                    ratio = abs(measured[1]) / (1000.0 * best.sigma_radius_m)
                    turn_ratio = measured[0] / best.sigma_axis_deg if measured[0] else 0.0
                    rows.append((*measured, ratio, turn_ratio))
            n_more += len(found)
        if not rows:
            print(f"| {subject} | {options.seeds} | 0 of {n_true}, {n_more} | | | | |")
            continue
        turn, radius, place, ratio, turn_ratio = np.abs(np.array(rows)).T
        print(
            f"| {subject} | {options.seeds} | {len(rows)} of {n_true}, {n_more} "
            f"| {np.median(turn):.4f}, {turn.max():.4f} | {np.median(radius):.3f}, "
            f"{radius.max():.3f} | {np.median(place):.3f}, {place.max():.3f} "
            f"| {np.sqrt(np.mean(ratio**2)):.1f}, {np.sqrt(np.mean(turn_ratio**2)):.1f} |",
            flush=True,
        )


def report_rooms(options: argparse.Namespace) -> None:
    """Print the number of curved surfaces found in rooms that have none."""
    n_found = 0
    for seed in range(options.rooms):
        cloud, _ = simulated(
            SimulateRoom,
            seed,
            scan_step_m=options.step,
            geometry="drawn",
            decoration="drawn",
            n_plaques=6,
            noise_m=options.noise_mm / 1000.0,
        )
        found = detected_in_turn(cloud, seed)
        n_found += len(found)
        for item in found:
            print(f"room {seed}: {item.name} of radius {item.radius_m:.2f} m", flush=True)
    print(f"{n_found} curved surfaces in {options.rooms} rooms of planes")


def report_times(options: argparse.Namespace) -> None:
    print("| building | points | time |")
    print("|---|---|---|")
    for subject in options.subject or SUBJECTS:
        step_m = options.step * math.sqrt(2.9e6 / options.points)
        cloud, _ = simulated(SimulateCurved, 1, subject=subject, scan_step_m=step_m)
        floor_s = pass_s(cloud)
        detected(cloud)
        runs = []
        for _ in range(3):
            start, cpu = time.perf_counter(), time.process_time()
            detected(cloud)
            runs.append((time.perf_counter() - start, time.process_time() - cpu))
            floor_s = min(floor_s, pass_s(cloud))
        fastest, cpu_s = min(runs)[0], min(cpu for _, cpu in runs)
        print(
            f"| {subject} | {len(cloud)} | {fastest:.2f} s, processor {cpu_s:.2f} s = "
            f"{fastest / floor_s:.0f} F, {cpu_s / floor_s:.0f} F |",
            flush=True,
        )
    print(f"F = {1000 * floor_s:.1f} ms; load at the end {os.getloadavg()[0]:.1f}")


def report_peers(options: argparse.Namespace) -> None:
    print("| building | program | points | time s | axis deg | radius mm |")
    print("|---|---|---|---|---|---|")
    for subject in options.subject or SUBJECTS:
        cloud, truth = simulated(SimulateCurved, 1, subject=subject, scan_step_m=options.step)
        points = cloud.points_world()
        every = max(1, len(points) // 100_000)
        # The second row shows what remains without the planes that orthoflow or others find.
        true = truth.surfaces.surfaces[0]
        alone = points[np.abs(true.shape.distances_m(points)) < 0.05]
        for name, chosen in (("all", points[::every]), ("only near the surface", alone)):
            thinned = chosen[:: max(1, len(chosen) // 100_000)]
            start = time.perf_counter()
            axis, radius_m = _pyransac(thinned)
            seconds = time.perf_counter() - start
            turn = np.degrees(np.arcsin(np.linalg.norm(np.cross(axis, true.shape.axis_world))))
            print(
                f"| {subject} | pyransac3d, {name} | {len(thinned)} | {seconds:.2f} | {turn:.3f} "
                f"| {1000 * (radius_m - true.radius_m):+.1f} |",
                flush=True,
            )
        start = time.perf_counter()
        found = detected(cloud).surfaces
        seconds = time.perf_counter() - start
        if found:
            best = min(found, key=lambda item: errors(item, true)[0])
            turn, radius_mm, _ = errors(best, true)
            print(
                f"| {subject} | orthoflow | {len(points)} | {seconds:.2f} | {turn:.4f} "
                f"| {radius_mm:+.3f} |",
                flush=True,
            )


def _pyransac(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    import random

    import pyransac3d

    random.seed(1)
    _, axis, radius, _ = pyransac3d.Cylinder().fit(points, thresh=0.02, maxIteration=2000)
    return np.asarray(axis) / np.linalg.norm(axis), float(radius)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--subject", choices=typing.get_args(Subject), action="append")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--step", type=float, default=0.01, help="point spacing at 3 m, metres")
    parser.add_argument("--noise-mm", type=float, default=2.0)
    parser.add_argument("--rooms", type=int, default=0)
    parser.add_argument("--points", type=int, default=0)
    parser.add_argument("--peers", action="store_true")
    options = parser.parse_args()
    if options.rooms:
        report_rooms(options)
    elif options.points:
        report_times(options)
    elif options.peers:
        report_peers(options)
    else:
        report_accuracy(options)


if __name__ == "__main__":
    main()
