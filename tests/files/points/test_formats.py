"""Which reader a file gets, by its content and its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points import open_scan
from orthoflow.files.points import scan_file as blocks_module
from tests import scan_files
from tests.scan_files import read_all


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "room.e57",
            "this is text\n",
            "room.e57 is named as E57 but does not begin with 'ASTM-E57'",
        ),
        (
            "room.laz",
            "this is text\n",
            "room.laz is named as LAS/LAZ but does not begin with 'LASF'",
        ),
        ("room.ply", "this is text\n", "room.ply is named as PLY but does not begin with 'ply'"),
        ("room.pcd", "this is text\n", "room.pcd has no PCD header that can be read"),
        ("room.rcp", "this is text\n", "room.rcp is not a point file .* one of .e57 .las .laz"),
        ("room.e57", "", "room.e57 is empty"),
        ("room.xyz", "", "room.xyz is empty"),
        ("room.ptx", "this is text\n", "room.ptx, line 1: expected the ten header lines"),
        ("room.e57", "ASTM-E57 and then nothing", "room.e57 cannot be read as E57"),
        ("room.laz", "LASF and then nothing", "room.laz cannot be read as LAS/LAZ"),
    ],
)
def test_a_file_that_is_not_what_it_is_called_is_refused(
    tmp_path: Path, name: str, content: str, message: str
) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_all(path)
    assert "\n" not in str(caught.value)


def test_content_decides_where_it_is_certain(tmp_path: Path, points: NDArray[np.float64]) -> None:
    path = scan_files.write_las(tmp_path / "a.laz", points)
    renamed = path.rename(tmp_path / "scan.dat")
    assert open_scan(renamed).format_name == "LAS/LAZ"


def test_a_folder_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must be a point file, but there is a folder"):
        open_scan(tmp_path)
    with pytest.raises(InputError, match=r"none\.las must be a point file, but there is nothing"):
        open_scan(tmp_path / "none.las")


def test_points_are_counted_in_four_bytes() -> None:
    def stated(n_most: int) -> blocks_module.ScanFile:
        return blocks_module.ScanFile(
            name="a.las",
            format_name="LAS/LAZ",
            n_most=n_most,
            scans=[],
            read=lambda: iter(()),
        )

    assert stated(2**32 - 1).n_most == 4_294_967_295
    with pytest.raises(InputError, match="states 4294967296 points, at most 4294967295 can be"):
        stated(2**32)
    with pytest.raises(InputError, match=r"a\.las holds no points"):
        stated(0)
    assert stated(1).n_most == 1
