"""The benchmark of plane detectors on two of its rooms: one run, one record, one page over both."""

from __future__ import annotations

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from orthoflow.workflow.source import shipped_workflow
from tests.road.conftest import Shell, metrics_of

ROOMS = ("usual", "one-station")
DETECTORS = ("ransac", "region")


@pytest.fixture(scope="module")
def shell(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Shell:
    """A folder with the run `run`: two detectors in two coarse rooms."""
    shell = Shell(tmp_path_factory.mktemp("many-rooms"), store)
    yaml = YAML(typ="safe", pure=True)
    document = yaml.load(shipped_workflow("plane-benchmark").read_text())
    variants = document["steps"]["plane"]["variants"]
    document["steps"]["plane"]["variants"] = {name: variants[name] for name in DETECTORS}
    document["compare"]["baseline"] = {"plane": "region"}
    with (shell.folder / "quick.yaml").open("w") as stream:
        yaml.dump(document, stream)
    shell(
        "run", "quick.yaml", "--only-data", ",".join(ROOMS), "--set", "room.scan_step_m=0.05",
        "--executor", "inline", "-o", "run", timeout_s=900,
    )  # fmt: skip
    return shell


def test_every_detector_finds_the_main_wall_of_every_room(shell: Shell) -> None:
    found = metrics_of(shell.folder / "run")
    for cell in (f"check@data={room},plane={name}" for room in ROOMS for name in DETECTORS):
        # Measured: at most 0.005 deg and 0.15 mm, with a point every five centimetres.
        assert found[cell, "plane_angle_deg"] <= 0.02
        assert abs(found[cell, "plane_offset_mm"]) <= 1.0


def test_the_page_compares_the_detectors_over_the_rooms(shell: Shell) -> None:
    page = (shell.folder / "run" / "report.html").read_text()
    assert "2 of 2 datasets are complete" in page
    assert "Over all datasets" in page
    assert "check: direction error of the main plane" in page
    assert {path.stem for path in (shell.folder / "run" / "pages").iterdir()} == set(ROOMS)
