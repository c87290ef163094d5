"""A table of datasets read as a mapping: names, values, places, and what is wrong with a line."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.errors import WorkflowError
from orthoflow.files.yaml_positions import Position, Table
from orthoflow.workflow import dataset_files as module
from orthoflow.workflow.dataset_files import read_rows, read_text
from orthoflow.workflow.problems import ProblemLog


def rows_of(text: str) -> tuple[Table, list[str]]:
    log = ProblemLog(file="rooms.csv", lines=tuple(text.split("\n")))
    table = read_rows(text, log)
    return table, [f"{one.line}:{one.column} {one.message}" for one in log._in_file]


def plain(table: Table) -> dict[str, object]:
    """What a table says, without places."""
    return {
        entry.key: plain(entry.value)
        if isinstance(entry.value, Table)
        else getattr(entry.value, "value", entry.value)
        for entry in table
    }


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_a_line_is_a_dataset_with_its_files_and_its_settings(mark: str) -> None:
    text = "\n".join(
        [
            "# rooms",
            "name,scan,plane.tolerance_m,plane.is_exact",
            "hall,hall.e57,0.02,true",
            "",
            "attic, attic.laz ,3,",
            "cellar,,,",
        ]
    ).replace(",", mark)
    table, problems = rows_of(text)
    assert problems == []
    assert plain(table) == {
        "hall": {"scan": "hall.e57", "set": {"plane.tolerance_m": 0.02, "plane.is_exact": True}},
        "attic": {"scan": "attic.laz", "set": {"plane.tolerance_m": 3}},
        "cellar": {},
    }
    hall, attic, cellar = table
    assert [one.position.line for one in (hall, attic, cellar)] == [3, 5, 6]
    assert table.position == Position(line=1, column=1)
    assert isinstance(attic.value, Table)
    scan, settings = attic.value
    # Keys have the place of their column in the header, values their own.
    assert scan.position == Position(line=2, column=6)
    assert scan.value.position == Position(line=5, column=7)
    assert isinstance(settings.value, Table)
    (tolerance,) = settings.value
    assert tolerance.position == Position(line=2, column=11)
    assert tolerance.value.position == Position(line=5, column=19)


def test_the_separator_is_the_first_of_three_that_the_header_has() -> None:
    table, problems = rows_of('name;scan,a;"plane.x"\nhall;a,b;1\n')
    assert problems == []
    assert plain(table) == {"hall": {"scan,a": "a,b", "set": {"plane.x": 1}}}
    table, _ = rows_of("name\nhall\n")
    assert plain(table) == {"hall": {}}
    # A header of one column says nothing of it.
    table, problems = rows_of("name\nhall;attic\n")
    assert plain(table) == {"hall;attic": {}}


@pytest.mark.parametrize(
    ("written", "value"),
    [("7", 7), ("-7", -7), ("0.5", 0.5), ("hall", "hall"), ("true", True), ('"7"', 7)],
)
def test_settings_are_read_as_yaml(written: str, value: object) -> None:
    table, problems = rows_of(f"name;p.q\nhall;{written}\n")
    assert problems == []
    found = plain(table)["hall"]
    assert found == {"set": {"p.q": value}}
    assert type(found["set"]["p.q"]) is type(value)  # type: ignore[index]


def test_a_setting_that_is_no_yaml_is_told() -> None:
    table, problems = rows_of("name;p.q;p.r\nhall;[1;3\n")
    assert problems == ["2:6 the value cannot be read as YAML; quote it"]
    assert plain(table) == {"hall": {"set": {"p.r": 3}}}


@pytest.mark.parametrize(
    ("text", "problems"),
    [
        ("", ["1:1 a table of datasets begins with a line of column names, got none"]),
        ("\n# x\n", ["1:1 a table of datasets begins with a line of column names, got none"]),
        (
            "scan,b\nx,y\n",
            ["1:1 a table of datasets needs the column name; its columns are scan, b"],
        ),
        (
            ",\n",
            ["1:1 a table of datasets needs the column name; its columns are none"],
        ),
        (
            "hall: 1\n",
            [
                (
                    "1:1 a table of datasets needs the column name; its columns are hall: 1; "
                    "a mapping stands in the workflow, under datasets:"
                )
            ],
        ),
        (
            "hall:\n",
            [
                (
                    "1:1 a table of datasets needs the column name; its columns are hall:; "
                    "a mapping stands in the workflow, under datasets:"
                )
            ],
        ),
        (
            "name,scan,scan\nhall,a,\n",
            ["1:11 the column scan is there twice; remove one of them"],
        ),
        (
            "name,,scan\nhall,x,y\nattic,,z\n",
            ["2:6 x stands in column 2, which has no name in the header"],
        ),
        (
            "name\nhall,x\n",
            ["2:6 x stands in column 2, which has no name in the header"],
        ),
        ("name,scan\n,x\n,\n", ["2:1 the dataset needs a name in the column name"]),
        (
            "name,scan\nhall,x\nattic,y\nhall,z\n",
            ["4:1 the dataset hall is there already, in line 2; give it another name"],
        ),
    ],
)
def test_what_is_wrong_with_a_table_has_its_place(text: str, problems: list[str]) -> None:
    assert rows_of(text)[1] == problems


def test_a_line_that_is_no_csv_is_told_and_the_others_are_read() -> None:
    table, problems = rows_of('name,scan\nhall,"x\nattic,y\n')
    (problem,) = problems
    assert problem.startswith("2:1 the line cannot be read as CSV: ")
    assert plain(table) == {"attic": {"scan": "y"}}


@pytest.mark.parametrize(("n_more", "is_told"), [(0, False), (1, True)])
def test_a_table_has_no_more_than_anybody_needs(
    monkeypatch: pytest.MonkeyPatch, n_more: int, is_told: bool
) -> None:
    monkeypatch.setattr(module, "MOST_DATASETS", 3)
    lines = [f"r{k}" for k in range(3 + n_more)]
    table, problems = rows_of("\n".join(["name", *lines, *lines[3:]]))
    assert len(table.entries) == 3
    assert problems == (["5:1 a table has at most 3 datasets"] if is_told else [])
    monkeypatch.setattr(module, "MOST_COLUMNS", 2)
    _, problems = rows_of("name,a" + ",b" * n_more + "\n")
    assert problems == (["1:1 a table has at most 2 columns, got 3"] if is_told else [])
    monkeypatch.setattr(module, "MOST_LINE", 12)
    table, problems = rows_of(f"name,a\nhall,{'x' * (7 + n_more)}\nattic,y\n")
    assert problems == (["2:1 a line has at most 12 letters, got 13"] if is_told else [])
    # What follows is not read.
    assert len(table.entries) == (0 if is_told else 2)


def test_a_table_is_text_of_some_megabytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "rooms.csv"
    with pytest.raises(WorkflowError, match="there is no table of datasets"):
        read_text(path)
    path.write_bytes(b"\xef\xbb\xbfname\n")
    assert read_text(path) == "name\n"
    monkeypatch.setattr(module, "MOST_BYTES", 8)
    assert read_text(path) == "name\n"
    path.write_bytes(b"name\nhall")
    with pytest.raises(WorkflowError, match="has more than 8 bytes"):
        read_text(path)
    path.write_bytes(b"na\nb\n\xe4h")
    with pytest.raises(WorkflowError, match=r"rooms.csv:3: expected UTF-8 text, got the byte 0xe4"):
        read_text(path)
