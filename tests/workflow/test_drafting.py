"""First workflows for one's own files: each names what was found, and is fine as it is."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.errors import InputError
from orthoflow.foreign_text import shown
from orthoflow.workflow import drafting as module
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.drafting import draft_workflow
from orthoflow.workflow.inputs import resolve_input_files
from orthoflow.workflow.recognising import Recognised
from tests.studios import asked, said

CALIBRATION = """cameras:
  "*": {width: 40, height: 30, fx: 50, fy: 50, cx: 20, cy: 15, distortion: [0, 0, 0, 0, 0]}
"""
TIES = "photo,u_px,v_px,x,y,z\na.jpg,1,2,3,4,5\n"
POINTS = "name,x,y,z\nP1,1,2,3\nP2,2,2,3\n"


def write_scan(path: Path) -> Path:
    cloud = laspy.LasData(laspy.LasHeader(point_format=2, version="1.2"))
    cloud.x = cloud.y = cloud.z = np.arange(500.0)
    cloud.write(str(path))
    return path


def write_photos(folder: Path, count: int) -> Path:
    folder.mkdir()
    for index in range(count):
        cv2.imwrite(str(folder / f"{chr(97 + index)}.jpg"), np.zeros((30, 40, 3), np.uint8))
    return folder


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder as a surveyor has it, with a name that is a pattern and needs quotes."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "the [old] hall"
    folder.mkdir()
    write_scan(folder / "hall.las")
    write_photos(folder / "photos", 3)
    (folder / "calibration.yaml").write_text(CALIBRATION)
    (folder / "checks.csv").write_text(POINTS)
    (folder / "ties.csv").write_text(TIES)
    (folder / "notes.txt").write_text("1 2 3\n4 5 6\n")
    (folder / "plan.dwg").write_bytes(b"AC1027")
    (folder / "IMG_7.CR2").write_bytes(b"II*\0")
    return folder


def inputs_of(workflow: Path) -> dict[str, list[str]]:
    loaded = load_workflow(workflow, discover_catalog())
    found = resolve_input_files(loaded)
    return {name: [path.name for path in files.paths] for name, files in found.items() if files}


def test_a_folder_becomes_a_workflow_that_is_fine_as_it_is(data: Path) -> None:
    out = said("new", data, "-o", "jobs/hall 1.yaml")
    assert said("check", "jobs/hall 1.yaml").startswith("hall-1 is fine: 20 steps")
    assert inputs_of(Path("jobs/hall 1.yaml")) == {
        "scan": ["hall.las"],
        "photos": ["a.jpg", "b.jpg", "c.jpg"],
        "calibration": ["calibration.yaml"],
        "checkpoints": ["checks.csv"],
        "ties": ["ties.csv"],
    }
    text = Path("jobs/hall 1.yaml").read_text()
    assert 'photos: {files: "../the [old] hall/photos"}  # 3 photos' in text
    assert "scan: hall.las, LAS/LAZ, 500 points, fields for intensity and colours" in out
    assert "calibration: calibration.yaml, a calibration of *" in out
    assert "checkpoints: checks.csv, 2 surveyed points" in out
    assert "ties: ties.csv, 1 tie" in out
    assert "not used: notes.txt: text, left out beside scans of other formats" in out
    assert "not used: plan.dwg: no method reads such files" in out
    assert "not used: IMG_7.CR2: camera raw, which is not read: develop to TIFF of 16 bits" in out
    assert "next: orthoflow check 'jobs/hall 1.yaml'" in out


def test_a_scan_alone_is_painted_from_its_own_colours_without_a_stand_in(data: Path) -> None:
    out = json.loads(said("new", data / "hall.las", data / "checks.csv", "--json"))
    assert (out["file"], out["recipe"], out["left_out"]) == ("workflow.yaml", "direct", [])
    text = Path("workflow.yaml").read_text()
    assert "room" not in text
    assert "orthoflow run direct.yaml" not in text
    # No step waits for a simulated room, none is skipped.
    assert said("check", "workflow.yaml") == "workflow is fine: 7 steps\n"


def test_a_plan_is_made_when_it_is_asked_for(data: Path) -> None:
    said("new", data / "hall.las", "-o", "plan.yaml", "--recipe", "plan")
    assert "check" in said("check", "plan.yaml") or "plan is fine" in said("check", "plan.yaml")
    assert inputs_of(Path("plan.yaml")) == {"scan": ["hall.las"]}


def test_several_scans_and_two_tables_of_points(data: Path) -> None:
    write_scan(data / "second.las")
    (data / "more.csv").write_text(POINTS)
    out = said("new", data, "-o", "w.yaml")
    assert inputs_of(Path("w.yaml"))["scan"] == ["hall.las", "second.las"]
    # Which one is to be checked with only the surveyor knows.
    assert "checkpoints" not in inputs_of(Path("w.yaml"))
    assert "not used: checks.csv, more.csv: checkpoints may be one of them only" in out


def test_a_table_of_coordinates_is_a_scan_and_no_list_of_points(tmp_path: Path) -> None:
    table = tmp_path / "cloud.csv"
    rows = np.column_stack([np.arange(50) + 0.125, np.zeros(50), np.ones(50), np.full(50, 0.5)])
    table.write_text("\n".join(",".join(f"{value:.3f}" for value in row) for row in rows))
    out = said("new", table, "-o", tmp_path / "w.yaml")
    assert out.startswith("scan: cloud.csv, text, ")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("nowhere",), "nowhere does not exist: give scans, photos, and folders with them"),
        (("photos",), "there is no scan among the files, and a workflow needs one (E57, LAS"),
        (("hall.las", "--recipe", "photos-on-scan"), "photos-on-scan needs photos, and there are"),
        (
            ("hall.las", "-o", "notes.txt"),
            "notes.txt is there already: choose another name with -o",
        ),
        (("torn.las",), "torn.las"),
    ],
)
def test_mistakes_get_a_sentence_and_no_file(
    data: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], sentence: str
) -> None:
    monkeypatch.chdir(data)
    (data / "torn.las").write_bytes((data / "hall.las").read_bytes()[:100])
    result = asked("new", *arguments)
    assert result.exit_code == 2
    assert sentence in result.output
    assert not (data / "workflow.yaml").exists()
    assert (data / "notes.txt").read_text() == "1 2 3\n4 5 6\n"


ODD = (
    "\u2028steps: []",
    "\x85name: evil",
    "\u202egpj",
    "\x7f\x9b2J",
    "\n# x",
    "\ufffe",
    "\U000e0001",
    '"#',
)


@pytest.mark.parametrize("odd", ODD, ids=ascii)
def test_no_name_of_a_file_says_more_than_that_it_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, odd: str
) -> None:
    monkeypatch.chdir(tmp_path)
    data = tmp_path / "data"
    data.mkdir()
    write_scan(data / f"hall{odd}.las")
    (data / f"left{odd}.doc").touch()
    write_photos(data / f"photos{odd}", 2)
    told = said("new", "data")
    assert told == shown(told, keep="\n")
    text = Path("workflow.yaml").read_text(encoding="utf-8")
    assert all(line.isprintable() for line in text.split("\n"))
    workflow = load_workflow(Path("workflow.yaml"), discover_catalog())
    assert workflow.name == "workflow"
    files = resolve_input_files(workflow)
    assert files["scan"] is not None
    assert [path.name for path in files["scan"].paths] == [f"hall{odd}.las"]


def test_a_path_that_is_no_text_is_left_out(data: Path) -> None:
    bad = os.fsdecode(os.fsencode(data) + b"/\xff.las")
    write_scan(data / "b.las").rename(bad)
    assert "not used: \\udcff.las: its path is no UTF-8: rename it" in said("new", data)
    assert "udcff" not in Path("workflow.yaml").read_text().partition("What follows")[2]


@pytest.mark.parametrize("name", ["a.xyz", "a.yaml", "a.csv", "cameras.json", "a.las", "z.jpg"])
def test_what_is_no_file_is_not_waited_for(data: Path, name: str) -> None:
    os.mkfifo(data / "photos" / name)
    zero = data.parent / f"link-{name}"
    zero.symlink_to("/dev/zero")
    told = said("new", data / "hall.las", data / "photos" / name, zero)
    assert f"not used: {name}, link-{name}: a pipe or a device" in told


# --- drafts by themselves ---


def found(kind: str, name: str, said: str = "something", n_photos: int = 0) -> Recognised:
    posed = n_photos if kind == "scan" else 0
    return Recognised(kind=kind, path=Path(name), said=said, n_photos=n_photos, n_posed=posed)  # type: ignore[arg-type]


def test_photos_in_a_scan_are_taken_where_there_are_no_others() -> None:
    scan = found("scan", "hall.e57", "a scan", 3)
    inside = draft_workflow([scan], Path("flow.yaml"), None)
    assert inside.recipe == "photos-on-scan"
    assert inside.inputs["photos"] == "hall.e57, the photos in it"
    assert inside.inputs["cameras"] == "hall.e57, the poses of its photos"
    beside = draft_workflow([scan, found("photos", "a.jpg", "a photo", 1)], Path("flow.yaml"), None)
    assert beside.inputs["photos"] == "a.jpg, a photo"
    assert "cameras" not in beside.inputs
    # Of two scans nobody knows whose poses are meant.
    two = draft_workflow([scan, found("scan", "b.e57", "a scan", 1)], Path("flow.yaml"), None)
    assert two.inputs["photos"] == "2 files: hall.e57, b.e57"
    assert "cameras" not in two.inputs
    given = draft_workflow([scan, found("cameras", "poses.json", "poses")], Path("flow.yaml"), None)
    assert given.inputs["cameras"] == "poses.json, poses"


def test_photos_without_a_pose_in_a_scan_are_taken_when_asked_for() -> None:
    scan = replace(found("scan", "hall.e57", "a scan", 1), n_posed=0)
    plain = draft_workflow([scan], Path("flow.yaml"), None)
    assert (plain.recipe, sorted(plain.inputs)) == ("direct", ["scan"])
    asked = draft_workflow([scan], Path("flow.yaml"), "photos-on-scan")
    assert sorted(asked.inputs) == ["photos", "scan"]


def test_text_beside_scans_of_other_formats_is_left_out() -> None:
    scans = [found("scan", "hall.laz", "a scan"), found("scan", "notes.txt", "numbers")]
    told = draft_workflow(scans, Path("flow.yaml"), None)
    assert told.recipe == "direct"
    assert told.left_out == ["notes.txt: text, left out beside scans of other formats"]
    assert told.inputs["scan"] == "hall.laz, a scan"
    alone = draft_workflow(scans[1:], Path("flow.yaml"), None)
    assert (alone.left_out, alone.inputs["scan"]) == ([], "notes.txt, numbers")


@pytest.mark.parametrize("n_others", [12, 13])
def test_a_dozen_files_are_named_that_nothing_takes(n_others: int) -> None:
    others = [found("unknown", f"f{k}.xyz", f"reason {k}") for k in range(n_others)]
    with pytest.raises(InputError) as caught:
        draft_workflow(others, Path("flow.yaml"), None)
    assert str(caught.value).count("reason") == 12
    with pytest.raises(InputError, match=r"found nothing$"):
        draft_workflow([], Path("flow.yaml"), None)
    told = draft_workflow([found("scan", "hall.laz"), *others], Path("flow.yaml"), None)
    assert len(told.left_out) == n_others
    assert told.text.count("# Not used: ") == 12


def test_what_is_wrong_in_the_same_way_is_said_once() -> None:
    others = [found("unknown", f"f{k}.doc", "no format of ours") for k in range(6)]
    told = draft_workflow([found("scan", "hall.laz"), *others], Path("flow.yaml"), None)
    assert told.left_out == ["f0.doc, f1.doc, f2.doc, f3.doc and 2 more: no format of ours"]


def test_an_orthoimage_is_taken_with_the_frame_beside_it(tmp_path: Path) -> None:
    drafting = module._Drafting(by_kind={}, target=tmp_path / "w.yaml", recipe="direct")
    image = Recognised(kind="other", path=tmp_path / "wall.tif", said="an orthoimage")
    assert drafting._input_line("other", [image]).splitlines()[1:] == [
        *("    files:", "      - wall.tif", "      - wall.json"),
    ]
    assert "{files: wall.tif}" in drafting._input_line("scan", [image])


def test_a_recipe_of_photos_needs_some() -> None:
    with pytest.raises(InputError, match="photos-on-scan needs photos, and there are none"):
        draft_workflow([found("scan", "hall.laz")], Path("flow.yaml"), "photos-on-scan")
