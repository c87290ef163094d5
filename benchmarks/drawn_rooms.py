"""Compare methods of the two papers in drawn rooms: twice ten, whose seeds are apart.

    python benchmarks/drawn_rooms.py planes
    python benchmarks/drawn_rooms.py surfaces

Directions, leans and distances of all planes, decoration, scanner stations, photos and lens are
drawn from a room's seed. Prints mean ± standard deviation (largest) over the rooms of each ten.

`planes` searches with every detector of markiewicz2015, as it finds planes (raw) and after the
common fit. `surfaces` makes orthoimages from photos on a surface (backward) and from points
(direct), once on the scan and once on points that semi-global matching (OpenCV) finds in the
photos, as skarlatos2012 had. Orientations are the true ones; check points are those that all four
orthoimages of a room show.
"""

from __future__ import annotations

import argparse
import platform
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.colour.photos import ColourPhotos
from orthoflow_plugins.inspect.checkpoints import InspectCheckpoints
from orthoflow_plugins.inspect.truth import InspectTruth
from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.hough3d import Hough3d
from orthoflow_plugins.plane.ransac import Ransac
from orthoflow_plugins.plane.region import Region
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.files.images import decode_image
from orthoflow.products import Camera, Inspection, Photos, PointCloud
from orthoflow.sdk import Method, StepContext

TENS: Final = (range(1, 11), range(101, 111))
DETECTORS: Final[Mapping[str, tuple[type[Method], dict[str, Any]]]] = {
    "hough2d": (Hough2d, {}),
    "hough2d, votes": (Hough2d, {"scoring": "votes"}),
    "hough2d, one vote per cell": (Hough2d, {"scoring": "votes", "accumulator": "unit"}),
    "hough2d, Canny": (Hough2d, {"scoring": "votes", "accumulator": "canny"}),
    "hough3d": (Hough3d, {}),
    "hough3d, votes": (Hough3d, {"search": "full", "scoring": "votes"}),
    "ransac": (Ransac, {}),
    "ransac, 2D": (Ransac, {"model": "2d"}),
    "region": (Region, {}),
    "region, normals alone": (Region, {"preset": "paper"}),
}
# Nearest and farthest surface from a camera.
RANGES_M: Final = (1.5, 3.6)
# Photos of a row of `variant2`.
PER_ROW: Final = 6


def run(
    method: type[Method], inputs: Any, seed: int, **params: Any
) -> tuple[Any, dict[str, float]]:
    """Run a method; return what it gives and its metrics."""
    folder = Path(tempfile.mkdtemp())
    ctx = StepContext(rng=np.random.default_rng(seed), cores=2, scratch=folder)
    out = method().run(inputs, method.Params.model_validate(params), ctx)
    return out, {metric.name: float(metric.value) for metric in ctx.metrics}


def room_of(seed: int, **params: Any) -> SimulateRoom.Out:
    drawn = {"geometry": "drawn", "decoration": "drawn"}
    return run(SimulateRoom, SimulateRoom.In(), seed, **drawn, **params)[0]


def numbers(inspection: Inspection) -> dict[str, float]:
    return {finding.name: finding.value for finding in inspection.findings if finding.wall <= 0}


def planes(seed: int) -> Iterator[tuple[str, str, float]]:
    """Return every detector's errors in a room."""
    room = room_of(seed, scan_step_m=0.03)
    for name, (method, params) in DETECTORS.items():
        out, metrics = run(method, method.In(cloud=room.cloud), seed, **params)
        inputs = InspectTruth.In(truth=room.truth, planes=out.planes, labels=out.labels)
        found = numbers(run(InspectTruth, inputs, seed)[0].inspection)
        yield name, "raw angle / deg", abs(metrics["raw_angle_deg"])
        yield name, "raw offset / mm", abs(metrics["raw_offset_mm"])
        yield name, "angle / deg", abs(found["plane_angle_deg"])
        yield name, "offset / mm", abs(found["plane_offset_mm"])
        yield name, "planes found", found["true_planes_found"] / found["true_planes"]
        yield name, "IoU", found["label_iou_mean"]


