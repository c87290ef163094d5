"""The calibration file: OpenCV's pixels outside, ours inside, and every mistake with its line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files.calibration import (
    CalibratedLenses,
    calibration_text,
    lens_for,
    matching_pattern,
    read_calibration,
    write_calibration,
)
from orthoflow.files.cube_faces import FisheyeLens
from orthoflow.products import Calibration, Intrinsics

GOOD = "width: 4000, height: 3000, fx: 3000, fy: 3001.5, cx: 1999.5, cy: 1500"


def read(folder: Path, text: str) -> CalibratedLenses:
    path = folder / "calibration.yaml"
    path.write_text(text)
    return read_calibration(path)


def the_lens(calibration: CalibratedLenses) -> Intrinsics:
    (lens, *_) = calibration.lenses
    assert isinstance(lens, Intrinsics)
    return lens


def refusal(folder: Path, text: str) -> str:
    with pytest.raises(InputError) as caught:
        read(folder, text)
    return str(caught.value)


def camera(width: int = 4000, height: int = 3000) -> Intrinsics:
    lens = Intrinsics(width=width, height=height, fx=3004.25, fy=3003.125, cx=2000.5, cy=1499.0)
    return replace(lens, distortion=(-0.08, 0.05, 1e-4, -2e-4, 0.003))


def test_pixels_are_converted_from_opencv_to_ours(tmp_path: Path) -> None:
    import cv2

    calibration = read(
        tmp_path, 'cameras: {"*": {' + GOOD + ", distortion: [-0.1, 0.02, 1e-3, -2e-3, 0.001]}}"
    )
    ours = the_lens(calibration)
    assert (ours.cx, ours.cy, ours.source) == (2000.0, 1500.5, "calibration")
    points = np.random.default_rng(1).uniform([-1, -1, 3], [1, 1, 5], (50, 3))
    matrix = np.array([[3000, 0, 1999.5], [0, 3001.5, 1500], [0, 0, 1]])
    lens = np.array([-0.1, 0.02, 1e-3, -2e-3, 0.001])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens)
    np.testing.assert_allclose(
        ours.posed().project(points)[:, :2], theirs.reshape(-1, 2) + 0.5, atol=1e-8
    )


def test_what_was_written_is_read_again(tmp_path: Path) -> None:
    calibration = Calibration(
        patterns=('IMG "1".jpg', "wände [x]/ü*.jpg", "*"),
        intrinsics=(camera(), camera(6000, 4000), camera()),
    )
    path = tmp_path / "calibration.yaml"
    write_calibration(path, calibration)
    found = read_calibration(path)
    assert (found.patterns, found.lenses) == (calibration.patterns, calibration.intrinsics)
    assert path.read_text() == calibration_text(calibration)


def test_a_fisheye_has_terms_of_its_own(tmp_path: Path) -> None:
    entry = "{model: fisheye, " + GOOD + ", distortion: [0.04, 0.01, -0.01, 0.002]}"
    wide = entry.replace("}", ", field_of_view_deg: 200, skew: 2}")
    calibration = read(tmp_path, f"cameras:\n  a.jpg: {entry}\n  b.jpg: {wide}\n")
    plain = FisheyeLens(width=4000, height=3000, fx=3000.0, fy=3001.5, cx=2000.0, cy=1500.5)
    plain = replace(plain, radial=(0.04, 0.01, -0.01, 0.002))
    assert calibration.lenses == (plain, replace(plain, skew=2.0, field_of_view_deg=200.0))
    without = read(tmp_path, "cameras: {a: {model: fisheye, " + GOOD + "}}").lenses
    assert without == (replace(plain, radial=(0.0, 0.0, 0.0, 0.0)),)


@pytest.mark.parametrize("place", [0, 1, 4], ids=["k1", "k2", "k3"])
def test_a_lens_is_refused_just_where_its_radius_turns_back(tmp_path: Path, place: int) -> None:
    # Of a single coefficient k of r^(2n) the radius grows as 1 + (2n + 1) k r^(2n): it turns back
    # at (1 + 2n) k r^(2n) = -1. The corner of this image lies at the bent radius 0.5.
    order = {0: 1, 1: 2, 4: 3}[place]
    entry = "width: 800, height: 600, fx: 1000, fy: 1000, cx: 399.5, cy: 299.5"
    radius = 0.5 * (2 * order + 1) / (2 * order)  # bent by 2n / (2n + 1) where it turns back
    limit = -1.0 / ((2 * order + 1) * radius ** (2 * order))
    for share, is_refused in ((0.97, False), (1.03, True)):
        lens = [0.0] * 5
        lens[place] = share * limit
        text = f"cameras: {{a.jpg: {{{entry}, distortion: {lens}}}}}"
        if is_refused:
            assert "the lens distortion is not monotonic inside the image" in refusal(
                tmp_path, text
            )
        else:
            assert the_lens(read(tmp_path, text)).distortion == tuple(lens)


def test_the_first_entry_that_matches_holds() -> None:
    patterns = ("a.jpg", "x[1].jpg", "IMG_00*.jpg", "*", "never")
    names = ("a.jpg", "IMG_0012.jpg", "IMG_0100.jpg", "img_0012.jpg", "x[1].jpg")
    found = [matching_pattern(patterns, name) for name in names]
    assert found == ["a.jpg", "IMG_00*.jpg", "*", "*", "x[1].jpg"]
    assert matching_pattern(("b*",), "a.jpg") is None


def test_another_size_is_refused_and_a_turned_one_named() -> None:
    calibration = CalibratedLenses(patterns=("*",), lenses=(camera(),))
    with pytest.raises(
        InputError,
        match=r'photo a\.jpg has 2000 x 1500 pixels, but its calibration "\*" is for 4000 x 3000; '
        "calibrate at the size of the photos",
    ):
        lens_for(calibration, "a.jpg", 2000, 1500)
    with pytest.raises(
        InputError, match=r"it seems to be for the rotated photo.*as they are stored"
    ):
        lens_for(calibration, "a.jpg", 3000, 4000)
