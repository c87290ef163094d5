"""`read.checkpoints`: surveyed points from what programs and people write as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.read.checkpoints import ReadCheckpoints

from orthoflow.errors import InputError
from orthoflow.products import CheckPoints, InputFiles
from orthoflow.sdk import StepContext


class Reader:
    """Writes texts to files, runs the method on them and keeps what it said."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ctx: StepContext

    def __call__(self, *texts: str | bytes, unit: str = "m") -> CheckPoints:
        paths = []
        for index, text in enumerate(texts):
            paths.append(self.folder / f"points{index}.csv")
            paths[-1].write_bytes(text if isinstance(text, bytes) else text.encode())
        self.ctx = StepContext(rng=np.random.default_rng(0), cores=1, scratch=self.folder)
        inputs = ReadCheckpoints.In(files=InputFiles(name="checkpoints", paths=tuple(paths)))
        params = ReadCheckpoints.Params.model_validate({"unit": unit})
        return ReadCheckpoints().run(inputs, params, self.ctx).checkpoints


@pytest.fixture
def read(tmp_path: Path) -> Reader:
    return Reader(tmp_path)


@pytest.mark.parametrize("mark", [",", ";", "\t"], ids=["comma", "semicolon", "tab"])
def test_all_columns_come_out_whatever_separates_them(read: Reader, mark: str) -> None:
    lines = [
        "# exported from the total station",
        "name,class,x,y,z,wall,v_px,u_px",
        "P1,flat,634512.3475,-2,1e-3,1,20.25,10.5",
        "",
        "P 2,,4,5,6,,,",
    ]
    points = read("\n".join(lines).replace(",", mark) + "\n")
    assert points.names == ("P1", "P 2")
    assert points.classes == ("flat", "")
    np.testing.assert_array_equal(points.points_world, [[634512.3475, -2, 0.001], [4, 5, 6]])
    np.testing.assert_array_equal(points.wall, [1, -1])
    np.testing.assert_array_equal(points.pixels_wall, [[10.5, 20.25], [np.nan, np.nan]])
    assert points.points_world.dtype == np.float64
    assert points.wall.dtype == np.int32


def test_files_are_joined_in_order(read: Reader) -> None:
    points = read("P1,1,2,3\n", "name,x,y,z,class\nP2,4,5,7,edge\n")
    assert points.names == ("P1", "P2")
    assert points.classes == ("", "edge")
    assert {metric.name: metric.value for metric in read.ctx.metrics} == {
        "n_points": 2,
        "n_measured": 0,
        "extent_x_m": 3,
        "extent_y_m": 3,
        "extent_z_m": 4,
    }


def test_one_name_in_two_files_is_refused(read: Reader) -> None:
    with pytest.raises(InputError, match=r"P1 is in points0\.csv and again in points1\.csv"):
        read("P1,1,2,3\n", "P1,1,2,4\n")


def test_no_files_are_refused(read: Reader, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the input checkpoints names no files"):
        read()
    ctx = StepContext(rng=np.random.default_rng(0), cores=1, scratch=tmp_path)
    gone = InputFiles(name="checkpoints", paths=(tmp_path / "gone.csv",))
    with pytest.raises(InputError, match=r"gone\.csv cannot be read: No such file"):
        ReadCheckpoints().run(ReadCheckpoints.In(files=gone), ReadCheckpoints.Params(), ctx)
