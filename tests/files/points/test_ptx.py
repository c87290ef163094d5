"""PTX: scans on grids, each where its scanner stood."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import open_scan
from tests import scan_files
from tests.scan_files import read_all


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
