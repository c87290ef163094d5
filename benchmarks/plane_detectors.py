"""Measure time, memory and accuracy of the plane detectors and of other programs, on one room.

    python benchmarks/plane_detectors.py                          # the room of 48 million points
    python benchmarks/plane_detectors.py --points 5000000 --method ransac --no-peers
    python benchmarks/plane_detectors.py --npy room.npy --truth truth.json --labels labels.npy

F is the time of one pass over separate x, y and z arrays at full memory bandwidth, measured in the
same run. Seconds on different machines cannot be compared, but multiples of F can. Code has been
compiled, and points are in memory. Detection and labelling are measured together, statistics
separately; figures and files are not measured. Processor seconds are the sum over both threads; on
an idle machine, the elapsed time is at least half of it.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numba
import numpy as np
from great_room import FULL_POINTS, great_room
from numpy.typing import NDArray
from orthoflow_plugins.plane.cloud import PreparedCloud, prepare
from orthoflow_plugins.plane.fit import FoundPlane
from orthoflow_plugins.plane.hough import PlanProposer, SpaceProposer
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.hough3d import Hough3d
from orthoflow_plugins.plane.planes import measure_planes
from orthoflow_plugins.plane.proposing import DetectorParams, Proposer
from orthoflow_plugins.plane.ransac import ConsensusProposer, Ransac
from orthoflow_plugins.plane.region import Region, RegionProposer
from orthoflow_plugins.plane.search import Search, find_planes
from plane_peers import PEERS, measured

from orthoflow.products import PointCloud

SHARE = 0.005
TOLERANCE_M, FIT_TOLERANCE_M = 0.05, 0.015
METHODS = ("hough2d", "hough3d", "hough3d-full", "ransac", "region")


@numba.njit(nogil=True)
def _pass(x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32]) -> int:
    near = 0
    for i in range(x.size):
        distance = np.float32(0.1) * x[i] + np.float32(0.9) * y[i] + np.float32(0.01) * z[i]
        near += abs(distance - np.float32(3.7)) < np.float32(0.05)
    return near


def times_s(task: Callable[[], object], repeats: int) -> tuple[float, float, float]:
    """Return the minimum and maximum time of some runs, and the fastest run's processor time."""
    runs = []
    for _ in range(repeats):
        start, cpu = time.perf_counter(), time.process_time()
        task()
        runs.append((time.perf_counter() - start, time.process_time() - cpu))
    return min(runs)[0], max(runs)[0], min(cpu_s for _, cpu_s in runs)


def detect(
    method: str, cloud: PointCloud, *, most: int, cores: int
) -> tuple[PreparedCloud, list[FoundPlane]]:
    """Run a method up to its labels, without statistics, files and figures."""
    params = {"n_planes_max": most, "min_share": SHARE}
    prepared = prepare(cloud, TOLERANCE_M, FIT_TOLERANCE_M, parts=cores)
    search = Search(cloud=prepared, params=DetectorParams.model_validate(params))
    found = find_planes(search, proposer_of(method, search, params))
    labels = np.empty(len(cloud), dtype=np.int16)
    names = np.append(np.arange(len(found)), -1).astype(np.int16)
    prepared.write_labels(names, labels)
    return prepared, found


def proposer_of(method: str, search: Search, params: dict[str, float]) -> Proposer:
    if method == "ransac":
        return ConsensusProposer(search, Ransac.Params(**params), np.random.default_rng(0))
    if method == "region":
        return RegionProposer(search, Region.Params(**params))
    if method == "hough2d":
        return PlanProposer(search, Hough2d.Params(**params))
    mode = "full" if method == "hough3d-full" else "coarse-to-fine"
    return SpaceProposer(search, Hough3d.Params(search=mode, **params))


