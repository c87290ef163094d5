"""What files are, told by looking into them: scans, photos, tables, cameras, and others."""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.workflow import recognising
from orthoflow.workflow.recognising import Recognised, recognised

TIES = "photo,u_px,v_px,x,y,z\na.jpg,1,2,3,4,5\nb.jpg,1,2,3,4,5\n"
POINTS = "name,x,y,z\nP1,1,2,3\nP2,2,2,3\nP3,2,2,3\n"
REALITYCAPTURE = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
LENS = "cameras: {a.jpg: {width: 640, height: 480, fx: 500, fy: 500, cx: 319.5, cy: 239.5}}"


def one(path: Path, content: str | bytes = "") -> Recognised:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    (found,) = recognised([path])
    assert found.path == path
    return found


@pytest.mark.parametrize(
    ("name", "content", "kind", "said", "n_photos"),
    [
        ("a.JPG", "", "photos", "a photo", 1),
        ("a.png", "", "photos", "a photo", 1),
        ("ties.csv", TIES, "ties", "2 ties measured in photos", 0),
        ("points.csv", POINTS, "checkpoints", "3 surveyed points", 0),
        ("lens.yaml", LENS, "calibration", "a calibration of a.jpg", 0),
        ("frame.json", "{}", "unknown", "no method reads such files", 0),
        ("notes.docx", "", "unknown", "no method reads such files", 0),
    ],
)
def test_a_file_is_what_is_in_it(
    tmp_path: Path, name: str, content: str, kind: str, said: str, n_photos: int
) -> None:
    found = one(tmp_path / name, content)
    assert (found.kind, found.said, found.n_photos) == (kind, said, n_photos)
    assert found.fields == frozenset()


def test_numbers_in_rows_are_a_scan_and_not_points_with_names(tmp_path: Path) -> None:
    rows = "\n".join(f"{k}.25 {k} {k}.5 {k}" for k in range(20))
    found = one(tmp_path / "cloud.xyz", rows)
    assert found.kind == "scan"
    assert found.said.startswith("text, ")
    # A single name among them makes it a list.
    named = one(tmp_path / "list.csv", "1.5,1,2,3\nP1,1,2,3\n")
    assert (named.kind, named.said) == ("checkpoints", "2 surveyed points")
    assert one(tmp_path / "words.txt", "nothing but words\n").kind == "unknown"


def test_a_scan_says_how_many_points_it_has_and_what_of_each(tmp_path: Path) -> None:
    cloud = laspy.LasData(laspy.LasHeader(point_format=2, version="1.2"))
    cloud.x = cloud.y = cloud.z = np.arange(1500.0)
    cloud.write(str(tmp_path / "hall.las"))
    (found,) = recognised([tmp_path / "hall.las"])
    assert (found.kind, found.n_photos) == ("scan", 0)
    assert found.said == "LAS/LAZ, 1,500 points, fields for intensity and colours"
    assert found.fields == {"intensity", "rgb"}


def test_camera_raw_says_what_to_do(tmp_path: Path) -> None:
    found = one(tmp_path / "a.NEF", b"raw")
    assert found.kind == "unknown"
    assert "develop to TIFF of 16 bits or JPEG first" in found.said


def test_a_raster_with_its_frame_beside_it_is_an_orthoimage(tmp_path: Path) -> None:
    alone = one(tmp_path / "wall.tif")
    assert alone.kind == "photos"
    (tmp_path / "wall.json").write_text("{}")
    (beside,) = recognised([tmp_path / "wall.tif"])
    assert (beside.kind, beside.said) == ("other", "an orthoimage with its frame beside it")


def test_a_list_of_cameras_is_one_by_its_columns_and_its_ending(tmp_path: Path) -> None:
    text = f"{REALITYCAPTURE}a.jpg,1,2,3,0,0,0,24,0,0,0,0,0,0,0,0\n"
    found = one(tmp_path / "cameras.csv", text)
    assert (found.kind, found.said) == ("cameras", "1 cameras")
    assert one(tmp_path / "cameras.txt", text).kind == "unknown"


@pytest.mark.parametrize(("n_bytes", "is_told"), [(990_000, True), (1_010_000, False)])
def test_a_workflow_is_one_by_its_first_megabyte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_bytes: int, *, is_told: bool
) -> None:
    def refused(_path: Path) -> str:
        raise InputError("it is no calibration")

    # It would take seconds to read so much YAML.
    monkeypatch.setattr(recognising, "_calibration_said", refused)
    found = one(tmp_path / "big.yaml", "#".ljust(n_bytes - 1) + "\nsteps:\n")
    assert found.kind == "unknown"
    assert (found.said == "big.yaml is a workflow itself") is is_told


