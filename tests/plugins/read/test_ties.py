"""`read.ties`: what a person measured, and a sentence with its line for what cannot be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.read.ties import ReadTies

from orthoflow.errors import InputError
from orthoflow.files.images import encode_png
from orthoflow.products import Photo, Photos, Ties
from tests.method_runs import Reader

PHOTOS = Photos(
    photos=tuple(
        Photo(name=name, encoded=encode_png(np.zeros((48, 64), np.uint8)), width=64, height=48)
        for name in ("a.jpg", "b c.jpg")
    )
)


def read(folder: Path, *texts: str, **params: object) -> Ties:
    paths = tuple(folder / f"ties{index}.csv" for index in range(len(texts)))
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    ties: Ties = Reader(ReadTies, folder).run(paths, params, photos=PHOTOS).ties
    return ties


def test_ties_come_out_with_our_pixels_and_the_sigmas_that_are_said(tmp_path: Path) -> None:
    text = (
        "x,y,z,photo,v_px,u_px,sigma_px\n1,2,3,b c.jpg,20.25,10.5,0.4\n# later\n4,5,6,a.jpg,0,0,\n"
    )
    ties = read(tmp_path, text, "a.jpg;63;47;7;8;634512.345\n", sigma_px=2.0, sigma_m=0.005)
    assert ties.photo_names == ("a.jpg", "b c.jpg")
    np.testing.assert_array_equal(ties.photo, [1, 0, 0])
    # OpenCV's first pixel centre is at (0, 0), ours at (0.5, 0.5).
    np.testing.assert_array_equal(ties.pixels_photo, [[11.0, 20.75], [0.5, 0.5], [63.5, 47.5]])
    np.testing.assert_array_equal(ties.points_world, [[1, 2, 3], [4, 5, 6], [7, 8, 634512.345]])
    np.testing.assert_array_equal(ties.sigma_px, [0.4, 2.0, 2.0])
    np.testing.assert_array_equal(ties.sigma_m, [0.005] * 3)
    np.testing.assert_array_equal(ties.by_hand, [1, 1, 1])
    np.testing.assert_array_equal(ties.wall, [-1, -1, -1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("photo,u_px,v_px,x,y,z\nA.jpg,1,2,3,4,5\n", "ties0.csv:2: there is no photo A.jpg among"),
        ("A.jpg,1,2,3,4,5\n", r"photo A.jpg among those given \(did you mean a.jpg\?\)"),
        ("a.jpg,64,2,3,4,5\n", r"ties0.csv:1: \(u 64, v 2\) is outside photo a.jpg, which"),
        ("a.jpg,1,47.6,3,4,5\n", "photo a.jpg, which is 64 x 48 pixels as it is stored"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_said_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(tmp_path, text)
