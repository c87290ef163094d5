"""PLY of all encodings: vertices, whatever lies before them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import open_scan, ply
from tests import scan_files
from tests.scan_files import read_all, read_points

EMPTY_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
    "property float z\nend_header\n"
)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_gives_its_vertices(tmp_path: Path, points: NDArray[np.float64], encoding: str) -> None:
    fields = {
        "x": points[:, 0],
        "y": points[:, 1],
        "z": points[:, 2].astype(np.float32),
        "nx": np.zeros(40, np.float32),
        "red": np.arange(40, dtype=np.uint8),
        "green": np.arange(40, dtype=np.uint8) + np.uint8(1),
        "blue": np.arange(40, dtype=np.uint8) + np.uint8(2),
        "scalar_Intensity": np.arange(40, dtype=np.float32),
    }
    scan = open_scan(scan_files.write_ply(tmp_path / "a.ply", fields, encoding=encoding))
    (block,) = scan.read()
    np.testing.assert_allclose(block.points[:, :2], points[:, :2], atol=0)
    np.testing.assert_allclose(block.points[:, 2], points[:, 2], atol=1e-6)
    np.testing.assert_array_equal(block.rgb[:, 2], np.arange(40) + 2)  # type: ignore[index]
    np.testing.assert_array_equal(block.intensity, np.arange(40))
    assert scan.scans[0].rgb_limit == 255.0
    assert scan.fields == {"intensity", "rgb"}


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


@pytest.mark.parametrize("n_before", [3, 4, 5])
def test_many_lines_before_the_vertices_are_skipped_in_blocks(
    tmp_path: Path, points: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch, n_before: int
) -> None:
    monkeypatch.setattr(ply, "BLOCK_POINTS", 2)
    path = scan_files.write_ply(
        tmp_path / "a.ply",
        dict(zip("xyz", points.T, strict=True)),
        encoding="ascii",
        before=f"element strip {n_before}\nproperty uchar kind",
        before_data=b"1\n" * n_before,
    )
    np.testing.assert_array_equal(read_points(path), points)
    # Lines are counted on from the header's.
    head, _, data = path.read_bytes().partition(b"end_header\n")
    lines = data.split(b"\n")
    lines[2] = b"1" * 10_001
    path.write_bytes(head + b"end_header\n" + b"\n".join(lines))
    with pytest.raises(InputError, match=rf"line {head.count(bytes([10])) + 4}: the line has more"):
        read_points(path)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_a_ply_file_that_is_cut_off_is_refused(
    tmp_path: Path, points: NDArray[np.float64], encoding: str
) -> None:
    fields = dict(zip("xyz", points.T, strict=True))
    path = scan_files.write_ply(tmp_path / "a.ply", fields, encoding=encoding)
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(
        InputError, match=r"a\.ply is cut off: its vertex element holds \d+ points, .* 40;"
    ):
        read_all(path)


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


@pytest.mark.parametrize(("n_bytes", "is_read"), [(1 << 20, True), ((1 << 20) + 1, False)])
def test_a_header_has_a_megabyte(tmp_path: Path, n_bytes: int, is_read: bool) -> None:
    begin, end = "ply\nformat ascii 1.0\ncomment ", EMPTY_PLY.partition("1.0")[2]
    blank = " " * (n_bytes - len(begin) - len(end))
    path = tmp_path / "a.ply"
    path.write_text(begin + blank + end)
    told = "holds no points" if is_read else "no end_header"
    with pytest.raises(InputError, match=told):
        read_all(path)