def test_what_cannot_be_read_is_told_in_one_line(tmp_path: Path) -> None:
    broken = one(tmp_path / "lens.yaml", "cameras: {a.jpg: {width: x}, b.jpg: {}}")
    assert broken.kind == "unknown"
    assert "\n" not in broken.said
    assert "lens.yaml" in broken.said
    cameras = one(tmp_path / "cameras.json", json.dumps({"cameras": 5}))
    assert cameras.kind == "unknown"
    assert "cameras.json" in cameras.said


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        (
            "points.csv",
            "name;x;y;z\nA;1,5;2;3\n",
            "points.csv:2: x must be a number, got 1,5; write a decimal point",
        ),
        ("points.txt", "Name,X,Y,Z\nA,1,2\n", "points.txt:2: expected 4 columns, got 3"),
        (
            "ties.csv",
            "photo,u_px,v_px,x,y,z\na.jpg,1,2,3,4,five\n",
            "ties.csv:2: z must be a number, got five",
        ),
        ("mine.yaml", "orthoflow: 1\nsteps:\n  a: {use: read.scan}\n", "is a workflow itself"),
        (
            "calibration.yaml",
            'cameras:\n  "*.jpg": {width: 9, height: 9, fx: 9,1, fy: 9, cx: 4, cy: 4}\n',
            "unknown key, what a decimal comma leaves behind: write decimal points",
        ),
    ],
)
def test_a_faulty_table_says_what_is_wrong_with_it_and_not_that_it_is_no_scan(
    tmp_path: Path, name: str, content: str, said: str
) -> None:
    found = one(tmp_path / name, content)
    assert found.kind == "unknown"
    assert said in found.said


def names(paths: list[Path], root: Path) -> list[str]:
    return [found.path.relative_to(root).as_posix() for found in recognised(paths)]


def test_folders_are_looked_into_three_deep_and_no_link_is_followed(tmp_path: Path) -> None:
    data = tmp_path / "data"
    for place in ("b.jpg", "a.jpg", "1/c.jpg", "1/2/d.jpg", "1/2/3/e.jpg", "1/2/3/4/f.jpg"):
        (data / place).parent.mkdir(parents=True, exist_ok=True)
        (data / place).touch()
    for hidden in (".hidden.jpg", ".git/g.jpg"):
        (data / hidden).parent.mkdir(parents=True, exist_ok=True)
        (data / hidden).touch()
    (data / "link").symlink_to(data / "1", target_is_directory=True)
    assert names([data], data) == ["a.jpg", "b.jpg", "1/c.jpg", "1/2/d.jpg", "1/2/3/e.jpg"]
    assert names([data / "1", data / "a.jpg"], data)[-1] == "a.jpg"
    with pytest.raises(InputError, match="nowhere does not exist: give scans, photos, and folders"):
        recognised([data, tmp_path / "nowhere"])


@pytest.mark.parametrize(("most", "is_too_much"), [(3, False), (2, True)])
def test_so_many_files_are_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, *, is_too_much: bool
) -> None:
    monkeypatch.setattr(recognising, "MOST_FILES", most)
    for name in "abc":
        (tmp_path / f"{name}.jpg").touch()
    if is_too_much:
        with pytest.raises(InputError, match=f"holds more than {most} files: name those that"):
            recognised([tmp_path])
    else:
        assert len(recognised([tmp_path])) == 3


def test_results_of_runs_are_no_photos_of_the_next(tmp_path: Path) -> None:
    run = tmp_path / "runs" / "first"
    (run / "figures").mkdir(parents=True)
    for name in ("run.h5", "sheet.png", "figures/plan.png"):
        (run / name).touch()
    (tmp_path / "photo.jpg").touch()
    found = {one.path: (one.kind, one.said) for one in recognised([tmp_path])}
    assert found == {
        tmp_path / "photo.jpg": ("photos", "a photo"),
        run: ("unknown", "a folder of results"),
    }
    # Who names it means it.
    assert {one.kind for one in recognised([run])} == {"photos", "unknown"}


def test_a_model_of_cameras_is_one_thing(tmp_path: Path) -> None:
    model = tmp_path / "model"
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 1 b.jpg\n\n")
    (model / "deeper").mkdir()
    (model / "deeper" / "c.jpg").touch()
    (found,) = recognised([tmp_path])
    assert (found.kind, found.path, found.said) == ("cameras", model, "2 cameras")
    # With one of the two files it is a folder like any.
    (model / "images.txt").unlink()
    assert len(recognised([tmp_path])) == 2