@dataclass(frozen=True, kw_only=True)
class Room:
    """The measured room.

    Attributes:
        cloud: the points.
        truth: for each true plane, with the main wall first: name, (3,) normal, offset, and (3,)
            centroid of its points.
        is_main: (n,) mask of the points that are truly on the main wall.
        floor_s: F, the seconds of one pass over the points at full memory bandwidth.
    """

    cloud: PointCloud
    truth: list[tuple[str, NDArray[np.float64], float, NDArray[np.float64]]]
    is_main: NDArray[np.bool_]
    floor_s: float


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--method", choices=METHODS, action="append")
    parser.add_argument("--points", type=int, default=FULL_POINTS)
    parser.add_argument("--npy", type=Path, help="(n, 3) float32 points instead of the room")
    parser.add_argument("--truth", type=Path, help="JSON with planes: {name: {n: [3], R}}")
    parser.add_argument("--labels", type=Path, help="(n,) true plane of each point, names as ints")
    parser.add_argument("--seed", type=int, default=1, help="draws where the room lies")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--no-peers", action="store_true")
    options = parser.parse_args()
    room = _stored(options) if options.npy else _simulated(options)
    machine = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    print(f"{len(room.cloud)} points, {options.cores} threads, {machine}")
    print("| method | first plane | all planes | statistics | extra memory | main wall | others |")
    print("|---|---|---|---|---|---|---|")
    for method in options.method or METHODS:
        room = report_method(method, room, options)
    print(f"F = {1000 * room.floor_s:.1f} ms; load at the end {os.getloadavg()[0]:.1f}")
    if not options.no_peers:
        report_peers(room)


def _room(cloud: PointCloud, planes: list[tuple[str, NDArray, float]], labels: NDArray) -> Room:
    """Join a cloud with its truth; labels are plane indices."""
    truth = []
    for number, (name, normal, offset) in enumerate(planes):
        mine = np.flatnonzero(labels == number)[::7]
        points = np.column_stack([cloud.x[mine], cloud.y[mine], cloud.z[mine]])
        truth.append((name, normal, offset, points.astype(np.float64).mean(axis=0)))
    return Room(cloud=cloud, truth=truth, is_main=labels == 0, floor_s=pass_s(cloud))


def _simulated(options: argparse.Namespace) -> Room:
    scanned = great_room(options.points, cores=options.cores, seed=options.seed)
    planes = [(p.name, p.plane.normal, p.plane.offset_m) for p in scanned.planes]
    return _room(_cloud(scanned.x, scanned.y, scanned.z), planes, scanned.plane_index)


def _stored(options: argparse.Namespace) -> Room:
    points = np.load(options.npy, mmap_mode="r")
    stored = json.loads(options.truth.read_text())["planes"]
    planes = [(name, np.array(item["n"]), item["R"]) for name, item in stored.items()]
    named = np.load(options.labels)
    labels = np.full(len(named), -1, dtype=np.int8)
    for number, (name, _, _) in enumerate(planes):
        labels[named == int(name)] = number
    columns = [np.ascontiguousarray(points[:, axis]) for axis in range(3)]
    return _room(_cloud(*columns), planes, labels)


def _cloud(x: NDArray, y: NDArray, z: NDArray) -> PointCloud:
    return PointCloud(origin=np.zeros(3), x=x, y=y, z=z, up=np.array([0.0, 0.0, 1.0]))


def pass_s(cloud: PointCloud) -> float:
    """Return the minimum time of some passes over the points, in seconds."""
    _pass(cloud.x, cloud.y, cloud.z)
    return times_s(lambda: _pass(cloud.x, cloud.y, cloud.z), 5)[0]


def report_method(method: str, room: Room, options: argparse.Namespace) -> Room:
    """Print times, memory and accuracy of a method; return the room with the fastest pass."""
    cloud, cores = room.cloud, options.cores
    detect(method, cloud, most=2, cores=cores)  # compiles the code
    before_mib = forget_peak()
    prepared, found = detect(method, cloud, most=16, cores=cores)
    grown_mib = peak_mib() - before_mib
    slabs = np.array([item.raster.slab() for item in found])
    bounds = np.array([item.support.bounds_m for item in found])
    cells = []
    for task in (
        lambda: detect(method, cloud, most=1, cores=cores),
        lambda: detect(method, cloud, most=16, cores=cores),
        lambda: measure_planes(prepared, slabs, bounds),
    ):
        fastest, slowest, cpu_s = times_s(task, options.repeats)
        # Measure F next to each task, because other load on the machine slows both.
        room = replace(room, floor_s=min(room.floor_s, pass_s(cloud)))
        cells.append(
            f"{fastest:.2f}..{slowest:.2f} s, processor {cpu_s:.2f} s"
            f" = {fastest / room.floor_s:.0f} F, {cpu_s / room.floor_s:.0f} F"
        )
    share = grown_mib * 2**20 / (12 * len(cloud))
    cells += [f"{grown_mib:.0f} MiB = {share:.2f} of the input", *accuracy(room, prepared, found)]
    print(f"| {method}, {len(found)} planes | {' | '.join(cells)} |", flush=True)
    return room


