"""Text scans: how columns are told, and mistakes with their line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files.points import open_scan
from orthoflow.files.points.fields import columns_of_user
from tests.scan_files import read_all, read_points


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("1 2 3\n4 5 6\n", [[1, 2, 3], [4, 5, 6]]),
        ("  1   2\t3 \r\n 4 5 6", [[1, 2, 3], [4, 5, 6]]),
        ("1,2,3\n4, 5, 6\n", [[1, 2, 3], [4, 5, 6]]),
        ("1;2;3;\n4;5;6;\n", [[1, 2, 3], [4, 5, 6]]),
        ("1,5;2,25;3\n4;5;6\n", [[1.5, 2.25, 3], [4, 5, 6]]),
        ("1,5 2,25 3,0\n4 5 6\n", [[1.5, 2.25, 3], [4, 5, 6]]),
        ("1\t2\t3\n4\t5\t6\n", [[1, 2, 3], [4, 5, 6]]),
        ("# made by hand\n//X Y Z\n1 2 3\n# in between\n4 5 6\n", [[1, 2, 3], [4, 5, 6]]),
        ("z,y,x\n3,2,1\n6,5,4\n", [[1, 2, 3], [4, 5, 6]]),
        ('"Easting" "Northing" "Elevation"\n1 2 3\n4 5 6\n', [[1, 2, 3], [4, 5, 6]]),
        ("2\n1 2 3\n4 5 6\n", [[1, 2, 3], [4, 5, 6]]),
        ("\ufeff1 2 3\n\n4 5 6\n\n", [[1, 2, 3], [4, 5, 6]]),
        ("1e0 -2.5E+1 .5\n4 5 6\n", [[1, -25, 0.5], [4, 5, 6]]),
    ],
    ids=[
        "spaces",
        "blanks-crlf",
        "commas",
        "semicolons",
        "decimal-commas-semicolons",
        "decimal-commas-spaces",
        "tabs",
        "comments",
        "header-order",
        "header-words",
        "count",
        "bom-blank-lines",
        "exponents",
    ],
)
def test_text_is_read_however_its_numbers_are_separated(
    tmp_path: Path, content: str, expected: list[list[float]]
) -> None:
    path = tmp_path / "a.xyz"
    path.write_text(content, encoding="utf-8")
    np.testing.assert_array_equal(read_points(path), expected)


@pytest.mark.parametrize(
    ("name", "content", "rgb", "intensity"),
    [
        ("a.txt", "//X Y Z R G B Intensity\n1 2 3 10 20 30 2232.0\n", [10, 20, 30], 2232),
        ("a.csv", "x,y,z,i,red,green,blue\n1,2,3,7,10,20,30\n", [10, 20, 30], 7),
        ("a.xyz", "1 2 3 0.25\n", None, 0.25),
        ("a.xyz", "1 2 3 10 20 30\n", [10, 20, 30], None),
        ("a.xyz", "1 2 3 10 20 30 2232\n", [10, 20, 30], 2232),
        ("a.xyz", "1 2 3 -1200 10 20 30\n", [10, 20, 30], -1200),
        ("a.pts", "1\n1 2 3 -1200 10 20 30\n", [10, 20, 30], -1200),
        ("a.pts", "1\n1 2 3 120 10 20 30\n", [10, 20, 30], 120),
    ],
)
def test_text_columns_are_told_by_header_or_by_number(
    tmp_path: Path, name: str, content: str, rgb: list[int] | None, intensity: float | None
) -> None:
    path = tmp_path / name
    path.write_text(content)
    (block,) = read_all(path)
    np.testing.assert_array_equal(block.points, [[1, 2, 3]])
    assert (None if block.rgb is None else block.rgb.tolist()[0]) == rgb
    assert (None if block.intensity is None else float(block.intensity[0])) == intensity


@pytest.mark.parametrize(
    "content", ["1 2 3 10 20 30 40\n", "1 2 3 10 20 30 22\n", "1 2 3 4 5\n", "1 2 3 4 5 6 7 8\n"]
)
def test_text_columns_that_can_mean_several_things_are_asked_for(
    tmp_path: Path, content: str
) -> None:
    path = tmp_path / "a.txt"
    path.write_text(content)
    with pytest.raises(InputError, match=r"a\.txt has \d columns and no header .* cloud\.columns"):
        open_scan(path)


def test_the_user_can_say_what_the_columns_are(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("wall 9 3 2 1 50 60 70\nwall 9 6 5 4 51 61 71\n".replace("wall", "0"))
    (block,) = read_all(path, columns_of_user("_ _ z y x b g r"))
    np.testing.assert_array_equal(block.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(block.rgb, [[70, 60, 50], [71, 61, 51]])


@pytest.mark.parametrize("text", ["x y", "x y z z", "x y z depth", ""])
def test_columns_that_make_no_sense_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="columns must name x, y and z once each"):
        columns_of_user(text)


def test_more_columns_named_than_there_are_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("1 2 3\n")
    with pytest.raises(
        InputError, match=r"a\.txt has 3 columns, but cloud\.columns names 4: x y z r"
    ):
        open_scan(path, columns_of_user("x y z r"))


@pytest.mark.parametrize("count", ["9" * 5000, "\u00b2"])
def test_what_counts_no_points_is_passed_over(tmp_path: Path, count: str) -> None:
    path = tmp_path / "a.xyz"
    path.write_text(f"{count}\n1 2 3\n4 5 6\n", encoding="utf-8")
    assert len(read_points(path)) == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 2 3\n4 5 6\n7 eight 9\n", r"a\.xyz, line 3: expected 3 numbers .* got '7 eight 9'"),
        ("1 2 3\n4 5 6 7 8\n", r"a\.xyz, line 2: expected 3 numbers"),
        ("# only\n# comments\n", r"no line with three numbers among its first 2"),
        ("5\n1 2 3\n4 5 6\n", r"a\.xyz is cut off: its list holds 2 points, its header states 5"),
    ],
    ids=["word", "too-many", "no-data", "short-list"],
)
def test_text_that_is_wrong_is_refused_with_its_line(
    tmp_path: Path, content: str, message: str
) -> None:
    path = tmp_path / "a.xyz"
    path.write_text(content)
    with pytest.raises(InputError, match=message):
        read_all(path)


def test_binary_data_named_as_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.xyz"
    path.write_bytes(b"1 2 3\n\0\1\2")
    with pytest.raises(InputError, match=r"a\.xyz is named as a text file but holds binary data"):
        open_scan(path)
    path.write_bytes("1 2 3\n".encode("utf-16"))
    with pytest.raises(InputError, match=r"a\.xyz is UTF-16 text"):
        open_scan(path)
