"""Measure the rows of docs/papers.md in random rooms; write this page and docs/choosing.md.

    python benchmarks/drawn_rooms.py FOLDER
    python benchmarks/drawn_rooms.py FOLDER --part surfaces --rooms 5
    orthoflow runs FOLDER --table numbers.csv

The directions, tilts and distances of all planes, the decoration, scanner stations, photos and lens
of a room are determined by its seed: ten rooms have seeds from 1, and five other rooms, which
verify rankings, have seeds from 101. Each room is measured in four parts: `planes`
(plane-methods.yaml, paper_planes.yaml), `orient` (orient-methods.yaml), `ortho`
(ortho-methods.yaml) and `surfaces` (matched_surface.yaml). The last part compares orthoimages from
photos projected onto a surface (backward) with those from points (direct), for the scan and for
points matched in the photos, as in skarlatos2012. Comparisons include only the check points that
all orthoimages of a room show, and only the photos that all methods orient.

The runs of a room are recorded in `FOLDER/<part>-<seed>/`, together with the numbers for the pages
in `numbers.json`; finished runs are not repeated. Products are deleted after the room is measured.
docs/papers.md and docs/choosing.md are written from these files and the templates in
benchmarks/pages. `{{part: cell metric}}` is replaced by mean±standard deviation over the first ten
rooms. `{{part: cell metric < cell metric ? text | other text}}` is replaced by the text if the
ranking holds (see `ranking_holds`), otherwise by the other text, and by the counts of rooms.
Combinations of variants that no page uses are not run.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.inspect.findings import check_findings
from orthoflow_plugins.inspect.orientation_errors import (
    PoseError,
    pose_errors,
    pose_findings,
    tie_findings,
)
from ruamel.yaml import YAML
from scipy.stats import binomtest

import orthoflow
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import Inspection
from orthoflow.records.runs import cell_metrics
from orthoflow.report.notebooks import OpenedRun

ROOT: Final = Path(__file__).resolve().parents[1]
# Seeds of the rooms that are summarised, and of those with which rankings are verified.
SETS: Final = (range(1, 11), range(101, 106))
DRAWN: Final = {"geometry": "drawn", "decoration": "drawn"}
COARSE: Final = {
    **DRAWN,
    "scan_step_m": 0.006,
    "panorama_step_m": 0.04,
    "photo_gsd_m": 0.005,
}
# Recipes of a part, and parameters of their rooms.
RECIPES: Final[Mapping[str, tuple[tuple[str, ...], dict[str, Any]]]] = {
    "planes": (
        ("workflows/plane-methods.yaml", "benchmarks/paper_planes.yaml"),
        {**DRAWN, "scan_step_m": 0.03},
    ),
    "orient": (("workflows/orient-methods.yaml",), COARSE),
    "ortho": (("workflows/ortho-methods.yaml",), COARSE),
    "surfaces": (("benchmarks/matched_surface.yaml",), {}),
}
PAGES: Final = ROOT / "benchmarks" / "pages"
WALL_GSD_M: Final = 0.008
# A ranking holds if it is true in at least this share of the rooms of each set, and if the
# probability of a chance result in a two-sided sign test over all rooms is less than the second
# value.
RANKING_SHARE: Final = 0.9
RANKING_P: Final = 0.05
PLACE: Final = re.compile(r"\{\{(\w+): ([^}]+)\}\}")


Residuals = Mapping[tuple[Any, ...], NDArray[np.float64]]


def measure(folder: Path, part: str, seed: int) -> Iterator[tuple[str, float]]:
    """Run the recipes of a part in one room; return metrics by `cell metric`."""
    store = folder / "store"
    points: dict[str, Residuals] = {}
    poses: dict[str, tuple[PoseError, ...]] = {}
    for name in RECIPES[part][0]:
        workflow = folder / f"{Path(name).stem}.json"
        workflow.write_text(json.dumps(reduced(part, name, seed)))
        run = orthoflow.run(workflow, output=folder / workflow.stem, store=store, executor="inline")
        for cell in run.record.cells:
            for row in cell_metrics(cell):
                yield f"{cell.address} {row.metric}", row.value
            if cell.status != "ok":
                continue
            if "inspection" in cell.outputs and cell.method == "inspect.checkpoints":
                points[cell.address] = by_point(
                    run.product(cell.address, "inspection", store=store)
                )
            if part == "orient" and cell.step == "orient":
                found, errors = errors_of_orientation(run, cell.address, store)
                poses[cell.address] = errors
                for finding in found:
                    yield f"{cell.address} {finding.name}", finding.value
    yield from on_common(points, WALL_GSD_M)
    yield from common_poses(poses)
    # Delete gigabytes that the records do not need.
    shutil.rmtree(store)
    for products in folder.glob("*/products"):
        shutil.rmtree(products)


def errors_of_orientation(
    run: OpenedRun, address: str, store: Path
) -> tuple[list[Any], tuple[PoseError, ...]]:
    """Return findings on poses and ties, and pose errors including those of rejected photos."""
    cameras = run.product(address, "cameras", store=store)
    walls, truth = (
        run.product(*place, store=store) for place in (("wall", "walls"), ("room", "truth"))
    )
    errors = tuple(pose_errors(cameras, walls, truth, SceneCameras(truth.scene, cores=2)))
    return [*pose_findings(errors), *tie_findings(cameras, walls, truth)], errors


def common_poses(poses: Mapping[str, Sequence[PoseError]]) -> Iterator[tuple[str, float]]:
    """Return the RMS error on the wall for photos that all methods orient by guided ties."""
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


def reduced(part: str, name: str, seed: int) -> dict[str, Any]:
    """Return a recipe for a room, with only the steps and combinations that the pages use."""
    tree: dict[str, Any] = YAML(typ="safe").load((ROOT / name).read_text())
    steps = tree["steps"]
    named = [assignment_of(address) for address in cells_named(part)]
    ends = {address.partition("@")[0] for address in cells_named(part)}
    kept = {step for end in ends & set(steps) for step in needed(end, steps)}
    tree |= {"seed": seed, "steps": {step: steps[step] for step in steps if step in kept}}
    tree["steps"]["room"]["params"].update(RECIPES[part][1])
    if "wall" in kept:
        tree["steps"]["wall"]["params"]["gsd_m"] = WALL_GSD_M
    varied: dict[str, list[str]] = {}
    for step, content in tree["steps"].items():
        if "variants" in content:
            used = {one[step] for one in named if step in one}
            content["variants"] = {k: v for k, v in content["variants"].items() if k in used}
            varied[step] = list(content["variants"])
            for variant in content["variants"].values():
                variant.pop("repeat", None)
    # List the combinations that no page uses, of steps that are combined on a page.
    left_out = [
        combination
        for together in {tuple(one): None for one in named}
        for combination in combinations(together, varied)
        if not any(combination.items() <= one.items() for one in named)
    ]
    first = next(
        one
        for one in combinations(tuple(varied), varied)
        if not any(other.items() <= one.items() for other in left_out)
    )
    tree["compare"] = {"design": "product", "baseline": first}
    if left_out:
        tree["compare"]["exclude"] = left_out
    return tree


def combinations(
    steps: Sequence[str], variants: Mapping[str, Sequence[str]]
) -> list[dict[str, str]]:
    """Return all combinations of variants of some steps."""
    chosen = product(*(variants[step] for step in steps))
    return [dict(zip(steps, one, strict=True)) for one in chosen]


def needed(step: str, steps: Mapping[str, Any]) -> set[str]:
    """Return a step and all steps on which it depends."""
    found = {step}
    for sources in steps[step].get("in", {}).values():
        for source in [sources] if isinstance(sources, str) else sources:
            before = source.partition(".")[0]
            if before in steps:
                found |= needed(before, steps)
    return found


def assignment_of(address: str) -> dict[str, str]:
    """Return the variant of each step of a cell.

    >>> assignment_of("orient@reties=guided,orient=dlt")
    {'reties': 'guided', 'orient': 'dlt'}
    """
    return dict(pair.split("=") for pair in address.partition("@")[2].split(","))


def cells_named(part: str) -> set[str]:
    """Return the addresses of the cells whose metrics are on the pages."""
    places = [
        place[2]
        for page in PAGES.glob("*.md")
        for place in PLACE.finditer(page.read_text())
        if place[1] == part
    ]
    return {word for place in places for word in place.split() if "@" in word}


def on_common(points: Mapping[str, Residuals], gsd_m: float) -> Iterator[tuple[str, float]]:
    """Return statistics, by class, of the check points that all orthoimages show.

    Args:
        points: residuals of the orthoimage of each cell.
        gsd_m: cell size.
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


