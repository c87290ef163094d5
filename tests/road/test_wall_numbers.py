"""One number per plane: planes.json, names of files, sidecars, tags, warnings, report, tables."""

from __future__ import annotations

import csv
import html
import json
import re
from pathlib import Path

import laspy
import numpy as np
import pytest

import orthoflow
from orthoflow.files.geotiff import read_raster
from tests.road.conftest import Shell, metrics_of

# Neither the first planes nor all of one kind, so that no place among the rasters is a number.
RANKS = (1, 3, 4)
SETS = ("room.scan_step_m=0.04", "wall.gsd_m=0.04", f"wall.ranks={list(RANKS)}")
NAMED = re.compile(r"\b(?:wall|floor|ceiling|level|slope) \d+\b")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Path:
    """A run of `direct.yaml` on some planes of the simulated room."""
    shell = Shell(tmp_path_factory.mktemp("numbers"), store)
    sets = (f"--set={item}" for item in SETS)
    shell("run", "direct.yaml", *sets, "-o", "run", "--executor", "inline")
    return shell.folder / "run"


@pytest.fixture(scope="module")
def names(folder: Path) -> dict[int, str]:
    """What planes.json calls the planes that were rastered."""
    planes = json.loads((folder / "products/plane/planes.json").read_text())["planes"]
    assert [plane["label"].split()[1] for plane in planes] == [str(k) for k in range(len(planes))]
    found = {rank: str(planes[rank]["label"]) for rank in RANKS}
    # Otherwise the test would not see a floor that has no number, or one of its own.
    assert len({name.split()[0] for name in found.values()}) > 1
    return found


@pytest.mark.parametrize("step", ["wall", "mosaic"])
def test_files_sidecars_and_tags_bear_the_plane_s_number(
    folder: Path, names: dict[int, str], step: str
) -> None:
    files = sorted((folder / "products" / step).glob("wall_*.tif"))
    assert {int(path.name.split("_")[1]) for path in files} == set(RANKS)
    for path in files:
        number = int(path.name.split("_")[1])
        sidecar = json.loads(path.with_suffix(".json").read_text())
        assert (sidecar["wall"], sidecar["name"]) == (number, names[number]), path.name
        assert read_raster(path).tags["name"] == names[number]


def test_whatever_is_said_of_a_wall_names_one_of_the_rastered_planes(
    folder: Path, names: dict[int, str]
) -> None:
    run = orthoflow.open_run(folder)
    said = [
        text
        for address in ("wall", "ortho", "mosaic", "check")
        for text in (
            *run.cells[address].warnings,
            *(figure.caption for figure in run.cells[address].figures),
        )
    ]
    named = {name for text in said for name in NAMED.findall(text)}
    assert named
    assert named <= set(names.values())
    figures = {
        int(match[1])
        for cell in run.cells.values()
        for figure in cell.figures
        if (match := re.match(r"wall_(\d+)_", figure.name))
    }
    assert figures == set(RANKS)


def test_metrics_and_the_report_use_the_same_numbers(folder: Path, names: dict[int, str]) -> None:
    metrics = metrics_of(folder)
    numbered = {int(name.split("_")[1]) for _, name in metrics if re.match(r"wall_\d+_", name)}
    assert numbered == set(RANKS[1:])  # those of the first one bear plain names
    with (folder / "products/metrics.csv").open() as file:
        assert any(row["metric"].startswith(f"wall_{RANKS[1]}_") for row in csv.DictReader(file))
    page = html.unescape((folder / "report.html").read_text())
    for number, name in names.items():
        assert f"products/mosaic/wall_{number}_ortho.tif" in page
        assert f"products/wall/wall_{number}_depth.tif" in page
        assert name in page
        # What the cursor tells, and writes into check points measured on the page.
        assert re.search(rf'"name": "{name}".*?"wall": {number}\b', page)


def test_clouds_are_cut_out_by_the_same_numbers(folder: Path, store: Path) -> None:
    shell = Shell(folder.parent, store)
    planes = json.loads((folder / "products/plane/planes.json").read_text())["planes"]
    for number in RANKS:
        wanted = (f"--wall={number}", f"--store={store}", "-o", f"cut_{number}")
        shell("export", "run", "--to", "laz", *wanted)
        with laspy.open(folder.parent / f"cut_{number}" / "cloud.laz") as reader:
            points = reader.read().xyz
        off_m = points @ np.array(planes[number]["normal"]) - planes[number]["offset_m"]
        # Relief and niches; points of another plane are metres off.
        assert np.abs(off_m).max() < 1.0, number
    refused = shell(
        "export", "run", "--to", "laz", "--wall=0", f"--store={store}", "-o", "cut_0", code=2
    )
    assert "--wall 0: the run has no wall 0; it has 1, 3, 4" in refused.said
