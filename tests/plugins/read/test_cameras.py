"""`read.cameras`: which given camera is a photo's, and what is reported of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.read.cameras import ReadCameras

from orthoflow.errors import InputError
from orthoflow.files.images import encode_png
from orthoflow.products import Cameras, Photo, Photos
from tests.method_runs import Reader

HEAD = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
PICTURE = encode_png(np.zeros((48, 64), np.uint8))


def photo(path: str) -> Photo:
    folder, _, name = path.rpartition("/")
    return Photo(name=name, encoded=PICTURE, width=64, height=48, folder=folder)


def read(
    folder: Path, rows: dict[str, str], photos: list[Photo]
) -> tuple[Cameras, tuple[str, ...]]:
    """Cameras that stand at x = 1, 2, 3 ... in the order of the rows."""
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
        # The only camera of a name is that of the only photo, wherever both lie.
        (["elsewhere/a.jpg"], ["here/a.jpg"], [1]),
        (["x/a.jpg", "b.jpg"], ["x/a.jpg", "y/a.jpg", "b.jpg"], [1, None, 2]),
        (["x/a.jpg", "y/a.jpg", "b.jpg"], ["a.jpg", "b.jpg"], [None, 3]),
    ],
)
def test_cameras_are_found_by_name_and_folder(
    tmp_path: Path, names: list[str], photos: list[str], expected: list[float | None]
) -> None:
    cameras, warnings = read(tmp_path, dict.fromkeys(names, ""), [photo(each) for each in photos])
    assert places(cameras) == expected
    assert len(warnings) == expected.count(None)


def test_what_is_left_out_of_a_lens_is_reported_or_refused(tmp_path: Path) -> None:
    rows = {
        "sound.jpg": "",
        "slight.jpg": "24,0,0,0,0,0,0,0.001,0",
        "far.jpg": "24,0,0,0,0,0,0,0.1,0",
    }
    cameras, warnings = read(tmp_path, rows, [photo(name) for name in rows])
    assert places(cameras) == [1, 2, None]
    assert (
        "closest OpenCV lens, with a deviation of up to 0.11 pixels (1 photos, such as slight.jpg)"
        in warnings[0]
    )
    assert "differs from the closest OpenCV lens by up to 11 pixels" in warnings[1]


def test_files_that_orient_no_photo_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="orients none of the 1 photos"):
        read(tmp_path, {"b.jpg": ""}, [photo("a.jpg")])
