"""Lines of numbers: how fields are told apart, how lines are counted, and which are named."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files.points import tables
from orthoflow.files.points.tables import Layout, count_lines, find_layout, numbers_of, read_tables

SPACES = r"\s+"


@pytest.mark.parametrize(
    ("line", "fields", "separator"),
    [
        ("1;2;3", ["1", "2", "3"], ";"),
        ("1,5; 2 ;3;;", ["1,5", "2", "3"], ";"),
        ("1\t2\t3\t", ["1", "2", "3"], "\t"),
        ("1\t\t3", ["1", "", "3"], "\t"),
        ("a name\t2", ["a name", "2"], "\t"),
        ("1 2\t3", ["1", "2", "3"], SPACES),
        ("1,2,3", ["1", "2", "3"], ","),
        ("1, 2, 3", ["1", "2", "3"], ","),
        ("1,5 2,5 3,5", ["1,5", "2,5", "3,5"], SPACES),
        ("1,5 2,5", ["1", "5 2", "5"], ","),
        ("x,y z w", ["x", "y z w"], ","),
        ("  1   2  3 ", ["1", "2", "3"], SPACES),
        ("", [], SPACES),
    ],
)
def test_fields_are_told_apart(line: str, fields: list[str], separator: str) -> None:
    assert tables.split_fields(line) == (fields, separator)


@pytest.mark.parametrize(
    ("line", "layout"),
    [
        ("1 2 3 name", Layout(separator=SPACES, decimal=".", n_columns=4)),
        ("1;2,5;3", Layout(separator=";", decimal=",", n_columns=3)),
        ("1,2,3,4", Layout(separator=",", decimal=".", n_columns=4)),
        ("-1e3 +.5 NaN", Layout(separator=SPACES, decimal=".", n_columns=3)),
        ("inf -INF 5.", Layout(separator=SPACES, decimal=".", n_columns=3)),
        ("1 2", None),
        ("1 2 x", None),
        ("x 2 3", None),
        ("1 2 3e", None),
        ("1 2 .", None),
    ],
)
def test_three_numbers_make_a_layout(line: str, layout: Layout | None) -> None:
    assert find_layout(line) == layout


def test_what_is_no_number_is_none() -> None:
    layout = Layout(separator=";", decimal=",", n_columns=3)
    one, nothing, two = numbers_of("1,5;x;-2", layout)
    assert (one, two) == (1.5, -2.0)
    assert math.isnan(nothing)


@pytest.mark.parametrize(
    ("content", "n_lines"), [(b"", 0), (b"a", 1), (b"a\n", 1), (b"a\nb", 2), (b"\n\n", 2)]
)
def test_lines_are_counted_with_or_without_a_last_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes, n_lines: int
) -> None:
    (tmp_path / "a").write_bytes(content)
    for n_bytes in (1, 2, 1 << 24):
        monkeypatch.setattr(tables, "_SCAN_BYTES", n_bytes)
        assert count_lines(tmp_path / "a") == n_lines


def read(path: Path, text: str, *columns: int, block_lines: int = 2) -> list[list[list[float]]]:
    path.write_text(text)
    layout = Layout(separator=SPACES, decimal=".", n_columns=3)
    with path.open("rb") as file:
        found = read_tables(file, layout, columns, block_lines=block_lines, first_line=1)
        return [table.tolist() for table in found]


def test_a_file_is_read_in_blocks_of_lines(tmp_path: Path) -> None:
    text = "1 2 3\n4 5 6\n# 7 8 9\n\n1 x 3\n"
    assert read(tmp_path / "a", text, 2, 0) == [[[3, 1], [6, 4]], [], [[3, 1]]]
    assert read(tmp_path / "a", "", 0) == []
    (short,) = read(tmp_path / "a", "1 2 3\n4\n", 0, 2)
    np.testing.assert_array_equal(short, [[1, 3], [4, np.nan]])


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("1 2 3\n4 5 x\n", 2),
        ("1 2 3\n# 4 5 x\n4 5 x\n", 3),
        ("1 2 3 4\n", 1),
        ("1 2 3\n1 2 3\n1 2 3\n\n1 2 ,\n", 5),
    ],
)
def test_the_first_line_that_does_not_fit_is_named(tmp_path: Path, text: str, line: int) -> None:
    bad = text.splitlines()[line - 1]
    with pytest.raises(InputError) as caught:
        read(tmp_path / "a.xyz", text, 0, 1, 2)
    assert str(caught.value) == (
        f"a.xyz, line {line}: expected 3 numbers as in the lines before, got {bad!r}; correct the "
        "line or export the file again"
    )


def test_a_long_line_is_told_by_its_first_sixty_letters(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"got '1 2 3{' 4' * 27} '; correct"):
        read(tmp_path / "a.xyz", "1 2 3" + " 4" * 40, 0)


def test_where_every_line_fits_the_first_of_them_is_named(tmp_path: Path) -> None:
    # Of a block that pandas refuses for reasons of its own.
    layout = Layout(separator=SPACES, decimal=".", n_columns=3)
    error = tables._bad_line(tmp_path / "a.xyz", [b"1 2 3\n"], layout, (0, 1, 2), 17)
    assert str(error) == ("a.xyz, from line 17: expected 3 numbers per line; export the file again")


@pytest.mark.parametrize(("n_bytes", "is_read"), [(10_000, True), (10_001, False)])
def test_a_line_has_ten_thousand_bytes(tmp_path: Path, n_bytes: int, is_read: bool) -> None:
    line = "1 2 3".ljust(n_bytes - 1) + "\n"
    if is_read:
        assert read(tmp_path / "a.xyz", f"4 5 6\n{line}", 0, 1, 2) == [[[4, 5, 6], [1, 2, 3]]]
        return
    with pytest.raises(InputError, match="line 2: the line has more than 10000 bytes, so this is"):
        read(tmp_path / "a.xyz", f"4 5 6\n{line}", 0, 1, 2)
