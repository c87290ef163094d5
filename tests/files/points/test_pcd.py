"""PCD of all encodings, LZF and grids."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import open_scan
from orthoflow.files.points.lzf_kernels import decompress_lzf
from tests import scan_files
from tests.scan_files import read_all


def pcd_fields(points: NDArray[np.float64]) -> dict[str, NDArray[np.generic]]:
    colours = np.arange(40, dtype=np.uint32)
    packed = (colours << 16) | (colours + 1 << 8) | (colours + 2)
    return {
        "x": points[:, 0].astype(np.float32),
        "y": points[:, 1].astype(np.float32),
        "z": points[:, 2].astype(np.float32),
        "rgb": packed.view(np.float32),
        "intensity": np.repeat(np.arange(10, dtype=np.float32), 4),
    }


def test_texts_keep_the_digits_that_their_type_has_no_room_for(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_pcd(tmp_path / "a.pcd", pcd_fields(points), data="ascii")
    first = path.read_bytes().partition(b"DATA ascii\n")
    x, _, behind = first[2].partition(b" ")
    assert float(x) == np.float32(points[0, 0])
    path.write_bytes(b"".join(first[:2]) + b"500000.01 " + behind)
    (block,) = read_all(path)
    assert block.points[0, 0] == 500_000.01


def test_a_grid_of_one_column_has_as_many_rows_as_points(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    (block,) = read_all(scan_files.write_pcd(tmp_path / "a.pcd", pcd_fields(points), width=1))
    np.testing.assert_array_equal(block.row, np.arange(40))
    np.testing.assert_array_equal(block.column, np.zeros(40))


def test_comments_and_empty_lines_are_no_entries(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_pcd(tmp_path / "a.pcd", pcd_fields(points))
    plain = path.read_bytes()
    (expected,) = read_all(path)
    between = b"\n#\n# WIDTH 7\n#HEIGHT 7\n \nWIDTH"
    path.write_bytes(plain.replace(b"WIDTH", between, 1))
    (block,) = read_all(path)
    np.testing.assert_array_equal(block.points, expected.points)
    assert block.row is None


@pytest.mark.parametrize("count", [1, 3])
def test_values_of_several_numbers_stand_between_those_of_one(tmp_path: Path, count: int) -> None:
    """Descriptors of points, as PCL writes them among the coordinates."""
    path = tmp_path / "a.pcd"
    head = (
        f"FIELDS x y histogram z\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 {count} 1\n"
        "WIDTH 2\nHEIGHT 1\nPOINTS 2\n"
    )
    rows = np.arange(2 * (3 + count), dtype="<f4").reshape(2, -1)
    expected = rows[:, [0, 1, -1]]
    for data, content in (
        ("ascii", "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode() + b"\n"),
        ("binary", rows.tobytes()),
    ):
        path.write_bytes(f"{head}DATA {data}\n".encode() + content)
        (block,) = read_all(path)
        np.testing.assert_array_equal(block.points, expected)
        assert block.row is None


def test_pcd_colours_may_be_integers_and_the_sensor_may_stand_somewhere(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    fields = pcd_fields(points)
    fields["rgb"] = fields["rgb"].view(np.uint32)
    path = scan_files.write_pcd(tmp_path / "a.pcd", fields, data="ascii", viewpoint="1 2 3 1 0 0 0")
    opened = open_scan(path)
    (block,) = opened.read()
    assert block.rgb is not None
    np.testing.assert_array_equal(block.rgb[:, 0], np.arange(40))
    np.testing.assert_array_equal(opened.scans[0].station, [1.0, 2.0, 3.0])


def test_a_damaged_compressed_pcd_file_is_refused(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_pcd(tmp_path / "a.pcd", pcd_fields(points), data="binary_compressed")
    content = bytearray(path.read_bytes())
    content[content.index(b"binary_compressed\n") + 18 + 8] = 0xFF
    path.write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"a\.pcd cannot be unpacked: 40 points need 800 bytes"):
        read_all(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"FIELDS", b"FIELDZ", "without FIELDS"),
        (b"DATA binary", b"DATA zipped", "data are zipped, expected ascii"),
        (b"FIELDS x y", b"FIELDS u v", "its fields are u v z rgb intensity, expected x, y and z"),
        (b"COUNT 1 1 1", b"COUNT 1 1 0", "its fields are x y z rgb intensity, expected x, y and z"),
        (b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 1", "VIEWPOINT has 1 numbers, expected 7"),
    ],
)
def test_pcd_headers_that_make_no_sense_are_refused(
    tmp_path: Path, points: NDArray[np.float64], old: bytes, new: bytes, message: str
) -> None:
    path = scan_files.write_pcd(tmp_path / "a.pcd", pcd_fields(points))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        open_scan(path)


# Nothing checks indices in compiled code: each case is tried in arrays that go on behind their end.
GUARD = 0xAA


def unpack(packed: list[int], n_plain: int) -> tuple[int, list[int]]:
    """Unpack into so many bytes; gives what was said and written, and asserts nothing was beyond.

    Behind the packed bytes lie more that could be read.
    """
    source = np.array([*packed, 0, 7, 7, 7, 7], np.uint8)[: len(packed)]
    memory = np.full(n_plain + 300, GUARD, np.uint8)
    said = decompress_lzf(source, memory[:n_plain])
    assert (memory[n_plain:] == GUARD).all()
    return int(said), memory[:n_plain].tolist()


@pytest.mark.parametrize("seed", range(4))
def test_damaged_lzf_data_never_leave_their_array(seed: int) -> None:
    packed = np.random.default_rng(seed).integers(0, 256, 300).astype(np.uint8)
    assert decompress_lzf(packed, np.zeros(64, np.uint8)) == -1
