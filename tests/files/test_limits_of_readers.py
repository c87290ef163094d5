"""A file exactly as large as allowed is read, and one that is larger by one of anything is not."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files import (
    calibration,
    camera_formats,
    colmap,
    images,
    metashape,
    polygons,
    sidecars,
    survey_points,
)
from orthoflow.files.camera_formats import read_given_cameras
from orthoflow.files.drawings import sheet_contents
from orthoflow.files.images import encode_png

LENS = "cameras: {a.jpg: {width: 640, height: 480, fx: 500, fy: 500, cx: 319.5, cy: 239.5}}"
CSV = "name,x,y,z\na,1,2,3\nlong name,1.25,2.5,3.125\n"
CAMERA = "<camera id='0' sensor_id='0' label='a.jpg'/>"
CHUNK = (
    "<document><chunk><sensors><sensor id='0'><resolution width='640' height='480'/>"
    "<calibration><f>500</f></calibration></sensor></sensors>"
    f"<cameras>{CAMERA}</cameras></chunk></document>"
)
THREE = CHUNK.replace(CAMERA, 3 * CAMERA)
MASK = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "properties": {"photo": f"{number}.jpg"},
            "geometry": {"type": "Polygon", "coordinates": [[[0, 0], [4, 0], [4, 3], [0, 0]]]},
        }
        for number in range(3)
    ],
}


@dataclass(frozen=True, kw_only=True)
class Limit:
    """A limit of a reader, a file, and how much of what is limited the file has."""

    module: object
    constant: str
    content: bytes
    size: int
    read: Callable[[Path], object]

    def __str__(self) -> str:
        module = getattr(self.module, "__name__", "").rpartition(".")[2]
        return f"{module}-{self.constant}-{self.size}"


def limit(
    module: object, constant: str, text: str, size: int | None, read: Callable[[Path], object]
) -> Limit:
    content = text.encode()
    size = len(content) if size is None else size
    return Limit(module=module, constant=constant, content=content, size=size, read=read)


def masks(path: Path) -> object:
    return polygons.read_polygons(path, name="photo", what="a mask")


def decoded(path: Path) -> object:
    return images.decode_image(path.read_bytes(), path.name)


def cameras_of(suffix: str) -> Callable[[Path], object]:
    return lambda path: read_given_cameras([path.rename(path.with_suffix(suffix))])


def colmap_of_two(path: Path) -> object:
    for name, text in (
        ("cameras.txt", "1 PINHOLE 64 48 50 50 32 24\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 1 b.jpg\n\n"),
    ):
        path.with_name(name).write_text(text)
    return read_given_cameras([path.with_name(name) for name in ("cameras.txt", "images.txt")])


REALITYCAPTURE = "#name,x,y,alt,heading,pitch,roll,f\n" + "a.jpg,1,2,3,0,0,0,24\n" * 2
BLOCK = "project: Hall\ntitle: West wall\n"
LIMITS = [
    limit(calibration, "MOST_BYTES", LENS, None, calibration.read_calibration),
    limit(sheet_contents, "MOST_BYTES", BLOCK, None, sheet_contents.read_title_block),
    limit(sheet_contents, "MOST_LETTERS", BLOCK, len("West wall"), sheet_contents.read_title_block),
    limit(survey_points, "MOST_BYTES", CSV, None, survey_points.read_survey_points),
    limit(survey_points, "MOST_LINE", CSV, 24, survey_points.read_survey_points),
    limit(survey_points, "MOST_POINTS", CSV, 3, survey_points.read_survey_points),
    limit(polygons, "MOST_BYTES", json.dumps(MASK), None, masks),
    limit(polygons, "MOST_POLYGONS", json.dumps(MASK), 3, masks),
    limit(sidecars, "MOST_SIDECAR_BYTES", '{"gsd_m": 0.5}', None, sidecars.read_sidecar),
    limit(camera_formats, "MOST_CAMERAS", REALITYCAPTURE, 2, cameras_of(".csv")),
    limit(colmap, "MOST_CAMERAS", "", 2, colmap_of_two),
    limit(camera_formats, "MOST_CAMERAS", THREE, 3, cameras_of(".xml")),
    limit(metashape, "MOST_TAGS", CHUNK, CHUNK.count("<"), metashape.read_metashape_xml),
    limit(metashape, "MOST_PIXELS", CHUNK, 640 * 480, metashape.read_metashape_xml),
    Limit(
        module=images,
        constant="MOST_PIXELS",
        content=encode_png(np.zeros((6, 7, 3), dtype=np.uint8)),
        size=42,
        read=decoded,
    ),
]


@pytest.mark.parametrize("limit", LIMITS, ids=str)
def test_what_is_as_large_as_allowed_is_read_and_nothing_larger(
    limit: Limit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read() -> str:
        (tmp_path / "file").write_bytes(limit.content)
        return repr(limit.read(tmp_path / "file"))

    usual = read()
    monkeypatch.setattr(limit.module, limit.constant, limit.size)
    assert read() == usual
    monkeypatch.setattr(limit.module, limit.constant, limit.size - 1)
    with pytest.raises(InputError):
        read()


@pytest.mark.parametrize(
    ("name", "most_bytes", "read"),
    [
        ("calibration.yaml", 400_000, calibration.read_calibration),
        ("block.yaml", 100_000, sheet_contents.read_title_block),
        ("points.csv", 20_000_000, survey_points.read_survey_points),
        ("ties.csv", 20_000_000, survey_points.read_measured_ties),
        ("wall_0_depth.json", 1_048_576, sidecars.read_sidecar),
        ("masks.geojson", 50_000_000, masks),
        ("cameras.json", 50_000_000, lambda path: read_given_cameras([path])),
        ("cameras.xml", 50_000_000, lambda path: read_given_cameras([path])),
    ],
)
def test_what_is_larger_than_any_file_of_its_kind_is_not_read(
    tmp_path: Path, name: str, most_bytes: int, read: Callable[[Path], object]
) -> None:
    path = tmp_path / name
    path.touch()
    os.truncate(path, most_bytes + 1)  # without a byte on the disk
    with pytest.raises(InputError, match=rf"{name}.* (at most|more than) {most_bytes}"):
        read(path)
