"""`read.cameras`, `read.ties` and `read.checkpoints`: measurements by people and other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.read.cameras import ReadCameras
from orthoflow_plugins.read.checkpoints import ReadCheckpoints
from orthoflow_plugins.read.ties import ReadTies

from orthoflow.errors import InputError
from orthoflow.files.images import encode_png
from orthoflow.products import Cameras, CheckPoints, Photo, Photos, Ties
from tests import photo_files
from tests.method_runs import Reader

HEAD = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
PICTURE = encode_png(np.zeros((48, 64), np.uint8))


def photo(path: str) -> Photo:
    folder, _, name = path.rpartition("/")
    return Photo(name=name, encoded=PICTURE, width=64, height=48, folder=folder)


def read_cameras(
    folder: Path, rows: dict[str, str], photos: list[Photo]
) -> tuple[Cameras, tuple[str, ...]]:
    """Return cameras at x = 1, 2, 3 ... in the order of the rows."""
    text = HEAD + "".join(
        f"{name},{place},0,0,0,0,0,{lens or '24,0,0,0,0,0,0,0,0'}\n"
        for place, (name, lens) in enumerate(rows.items(), 1)
    )
    path = folder / "cameras.csv"
    path.write_text(text)
    reader = Reader(ReadCameras, folder)
    found = reader.run((path,), {}, photos=Photos(photos=tuple(photos)))
    return found.cameras, tuple(reader.ctx.warnings)


def places(cameras: Cameras) -> list[float | None]:
    return [
        None if camera.status != "ok" else round(float(camera.viewing().centre_world[0]), 9)
        for camera in cameras.cameras
    ]


@pytest.mark.parametrize(
    ("names", "photos", "expected"),
    [
        (["a.jpg", "B.JPG", "c"], ["a.jpg", "b.jpg", "c.png"], [1, 2, 3]),
        (["x/a.jpg", "y/a.jpg"], ["x/a.jpg", "y/a.jpg"], [1, 2]),
        (["nadir/102MEDIA/a.jpg", "oblique/101MEDIA/a.jpg"], ["oblique/a.jpg"], [2]),
        (["C:\\x\\a.jpg", "C:\\y\\a.jpg"], ["y/a.jpg", "x/a.jpg"], [2, 1]),
        # The only camera with a name belongs to the only photo with that name, whatever their
        # folders.
        (["elsewhere/a.jpg"], ["here/a.jpg"], [1]),
        (["x/a.jpg", "b.jpg"], ["x/a.jpg", "y/a.jpg", "b.jpg"], [1, None, 2]),
        (["x/a.jpg", "y/a.jpg", "b.jpg"], ["a.jpg", "b.jpg"], [None, 3]),
    ],
)
def test_cameras_are_found_by_name_and_folder(
    tmp_path: Path, names: list[str], photos: list[str], expected: list[float | None]
) -> None:
    cameras, warnings = read_cameras(
        tmp_path, dict.fromkeys(names, ""), [photo(each) for each in photos]
    )
    assert places(cameras) == expected
    assert len(warnings) == expected.count(None)


def test_what_is_left_out_of_a_lens_is_reported_or_refused(tmp_path: Path) -> None:
    rows = {
        "sound.jpg": "",
        "slight.jpg": "24,0,0,0,0,0,0,0.001,0",
        "far.jpg": "24,0,0,0,0,0,0,0.1,0",
    }
    cameras, warnings = read_cameras(tmp_path, rows, [photo(name) for name in rows])
    assert places(cameras) == [1, 2, None]
    assert "deviation of up to 0.11 pixels (affected photos: 1, e.g. slight.jpg)" in warnings[0]
    assert "differs from the closest OpenCV lens by up to 11 pixels" in warnings[1]


def test_files_that_orient_no_photo_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="orients none of the photos"):
        read_cameras(tmp_path, {"b.jpg": ""}, [photo("a.jpg")])


PHOTOS = Photos(photos=(photo("a.jpg"), photo("b c.jpg")))


def written(folder: Path, stem: str, texts: tuple[str, ...]) -> tuple[Path, ...]:
    """Write tables to files with a stem and the numbers 0, 1 and so on."""
    files = {f"{stem}{number}.csv": text.encode() for number, text in enumerate(texts)}
    return photo_files.write(folder, files)


def read_ties(folder: Path, *texts: str, **params: object) -> Ties:
    paths = written(folder, "ties", texts)
    ties: Ties = Reader(ReadTies, folder).run(paths, params, photos=PHOTOS).ties
    return ties


def test_ties_come_out_with_our_pixels_and_the_sigmas_that_are_said(tmp_path: Path) -> None:
    text = "x,y,z,photo,v_px,u_px,sigma_px\n1,2,3,b c.jpg,20.25,10.5,0.4\n# b\n4,5,6,a.jpg,0,0,\n"
    ties = read_ties(tmp_path, text, "a.jpg;63;47;7;8;634512.345\n", sigma_px=2.0, sigma_m=0.005)
    assert ties.photo_names == ("a.jpg", "b c.jpg")
    np.testing.assert_array_equal(ties.photo, [1, 0, 0])
    # In OpenCV, the centre of the first pixel is at (0, 0), in orthoflow at (0.5, 0.5).
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
        read_ties(tmp_path, text)


def read_points(folder: Path, *texts: str) -> tuple[CheckPoints, dict[str, float]]:
    reader = Reader(ReadCheckpoints, folder)
    return reader.run(written(folder, "points", texts), {}).checkpoints, reader.metrics


def test_all_columns_come_out(tmp_path: Path) -> None:
    text = "name,class,x,y,z,wall,v_px,u_px\nP1,flat,1,2,3,1,20.25,10.5\nP 2,,4,5,6,,,\n"
    points, _ = read_points(tmp_path, text)
    assert points.names == ("P1", "P 2")
    assert points.classes == ("flat", "")
    np.testing.assert_array_equal(points.points_world, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(points.wall, [1, -1])
    np.testing.assert_array_equal(points.pixels_wall, [[10.5, 20.25], [np.nan, np.nan]])


def test_files_are_joined_in_order(tmp_path: Path) -> None:
    points, metrics = read_points(tmp_path, "P1,1,2,3\n", "name,x,y,z,class\nP2,4,5,7,edge\n")
    assert points.names == ("P1", "P2")
    assert points.classes == ("", "edge")
    extents = {"extent_x_m": 3, "extent_y_m": 3, "extent_z_m": 4}
    assert metrics == {"n_points": 2, "n_measured": 0, **extents}
    with pytest.raises(InputError, match=r"P1 occurs in points0\.csv and in points1\.csv"):
        read_points(tmp_path, "P1,1,2,3\n", "P1,1,2,4\n")
    with pytest.raises(InputError, match="the input checkpoints has no files"):
        read_points(tmp_path)
