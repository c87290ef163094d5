"""What is asked of a LAS file before and after its points are believed, byte by byte."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import las
from orthoflow.files.points.blocks import PointBlock
from tests import scan_files


def header(
    path: Path,
    *,
    size: int = 375,
    start: int = 375,
    n_records: int = 0,
    minor: int = 4,
    extended: tuple[int, int] = (0, 0),
    n_bytes: int = 1000,
) -> Path:
    """A file of so many bytes that begins with a header that states this."""
    content = bytearray(375)
    content[25] = minor
    struct.pack_into("<HII", content, 94, size, start, n_records)
    struct.pack_into("<QI", content, 235, *extended)
    path.write_bytes(bytes(content).ljust(n_bytes, b"\0")[:n_bytes])
    return path


CUT_OFF = "its points begin outside the file, which is cut off"


@pytest.mark.parametrize(
    ("stated", "problem"),
    [
        ({}, ""),
        ({"n_bytes": 226, "minor": 2, "size": 227, "start": 227}, "it ends within its header"),
        ({"n_bytes": 227, "minor": 2, "size": 227, "start": 227}, ""),
        ({"start": 1000}, ""),
        ({"start": 1001}, CUT_OFF),
        ({"start": 374}, CUT_OFF),
        ({"n_records": 2, "start": 375 + 108}, ""),
        ({"n_records": 2, "start": 374 + 108}, "its header states 2 records that have no room"),
        ({"extended": (880, 2)}, ""),
        ({"extended": (881, 2)}, "records at its end are missing, it is cut off"),
        ({"extended": (2000, 0)}, ""),
        ({"extended": (881, 2), "minor": 3}, ""),
        ({"extended": (881, 2), "n_bytes": 374, "start": 374, "size": 374}, ""),
        ({"extended": (315, 1), "n_bytes": 375}, ""),
        ({"extended": (316, 1), "n_bytes": 375}, "records at its end are missing, it is cut off"),
    ],
)
def test_what_a_header_states_must_have_room_in_the_file(
    tmp_path: Path, stated: dict[str, int], problem: str
) -> None:
    path = header(tmp_path / "a.las", **stated)  # type: ignore[arg-type]
    if not problem:
        las._check_header(path)
        return
    with pytest.raises(InputError) as caught:
        las._check_header(path)
    assert str(caught.value) == (
        f"a.las cannot be read as LAS/LAZ: {problem}; copy or export it again"
    )


# Points begin at byte 100: 8 bytes of where the table is, chunks, the table.
START = 100


def chunks(path: Path, *, table: int, n_chunks: int, last: int | None = None) -> Path:
    content = bytearray(300)
    struct.pack_into("<q", content, START, table)
    if last is not None:
        struct.pack_into("<q", content, 292, last)
    place = table if table > 0 else last or 0
    if 0 <= place <= 292:
        struct.pack_into("<II", content, place, 0, n_chunks)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("table", "last", "n_chunks", "n_points", "said"),
    [
        (200, None, 3, 50, 92),
        (108, None, 0, 50, 0),
        (108, None, 1, 50, "its chunk table states 1 chunks"),
        (109, None, 1, 50, 1),
        (292, None, 50, 50, 184),
        (292, None, 51, 50, "its chunk table states 51 chunks"),
        (107, None, 0, 50, "its chunk table lies outside the file, which is cut off"),
        (293, None, 0, 50, "its chunk table lies outside the file, which is cut off"),
        (-1, 250, 3, 50, 142),
        (0, 250, 3, 50, 142),
        (-1, 293, 3, 50, "its chunk table lies outside the file, which is cut off"),
    ],
)
def test_the_chunk_table_lies_behind_its_chunks(
    tmp_path: Path, table: int, last: int | None, n_chunks: int, n_points: int, said: int | str
) -> None:
    path = chunks(tmp_path / "a.laz", table=table, n_chunks=n_chunks, last=last)
    with path.open("rb") as file:
        if isinstance(said, int):
            assert las._check_size(path, file, START, n_points) == said
            return
        with pytest.raises(InputError, match=f"as LAS/LAZ: {said}; copy"):
            las._check_size(path, file, START, n_points)


def test_a_file_that_ends_before_its_points_is_refused(tmp_path: Path) -> None:
    path = chunks(tmp_path / "a.laz", table=200, n_chunks=1)
    with path.open("rb") as file, pytest.raises(InputError, match="ends before its points begin"):
        las._check_size(path, file, 293, 50)


def block(*points: tuple[float, float, float], told: bool = True) -> PointBlock:
    array: NDArray[np.float64] = np.array(points, dtype=np.float64).reshape(-1, 3)
    bounds = np.stack([array.min(axis=0), array.max(axis=0)]) if told and len(array) else None
    return PointBlock(points=array, scan=0, n_read=len(array), bounds=bounds)


def outside(found: PointBlock, low: object, high: object) -> int:
    bounds = np.array([np.broadcast_to(low, 3), np.broadcast_to(high, 3)], dtype=np.float64)  # type: ignore[call-overload]
    header = SimpleNamespace(mins=bounds[0], maxs=bounds[1], are_points_compressed=True)
    check = las._BoundsCheck(Path("a.las"), header)
    check.add(found)
    notes = "".join(check.notes())
    return int(notes.split()[1]) if notes else 0


@pytest.mark.parametrize("told", [True, False], ids=["with bounds", "without"])
def test_points_a_thousandth_outside_the_bounds_are_counted(*, told: bool) -> None:
    # 10 units: a hundredth of one is rounding.
    near, far = (10.009, 5.0, 5.0), (10.011, 5.0, 5.0)
    below = (5.0, 5.0, -0.011)
    assert outside(block((0, 0, 0), (10, 10, 10), near, told=told), 0, 10) == 0
    assert outside(block(near, far, below, (5, -0.009, 5), told=told), 0, 10) == 2
    # Of less than a unit, a thousandth of one is.
    assert outside(block((0.1009, 0, 0), (0.1011, 0, 0), told=told), 0, 0.1) == 1


@pytest.mark.parametrize(
    ("extent", "far", "is_damaged"),
    [(10, 10.0, False), (10, 10.5, True), (0.1, 1.0, False), (0.1, 1.5, True)],
)
def test_points_farther_outside_than_the_scan_is_large_are_damage(
    extent: float, far: float, *, is_damaged: bool
) -> None:
    found = block((0, 0, 0), (0, extent + far, 0))
    if not is_damaged:
        assert outside(found, 0, extent) == 1
        return
    with pytest.raises(InputError) as caught:
        outside(found, 0, extent)
    assert str(caught.value) == (
        f"a.las is damaged: points lie {far:.0f} units outside the bounds its header states "
        f"([0.0, 0.0, 0.0] to {[float(extent)] * 3}); copy or export it again"
    )


@pytest.mark.parametrize(
    ("low", "high"),
    [(0, 0), (1, -1), (0, 1e12), (-1e12, 0), (0, np.inf), (0, np.nan), ((0, 0, 1), (9, 9, 0))],
)
def test_bounds_that_no_scan_has_say_nothing(low: object, high: object) -> None:
    assert outside(block((1e6, 0, 0), (0, 0, -1e6)), low, high) == 0
    assert outside(block(), 0, 10) == 0


def test_bounds_of_a_block_are_none_where_they_are_not_finite() -> None:
    axes = np.array([[1.0, 5.0], [2.0, -3.0], [0.0, 7.0]])
    found = las._bounds(axes)
    assert found is not None
    assert found.tolist() == [[1, -3, 0], [5, 2, 7]]
    axes[1, 1] = np.nan
    assert las._bounds(axes) is None
    assert las._bounds(np.zeros((3, 0))) is None


@pytest.mark.parametrize(("farthest", "is_told"), [(0.9e12, True), (1.1e12, False)])
def test_bounds_are_believed_up_to_a_trillion_units(farthest: float, *, is_told: bool) -> None:
    found = block((0.0, 0.0, -2.0), (0.0, 0.0, 1.0))
    low = (-farthest, 0.0, -1.0)
    assert outside(found, low, (0.0, 0.0, 1.0)) == 0
    # Beyond bounds that are said, by more than a thousandth of their largest extent.
    beyond = block((0.0, 0.0, 0.002 * farthest), (0.0, 0.0, 1.0))
    assert outside(beyond, low, (0.0, 0.0, 1.0)) == is_told


def compressed(*items: tuple[int, int]) -> bytes:
    """The record of a compression: kind and bytes of each item."""
    listed = b"".join(struct.pack("<HHH", kind, size, 3) for kind, size in items)
    return bytes(32) + struct.pack("<H", len(items)) + listed


def layered(n_layers: int, n_first: int, n_chunks: int, *, more: int = 0) -> tuple[bytes, int]:
    """Chunks of so many layers of 3, 4, 5 ... bytes behind a first point, and the size of one."""
    sizes = [3 + k for k in range(n_layers)]
    head = bytes(n_first) + struct.pack(f"<I{n_layers}I", 7, *sizes[:-1], sizes[-1] + more)
    chunk = head + bytes(sum(sizes))
    return chunk * n_chunks, len(chunk)


@pytest.mark.parametrize(
    ("items", "n_layers"),
    [
        ([(10, 30)], 9),
        ([(10, 30), (11, 6)], 10),
        ([(10, 30), (12, 8)], 11),
        ([(10, 30), (13, 29)], 10),
        # Each byte that a program has added is a layer of its own.
        ([(10, 30), (11, 6), (14, 5)], 15),
    ],
)
def test_layers_are_as_large_as_their_chunk(
    tmp_path: Path, items: list[tuple[int, int]], n_layers: int
) -> None:
    path = tmp_path / "a.laz"
    n_first = sum(size for _, size in items)
    content, n_chunk = layered(n_layers, n_first, 2)
    path.write_bytes(b"12345" + content)
    las._check_layers(path, compressed(*items), 5, [n_chunk, n_chunk])
    content, _ = layered(n_layers, n_first, 2, more=1)
    path.write_bytes(b"12345" + content)
    with pytest.raises(InputError, match="layers of its chunks are not as large as they are said"):
        las._check_layers(path, compressed(*items), 5, [n_chunk, n_chunk])
    path.write_bytes(b"12345" + bytes(n_first))
    with pytest.raises(InputError, match="layers of its chunks are not as large as they are said"):
        las._check_layers(path, compressed(*items), 5, [n_chunk])


def test_items_of_older_points_have_no_layers(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="its compression is none of point formats 6 and up"):
        las._check_layers(tmp_path / "a.laz", compressed((10, 30), (6, 20)), 0, [])


@pytest.mark.parametrize(("most", "is_refused"), [(49_999, True), (50_000, False)])
def test_chunks_hold_no_more_points_than_any_program_puts_into_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, *, is_refused: bool
) -> None:
    points = np.random.default_rng(1).uniform(0.0, 5.0, (40, 3))
    path = scan_files.write_las(tmp_path / "a.laz", points)
    monkeypatch.setattr(las, "MOST_FIXED_CHUNK", most)
    if not is_refused:
        assert las.open_las(path).n_most == 40
        return
    with pytest.raises(InputError, match="its chunks are said to hold 50000 points each"):
        las.open_las(path)


def test_points_of_formats_6_and_up_have_layers() -> None:
    assert [las._is_layered(struct.pack("<HI", kind, 9)) for kind in (0, 1, 2, 3, 4)] == [
        *(False, False, False, True, False),
    ]
