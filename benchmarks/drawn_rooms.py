"""Measure the rows of docs/papers.md in drawn rooms, and write it and docs/choosing.md.

    python benchmarks/drawn_rooms.py FOLDER
    python benchmarks/drawn_rooms.py FOLDER --part surfaces --rooms 5

Directions, leans and distances of all planes, decoration, scanner stations, photos and lens are
drawn from a room's seed: ten rooms from 1 on, and five others from 101 on, by which rankings are
checked. Each room is measured four times: `planes` (plane-methods.yaml, paper_planes.yaml),
`orient` (orient-methods.yaml), `ortho` (ortho-methods.yaml) and `surfaces`, where orthoimages are
made from photos on a surface (backward) and from points (direct), on the scan and on points that
semi-global matching (OpenCV) finds in the photos, as skarlatos2012 had; orientations are the true
ones there, and plaques at drawn places give the main wall corners for check points at edges. Check
points are compared over those that all orthoimages of a room show.

Every room goes to `FOLDER/<part>-<seed>.json` as soon as it is measured, and is not measured again.
From these files and the pages of benchmarks/pages docs/papers.md and docs/choosing.md are written:
a place `{{part: cell metric}}` becomes mean±standard deviation of the first ten rooms,
`{{part: cell metric < cell metric ? text | other text}}` the text where the ranking holds and the
other where it does not (see `ranking_holds`), with the counts of rooms. Cells that no page names
are not run.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.colour.photos import ColourPhotos
from orthoflow_plugins.inspect.checkpoints import InspectCheckpoints
from orthoflow_plugins.inspect.findings import check_findings
from orthoflow_plugins.inspect.orientation_errors import (
    PoseError,
    pose_errors,
    pose_findings,
    tie_findings,
)
from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom
from ruamel.yaml import YAML
from scipy.stats import binomtest

from orthoflow.catalog.discovery import Catalog, discover_catalog
from orthoflow.errors import OrthoflowError
from orthoflow.files.images import decode_image
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import (
    Camera,
    Cameras,
    Inspection,
    Photos,
    PointCloud,
    Truth,
    Walls,
)
from orthoflow.sdk import Method, StepContext
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import Cell, CellOutput, expand_cells

ROOT: Final = Path(__file__).resolve().parents[1]
# The rooms that are summed up, and others by which rankings are checked.
SETS: Final = (range(1, 11), range(101, 106))
DRAWN: Final = {"geometry": "drawn", "decoration": "drawn"}
COARSE: Final = {
    **DRAWN,
    "scan_step_m": 0.006,
    "panorama_step_m": 0.04,
    "photo_gsd_m": 0.005,
}
# Recipes of a part, and what is set in their rooms.
RECIPES: Final[Mapping[str, tuple[tuple[str, ...], dict[str, Any]]]] = {
    "planes": (
        ("workflows/plane-methods.yaml", "benchmarks/paper_planes.yaml"),
        {**DRAWN, "scan_step_m": 0.03},
    ),
    "orient": (("workflows/orient-methods.yaml",), COARSE),
    "ortho": (("workflows/ortho-methods.yaml",), COARSE),
}
PAGES: Final = ROOT / "benchmarks" / "pages"
WALL_GSD_M: Final = 0.008
# skarlatos2012, 4.2: the DSM of LPS had 5 cm at cells of 2 cm.
DSM_CELLS: Final = 2.5
# A ranking is stated where it holds in this share of the rooms of each set, and a two-sided sign
# test over all rooms gives less than this probability by chance.
RANKING_SHARE: Final = 0.9
RANKING_P: Final = 0.05
# Nearest and farthest surface from a camera.
RANGES_M: Final = (1.5, 3.6)
# Photos of a row of `variant2`.
PER_ROW: Final = 6
PLACE: Final = re.compile(r"\{\{(\w+): ([^}]+)\}\}")


@dataclass(kw_only=True)
class Context(StepContext):
    """The context of a method whose figures nobody looks at."""

    def figure(self, name: str, content: Any, caption: str = "") -> None:
        """Leave the figure out."""


def run(
    method: type[Method], inputs: Any, seed: int, /, **params: Any
) -> tuple[Any, dict[str, float]]:
    """Run a method; return what it gives and its metrics."""
    with tempfile.TemporaryDirectory() as folder:
        ctx = Context(rng=np.random.default_rng(seed), cores=2, scratch=Path(folder))
        out = method().run(inputs, method.Params.model_validate(params), ctx)
    return out, {metric.name: float(metric.value) for metric in ctx.metrics}


def recipes(part: str, seed: int) -> Iterator[tuple[str, float]]:
    """Run the recipes of a part in one room; return metrics by `cell metric`."""
    catalog = discover_catalog()
    for name in RECIPES[part][0]:
        given: dict[str, Any] = {}
        poses: dict[str, tuple[PoseError, ...]] = {}
        for cell in cells_of(part, name, seed, catalog):
            sources = cell.inputs.items()
            if cell.skip_reason or not all(str(source) in given for _, source in sources):
                continue
            method = catalog.method(cell.method).load()
            inputs = method.In(**{port: given[str(source)] for port, source in sources})
            # A method that refuses what a room gives it has no number of that room.
            with suppress(OrthoflowError):
                out, metrics = run(method, inputs, cell.seed, **cell.params)
                for port in vars(out):
                    given[str(CellOutput(address=cell.address, port=port))] = getattr(out, port)
                for metric, value in metrics.items():
                    yield f"{cell.address} {metric}", value
                if part == "orient" and cell.step == "orient":
                    errors = poses_against_truth(out.cameras, given)
                    poses[cell.address] = errors
                    ties = tie_findings(out.cameras, given["wall.walls"], given["room.truth"])
                    for finding in [*pose_findings(errors), *ties]:
                        yield f"{cell.address} {finding.name}", finding.value
        points = {
            address.removesuffix(".inspection"): by_point(product)
            for address, product in given.items()
            if address.startswith("points@")
        }
        yield from on_common(points, WALL_GSD_M)
        yield from common_poses(poses)


def poses_against_truth(cameras: Cameras, given: Mapping[str, Any]) -> tuple[PoseError, ...]:
    """Return true errors of poses, also of photos that were refused."""
    truth: Truth = given["room.truth"]
    views = SceneCameras(truth.scene, cores=2)
    return tuple(pose_errors(cameras, given["wall.walls"], truth, views))


def common_poses(poses: Mapping[str, Sequence[PoseError]]) -> Iterator[tuple[str, float]]:
    """Return the RMS error on the wall of the photos that all methods orient by guided ties."""
    walls_mm = {
        address: {
            error.photo: 1e3 * error.wall_m
            for error in errors
            if error.status == "ok" and error.wall_m is not None
        }
        for address, errors in poses.items()
        if "reties=guided" in address
    }
    common = set.intersection(*map(set, walls_mm.values())) if walls_mm else set()
    for address, found in walls_mm.items():
        yield f"{address} common_n_photos", float(len(common))
        if common:
            rms_mm = float(np.sqrt(np.mean([found[photo] ** 2 for photo in common])))
            yield f"{address} common_pose_wall_rms_mm", rms_mm


def cells_of(part: str, name: str, seed: int, catalog: Catalog) -> list[Cell]:
    """Return the cells of a recipe in a room that pages name, and those that these need."""
    tree = YAML(typ="safe").load((ROOT / name).read_text())
    tree["seed"] = seed
    tree["steps"]["room"]["params"].update(RECIPES[part][1])
    if "wall" in tree["steps"]:
        tree["steps"]["wall"]["params"]["gsd_m"] = WALL_GSD_M
        tree["compare"]["design"] = "one-at-a-time"
    for step in tree["steps"].values():
        for variant in step.get("variants", {}).values():
            variant.pop("repeat", None)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recipe.yaml"
        path.write_text(json.dumps(tree))
        cells = expand_cells(load_workflow(path, catalog), catalog)
    needed = cells_named(part)
    for cell in reversed(cells):
        if cell.address in needed:
            sources = cell.inputs.values()
            needed |= {one.address for one in sources if isinstance(one, CellOutput)}
    return [cell for cell in cells if cell.address in needed]


def cells_named(part: str) -> set[str]:
    """Return the addresses of cells of which the pages state a metric."""
    places = [
        place[2]
        for page in PAGES.glob("*.md")
        for place in PLACE.finditer(page.read_text())
        if place[1] == part
    ]
    return {word for place in places for word in place.split() if "@" in word}


def on_common(points: Mapping[str, Residuals], gsd_m: float) -> Iterator[tuple[str, float]]:
    """Return statistics over the check points that all orthoimages show, by class.

    Args:
        points: cell -> residuals of its orthoimage.
        gsd_m: side of a cell.
    """
    if not points:
        return
    common = set.intersection(*(set(found) for found in points.values()))
    for address, found in points.items():
        yield f"{address} n_of_its_own", float(len(found))
        for kind in ("flat", "vertical edge", "all"):
            shifts_m = np.array([found[key] for key in common if kind in ("all", key[0])])
            prefix = f"common_{kind.replace(' ', '_')}_"
            yield f"{address} {prefix}n", float(len(shifts_m))
            if len(shifts_m):
                for finding in check_findings(shifts_m, gsd_m, prefix=prefix):
                    yield f"{address} {finding.name}", finding.value


def surfaces(seed: int) -> Iterator[tuple[str, float]]:
    """Return errors of orthoimages on a scanned and on a matched surface of a room."""
    room = run(
        SimulateRoom,
        SimulateRoom.In(),
        seed,
        **COARSE,
        # Drawn walls have 0 to 16 corners that are seen, too few for check points at edges.
        n_plaques=24,
        photo_layout="variant2",
        # Of oblique neighbours one may stand above the other, which the matching of rows excludes.
        photo_obliquity_deg=3.0,
        check_points_most=40,
    )[0]
    seen = {"photos": room.photos, "cameras": room.truth.cameras}
    main = room.truth.planes.names.index("main wall")

    def walls_of(cloud: PointCloud, gsd_m: float) -> Walls:
        inputs = RasterGrid.In(cloud=cloud, planes=room.truth.planes)
        walls: Walls
        walls = run(RasterGrid, inputs, seed, gsd_m=gsd_m, buffer_m=0.3, ranks=(main,))[0].walls
        return walls

    coloured = run(ColourPhotos, ColourPhotos.In(cloud=room.cloud, **seen), seed)[0].cloud
    matched = matched_cloud(room)
    on_scan, on_matched = (walls_of(cloud, WALL_GSD_M) for cloud in (coloured, matched))
    on_dsm = coarser(on_matched, walls_of(matched, DSM_CELLS * WALL_GSD_M))
    points = {}
    for name, walls, cloud in (
        ("scanned,backward", on_scan, coloured),
        ("scanned,direct", on_scan, coloured),
        ("matched,backward", on_matched, matched),
        ("matched,coarse", on_dsm, matched),
        ("matched,direct", on_matched, matched),
    ):
        if name.endswith("direct"):
            direct = PointcloudDirect.In(walls=walls, cloud=cloud)
            layers = run(PointcloudDirect, direct, seed)[0].layers
        else:
            backward = DsmBackward.In(walls=walls, cloud=cloud, **seen)
            layers = run(DsmBackward, backward, seed)[0].layers
        joined = MosaicSeams.In(layers=layers, walls=walls)
        images = run(MosaicSeams, joined, seed, gains="none")[0].orthoimages
        asked = InspectCheckpoints.In(
            orthoimages=images, walls=walls, truth=room.truth, checkpoints=room.checkpoints
        )
        inspection = run(InspectCheckpoints, asked, seed)[0].inspection
        points[f"points@{name}"] = by_point(inspection)
    yield from on_common(points, WALL_GSD_M)


def coarser(walls: Walls, dsm: Walls) -> Walls:
    """Return walls whose depths are interpolated from those of a coarser raster."""
    (wall,), (coarse,) = walls.walls, dsm.walls
    rows, columns = np.mgrid[: wall.frame.height, : wall.frame.width] + 0.5
    cells = np.column_stack([columns.ravel(), rows.ravel()])
    at = coarse.frame.wall_from_world(wall.frame.world_from_wall(cells))[:, :2] - 0.5
    across, down = (axis.reshape(rows.shape).astype(np.float32) for axis in at.T)
    depth_m = cv2.remap(
        coarse.depth_m.astype(np.float32), across, down, cv2.INTER_LINEAR, borderValue=(np.nan,)
    )
    both = np.isfinite(depth_m) & np.isfinite(wall.depth_m)
    mixed_m = np.where(both, depth_m, wall.depth_m).astype(wall.depth_m.dtype)
    return replace(walls, walls=(replace(wall, depth_m=mixed_m),))


Residuals = Mapping[tuple[Any, ...], NDArray[np.float64]]


def by_point(inspection: Inspection) -> Residuals:
    """Return residuals (2,) in metres, by class and place."""
    places = np.round(inspection.points_world, 3)
    return {
        (inspection.kinds[kind], *place.tolist()): shift_m
        for kind, place, shift_m in zip(
            inspection.kind, places, inspection.displacement_m, strict=True
        )
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


def measured(folder: Path, part: str, seed: int) -> dict[str, float]:
    """Return the numbers of a room, measured now unless its file is there."""
    path = folder / f"{part}-{seed}.json"
    if not path.is_file():
        started_s = time.process_time()
        values = dict(surfaces(seed) if part == "surfaces" else recipes(part, seed))
        values["processor_s"] = time.process_time() - started_s
        unfinished = path.with_suffix(".part")
        unfinished.write_text(json.dumps(values, indent=0))
        unfinished.replace(path)
        print(f"{path.name}: {values['processor_s']:.0f} s of processor", flush=True)
    return dict(json.loads(path.read_text()))


Sets = Mapping[str, Sequence[Sequence[Mapping[str, float]]]]


def filled_in(text: str, sets: Sets) -> str:
    """Put the numbers of rooms into the places of a text.

    Args:
        text: with places `{{part: cell metric}}`, `{{part: cell metric : share}}` for per cent,
            `: mean` without scatter, `: median`, and
            `{{part: cell metric < cell metric ? text | other text}}`.
        sets: part -> sets -> rooms -> numbers by `cell metric`.
    """
    return PLACE.sub(lambda place: _text_of(place[2].strip(), sets[place[1]]), text)


def _text_of(place: str, sets: Sequence[Sequence[Mapping[str, float]]]) -> str:
    if " < " in place:
        ranking, _, texts = place.partition(" ? ")
        stated, _, otherwise = texts.partition(" | ")
        counts = [counted(*ranking.split(" < "), rooms) for rooms in sets]
        rooms = " and ".join(f"{n_true} of {n_both}" for n_true, n_both in counts)
        return f"{stated if ranking_holds(counts) else otherwise} ({rooms} rooms)"
    key, _, form = place.partition(" : ")
    factor = 100.0 if form == "share" else 1.0
    values = factor * np.abs([room[key] for room in sets[0] if key in room])
    if not len(values):
        return "no value" if any(sets[0]) else "not measured"
    if form in ("mean", "median"):
        return _number(float(getattr(np, form)(values)))
    # Without spaces, so that lines are not broken there.
    spread = f"±{_number(float(values.std(ddof=1)), 2)}" if len(values) > 1 else ""
    return f"{_number(float(values.mean()))}{spread}"


def counted(first: str, second: str, rooms: Sequence[Mapping[str, float]]) -> tuple[int, int]:
    """Return in how many rooms the first is smaller, and how many have both."""
    both = [(abs(room[first]), abs(room[second])) for room in rooms if {first, second} <= set(room)]
    return sum(a < b for a, b in both), len(both)


def ranking_holds(counts: Sequence[tuple[int, int]]) -> bool:
    """Report whether a ranking may be stated: it holds in both sets of seeds, not by chance.

    Args:
        counts: of each set, in how many rooms it holds, and how many there are.
    """
    n_true, n_both = (sum(column) for column in zip(*counts, strict=True))
    if not all(n and true >= RANKING_SHARE * n for true, n in counts):
        return False
    return bool(binomtest(n_true, n_both).pvalue < RANKING_P)


def _number(value: float, digits: int = 3) -> str:
    # Never as a power of ten.
    return np.format_float_positional(
        float(f"{value:.{digits}g}"), trim="-", fractional=False, precision=digits
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--part", action="append", choices=[*RECIPES, "surfaces"])
    parser.add_argument("--rooms", type=int, default=10, help="of each set, at most")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    parts = [*RECIPES, "surfaces"]
    for n_rooms in range(options.rooms):
        for seeds in SETS:
            for part in options.part or parts:
                if n_rooms < len(seeds):
                    measured(options.folder, part, seeds[n_rooms])
    sets = {
        part: [[_read(options.folder, part, seed) for seed in seeds] for seeds in SETS]
        for part in parts
    }
    rooms = {
        part: [[room for room in seeds if room] for seeds in both] for part, both in sets.items()
    }
    newest_s = max(path.stat().st_mtime for path in options.folder.glob("*.json"))
    counts = ", ".join(f"{part} {len(one)} and {len(two)}" for part, (one, two) in rooms.items())
    made = (
        f"Measured {datetime.fromtimestamp(newest_s, UTC):%Y-%m-%d} on {platform.machine()}, "
        f"{os.cpu_count()} cores, Python {platform.python_version()}; rooms of the first and the "
        f"second set of seeds: {counts}"
    )
    for page in sorted(PAGES.glob("*.md")):
        text = page.read_text().replace("{{made}}", made)
        (ROOT / "docs" / page.name).write_text(filled_in(text, rooms))


def _read(folder: Path, part: str, seed: int) -> dict[str, float]:
    """Return the numbers of a room, with shares of planes found; none of one not measured."""
    path = folder / f"{part}-{seed}.json"
    room: dict[str, float] = json.loads(path.read_text()) if path.is_file() else {}
    for key in [key for key in room if key.endswith(" true_planes_found")]:
        cell = key.partition(" ")[0]
        room[f"{cell} found_share"] = room[key] / room[f"{cell} true_planes"]
    return room


if __name__ == "__main__":
    main()
