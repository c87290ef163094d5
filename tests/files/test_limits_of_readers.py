"""A file exactly as large as allowed is read, and one that is larger by one of anything is not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files import (
    calibration,
    camera_formats,
    colmap,
    given_cameras,
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
TIES = "photo,u_px,v_px,x,y,z\n" + 2 * "a.jpg,1,2,3,4,5\n"
CAMERA = "<camera id='0' sensor_id='0' label='a.jpg'/>"
CHUNK = (
    "<document><chunk><sensors><sensor id='0'><resolution width='640' height='480'/>"
    "<calibration><f>500</f></calibration></sensor></sensors>"
    f"<cameras>{CAMERA}</cameras></chunk></document>"
)
THREE = CHUNK.replace(CAMERA, 3 * CAMERA)
RING = [[0, 0], [4, 0], [4, 3], [0, 0]]
MASK = {
    "type": "FeatureCollection",
    "features": 3
    * [
        {
            "type": "Feature",
            "properties": {"photo": "a.jpg"},
            "geometry": {"type": "Polygon", "coordinates": [RING]},
        }
    ],
}


def masks(path: Path) -> object:
    return polygons.read_polygons(path, name="photo", what="a mask")


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
GREY = encode_png(np.zeros((6, 7, 3), dtype=np.uint8))
# Module and constant, a file, how much of what is limited it has, and what reads it.
LIMITS: list[tuple[ModuleType, str, str | bytes, int, Callable[[Path], object]]] = [
    (calibration, "MOST_BYTES", LENS, len(LENS), calibration.read_calibration),
    (sheet_contents, "MOST_BYTES", BLOCK, len(BLOCK), sheet_contents.read_title_block),
    (sheet_contents, "MOST_LETTERS", BLOCK, len("West wall"), sheet_contents.read_title_block),
    (survey_points, "MOST_BYTES", CSV, len(CSV), survey_points.read_survey_points),
    (survey_points, "MOST_LINE", CSV, 24, survey_points.read_survey_points),
    (survey_points, "MOST_POINTS", CSV, 3, survey_points.read_survey_points),
    (survey_points, "MOST_TIE_BYTES", TIES, len(TIES), survey_points.read_measured_ties),
    (survey_points, "MOST_TIES", TIES, 3, survey_points.read_measured_ties),
    (polygons, "MOST_BYTES", json.dumps(MASK), len(json.dumps(MASK)), masks),
    (polygons, "MOST_POLYGONS", json.dumps(MASK), 3, masks),
    (sidecars, "MOST_SIDECAR_BYTES", '{"gsd_m": 0.5}', 14, sidecars.read_sidecar),
    (given_cameras, "MOST_BYTES", CHUNK, len(CHUNK), cameras_of(".xml")),
    (camera_formats, "MOST_CAMERAS", REALITYCAPTURE, 2, cameras_of(".csv")),
    (colmap, "MOST_CAMERAS", "", 2, colmap_of_two),
    (camera_formats, "MOST_CAMERAS", THREE, 3, cameras_of(".xml")),
    (metashape, "MOST_TAGS", CHUNK, CHUNK.count("<"), metashape.read_metashape_xml),
    (metashape, "MOST_PIXELS", CHUNK, 640 * 480, metashape.read_metashape_xml),
    (images, "MOST_PIXELS", GREY, 42, lambda path: images.decode_image(path.read_bytes(), "a")),
]


@pytest.mark.parametrize(("module", "constant", "content", "size", "reader"), LIMITS)
def test_what_is_as_large_as_allowed_is_read_and_nothing_larger(
    module: ModuleType,
    constant: str,
    content: str | bytes,
    size: int,
    reader: Callable[[Path], object],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def read() -> str:
        data = content if isinstance(content, bytes) else content.encode()
        (tmp_path / "file").write_bytes(data)
        return repr(reader(tmp_path / "file"))

    usual = read()
    monkeypatch.setattr(module, constant, size)
    assert read() == usual
    monkeypatch.setattr(module, constant, size - 1)
    with pytest.raises(InputError):
        read()
