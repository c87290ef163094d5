"""Masks of photos: pictures beside them or elsewhere, and polygons."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.read.photos import ReadPhotos

from orthoflow.errors import InputError
from orthoflow.files.images import encode_jpeg, encode_png, used_pixels
from orthoflow.files.polygons import MOST_BYTES
from orthoflow.products import InputFiles, Photo
from tests.method_runs import Reader

SIZE = (64, 48)
INSIDE = np.s_[10:20, 30:50]


def picture() -> bytes:
    """White, with a black rectangle."""
    grey = np.full(SIZE[::-1], 255, dtype=np.uint8)
    grey[INSIDE] = 0
    return encode_png(grey)


def photo_in(folder: Path, name: str = "a.jpg") -> Path:
    path = folder / name
    path.write_bytes(encode_jpeg(np.full((*SIZE[::-1], 3), 99, dtype=np.uint8)))
    return path


def file_in(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def read(
    folder: Path, photos: list[Path], masks: list[Path] | None = None
) -> tuple[tuple[Photo, ...], str]:
    reader = Reader(ReadPhotos, folder)
    given = None if masks is None else InputFiles(name="masks", paths=tuple(masks))
    read = reader.run(tuple(photos), {}, masks=given).photos.photos
    return read, reader.warnings


def masked(photo: Photo) -> NDArray[np.bool_]:
    used = used_pixels(photo)
    assert used is not None
    return ~used


def expected() -> NDArray[np.bool_]:
    cells = np.zeros(SIZE[::-1], dtype=np.bool_)
    cells[INSIDE] = True
    return cells


def polygons(photo: str, *rings: list[tuple[float, float]]) -> str:
    geometry = {"type": "Polygon", "coordinates": [[*ring, ring[0]] for ring in rings]}
    feature = {"type": "Feature", "properties": {"photo": photo}, "geometry": geometry}
    return json.dumps({"type": "FeatureCollection", "features": [feature]})


RING = [(30.0, 10.0), (50.0, 10.0), (50.0, 20.0), (30.0, 20.0)]


def test_a_mask_beside_its_photo_is_no_photo(tmp_path: Path) -> None:
    files = [photo_in(tmp_path), file_in(tmp_path, "a_mask.png", picture())]
    (photo,), said = read(tmp_path, files)
    assert photo.name == "a.jpg"
    np.testing.assert_array_equal(masked(photo), expected())
    assert "masks that match no photo" not in said
    # What ends like a mask, but of no photo, is a photo.
    alone, _ = read(tmp_path, [file_in(tmp_path, "white_mask.png", picture())])
    assert [item.name for item in alone] == ["white_mask.png"]


def test_masks_of_no_photo_and_files_that_are_none_are_named(tmp_path: Path) -> None:
    masks = [
        file_in(tmp_path / "masks", "c.png", picture()),
        file_in(tmp_path / "masks", "a.png", picture()),
        file_in(tmp_path / "masks", "notes.txt", "drawn on Friday"),
        file_in(tmp_path, "none.geojson", polygons("x*.jpg", RING)),
    ]
    (photo,), said = read(tmp_path, [photo_in(tmp_path)], masks)
    np.testing.assert_array_equal(masked(photo), expected())
    assert (
        "masks that match no photo: c.png, x*.jpg: a mask must have the name of its photo" in said
    )
    assert "neither images (PNG, JPEG, TIFF) nor polygons (GeoJSON): notes.txt" in said


def test_polygons_mask_photos_by_name_or_pattern(tmp_path: Path) -> None:
    files = [photo_in(tmp_path, "a.jpg"), photo_in(tmp_path, "b.jpg")]
    one = file_in(tmp_path, "one.geojson", polygons("a.jpg", RING))
    (first, second), _ = read(tmp_path, files, [one])
    np.testing.assert_array_equal(masked(first), expected())
    assert second.mask is None
    every = file_in(tmp_path, "all.geojson", polygons("*", RING, [(35, 12), (45, 12), (40, 18)]))
    (first, second), _ = read(tmp_path, files, [every])
    holed = masked(first)
    # The hole has 30 pixels, give or take those whose centre its border passes.
    assert not (holed & ~expected()).any()
    assert (expected() & ~holed).sum() == pytest.approx(30, abs=3)
    np.testing.assert_array_equal(masked(second), holed)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.png", encode_png(np.full(SIZE, 255, np.uint8)), "a.png has 48 x 64 pixels, but a.jpg"),
        ("a.png", encode_png(np.zeros(SIZE[::-1], np.uint8)), "the mask of a.jpg excludes all"),
        ("a.png", b"no picture", "mask a.png"),
        ("a.txt", "words", r"the masks contain no pictures .* only a\.txt"),
        ("a.json", " " * (MOST_BYTES + 1), f"more than {MOST_BYTES} bytes"),
    ],
)
def test_what_is_no_mask_is_refused(
    tmp_path: Path, name: str, content: bytes | str, said: str
) -> None:
    mask = file_in(tmp_path / "masks", name, content)
    with pytest.raises(InputError, match=said):
        read(tmp_path, [photo_in(tmp_path)], [mask])