def by_point(inspection: Inspection) -> Residuals:
    """Return residuals (2,) in metres by class and position."""
    places = np.round(inspection.points_world, 3)
    return {
        (inspection.kinds[kind], *place.tolist()): shift_m
        for kind, place, shift_m in zip(
            inspection.kind, places, inspection.displacement_m, strict=True
        )
    }


def measured(folder: Path, part: str, seed: int) -> None:
    """Measure a room unless its numbers exist."""
    room = folder / f"{part}-{seed}"
    if (room / "numbers.json").is_file():
        return
    shutil.rmtree(room, ignore_errors=True)
    room.mkdir(parents=True)
    started_s = time.process_time()
    values = dict(measure(room, part, seed))
    (room / "numbers.json").write_text(json.dumps(values, indent=0))
    print(f"{room.name}: {time.process_time() - started_s:.0f} s of processor", flush=True)


Sets = Mapping[str, Sequence[Sequence[Mapping[str, float]]]]


def filled_in(text: str, sets: Sets) -> str:
    """Replace the placeholders of a text by the numbers of rooms.

    Args:
        text: text with placeholders `{{part: cell metric}}`, `{{part: cell metric : share}}` for
            per cent, `: mean` without scatter, `: median`, and
            `{{part: cell metric < cell metric ? text | other text}}`, where COUNTS in a text is
            replaced by the numbers of rooms in which the first value is smaller.
        sets: for each part, set and room, the numbers by `cell metric`.
    """
    return PLACE.sub(lambda place: _text_of(place[2].strip(), sets[place[1]]), text)