def surfaces(seed: int) -> Iterator[tuple[str, str, float]]:
    """Return errors of orthoimages on a scanned and on a matched surface of a room."""
    room = room_of(
        seed,
        scan_step_m=0.005,
        panorama_step_m=0.03,
        photo_layout="variant2",
        photo_gsd_m=0.004,
        # Of oblique neighbours one may stand above the other, which the matching of rows excludes.
        photo_obliquity_deg=3.0,
        check_points_most=20,
    )
    cameras = room.truth.cameras
    seen = {"photos": room.photos, "cameras": cameras}
    coloured = run(ColourPhotos, ColourPhotos.In(cloud=room.cloud, **seen), seed)[0].cloud
    residuals = {}
    for source, cloud in (("scanned", coloured), ("matched", matched_cloud(room))):
        main = room.truth.planes.names.index("main wall")
        inputs = RasterGrid.In(cloud=cloud, planes=room.truth.planes)
        walls = run(RasterGrid, inputs, seed, gsd_m=0.008, buffer_m=0.3, ranks=(main,))[0].walls
        for way in ("backward", "direct"):
            if way == "direct":
                direct = PointcloudDirect.In(walls=walls, cloud=cloud)
                layers = run(PointcloudDirect, direct, seed)[0].layers
            else:
                backward = DsmBackward.In(walls=walls, cloud=cloud, **seen)
                layers = run(DsmBackward, backward, seed)[0].layers
            joined = MosaicSeams.In(layers=layers, walls=walls)
            images = run(MosaicSeams, joined, seed, gains="none")[0].orthoimages
            shown = {"orthoimages": images, "walls": walls, "truth": room.truth}
            points = InspectCheckpoints.In(checkpoints=room.checkpoints, **shown)
            residuals[source, way] = by_point(run(InspectCheckpoints, points, seed)[0].inspection)
            found = numbers(run(InspectTruth, InspectTruth.In(**shown), seed)[0].inspection)
            name = f"{source}, {way}"
            yield name, "u / mm", found["rmse_u_mm"]
            yield name, "v / mm", found["rmse_v_mm"]
            yield name, "painted", found["completeness"]
            yield name, "points found", float(len(residuals[source, way]))
    common = set.intersection(*(set(found) for found in residuals.values()))
    for (source, way), found in residuals.items():
        for kind in ("flat", "vertical edge"):
            lengths = [found[key] for key in common if key[0] == kind]
            if lengths:
                yield (
                    f"{source}, {way}",
                    f"{kind} / mm",
                    float(np.sqrt(np.mean(np.square(lengths)))),
                )
                yield f"{source}, {way}", f"common {kind}", float(len(lengths))


def by_point(inspection: Inspection) -> dict[tuple[Any, ...], float]:
    """Return the length of each residual in mm, by class and place."""
    lengths = 1e3 * np.hypot(*inspection.displacement_m.T)
    places = np.round(inspection.points_world, 3)
    return {
        (inspection.kinds[kind], *place.tolist()): float(length)
        for kind, place, length in zip(inspection.kind, places, lengths, strict=True)
    }


def matched_cloud(room: SimulateRoom.Out) -> PointCloud:
    """Match neighbouring photos of each row densely; points take the colour of the left photo."""
    cameras = room.truth.cameras.cameras
    parts = [
        matched_pair(room.photos, cameras, left, right)
        for left, right in pairwise(range(len(cameras)))
        if left // PER_ROW == right // PER_ROW
    ]
    points = np.concatenate([points for points, _ in parts])
    x, y, z = points.astype(np.float32).T.copy()
    pair = np.repeat(np.arange(len(parts)), [len(points) for points, _ in parts])
    stations = np.array(
        [
            camera.viewing().centre_world
            for place, camera in enumerate(cameras)
            if (place + 1) % PER_ROW
        ]
    )
    return PointCloud(
        origin=np.zeros(3),
        x=x,
        y=y,
        z=z,
        up=room.cloud.up,
        rgb=np.concatenate([rgb for _, rgb in parts]),
        scan=pair.astype(np.uint16),
        stations=stations,
        stations_source="file",
        source={"simulated": True},
    )


