"""Time and accuracy of the plane detectors: first plane, all planes, statistics, in memory passes.

    python benchmarks/plane_detectors.py                          # a room of 10 million points
    python benchmarks/plane_detectors.py --points 48000000 --method ransac
    python benchmarks/plane_detectors.py --npy room.npy --truth truth.json

F is one pass over separate x, y, z arrays at memory speed, measured in the same run: seconds of
different machines do not compare, seconds over F do. Code is warm, points are in memory. Detection
and labels are measured, statistics apart; figures and files are not.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.plane.accumulators import PlanProposer, Voting
from orthoflow_plugins.plane.candidates import FoundPlane
from orthoflow_plugins.plane.consensus import ConsensusProposer, Search
from orthoflow_plugins.plane.detecting import rules_of, search_sample
from orthoflow_plugins.plane.deviations import measure_planes
from orthoflow_plugins.plane.parameters import DetectorParams
from orthoflow_plugins.plane.preparing import prepare
from orthoflow_plugins.plane.region_proposer import RegionProposer
from orthoflow_plugins.plane.regions import Growth, Regions, grow
from orthoflow_plugins.plane.remainders import Remainder
from orthoflow_plugins.plane.settling import name_points
from orthoflow_plugins.plane.space_accumulators import SpaceProposer, SpaceVoting
from orthoflow_plugins.plane.surface_cells import Neighbourhood, surface_cells

from orthoflow.geometry import basis_from_up
from orthoflow.products import PointCloud

CELL_M, SHARE = 0.02, 0.005
METHODS = ("hough2d", "hough3d", "hough3d-full", "ransac", "region")


@numba.njit(nogil=True)
def _pass(x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32]) -> int:
    near = 0
    for i in range(x.size):
        distance = np.float32(0.1) * x[i] + np.float32(0.9) * y[i] + np.float32(0.01) * z[i]
        near += abs(distance - np.float32(3.7)) < np.float32(0.05)
    return near


def simulated_room(n_points: int) -> tuple[NDArray[np.float32], list[tuple[str, NDArray, float]]]:
    """A room with clutter and outliers, ordered by direction like a scan, and its planes."""
    rng = np.random.default_rng(20150807)
    faces, points = [], []
    for name, omega, phi, offset, share in (
        ("main", 102.0, 0.8, 3.7, 0.30),
        ("opposite", 282.4, -0.2, 0.5, 0.08),
        ("right", 12.2, 0.3, 4.5, 0.05),
        ("left", 191.7, -0.3, 4.1, 0.05),
        ("floor", 0.0, -89.9, 1.5, 0.15),
        ("ceiling", 40.0, 89.8, 3.5, 0.17),
    ):
        o, p = np.radians(omega), np.radians(phi)
        normal = np.array([np.cos(p) * np.cos(o), np.cos(p) * np.sin(o), np.sin(p)])
        first = np.cross([0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [0.0, 1.0, 0.0], normal)
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        count = int(share * n_points)
        height = 1.0 if abs(normal[2]) < 0.9 else 0.0
        spread = rng.uniform(-1.0, 1.0, (count, 2)) * (4.2, 2.5 if height else 2.1)
        centre = offset * normal + height * second * np.sign(second[2])
        flat = centre + spread @ np.array([first, second])
        points.append(flat + rng.normal(0.0, 0.002, (count, 1)) * normal)
        faces.append((name, normal, offset))
    clutter = n_points - sum(map(len, points))
    points.append(rng.uniform((-4, -0.5, -1.5), (4, 3.5, 0.5), (clutter, 3)))
    cloud = np.concatenate(points).astype(np.float32)
    cloud[:: max(1, n_points // (n_points // 200))] += rng.normal(0, 3, 3).astype(np.float32)
    order = np.lexsort([cloud[:, 2], np.round(np.arctan2(cloud[:, 1], cloud[:, 0]), 3)])
    return cloud[order], faces


def median_s(task: Callable[[], object], repeats: int) -> tuple[float, float, float]:
    """Median, fastest and slowest of some runs, in seconds."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        task()
        times.append(time.perf_counter() - start)
    return statistics.median(times), min(times), max(times)


