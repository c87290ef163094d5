"""LAS, LAZ and COPC: every digit and every block, and damage found before a library meets it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files.points import las, open_scan
from tests import scan_files
from tests.scan_files import read_all

POINTS = np.round(np.random.default_rng(3).uniform(-5.0, 5.0, (40, 3)), 4)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_only_the_classes_asked_for_are_given_and_the_rest_is_counted(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(1)
    points, withheld = rng.uniform(0, 5, (60_000, 3)), np.arange(60_000) % 7 == 0
    classes = rng.choice([2, 6, 40], 60_000)
    path = scan_files.write_las(
        tmp_path / f"a{suffix}", points, withheld=withheld, classification=classes.astype(np.uint8)
    )
    monkeypatch.setattr(las, "BLOCK_POINTS", 50_000)
    blocks = list(open_scan(path, classes=(6, 40)).read())
    wanted = np.isin(classes, [6, 40])
    found = np.concatenate([block.points for block in blocks])
    np.testing.assert_allclose(found, points[wanted & ~withheld], atol=6e-5)
    assert sum(block.n_read for block in blocks) == 60_000
    assert sum(block.left_out["withheld"] for block in blocks) == withheld.sum()
    assert sum(block.left_out["other_class"] for block in blocks) == (~wanted & ~withheld).sum()


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
    # Of one block, and of many that are counted together.
    for block_points in (las.BLOCK_POINTS, 7):
        monkeypatch.setattr(las, "BLOCK_POINTS", block_points)
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
