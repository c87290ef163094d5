"""Measure the rows of docs/papers.md in drawn rooms, and write it and docs/choosing.md.

    python benchmarks/drawn_rooms.py FOLDER
    python benchmarks/drawn_rooms.py FOLDER --part surfaces --rooms 5

Directions, leans and distances of all planes, decoration, scanner stations, photos and lens are
drawn from a room's seed: ten rooms from 1 on, and five others from 101 on, by which rankings are
checked. Each room is measured four times: `planes` (plane-methods.yaml, paper_planes.yaml),
`orient` (orient-methods.yaml), `ortho` (ortho-methods.yaml) and `surfaces`, where orthoimages are
made from photos on a surface (backward) and from points (direct), on the scan and on points that
semi-global matching (OpenCV) finds in the photos, as skarlatos2012 had; orientations are the true
ones there. Check points are compared over those that all orthoimages of a room show.

Every room goes to `FOLDER/<part>-<seed>.json` as soon as it is measured, and is not measured again.
From these files and the pages of benchmarks/pages docs/papers.md and docs/choosing.md are written:
a place `{{part: cell metric}}` becomes mean ± standard deviation (largest) of the first ten rooms,
`{{part: cell metric < cell metric}}` in how many rooms of each set that holds.
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
from dataclasses import dataclass
from datetime import UTC, datetime
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
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom
from ruamel.yaml import YAML

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.errors import OrthoflowError
from orthoflow.files.images import decode_image
from orthoflow.products import Camera, Inspection, Photos, PointCloud
from orthoflow.sdk import Method, StepContext
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import CellOutput, expand_cells

ROOT: Final = Path(__file__).resolve().parents[1]
# The rooms that are summed up, and others by which rankings are checked.
SETS: Final = (range(1, 11), range(101, 106))
DRAWN: Final = {"geometry": "drawn", "decoration": "drawn"}
COARSE: Final = {
    **DRAWN,
    "scan_step_m": 0.005,
    "panorama_step_m": 0.03,
    "photo_gsd_m": 0.004,
}
# Recipes of a part, what is set in their rooms, and cells of their walls.
RECIPES: Final[Mapping[str, tuple[tuple[str, ...], dict[str, Any]]]] = {
    "planes": (
        ("workflows/plane-methods.yaml", "benchmarks/paper_planes.yaml"),
        {**DRAWN, "scan_step_m": 0.03},
    ),
    "orient": (("workflows/orient-methods.yaml",), COARSE),
    "ortho": (("workflows/ortho-methods.yaml",), COARSE),
}
WALL_GSD_M: Final = 0.006
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
    names, room = RECIPES[part]
    catalog = discover_catalog()
    for name in names:
        tree = YAML(typ="safe").load((ROOT / name).read_text())
        tree["seed"] = seed
        tree["steps"]["room"]["params"].update(room)
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
        given: dict[str, Any] = {}
        for cell in cells:
            sources = cell.inputs.items()
            if cell.skip_reason or not all(str(source) in given for _, source in sources):
                continue
            if part == "orient" and cell.step == "surf" and not cell.address.endswith("=dlt"):
                # Of orientations only the DLT is compared with the intensity (Figure 25).
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
        points = {
            address: by_point(product)
            for address, product in given.items()
            if address.startswith("points@")
        }
        yield from on_common(points)


def on_common(points: Mapping[str, Mapping[tuple[Any, ...], float]]) -> Iterator[tuple[str, float]]:
    """Return RMS lengths in mm over the check points that all orthoimages show, by class."""
    if not points:
        return
    common = set.intersection(*(set(found) for found in points.values()))
    for address, found in points.items():
        name = address.removesuffix(".inspection")
        yield f"{name} n_of_its_own", float(len(found))
        for kind in ("flat", "vertical edge", "all"):
            lengths = np.array([found[key] for key in common if kind in ("all", key[0])])
            yield f"{name} common_{kind.replace(' ', '_')}", float(len(lengths))
            if len(lengths):
                rms_mm = float(np.sqrt(np.mean(lengths**2)))
                yield f"{name} common_{kind.replace(' ', '_')}_mm", rms_mm


def numbers(inspection: Inspection) -> dict[str, float]:
    return {finding.name: finding.value for finding in inspection.findings if finding.wall <= 0}


def surfaces(seed: int) -> Iterator[tuple[str, float]]:
    """Return errors of orthoimages on a scanned and on a matched surface of a room."""
    room = run(
        SimulateRoom,
        SimulateRoom.In(),
        seed,
        **COARSE,
        photo_layout="variant2",
        # Of oblique neighbours one may stand above the other, which the matching of rows excludes.
        photo_obliquity_deg=3.0,
        check_points_most=20,
    )[0]
    cameras = room.truth.cameras
    seen = {"photos": room.photos, "cameras": cameras}
    coloured = run(ColourPhotos, ColourPhotos.In(cloud=room.cloud, **seen), seed)[0].cloud
    points = {}
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
            asked = InspectCheckpoints.In(checkpoints=room.checkpoints, **shown)
            name = f"points@{source},{way}"
            points[name] = by_point(run(InspectCheckpoints, asked, seed)[0].inspection)
            found = numbers(run(InspectTruth, InspectTruth.In(**shown), seed)[0].inspection)
            for metric in ("rmse_u_mm", "rmse_v_mm", "completeness"):
                yield f"check@{source},{way} {metric}", found[metric]
    yield from on_common(points)


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
            `: mean` without scatter, `: median`, and `{{part: cell metric < cell metric}}`.
        sets: part -> sets -> rooms -> numbers by `cell metric`.
    """
    return PLACE.sub(lambda place: _text_of(place[2].strip(), sets[place[1]]), text)


def _text_of(place: str, sets: Sequence[Sequence[Mapping[str, float]]]) -> str:
    if " < " in place:
        first, second = place.split(" < ")
        counts = [_how_often(first, second, rooms) for rooms in sets if rooms]
        return " and ".join(counts) or "not yet measured"
    key, _, form = place.partition(" : ")
    if form == "n":
        return str(sum(key in room for room in sets[0]))
    factor = 100.0 if form == "share" else 1.0
    values = factor * np.abs([room[key] for room in sets[0] if key in room])
    if not len(values):
        return "no value in these rooms" if any(sets[0]) else "not yet measured"
    if form in ("mean", "median"):
        return _number(float(getattr(np, form)(values)))
    spread = f" ± {_number(float(values.std(ddof=1)), 2)}" if len(values) > 1 else ""
    return f"{_number(float(values.mean()))}{spread} ({_number(float(values.max()))})"


def _how_often(first: str, second: str, rooms: Sequence[Mapping[str, float]]) -> str:
    both = [(abs(room[first]), abs(room[second])) for room in rooms if {first, second} <= set(room)]
    return f"{sum(a < b for a, b in both)} of {len(both)}"


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
    made = (
        f"{datetime.fromtimestamp(newest_s, UTC):%Y-%m-%d} on {platform.machine()}, "
        f"{os.cpu_count()} cores, Python {platform.python_version()}, in rooms of both sets: "
        + ", ".join(f"{part} {len(one)} and {len(two)}" for part, (one, two) in rooms.items())
    )
    for page in sorted((ROOT / "benchmarks" / "pages").glob("*.md")):
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