def detect(
    method: str, cloud: PointCloud, *, most: int, cores: int
) -> tuple[Remainder, list[FoundPlane]]:
    """What a method does up to its labels, without statistics, files and figures."""
    rules = replace(rules_of(DetectorParams()), n_planes_most=most, least_share=SHARE)
    cell_m = CELL_M if method == "hough2d" else 0.5
    remainder = prepare(
        cloud,
        basis_from_up(cloud.up),
        cell_m=cell_m,
        least_share=SHARE,
        parts=cores,
        counts_plan=method == "hough2d",
    )
    if method == "ransac":
        search = Search(
            model="3d",
            scoring="msac",
            n_hypotheses=1000,
            find_m=rules.find_m,
            family="any",
            tilt_most_deg=rules.tilt_most_deg,
            least_share=SHARE,
        )
        rng = np.random.default_rng(0)
        found = search_sample(
            remainder, rules, _listen, lambda sample: ConsensusProposer(sample, search, rng)
        )
    elif method == "region":
        wanted = Neighbourhood(shape="cube", size_m=0.1, n_points=30, cell_m=0.1 / 3.0)
        growth = Growth(angle_deg=10.0, distance_m=0.015, least_points=0.2 * SHARE * len(cloud))
        regions = grow(surface_cells(remainder, wanted), growth, np.zeros(3))
        found = search_sample(
            remainder, rules, _listen, lambda sample: region_proposer(regions, sample)
        )
    elif method.startswith("hough3d"):
        coarser = 1.0 if method == "hough3d-full" else 2.0
        space = SpaceVoting(
            cell_m=coarser * CELL_M, angle_step_deg=coarser, least_points=SHARE * len(cloud)
        )
        found = search_sample(remainder, rules, _listen, lambda _: SpaceProposer(remainder, space))
    else:
        voting = Voting(angle_step_deg=1.0, least_points=SHARE * len(cloud))
        found = search_sample(remainder, rules, _listen, lambda _: PlanProposer(remainder, voting))
    labels = np.empty(len(cloud), dtype=np.int16)
    name_points(remainder, np.arange(len(found) + 1, dtype=np.int16), labels)
    return remainder, found


def region_proposer(regions: Regions, sample: Remainder) -> RegionProposer:
    return RegionProposer(
        regions=regions,
        region_of_sample=regions.region_of(sample.points),
        family="any",
        tilt_most_deg=10.0,
        least_points=SHARE * len(sample.claims),
        proposes_once=False,
    )


def _listen(_part: float, _text: str) -> None:
    """Hear progress and say nothing."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--method", choices=METHODS, action="append")
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--npy", type=Path, help="(n, 3) float32 points instead of the room")
    parser.add_argument("--truth", type=Path, help="JSON with planes: {name: {n: [3], R}}")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    if options.npy:
        points = np.load(options.npy, mmap_mode="r")
        stored = json.loads(options.truth.read_text())["planes"] if options.truth else {}
        truth = [(name, np.array(item["n"]), item["R"]) for name, item in stored.items()]
    else:
        points, truth = simulated_room(options.points)
    x, y, z = (np.ascontiguousarray(points[:, axis]) for axis in range(3))
    cloud = PointCloud(origin=np.zeros(3), x=x, y=y, z=z, up=np.array([0.0, 0.0, 1.0]))
    del points
    _pass(x, y, z)
    floor_s = min(median_s(lambda: _pass(x, y, z), 5)[1] for _ in range(3))
    print(f"{len(cloud)} points, {options.cores} threads, F = {1000 * floor_s:.1f} ms")
    for method in options.method or METHODS:
        report_method(method, cloud, floor_s, options)
        _, found = detect(method, cloud, most=16, cores=options.cores)
        for name, normal, offset in truth:
            report_nearest(name, normal, offset, found)


def report_method(
    method: str, cloud: PointCloud, floor_s: float, options: argparse.Namespace
) -> None:
    """Print times and memory of a method."""
    cores = options.cores
    detect(method, cloud, most=2, cores=cores)  # warm
    before_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    remainder, found = detect(method, cloud, most=16, cores=cores)
    slabs = np.array([item.raster.slab() for item in found])
    bounds = np.array([item.footprint.bounds_m for item in found])
    print(method)
    for name, task in (
        ("first plane", lambda: detect(method, cloud, most=1, cores=cores)),
        (f"{len(found)} planes", lambda: detect(method, cloud, most=16, cores=cores)),
        ("statistics", lambda: measure_planes(remainder, slabs, bounds, find_m=0.05, fit_m=0.015)),
    ):
        cpu_s = time.process_time()
        median, fastest, slowest = median_s(task, options.repeats)
        cpu_s = (time.process_time() - cpu_s) / options.repeats
        print(
            f"  {name:12} {median:.3f} s ({fastest:.3f}..{slowest:.3f}) = {median / floor_s:.1f} F,"
            f" fastest {fastest / floor_s:.1f} F; processor {cpu_s:.3f} s = {cpu_s / floor_s:.1f} F"
        )
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    input_mib = 12 * len(cloud) / 2**20
    print(
        f"  input {input_mib:.0f} MiB, peak grew by {peak_mib - before_mib:.0f} MiB after warming"
    )


def report_nearest(
    name: str, normal: NDArray[np.float64], offset: float, found: list[FoundPlane]
) -> None:
    """Print how near the best plane comes to a true one, at the middle of its rectangle."""
    best = None
    for item in found:
        plane = item.raster.plane
        angle = float(np.degrees(np.linalg.norm(np.cross(plane.normal, normal))))
        u, v = item.raster.centres_m()
        cells = item.footprint.cells
        middle = (
            np.array([u[cells].mean(), v[cells].mean()]) @ item.raster.axes
            + plane.offset_m * plane.normal
        )
        miss_mm = 1000.0 * (float(normal @ middle) - offset)
        if angle < 1.0 and abs(miss_mm) < 15.0 and (best is None or angle < best[0]):
            best = (angle, miss_mm)
    print(f"  truth {name:9}", "missed" if best is None else f"{best[0]:.4f} deg {best[1]:+.2f} mm")


if __name__ == "__main__":
    main()
