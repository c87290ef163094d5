"""PCD of all encodings, LZF and grids."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import open_scan, pcd, tables
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


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_pcd_gives_its_points(tmp_path: Path, points: NDArray[np.float64], data: str) -> None:
    fields = pcd_fields(points)
    path = scan_files.write_pcd(tmp_path / "a.pcd", fields, data=data, width=8)
    (block,) = read_all(path)
    expected = np.column_stack([fields["x"], fields["y"], fields["z"]])
    np.testing.assert_array_equal(block.points, expected.astype(np.float64))
    index = np.arange(40)
    np.testing.assert_array_equal(block.rgb, np.column_stack([index, index + 1, index + 2]))
    np.testing.assert_array_equal(block.intensity, fields["intensity"])
    np.testing.assert_array_equal(block.row, index // 8)
    np.testing.assert_array_equal(block.column, index % 8)


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


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_the_grid_of_a_pcd_goes_on_from_block_to_block(
    tmp_path: Path, points: NDArray[np.float64], data: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = scan_files.write_pcd(tmp_path / "a.pcd", pcd_fields(points), data=data, width=8)
    for module in (pcd, tables):
        monkeypatch.setattr(module, "BLOCK_POINTS", 15)
    blocks = read_all(path)
    assert [block.n_read for block in blocks] == [15, 15, 10]
    index = np.arange(40)
    rows, columns, greys = (
        np.concatenate([getattr(block, name) for block in blocks])
        for name in ("row", "column", "intensity")
    )
    np.testing.assert_array_equal(rows, index // 8)
    np.testing.assert_array_equal(columns, index % 8)
    np.testing.assert_array_equal(greys, index // 4)


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


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("ascii", r"a\.pcd is cut off"),
        ("binary", r"a\.pcd is cut off"),
        ("binary_compressed", r"a\.pcd is cut off: its compressed data holds \d+ bytes"),
    ],
)
def test_a_pcd_file_that_is_cut_off_is_refused(
    tmp_path: Path, points: NDArray[np.float64], data: str, message: str
) -> None:
    path = scan_files.write_pcd(tmp_path / "a.pcd", pcd_fields(points), data=data)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=message):
        read_all(path)


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


@pytest.mark.parametrize("seed", range(4))
def test_lzf_gives_back_what_was_packed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plain = rng.integers(0, 2 + 60 * seed, 5000).astype(np.uint8)
    packed = np.frombuffer(scan_files.compress_lzf(plain.tobytes()), np.uint8)
    unpacked = np.zeros(5000, np.uint8)
    assert decompress_lzf(packed, unpacked) == 5000
    np.testing.assert_array_equal(unpacked, plain)


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


@pytest.mark.parametrize("count", [1, 2, 31, 32])
def test_lzf_literals_fit_exactly_or_not_at_all(count: int) -> None:
    literals = list(range(1, count + 1))
    packed = [count - 1, *literals]
    assert unpack(packed, count) == (count, literals)
    assert unpack(packed, count + 1) == (count, [*literals, GUARD])
    assert unpack(packed, count - 1)[0] == -1
    assert unpack(packed[:-1], count)[0] == -1


@pytest.mark.parametrize("length", [3, 8, 9, 10, 263, 264])
def test_lzf_back_references_fit_exactly_or_not_at_all(length: int) -> None:
    # Three literals, then a reference to the first of them; from nine bytes on the length takes a
    # byte of its own.
    long = [7 << 5, length - 9, 2] if length >= 9 else [(length - 2) << 5, 2]
    packed = [2, 11, 12, 13, *long]
    repeated = [11, 12, 13] * 90
    whole = repeated[: 3 + length]
    assert unpack(packed, 3 + length) == (3 + length, whole)
    assert unpack(packed, 4 + length) == (3 + length, [*whole, GUARD])
    assert unpack(packed, 2 + length)[0] == -1
    for n_missing in range(1, len(long)):
        assert unpack(packed[:-n_missing], 3 + length)[0] == -1


@pytest.mark.parametrize("distance", [1, 2, 256, 257, 8191, 8192])
def test_lzf_back_references_reach_the_first_byte_and_none_before(distance: int) -> None:
    literals = [1 + k % 150 for k in range(distance)]
    packed: list[int] = []
    for start in range(0, distance, 32):
        part = literals[start : start + 32]
        packed += [len(part) - 1, *part]
    reference = [(1 << 5) | ((distance - 1) >> 8), (distance - 1) & 255]
    whole = (literals * 4)[: distance + 3]
    assert unpack(packed + reference, distance + 3) == (distance + 3, whole)
    # One literal less: the same reference points before the first byte.
    shorter = [*packed[: -(len(part) + 1)], *([len(part) - 2, *part[1:]] if len(part) > 1 else [])]
    assert unpack(shorter + reference, distance + 2)[0] == -1


def test_lzf_data_without_anything_give_nothing() -> None:
    assert unpack([], 0) == (0, [])
    assert unpack([], 2) == (0, [GUARD, GUARD])
    assert unpack([0], 2)[0] == -1


@pytest.mark.parametrize("seed", range(4))
def test_damaged_lzf_data_never_leave_their_array(seed: int) -> None:
    packed = np.random.default_rng(seed).integers(0, 256, 300).astype(np.uint8)
    assert decompress_lzf(packed, np.zeros(64, np.uint8)) == -1
