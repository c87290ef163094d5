"""The calibration file: OpenCV's pixels outside, ours inside, and every mistake with its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files.calibration import (
    calibration_text,
    intrinsics_for,
    matching_pattern,
    read_calibration,
    write_calibration,
)
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Calibration, Intrinsics

GOOD = "width: 4000, height: 3000, fx: 3000, fy: 3001.5, cx: 1999.5, cy: 1500"


def read(folder: Path, text: str) -> Calibration:
    path = folder / "calibration.yaml"
    path.write_text(text)
    return read_calibration(path)


def refusal(folder: Path, text: str) -> str:
    with pytest.raises(InputError) as caught:
        read(folder, text)
    return str(caught.value)


def camera(width: int = 4000, height: int = 3000) -> Intrinsics:
    return Intrinsics(
        width=width,
        height=height,
        fx=3004.25,
        fy=3003.125,
        cx=2000.5,
        cy=1499.0,
        distortion=(-0.08, 0.05, 1e-4, -2e-4, 0.003),
    )


def test_pixels_are_converted_from_opencv_to_ours(tmp_path: Path) -> None:
    import cv2

    calibration = read(
        tmp_path, 'cameras: {"*": {' + GOOD + ", distortion: [-0.1, 0.02, 1e-3, -2e-3, 0.001]}}"
    )
    ours = calibration.intrinsics[0]
    assert (ours.cx, ours.cy, ours.source) == (2000.0, 1500.5, "calibration")
    viewing = ViewingCamera(
        width=4000,
        height=3000,
        fx=ours.fx,
        fy=ours.fy,
        cx=ours.cx,
        cy=ours.cy,
        distortion=np.array(ours.distortion),
        rotation=np.eye(3),
        translation=np.zeros(3),
    )
    points = np.random.default_rng(1).uniform([-1, -1, 3], [1, 1, 5], (50, 3))
    matrix = np.array([[3000, 0, 1999.5], [0, 3001.5, 1500], [0, 0, 1]])
    lens = np.array([-0.1, 0.02, 1e-3, -2e-3, 0.001])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens)
    np.testing.assert_allclose(
        viewing.project(points)[:, :2], theirs.reshape(-1, 2) + 0.5, atol=1e-8
    )


def test_a_calibration_without_distortion_has_none(tmp_path: Path) -> None:
    calibration = read(tmp_path, 'cameras: {"*": {' + GOOD + "}}")
    assert calibration.intrinsics[0].distortion == (0.0, 0.0, 0.0, 0.0, 0.0)


def test_what_was_written_is_read_again(tmp_path: Path) -> None:
    calibration = Calibration(
        patterns=('IMG "1".jpg', "wände [x]/ü*.jpg", "*"),
        intrinsics=(camera(), camera(6000, 4000), camera()),
    )
    path = tmp_path / "calibration.yaml"
    write_calibration(path, calibration)
    assert read_calibration(path) == calibration
    assert path.read_text() == calibration_text(calibration)


def test_values_may_be_shared_between_cameras(tmp_path: Path) -> None:
    text = "cameras:\n  a.jpg: &c {" + GOOD + "}\n  b.jpg: *c\n  c.jpg: {<<: *c, fx: 2900}\n"
    calibration = read(tmp_path, text)
    assert [item.fx for item in calibration.intrinsics] == [3000.0, 3000.0, 2900.0]
    assert [item.fy for item in calibration.intrinsics] == [3001.5] * 3


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("a.jpg", "a.jpg"),
        ("IMG_0012.jpg", "IMG_00*.jpg"),
        ("IMG_0100.jpg", "*"),
        ("img_0012.jpg", "*"),
        ("x[1].jpg", "x[1].jpg"),
    ],
)
def test_the_first_entry_that_matches_holds(name: str, pattern: str) -> None:
    patterns = ("a.jpg", "x[1].jpg", "IMG_00*.jpg", "*", "never")
    calibration = Calibration(patterns=patterns, intrinsics=(camera(),) * len(patterns))
    assert matching_pattern(calibration, name) == pattern
    assert matching_pattern(Calibration(patterns=("b*",), intrinsics=(camera(),)), name) is None


def test_a_photo_that_no_entry_matches_is_not_calibrated() -> None:
    calibration = Calibration(patterns=("b*",), intrinsics=(camera(),))
    assert intrinsics_for(calibration, "a.jpg", 4000, 3000) is None
    assert intrinsics_for(calibration, "b.jpg", 4000, 3000) == camera()


def test_another_size_is_refused_and_a_turned_one_named() -> None:
    calibration = Calibration(patterns=("*",), intrinsics=(camera(),))
    with pytest.raises(
        InputError,
        match=r'photo a\.jpg has 2000 x 1500 pixels, but its calibration "\*" is for 4000 x 3000; '
        "calibrate at the size of the photos",
    ):
        intrinsics_for(calibration, "a.jpg", 2000, 1500)
    with pytest.raises(
        InputError, match=r"it seems to be for the turned photo.*as they are stored"
    ):
        intrinsics_for(calibration, "a.jpg", 3000, 4000)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "calibration.yaml:1:1: the calibration file is empty"),
        ("- 1\n", "calibration.yaml:1:1: expected the key cameras"),
        ("camera: 3\n", "calibration.yaml:1:1: expected the key cameras"),
        ("cameras: {}\n", "1:1: cameras: expected one entry per photo name or pattern"),
        (
            "cameras:\n  1: {" + GOOD + "}\n",
            '2:3: cameras: a photo name must be text, got 1; write "1"',
        ),
        ("cameras:\n  a.jpg: 5\n", '2:3: cameras."a.jpg": expected width, height'),
        (
            "cameras:\n  a.jpg: {width: 10, height: 5}\n",
            '2:3: cameras."a.jpg": fx, fy, cx, cy missing',
        ),
        (
            "cameras:\n  a.jpg:\n    heigth: 5\n",
            '3:5: cameras."a.jpg".heigth: unknown key (did you mean height?)',
        ),
        ("cameras: {}\nnotes: x\n", "2:1: notes: unknown key; expected cameras"),
        ("cameras: {a: {" + GOOD + "}, a: {" + GOOD + "}}", 'found duplicate key "a"; remove one'),
        ("cameras: {a: {" + GOOD + "]}", "calibration.yaml:1:84: this is not YAML"),
        (
            "cameras:\n  a.jpg: {width: 4000.5}\n",
            '2:11: cameras."a.jpg".width: expected a whole number',
        ),
        ("cameras:\n  a.jpg: {width: true}\n", "expected a whole number of pixels, got True"),
        (
            "cameras:\n  a.jpg: {fx: wide}\n",
            '2:11: cameras."a.jpg".fx: expected a number, got the text "wide"',
        ),
        ("cameras:\n  a.jpg: {fx: .nan}\n", '2:11: cameras."a.jpg".fx: expected a number, got nan'),
        ("cameras:\n  a.jpg: {fx: }\n", '".fx: expected a number, got nothing'),
        ("cameras:\n  a.jpg: {fx: [1]}\n", '".fx: expected a number, got a list or mapping'),
        (
            'cameras: {"*": {' + GOOD + ", distortion: [0.1, 0, 0, 0]}}",
            "expected the five numbers [k1, k2, p1, p2, k3], got 4 values",
        ),
        (
            'cameras: {"*": {' + GOOD + ", distortion: [0.1, 0, x, 0, 0]}}",
            'cameras."*".distortion[2]: expected a number, got the text "x"',
        ),
        (
            'cameras: {"*": {' + GOOD.replace("fx: 3000", "fx: 28") + "}}",
            "expected the focal length in pixels, at least a tenth of the image's 4000, got 28",
        ),
        (
            'cameras: {"*": {' + GOOD.replace("cx: 1999.5", "cx: 19995") + "}}",
            'cameras."*".cx: expected the principal point in pixels',
        ),
        (
            'cameras: {"*": {' + GOOD + ", distortion: [-1.5, 0, 0, 0, 0]}}",
            'cameras."*".distortion: the lens model folds back inside the image',
        ),
    ],
)  # fmt: skip
def test_a_mistake_is_one_sentence_with_its_place(tmp_path: Path, text: str, problem: str) -> None:
    assert problem in refusal(tmp_path, text)


def test_all_mistakes_come_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = "cameras:\n  a.jpg: {width: x}\n  b.jpg:\n    fx: y\n    cz: 1\nother: 1\n"
    lines = refusal(tmp_path, text).splitlines()
    places = [int(line.split(":")[1]) for line in lines]
    assert places == sorted(places)
    assert {2, 3, 4, 5, 6} == set(places)


def test_what_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(InputError, match=r"calibration\.yaml is no UTF-8 text"):
        read_calibration(path)
    path.write_bytes(b"#" * 1_000_001)
    with pytest.raises(InputError, match="a calibration file is a short text"):
        read_calibration(path)
    with pytest.raises(InputError, match=r"gone\.yaml cannot be read: No such file"):
        read_calibration(tmp_path / "gone.yaml")
    path.write_text("[" * 1200)
    with pytest.raises(InputError, match="this is not YAML"):
        read_calibration(path)