def accuracy(room: Room, prepared: PreparedCloud, found: list[FoundPlane]) -> tuple[str, str]:
    """Return the errors of planes: those of the main wall, and the maxima of the other planes."""
    nearest = [_nearest(normal, offset, centre, found) for _, normal, offset, centre in room.truth]
    hits = [item for item in nearest if item is not None]
    others = [item for item in nearest[1:] if item is not None]
    worst = f"{len(hits)} of {len(nearest)} planes"
    if others:
        worst += (
            f", {max(angle for angle, _, _ in others):.4f} deg"
            f" {max(abs(miss) for _, miss, _ in others):.2f} mm at most"
        )
    if nearest[0] is None:
        return "missed", worst
    angle, miss_mm, index = nearest[0]
    plane = found[index].raster.plane
    a, b, c = plane.normal.astype(np.float32)
    cloud = room.cloud
    apart = np.abs(a * cloud.x + b * cloud.y + c * cloud.z - np.float32(plane.offset_m))
    chosen = (prepared.claims == index) & (apart <= 0.015)
    both = np.count_nonzero(chosen & room.is_main)
    precision, recall = both / np.count_nonzero(chosen), both / np.count_nonzero(room.is_main)
    return (
        f"{angle:.4f} deg {miss_mm:+.2f} mm, precision {precision:.3f} recall {recall:.3f}",
        worst,
    )


def _nearest(
    normal: NDArray[np.float64],
    offset: float,
    centre: NDArray[np.float64],
    found: list[FoundPlane],
) -> tuple[float, float, int] | None:
    """Return the nearest plane: angle, distance at the true centroid (mm), and index."""
    best = None
    for index, item in enumerate(found):
        plane = item.raster.plane
        angle = float(np.degrees(np.linalg.norm(np.cross(plane.normal, normal))))
        on_truth = centre - (float(centre @ normal) - offset) * normal
        miss_mm = 1000.0 * (float(plane.normal @ on_truth) - plane.offset_m)
        if angle < 1.0 and abs(miss_mm) < 15.0 and (best is None or abs(miss_mm) < abs(best[1])):
            best = (angle, miss_mm, index)
    return best


def report_peers(room: Room) -> None:
    """Print the main walls that other programs find in the same points."""
    print("| peer | points | time | main wall | planes |")
    print("|---|---|---|---|---|")
    _, normal, offset, centre = room.truth[0]
    points = np.column_stack([room.cloud.x, room.cloud.y, room.cloud.z])
    on_truth = centre - (float(centre @ normal) - offset) * normal
    for peer in PEERS:
        result = measured(peer, points, np.append(normal, offset))
        part = "all" if peer.every == 1 else f"1:{peer.every}"
        if isinstance(result, str):
            print(f"| {peer.name} | {part} | {result} | | |", flush=True)
            continue
        angle = float(np.degrees(np.linalg.norm(np.cross(result.normal, normal))))
        miss_mm = 1000.0 * (float(result.normal @ on_truth) - result.offset_m)
        wall = (
            "missed"
            if angle > 1.5 or abs(miss_mm) > 100.0
            else f"{angle:.3f} deg {miss_mm:+.1f} mm"
        )
        print(
            f"| {peer.name} | {part} | {result.seconds:.2f} s = "
            f"{result.seconds / room.floor_s:.0f} F | {wall} | {result.n_planes} |",
            flush=True,
        )


def forget_peak() -> float:
    """Reset the peak memory of this process; return its current memory, MiB."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak_mib()


def peak_mib() -> float:
    """Return the peak resident memory since the reset, MiB."""
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 1024


if __name__ == "__main__":
    main()
