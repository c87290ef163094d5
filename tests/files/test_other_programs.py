"""Cameras of other programs through the commands `check` and `run`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from orthoflow.files.images import encode_jpeg
from tests import photo_files
from tests.files.test_metashape import UTM
from tests.studios import asked

IDENTITY = " ".join(map(str, np.eye(4).ravel()))
PLACE = "<transform><translation>4147216.5 614626.7 4790649.3</translation></transform>"


def metashape(*cameras: str, chunk: str = "") -> dict[str, str]:
    """An export with cameras of some labels, or of a label and further attributes."""
    elements = "".join(
        f'<camera id="{k}" sensor_id="0" label="{label}"><transform>{IDENTITY}</transform></camera>'
        for k, label in enumerate(cameras)
    )
    return {
        "cameras.xml": '<document><chunk><sensors><sensor id="0" label="cam" type="frame">'
        '<resolution width="64" height="48"/><calibration class="adjusted"><f>60</f></calibration>'
        f"</sensor></sensors>{chunk}<cameras>{elements}</cameras></chunk></document>"
    }


BUNDLE = "# Bundle file v0.3\n2 0\n" + "60 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n" * 2
# Photos, files of their cameras, and for each photo its status: `ok`, or a part of the reason.
CAMERAS: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    "metashape folders": (
        metashape("nadir/a.jpg", "oblique/a.jpg"),
        {"nadir/a.jpg": "ok", "oblique/a.jpg": "ok"},
    ),
    "metashape georeferenced": (
        metashape("a.jpg", chunk=f"{PLACE}<reference>{UTM}</reference>"),
        {"a.jpg": "ok"},
    ),
    "bundler with spaces": (
        {"bundle.out": BUNDLE, "list.txt": "my photo 1.jpg\nmy photo 2.jpg 0 60\n"},
        {"my photo 1.jpg": "ok", "my photo 2.jpg": "ok"},
    ),
    "colmap": (
        {
            "cameras.txt": "1 SIMPLE_DIVISION 64 48 60 32 24 -0.01\n2 PINHOLE 64 48 60 60 32 24\n",
            "images.txt": "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 2 b.jpg\n\n",
        },
        {"a.jpg": "ok", "b.jpg": "ok"},
    ),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_cameras_of_other_programs_orient_their_photos(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, expected = CAMERAS[name]
    monkeypatch.chdir(tmp_path)
    pictures = {photo: photo_files.picture(seed=k) for k, photo in enumerate(expected)}
    photos = {photo: encode_jpeg(picture) for photo, picture in pictures.items()}
    photo_files.write(tmp_path / "photos", photos)
    photo_files.write(tmp_path / "theirs", {name: text.encode() for name, text in files.items()})
    (tmp_path / "workflow.yaml").write_text(
        "orthoflow: 1\ninputs: {photos: {}, cameras: {}}\nsteps:\n"
        "  shots: {use: read.photos, in: {files: inputs.photos}}\n"
        "  given: {use: read.cameras, in: {files: inputs.cameras, photos: shots.photos}}\n"
    )
    given = ("workflow.yaml", "--input", "photos=photos", "--input", "cameras=theirs")
    assert asked("check", *given).exit_code == 0
    done = asked("run", *given, "-o", "run", "--executor", "inline")
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "run/products/given/cameras.json").read_text())["cameras"]
    assert found.keys() == expected.keys()
    for photo, status in expected.items():
        assert status in found[photo]["status"]
    if "georeferenced" in name:
        centre = (
            -np.array(found["a.jpg"]["R_camera_from_world"]).T
            @ found["a.jpg"]["t_camera_from_world"]
        )
        np.testing.assert_allclose(centre[:2], [445000, 5430000], atol=20000)