def matched_pair(
    photos: Photos, cameras: tuple[Camera, ...], left: int, right: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return points (n, 3) in the world and colours (n, 3) of a pair by OpenCV's SGM."""
    views = [cameras[place].viewing() for place in (left, right)]
    images = [decode_image(photos.photos[place].encoded, "photo") for place in (left, right)]
    # Our pixel centres lie at .5, OpenCV's at whole numbers.
    matrices = [
        np.array([[v.fx, 0.0, v.cx - 0.5], [0.0, v.fy, v.cy - 0.5], [0.0, 0.0, 1.0]]) for v in views
    ]
    lenses = [np.array(cameras[place].intrinsics.distortion) for place in (left, right)]
    turn = views[1].rotation @ views[0].rotation.T
    shift = views[1].translation - turn @ views[0].translation
    size = (views[0].width, views[0].height)
    r1, r2, p1, p2, back, _, _ = cv2.stereoRectify(
        matrices[0], lenses[0], matrices[1], lenses[1], size, turn, shift[:, None], alpha=-1
    )
    rectified = [
        cv2.remap(
            image, *cv2.initUndistortRectifyMap(k, lens, r, p, size, cv2.CV_32FC1), cv2.INTER_LINEAR
        )
        for image, k, lens, r, p in zip(images, matrices, lenses, (r1, r2), (p1, p2), strict=True)
    ]
    reach = abs(p2[0, 3])
    nearest, farthest = (int(reach / distance) for distance in RANGES_M)
    disparities = 16 * -(-(nearest - farthest) // 16)
    matcher = cv2.StereoSGBM_create(
        minDisparity=farthest,
        numDisparities=disparities,
        blockSize=5,
        P1=8 * 3 * 25,
        P2=32 * 3 * 25,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    found = matcher.compute(*rectified).astype(np.float32) / 16.0
    kept = found >= farthest
    in_view = cv2.reprojectImageTo3D(found, back)[kept].astype(np.float64) @ r1
    world = (in_view - views[0].translation) @ views[0].rotation
    return world, rectified[0][kept]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["planes", "surfaces"])
    parser.add_argument("--rooms", type=int, default=10, help="of each ten")
    options = parser.parse_args()
    measure = {"planes": planes, "surfaces": surfaces}[options.what]
    print(f"{platform.machine()}, Python {platform.python_version()}", flush=True)
    for seeds in TENS:
        found: dict[tuple[str, str], list[float]] = defaultdict(list)
        for n_rooms, seed in enumerate(seeds[: options.rooms], start=1):
            for name, metric, value in measure(seed):
                found[name, metric].append(value)
            print(f"room {seed}", flush=True)
            if n_rooms % 5 == 0 or n_rooms == options.rooms:
                report(found, f"seeds {seeds[0]} to {seed}")


def report(found: Mapping[tuple[str, str], list[float]], title: str) -> None:
    """Print a table: a row per method, mean ± standard deviation and the worst room."""
    metrics = list(dict.fromkeys(metric for _, metric in found))
    print(f"\n| {title} | {' | '.join(metrics)} |\n| --- |{' ---: |' * len(metrics)}")
    for name in dict.fromkeys(name for name, _ in found):
        cells = []
        for metric in metrics:
            values = found.get((name, metric), [])
            spread = np.std(values, ddof=1) if len(values) > 1 else 0.0
            cells.append(
                f"{np.mean(values):.3g} ± {spread:.2g} ({np.max(values):.3g})" if values else "-"
            )
        print(f"| {name} | {' | '.join(cells)} |")
    print(flush=True)


if __name__ == "__main__":
    main()
