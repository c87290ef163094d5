"""PLY of all encodings: vertices, whatever lies before them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import open_scan
from tests import scan_files
from tests.scan_files import read_points

EMPTY_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
    "property float z\nend_header\n"
)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_elements_before_the_vertices_are_skipped(
    tmp_path: Path, points: NDArray[np.float64], encoding: str
) -> None:
    fields = dict(zip("xyz", points.T, strict=True))
    before = "element strip 2\nproperty list uchar short items\nproperty uchar kind"
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    data = b"2 5 6 1\n0 2\n"
    if order:
        items = np.array([5, 6], dtype=order + "i2").tobytes()
        data = b"\x02" + items + b"\x01" + b"\x00" + b"\x02"
    path = scan_files.write_ply(
        tmp_path / "a.ply", fields, encoding=encoding, before=before, before_data=data
    )
    np.testing.assert_array_equal(read_points(path), points)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("ply\nformat ascii 1.0\n", "no end_header"),
        ("ply\nelement vertex 3\nend_header\n", "it has no line that names the format"),
        ("ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "no PLY header"),
        ("ply\nformat ascii 1.0\nelement vertex 3\nend_header\n", "no element vertex with single"),
        (
            EMPTY_PLY,
            "a.ply holds no points",
        ),
    ],
    ids=["no-end", "no-format", "no-count", "no-coordinates", "no-points"],
)
def test_ply_headers_that_make_no_sense_are_refused(
    tmp_path: Path, header: str, message: str
) -> None:
    path = tmp_path / "a.ply"
    path.write_text(header)
    with pytest.raises(InputError, match=message):
        open_scan(path)
