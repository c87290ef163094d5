"""`read.checkpoints`: surveyed points from what programs and people write as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.read.checkpoints import ReadCheckpoints

from orthoflow.errors import InputError
from orthoflow.products import CheckPoints
from tests.method_runs import Reader


class PointReader(Reader):
    """Returns the check points of texts."""

    def __call__(self, *texts: str) -> CheckPoints:
        paths = tuple(self.folder / f"points{index}.csv" for index in range(len(texts)))
        for path, text in zip(paths, texts, strict=True):
            path.write_text(text)
        points: CheckPoints = self.run(paths, {}).checkpoints
        return points


@pytest.fixture
def read(tmp_path: Path) -> PointReader:
    return PointReader(ReadCheckpoints, tmp_path)


def test_all_columns_come_out(read: PointReader) -> None:
    points = read("name,class,x,y,z,wall,v_px,u_px\nP1,flat,1,2,3,1,20.25,10.5\nP 2,,4,5,6,,,\n")
    assert points.names == ("P1", "P 2")
    assert points.classes == ("flat", "")
    np.testing.assert_array_equal(points.points_world, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(points.wall, [1, -1])
    np.testing.assert_array_equal(points.pixels_wall, [[10.5, 20.25], [np.nan, np.nan]])


def test_files_are_joined_in_order(read: PointReader) -> None:
    points = read("P1,1,2,3\n", "name,x,y,z,class\nP2,4,5,7,edge\n")
    assert points.names == ("P1", "P2")
    assert points.classes == ("", "edge")
    assert read.metrics == {
        "n_points": 2,
        "n_measured": 0,
        "extent_x_m": 3,
        "extent_y_m": 3,
        "extent_z_m": 4,
    }
    with pytest.raises(InputError, match=r"P1 is in points0\.csv and again in points1\.csv"):
        read("P1,1,2,3\n", "P1,1,2,4\n")
    with pytest.raises(InputError, match="the input checkpoints has no files"):
        read()