def _text_of(place: str, sets: Sequence[Sequence[Mapping[str, float]]]) -> str:
    if " < " in place:
        ranking, _, texts = place.partition(" ? ")
        stated, _, otherwise = texts.partition(" | ")
        counts = [counted(*ranking.split(" < "), rooms) for rooms in sets]
        rooms = " and ".join(f"{n_true} of {n_both}" for n_true, n_both in counts)
        text = stated if ranking_holds(counts) else otherwise
        # Without a ranking, the text itself states which of the two the counts refer to.
        if "COUNTS" in text:
            return text.replace("COUNTS", f"{rooms} rooms")
        return f"{text} ({rooms} rooms)"
    key, _, form = place.partition(" : ")
    factor = 100.0 if form == "share" else 1.0
    values = factor * np.abs([room[key] for room in sets[0] if key in room])
    if not len(values):
        return "no value" if any(sets[0]) else "not measured"
    if form in ("mean", "median"):
        return _number(float(getattr(np, form)(values)))
    # Use no spaces, so that lines are not broken there.
    spread = f"±{_number(float(values.std(ddof=1)), 2)}" if len(values) > 1 else ""
    return f"{_number(float(values.mean()))}{spread}"


def counted(first: str, second: str, rooms: Sequence[Mapping[str, float]]) -> tuple[int, int]:
    """Return the number of rooms where the first value is smaller, and of rooms with both."""
    both = [(abs(room[first]), abs(room[second])) for room in rooms if {first, second} <= set(room)]
    return sum(a < b for a, b in both), len(both)


def ranking_holds(counts: Sequence[tuple[int, int]]) -> bool:
    """Return whether a ranking is significant, that is, true in both sets and not by chance.

    Args:
        counts: for each set, the number of rooms where the ranking is true, and the number of
            rooms.
    """
    n_true, n_both = (sum(column) for column in zip(*counts, strict=True))
    if not all(n and true >= RANKING_SHARE * n for true, n in counts):
        return False
    return bool(binomtest(n_true, n_both).pvalue < RANKING_P)


def _number(value: float, digits: int = 3) -> str:
    # Never use exponents.
    return np.format_float_positional(
        float(f"{value:.{digits}g}"), trim="-", fractional=False, precision=digits
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--part", action="append", choices=RECIPES)
    parser.add_argument("--rooms", type=int, default=10, help="of each set, at most")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    for n_rooms in range(options.rooms):
        for seeds in SETS:
            for part in options.part or RECIPES:
                if n_rooms < len(seeds):
                    measured(options.folder, part, seeds[n_rooms])
    sets = {
        part: [[_read(options.folder, part, seed) for seed in seeds] for seeds in SETS]
        for part in RECIPES
    }
    rooms = {
        part: [[room for room in seeds if room] for seeds in both] for part, both in sets.items()
    }
    newest_s = max(path.stat().st_mtime for path in options.folder.glob("*/numbers.json"))
    counts = {part: f"{len(one)} and {len(two)} rooms" for part, (one, two) in rooms.items()}
    stated = list(dict.fromkeys(counts.values()))
    if len(stated) > 1:
        stated = [f"{count} for {part}" for part, count in counts.items()]
    made = (
        f"Measured on {datetime.fromtimestamp(newest_s, UTC):%Y-%m-%d} ({platform.machine()}, "
        f"{os.cpu_count()} cores, Python {platform.python_version()}). The rooms "
        f"were generated from two sets of seeds ({', '.join(stated)})"
    )
    for page in sorted(PAGES.glob("*.md")):
        text = page.read_text().replace("{{made}}", made)
        (ROOT / "docs" / page.name).write_text(filled_in(text, rooms))


def _read(folder: Path, part: str, seed: int) -> dict[str, float]:
    """Return the numbers of a room with shares of planes found; empty if it was not measured."""
    path = folder / f"{part}-{seed}" / "numbers.json"
    room: dict[str, float] = json.loads(path.read_text()) if path.is_file() else {}
    for key in [key for key in room if key.endswith(" true_planes_found")]:
        cell = key.partition(" ")[0]
        room[f"{cell} found_share"] = room[key] / room[f"{cell} true_planes"]
    return room


if __name__ == "__main__":
    main()
