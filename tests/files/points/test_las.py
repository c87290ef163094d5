"""LAS, LAZ and COPC: every digit and every block, and damage found before a library meets it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import PointQuery, las, open_scan
from tests import scan_files
from tests.scan_files import read_all

POINTS = np.round(np.random.default_rng(3).uniform(-5.0, 5.0, (40, 3)), 4)


@pytest.mark.parametrize(("suffix", "flag"), [(".las", "withheld"), (".laz", "synthetic")])
def test_only_the_classes_asked_for_are_given_and_the_rest_is_counted(
    suffix: str, flag: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(1)
    points, is_flagged = rng.uniform(0, 5, (60_000, 3)), np.arange(60_000) % 7 == 0
    classes = rng.choice([2, 6, 40], 60_000)
    fields = {flag: is_flagged, "classification": classes.astype(np.uint8)}
    path = scan_files.write_las(tmp_path / f"a{suffix}", points, **fields)
    monkeypatch.setattr(las, "BLOCK_POINTS", 50_000)
    blocks = list(open_scan(path, classes=(6, 40)).read())
    wanted = np.isin(classes, [6, 40])
    found = np.concatenate([block.points for block in blocks])
    np.testing.assert_allclose(found, points[wanted & ~is_flagged], atol=6e-5)
    assert sum(block.n_read for block in blocks) == 60_000
    assert sum(block.left_out[flag] for block in blocks) == is_flagged.sum()
    assert sum(block.left_out["other_class"] for block in blocks) == (~wanted & ~is_flagged).sum()


def test_points_outside_the_stated_bounds_are_a_note_and_far_ones_of_laz_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stray = np.vstack([POINTS, POINTS.max(axis=0) + 1000.0])
    for suffix in (".laz", ".las"):
        path = scan_files.write_las(tmp_path / f"a{suffix}", stray)
        for axis, offset in enumerate((179, 195, 211)):
            change(path, offset, np.float64(POINTS[:, axis].max()).tobytes())
    with pytest.raises(InputError, match=r"a\.laz is damaged: points are \d+ units outside"):
        read_all(tmp_path / "a.laz")
    # Without compression there is nothing that a changed byte could spoil but itself.
    change(tmp_path / "a.las", 179, np.float64(POINTS[:, 0].max() - 0.5).tobytes())
    n_outside = np.count_nonzero(stray[:, 0] > POINTS[:, 0].max() - 0.5)
    # Blocks are counted together.
    monkeypatch.setattr(las, "BLOCK_POINTS", 7)
    scan = open_scan(tmp_path / "a.las")
    assert sum(len(block.points) for block in scan.read()) == len(stray)
    assert f": {n_outside} points are outside the bounding box in its header" in scan.notes[0]


def change(path: Path, position: int, content: bytes) -> Path:
    changed = bytearray(path.read_bytes())
    changed[position : position + len(content)] = content
    path.write_bytes(bytes(changed))
    return path


def chunk_table(path: Path) -> int:
    content = path.read_bytes()
    (start,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, start)
    return int(table)


@pytest.mark.parametrize(
    ("position", "content", "message"),
    [
        (96, b"\xff\xff\xff\x00", "its points begin outside the file, which is truncated"),
        (
            100,
            b"\xff\xff\xff\x7f",
            "its header declares 2147483647 records, which the file cannot contain",
        ),
        (243, b"\x05\x00\x00\x00", "records at its end are missing"),
        # Of the chunk table: 3 thousand million chunks of 16 bytes each would end the process.
        (4, b"\xff\xff\xff\xbf", "its chunk table declares 3221225471 chunks"),
        (
            247,
            struct.pack("<Q", 400_000),
            "its chunks contain 50000 points, but its header declares 400000",
        ),
    ],
)
def test_a_damaged_las_header_is_found_before_a_library_believes_it(
    tmp_path: Path, position: int, content: bytes, message: str
) -> None:
    path = scan_files.write_las(tmp_path / "a.laz", POINTS)
    if position == 243:
        change(path, 235, struct.pack("<Q", path.stat().st_size))
    position += chunk_table(path) if position == 4 else 0
    with pytest.raises(InputError, match=rf"a\.laz cannot be read as LAS/LAZ: .*{message}"):
        open_scan(change(path, position, content))
    path.write_bytes(path.read_bytes()[:150])
    with pytest.raises(InputError, match="it ends within its header"):
        open_scan(path)


# COPC: only nodes with requested points are read, and a damaged octree is reported ----------------


# Root, its eight children, and two children of the last of these.
PLACES = (
    ((0, 0, 0),),
    tuple((x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)),
    ((2, 2, 2), (3, 3, 3)),
)


def points_of(level: int, place: tuple[int, int, int]) -> NDArray[np.float64]:
    rng = np.random.default_rng([level, *place])
    side = 8.0 / 2**level
    low = side * np.array(place)
    return np.round(low + rng.uniform(0.01 * side, 0.99 * side, (300 + 10 * level, 3)), 4)


NODES = [{place: points_of(level, place) for place in PLACES[level]} for level in range(3)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return scan_files.write_copc(tmp_path / "a.copc.laz", NODES)


def sorted_points(points: NDArray[np.float64]) -> NDArray[np.float64]:
    rounded = np.round(points, 4)
    return rounded[np.lexsort(rounded.T)]


def read(path: Path, query: PointQuery | None) -> NDArray[np.float64]:
    scan = open_scan(path, query=query)
    blocks = list(scan.read())
    points = np.concatenate([block.points for block in blocks])
    assert scan.n_most == len(points) == sum(block.n_read for block in blocks)
    return points


def all_points(n_levels: int = 3) -> NDArray[np.float64]:
    return np.concatenate([points for level in NODES[:n_levels] for points in level.values()])


def test_a_copc_file_is_read_down_to_the_spacing_asked_for(path: Path) -> None:
    for query in (None, PointQuery()):
        np.testing.assert_array_equal(read(path, query).round(4), all_points().round(4))
        assert not open_scan(path, query=query).is_chosen
    for spacing, n_levels in ((2.0, 1), (0.5, 1), (0.4, 2), (0.25, 2), (0.2, 3), (0.001, 3)):
        found = read(path, PointQuery(spacing=spacing))
        np.testing.assert_array_equal(sorted_points(found), sorted_points(all_points(n_levels)))
    # Without an octree there is nothing to choose from; and a spacing beyond all numbers asks
    # for every level.
    plain = scan_files.write_las(path.with_name("a.las"), all_points())
    assert len(read(plain, PointQuery(spacing=0.5))) == len(all_points())
    content = bytearray(path.read_bytes())
    struct.pack_into("<d", content, 429 + 32, 1e308)
    path.write_bytes(bytes(content))
    assert len(read(path, PointQuery(spacing=0.1))) == len(all_points())


@pytest.mark.parametrize("block_points", [500_000, 700])
def test_only_nodes_that_meet_the_box_are_read(
    path: Path, monkeypatch: pytest.MonkeyPatch, block_points: int
) -> None:
    monkeypatch.setattr(las, "BLOCK_POINTS", block_points)
    found = read(path, PointQuery(box=np.array([[0.5, 4.5, 0.5], [3.5, 7.5, 3.5]])))
    expected = np.concatenate([NODES[0][0, 0, 0], NODES[1][0, 1, 0]])
    np.testing.assert_array_equal(sorted_points(found), sorted_points(expected))
    # If a box contains no node, the root is read, because it shows the position of the cloud.
    beside = read(path, PointQuery(box=np.array([[90.0, 0.0, 0.0], [91.0, 1.0, 1.0]])))
    np.testing.assert_array_equal(sorted_points(beside), sorted_points(NODES[0][0, 0, 0]))


def hierarchy(content: bytes) -> tuple[int, int]:
    at, size = struct.unpack_from("<2Q", content, 429 + 40)
    return int(at), int(size)


@pytest.mark.parametrize(
    ("where", "change", "reason"),
    [
        ("info", struct.pack("<d", -1.0), "the size or spacing of its root is invalid"),
        ("info", struct.pack("<d", float("nan")), "the size or spacing of its root is invalid"),
        ("root", struct.pack("<2Q", 1 << 60, 32), "its pages are outside the file"),
        ("root", struct.pack("<2Q", 0, 0), "it has no nodes"),
        ("level", struct.pack("<4i", 40, 0, 0, 0), "a node is outside the root"),
        ("level", struct.pack("<4i", 1, 0, 2, 0), "a node is outside the root"),
        ("chunk", struct.pack("<Q", 500), "it references chunks that the file does not contain"),
        ("count", struct.pack("<i", 1 << 30), "it references chunks that the file does not"),
        ("count", struct.pack("<i", -7), "a node is outside the root"),
    ],
)
def test_a_damaged_octree_is_told_before_anything_is_decoded(
    path: Path, where: str, change: bytes, reason: str
) -> None:
    content = bytearray(path.read_bytes())
    page, _ = hierarchy(content)
    places = {"info": 429 + 24, "root": 429 + 40, "level": page}
    at = (places | {"chunk": page + 16, "count": page + 28})[where]
    content[at : at + len(change)] = change
    path.write_bytes(bytes(content))
    with pytest.raises(InputError, match=rf"a\.copc\.laz cannot be read as COPC: .*{reason}"):
        open_scan(path, query=PointQuery(spacing=0.1))
    # Its points need no octree.
    assert len(read(path, None)) == len(all_points())


def test_pages_that_name_each_other_end(path: Path) -> None:
    content = bytearray(path.read_bytes())
    page, size = hierarchy(content)
    for at in range(page + 32, page + size, 32):
        struct.pack_into("<4iQii", content, at, 1, 0, 0, 0, page, size, -1)
    path.write_bytes(bytes(content))
    assert len(read(path, PointQuery(spacing=0.1))) == len(NODES[0][0, 0, 0])
