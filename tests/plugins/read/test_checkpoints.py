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


@pytest.mark.parametrize(
    "text",
    [
        "P1,1,2,3\nP2,4,5,6\n",
        "\ufeffP1;1;2;3;flat\r\nP2;4;5;6;flat\r\n",
        'Name,X,Y,Z\n"P1",1,2,3\nP2,4,5,6',
    ],
    ids=["no header", "mark of the byte order and a class", "capitals and quotes"],
)
def test_usual_exports_are_read(read: Reader, text: str) -> None:
    points = read(text)
    assert points.names == ("P1", "P2")
    np.testing.assert_array_equal(points.points_world, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("unit", "factor"), [("m", 1.0), ("mm", 0.001), ("ft", 0.3048), ("us-ft", 1200 / 3937)]
)
def test_points_come_out_in_metres(read: Reader, unit: str, factor: float) -> None:
    points = read("P1,1000,2000,3000\n", unit=unit)
    np.testing.assert_allclose(
        points.points_world, [[1000 * factor, 2000 * factor, 3000 * factor]], rtol=1e-15
    )


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


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "points0.csv holds no points: expected name,x,y,z per line"),
        ("# nothing\n", "points0.csv holds no points"),
        ("name,x,y,z\n", "points0.csv:1: only the names of the columns, no points"),
        ("name,x,y,zz\nP,1,2,3", "points0.csv:1: unknown column zz (did you mean z?)"),
        ("name,x,y,colour\nP,1,2,3", "points0.csv:1: unknown column colour; known are name, x"),
        ("name,x,y\nP,1,2", "points0.csv:1: the column z is missing"),
        ("name,x,y,z,x\nP,1,2,3,4", "points0.csv:1: the column x is there 2 times"),
        ("name,x,y,z,u_px\nP,1,2,3,4", "1: wall, u_px, v_px belong together, got only u_px"),
        ("P,1,2\n", "points0.csv:1: expected the names of the columns"),
        ("name,x,y,z\nP,1,2\n", "points0.csv:2: expected 4 columns, got 3"),
        (
            "name,x,y,z\nP,1,5,2,5,3,5\n",
            "2: expected 4 columns, got 7; write decimal points, not commas",
        ),
        ("name;x;y;z\nP;1,5;2;3\n", "2: x must be a number, got 1,5; write a decimal point"),
        ("name,x,y,z\nP,1,,3\n", "points0.csv:2: y must be a number, got nothing"),
        ("name,x,y,z\nP,1,nan,3\n", "points0.csv:2: y must be a number, got nan"),
        ("name,x,y,z\nP,1,2,inf\n", "points0.csv:2: z must be a number, got inf"),
        ("name,x,y,z\nP,1_0,2,3\n", "points0.csv:2: x must be a number, got 1_0"),
        ("name,x,y,z\n,1,2,3\n", "points0.csv:2: the name is missing"),
        ("P,1,2,3\n\nP,4,5,6\n", "points0.csv:3: the name P is there already, in line 1"),
        (
            "name,x,y,z,wall,u_px,v_px\nP,1,2,3,0,5,\n",
            "2: wall, u_px, v_px belong together, got only wall, u_px",
        ),
        ("name,x,y,z,wall,u_px,v_px\nP,1,2,3,0.5,5,6\n", "2: wall must be the number of a wall"),
        ("name,x,y,z,wall,u_px,v_px\nP,1,2,3,-1,5,6\n", "from 0, got -1"),
        ("name,x,y,z,wall,u_px,v_px\nP,1,2,3,0,x,6\n", "2: u_px must be a number, got x"),
        ("P,1,2,3\n" + "x" * 10_001, "points0.csv:2: the line is longer than 10000 letters"),
        (b"P,1,2,\xff\n", "points0.csv is no UTF-8 text: expected a CSV file"),
    ],
)
def test_a_mistake_is_one_sentence_with_its_line(
    read: Reader, text: str | bytes, problem: str
) -> None:
    with pytest.raises(InputError) as caught:
        read(text)
    assert problem in str(caught.value)


def test_all_mistakes_come_at_once_and_many_are_counted(read: Reader) -> None:
    with pytest.raises(InputError) as caught:
        read("name,x,y,z\n" + "P,1,x,nan\n" * 30)
    lines = str(caught.value).splitlines()
    assert lines[:2] == [
        "points0.csv:2: y must be a number, got x",
        "points0.csv:2: z must be a number, got nan",
    ]
    assert lines[-1] == "... and 40 more problems"


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
