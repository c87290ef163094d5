"""First workflows for one's own files: each names what was found, and is fine as it is."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import laspy
import numpy as np
import pyproj
import pytest
from syrupy.assertion import SnapshotAssertion

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.errors import InputError
from orthoflow.untrusted_text import shown
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.draft import Recipe, Recognised, draft_workflow, recognised
from orthoflow.workflow.inputs import resolve_input_files
from tests.studios import asked, said

CALIBRATION = """cameras:
  "*": {width: 40, height: 30, fx: 50, fy: 50, cx: 20, cy: 15, distortion: [0, 0, 0, 0, 0]}
"""
TIES = "photo,u_px,v_px,x,y,z\na.jpg,1,2,3,4,5\n"
JPEG = b"\xff\xd8\xff"
POINTS = "name,x,y,z\nP1,1,2,3\nP2,2,2,3\n"


def write_scan(path: Path) -> Path:
    cloud = laspy.LasData(laspy.LasHeader(point_format=2, version="1.2"))
    cloud.x = cloud.y = cloud.z = np.arange(500.0)
    cloud.intensity = cloud.red = np.arange(500)
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
    assert said("check", "jobs/hall 1.yaml").startswith("hall-1 is valid: 24 steps")
    assert inputs_of(Path("jobs/hall 1.yaml")) == {
        "scan": ["hall.las"],
        "photos": ["a.jpg", "b.jpg", "c.jpg"],
        "calibration": ["calibration.yaml"],
        "checkpoints": ["checks.csv"],
        "ties": ["ties.csv"],
    }
    text = Path("jobs/hall 1.yaml").read_text()
    assert 'photos: {files: "../the [old] hall/photos"}  # 3 photos' in text
    assert "scan: hall.las, LAS/LAZ, 500 points, intensity and colours" in out
    assert "calibration: calibration.yaml, a calibration for the photos *" in out
    assert "checkpoints: checks.csv, 2 surveyed points" in out
    assert "ties: ties.csv, 1 tie" in out
    assert "not used: notes.txt: text file, ignored because there are scans in other formats" in out
    assert "not used: plan.dwg: no method reads files of this type" in out
    assert (
        "not used: IMG_7.CR2: camera raw format, which cannot be read: develop it first to 16-bit "
        "TIFF" in out
    )
    assert "next: orthoflow check 'jobs/hall 1.yaml'" in out


def test_a_matrix_fills_a_calibration_and_notes_leave_photos_a_pattern(
    data: Path, tmp_path: Path
) -> None:
    plain = tmp_path / "plain"
    plain.mkdir()
    for name in ("hall.las", "photos"):
        (data / name).rename(plain / name)
    (plain / "photos" / "K.txt").write_text("2759 0 1520\n0 2764 1006\n0 0 1\n")
    (plain / "photos" / "readme.txt").write_text("read me first\n1 2 3\n")
    out = said("new", plain, "-o", "a/b/c/w.yaml")
    assert "not used: K.txt: a camera matrix: write it into a calibration file" in out
    assert "not used: readme.txt: text file, ignored because there are scans in other" in out
    assert '{"*": {width: 40, height: 30, fx: 2759, fy: 2764, cx: 1520, cy: 1006, dist' in out
    assert f'photos: {{files: "{plain}/photos/*.jpg"}}' in Path("a/b/c/w.yaml").read_text()
    assert inputs_of(Path("a/b/c/w.yaml"))["photos"] == ["a.jpg", "b.jpg", "c.jpg"]


def test_a_scan_alone_is_painted_from_its_own_colours_without_a_stand_in(data: Path) -> None:
    out = json.loads(said("new", data / "hall.las", data / "checks.csv", "--json"))
    assert (out["file"], out["recipe"], out["left_out"]) == ("workflow.yaml", "direct", [])
    text = Path("workflow.yaml").read_text()
    assert "room" not in text
    assert "orthoflow run direct.yaml" not in text
    # No step waits for a simulated room, none is skipped.
    assert said("check", "workflow.yaml") == "workflow is valid: 11 steps\n"


def test_a_table_of_coordinates_is_a_scan_and_no_list_of_points(tmp_path: Path) -> None:
    table = tmp_path / "cloud.csv"
    rows = np.column_stack([np.arange(50) + 0.125, np.zeros(50), np.ones(50), np.full(50, 0.5)])
    table.write_text("\n".join(",".join(f"{value:.3f}" for value in row) for row in rows))
    out = said("new", table, "-o", tmp_path / "w.yaml")
    assert out.startswith("scan: cloud.csv, text, ")


@pytest.mark.parametrize(
    "words",
    ["nowhere", "photos", "hall.las --recipe photos-on-scan", "hall.las -o notes.txt", "torn.las"],
)
def test_mistakes_get_a_sentence_and_no_file(
    data: Path, monkeypatch: pytest.MonkeyPatch, words: str, snapshot: SnapshotAssertion
) -> None:
    monkeypatch.chdir(data)
    (data / "torn.las").write_bytes((data / "hall.las").read_bytes()[:100])
    result = asked("new", *words.split())
    assert (result.exit_code, result.output) == (2, snapshot)
    assert not (data / "workflow.yaml").exists()
    assert (data / "notes.txt").read_text() == "1 2 3\n4 5 6\n"


ODD = ("\u2028steps: []", "\x85name: evil\u202egpj\x7f\x9b2J\ufffe\U000e0001", '\n# x"#')


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
    printed = said("new", "data")
    assert printed == shown(printed, keep="\n")
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
    assert "not used: \\udcff.las: its path is not UTF-8: rename it" in said("new", data)


@pytest.mark.parametrize("name", ["a.csv", "cameras.json", "a.las", "z.jpg"])
def test_what_is_no_file_is_not_waited_for(data: Path, name: str) -> None:
    os.mkfifo(data / "photos" / name)
    zero = data.parent / f"link-{name}"
    zero.symlink_to("/dev/zero")
    printed = said("new", data / "hall.las", data / "photos" / name, zero)
    assert f"not used: {name}, link-{name}: a pipe or a device" in printed


# --- what the data show ---


def test_a_scan_with_empty_fields_is_no_source_of_colours(data: Path) -> None:
    cloud = laspy.read(data / "hall.las")
    cloud.intensity[:] = cloud.red[:] = 0
    cloud.write(str(data / "bare.las"))
    result = asked("new", data / "bare.las", code=2)
    assert "the points of bare.las have neither colours nor intensity" in result.output
    assert not Path("workflow.yaml").exists()
    out = said("new", data / "bare.las", data / "photos")
    assert "empty fields for intensity and colours" in out
    assert "based on the recipe photos-on-scan" in out
    said("new", data / "bare.las", "--recipe", "direct", "-o", "asked.yaml")


@pytest.mark.parametrize(("scale", "note"), [(1000, "set cloud.unit=mm"), (1, ""), (1e-4, "unit")])
def test_a_scan_of_another_unit_is_asked_about(data: Path, scale: float, note: str) -> None:
    points = np.random.default_rng(1).uniform(0, 8, (50, 3)) * scale
    rows = "\n".join(f"{x:.6f} {y:.6f} {z:.6f} {k % 7}" for k, (x, y, z) in enumerate(points))
    (data / "room.xyz").write_text(rows)
    out = json.loads(said("new", data / "room.xyz", "--json"))
    assert bool(out["advice"]) is bool(note)
    assert note in "".join(out["advice"])


def test_the_unit_that_a_scan_states_is_used_and_degrees_are_refused(data: Path) -> None:
    cloud = laspy.read(data / "hall.las")
    for epsg, name in ((2260, "feet"), (4326, "degrees")):
        cloud.header.vlrs.clear()
        cloud.header.add_crs(pyproj.CRS.from_epsg(epsg))
        cloud.write(str(data / f"{name}.las"))
    out = said("new", data / "feet.las")
    assert "unit us-ft (GeoTIFF keys + NAD83 / New York East (ftUS))" in out
    assert "note:" not in out
    result = asked("new", data / "degrees.las", "-o", "degrees.yaml", code=2)
    assert "degrees.las has geographic coordinates in degrees" in result.output


@pytest.mark.parametrize("up", ["x", "z"])
def test_the_axis_that_surfaces_show_to_be_up_is_set_and_reported(data: Path, up: str) -> None:
    # Two slopes on one floor, as a roof: by no other axis they are level and upright.
    rng = np.random.default_rng(2)
    u, v = rng.uniform(0.0, 4.0, (2, 5_000))
    walls = np.array([[np.cos(a), np.sin(a), 0.0] for a in (0.4, 1.1, 1.8, 2.5)])
    height = np.stack([np.zeros_like(u), np.zeros_like(u), v]).T
    parts = [np.stack([u, v, 0.0 * u], axis=1), *(u[:, None] * wall + height for wall in walls)]
    points = np.roll(np.concatenate(parts), "xyz".index(up) - 2, axis=1)
    np.savetxt(data / "hall.xyz", np.column_stack([points, rng.uniform(0, 9, len(points))]))
    out = said("new", data / "hall.xyz")
    steps = Path("workflow.yaml").read_text()
    assert (f"the workflow contains cloud.up={up}" in " ".join(out.split())) is (up != "z")
    assert (f"    params: {{up: {up}}}\n" in steps) is (up != "z")
    assert said("check", "workflow.yaml").startswith("workflow is valid")


# --- drafts by themselves ---


def found(kind: str, name: str, summary: str = "something", n_photos: int = 0) -> Recognised:
    posed, fields = (n_photos, frozenset(["rgb"])) if kind == "scan" else (0, frozenset())
    counts = {"n_photos": n_photos, "n_posed": posed}
    return Recognised(kind=kind, path=Path(name), summary=summary, **counts, fields=fields)


def test_photos_in_a_scan_are_taken_where_there_are_no_others() -> None:
    def drafted(*files: Recognised, recipe: Recipe | None = None) -> tuple[str, Mapping[str, str]]:
        draft = draft_workflow(files, Path("flow.yaml"), recipe)
        return draft.recipe, draft.inputs

    scan = found("scan", "hall.e57", "a scan", 3)
    recipe, inside = drafted(scan)
    assert recipe == "photos-on-scan"
    assert inside["photos"] == "hall.e57, the photos in this file"
    assert inside["cameras"] == "hall.e57, the poses of the photos in this file"
    _, beside = drafted(scan, found("photos", "a.jpg", "a photo", 1))
    assert beside["photos"] == "a.jpg, a photo"
    assert "cameras" not in beside
    # With two scans, it is ambiguous which poses are meant.
    _, two = drafted(scan, found("scan", "b.e57", "a scan", 1))
    assert two["photos"] == "2 files: hall.e57, b.e57"
    assert "cameras" not in two
    _, given = drafted(scan, found("cameras", "poses.json", "poses"))
    assert given["cameras"] == "poses.json, poses"
    # Those without a pose only if they are asked for.
    bare = replace(scan, n_posed=0)
    recipe, inputs = drafted(bare)
    assert (recipe, sorted(inputs)) == ("direct", ["scan"])
    assert sorted(drafted(bare, recipe="photos-on-scan")[1]) == ["photos", "scan"]


def test_an_orthoimage_is_taken_with_the_frame_beside_it(tmp_path: Path) -> None:
    assert one(tmp_path / "wall.tif", b"II*\0").kind == "photos"
    (tmp_path / "wall.json").write_text("{}")
    (image,) = recognised([tmp_path / "wall.tif"])
    assert (image.kind, image.summary) == ("other", "an orthoimage with its position (JSON)")
    photos = [found("scan", "hall.laz"), found("photos", "a.jpg", "a photo", 1)]
    text = draft_workflow([*photos, image], tmp_path / "w.yaml", None).text
    assert "    files:\n      - wall.tif\n      - wall.json\n" in text


# --- what files are ---

REALITYCAPTURE = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"


def one(path: Path, content: str | bytes = "") -> Recognised:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    (found,) = recognised([path])
    assert found.path == path
    return found


def test_a_list_of_cameras_is_one_by_its_columns_and_its_ending(tmp_path: Path) -> None:
    text = f"{REALITYCAPTURE}a.jpg,1,2,3,0,0,0,24,0,0,0,0,0,0,0,0\n"
    found = one(tmp_path / "cameras.csv", text)
    assert (found.kind, found.summary) == ("cameras", "1 camera")


def names(paths: list[Path], root: Path) -> list[str]:
    return [found.path.relative_to(root).as_posix() for found in recognised(paths)]


def test_folders_are_looked_into_three_deep_and_no_link_is_followed(tmp_path: Path) -> None:
    data = tmp_path / "data"
    hidden = (".hidden.jpg", ".git/g.jpg")
    shown = ("b.jpg", "a.jpg", "1/c.jpg", "1/2/d.jpg", "1/2/3/e.jpg", "1/2/3/4/f.jpg")
    for place in (*shown, *hidden):
        (data / place).parent.mkdir(parents=True, exist_ok=True)
        (data / place).touch()
    (data / "link").symlink_to(data / "1", target_is_directory=True)
    assert names([data], data) == ["a.jpg", "b.jpg", "1/c.jpg", "1/2/d.jpg", "1/2/3/e.jpg"]
    assert names([data / "1", data / "a.jpg"], data)[-1] == "a.jpg"
    with pytest.raises(InputError, match="nowhere does not exist: give scans, photos, or folders"):
        recognised([data, tmp_path / "nowhere"])


def test_results_of_runs_are_no_photos_of_the_next(tmp_path: Path) -> None:
    run = tmp_path / "runs" / "first"
    (run / "figures").mkdir(parents=True)
    for name in ("run.h5", "sheet.png", "figures/plan.png"):
        (run / name).write_bytes(JPEG)
    (tmp_path / "photo.jpg").write_bytes(JPEG)
    found = {one.path: (one.kind, one.summary) for one in recognised([tmp_path])}
    assert found == {
        tmp_path / "photo.jpg": ("photos", "a photo"),
        run: ("unknown", "a run folder"),
    }
    # Who names it means it.
    assert {one.kind for one in recognised([run])} == {"photos", "unknown"}
