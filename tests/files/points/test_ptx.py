"""PTX: scans on grids, each where its scanner stood."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import open_scan, ptx
from tests import scan_files
from tests.scan_files import read_all


def test_ptx_scans_are_placed_and_their_grid_is_known(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    table = np.column_stack([points, np.linspace(0, 1, 40), np.tile([10, 20, 30], (40, 1))])
    table[5, :3] = 0.0
    matrix = np.eye(4)
    matrix[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    matrix[:3, 3] = [634512.347, 486215.781, 112.193]
    path = scan_files.write_ptx(tmp_path / "a.ptx", [(table, 8, np.eye(4)), (table, 5, matrix)])
    scan = open_scan(path)
    first, second = scan.read()
    seen = np.arange(40) != 5
    np.testing.assert_allclose(first.points, points[seen], atol=1e-9)
    turned = np.column_stack([-points[:, 1], points[:, 0], points[:, 2]])[seen]
    np.testing.assert_allclose(second.points, turned + matrix[:3, 3], atol=1e-9)
    np.testing.assert_array_equal(scan.scans[1].station, matrix[:3, 3])
    np.testing.assert_array_equal(first.row, (np.arange(40) % 8)[seen])
    np.testing.assert_array_equal(first.column, (np.arange(40) // 8)[seen])
    np.testing.assert_array_equal(second.row, (np.arange(40) % 5)[seen])
    assert (first.n_read, first.left_out) == (40, {"no_return": 1})
    assert scan.fields == {"intensity", "rgb", "grid"}


def test_a_ptx_file_of_fewer_lines_than_places_is_read_without_its_grid(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_ptx(tmp_path / "a.ptx", [(points, 8, np.eye(4))])
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-3]))
    scan = open_scan(path)
    (block,) = scan.read()
    np.testing.assert_allclose(block.points, points[:-3], atol=1e-9)
    assert block.row is None
    assert scan.fields == frozenset()
    (note,) = scan.notes
    assert "scan 0 has 37 lines of points, its header states 5 x 8 = 40: they are read with" in note


def test_a_ptx_file_that_ends_in_its_header_is_refused(
    tmp_path: Path, points: NDArray[np.float64]
) -> None:
    path = scan_files.write_ptx(tmp_path / "a.ptx", [(points, 8, np.eye(4))])
    path.write_text("\n".join(path.read_text().splitlines()[:5]))
    with pytest.raises(InputError, match=r"a\.ptx, line 1: expected the ten header lines of a PTX"):
        open_scan(path)


def test_a_ptx_line_with_an_odd_number_of_columns_is_refused(tmp_path: Path) -> None:
    table = np.ones((4, 5))
    path = scan_files.write_ptx(tmp_path / "a.ptx", [(table, 2, np.eye(4))])
    with pytest.raises(InputError, match=r"a\.ptx, line 11: expected x y z, with intensity"):
        open_scan(path)


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (51, "8 5", r"a\.ptx, line 57: expected 3 numbers"),
        (61, "1 2 x", r"a\.ptx, line 61"),
        (70, "1 2 x", r"a\.ptx, line 70"),
        (101, "8 5", r"a\.ptx, line 107: expected 3 numbers"),
    ],
    ids=["second-header", "its-first-point", "its-tenth", "third-header"],
)
def test_what_is_wrong_with_a_later_scan_is_told_with_its_line(
    tmp_path: Path, points: NDArray[np.float64], line: int, text: str, message: str
) -> None:
    path = scan_files.write_ptx(tmp_path / "a.ptx", [(points, 8, np.eye(4))] * 3)
    lines = path.read_text().splitlines()
    assert len(lines) == 150
    lines[line - 1] = text
    path.write_text("\n".join([*lines, ""]))
    with pytest.raises(InputError, match=message):
        read_all(path)


def test_the_grid_of_a_ptx_goes_on_from_block_to_block(
    tmp_path: Path, points: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ptx, "BLOCK_POINTS", 15)
    path = scan_files.write_ptx(tmp_path / "a.ptx", [(points, 8, np.eye(4))] * 2)
    blocks = read_all(path)
    assert [(block.scan, block.n_read) for block in blocks] == [
        (scan, n) for scan in (0, 1) for n in (15, 15, 10)
    ]
    rows = np.concatenate([block.row for block in blocks if block.row is not None])
    columns = np.concatenate([block.column for block in blocks if block.column is not None])
    np.testing.assert_array_equal(rows, np.tile(np.arange(40) % 8, 2))
    np.testing.assert_array_equal(columns, np.tile(np.arange(40) // 8, 2))
