"""A table of datasets, a line each, read as what a workflow file would say of them."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Generic

from orthoflow.errors import WorkflowError
from orthoflow.files.regular_files import open_file
from orthoflow.files.yaml_positions import (
    Entry,
    Position,
    Table,
    Text,
    Value,
    describe,
    plain,
    read_yaml,
)
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.shapes import TEXT, Found, Schema, Shape

MOST_BYTES: Final = 4_000_000
MOST_DATASETS: Final = 10_000
MOST_COLUMNS: Final = 200
MOST_LINE: Final = 10_000
_NAME: Final = "name"
_SET: Final = "set"
_NUMBER: Final = re.compile(r"-?(0|[1-9]\d{0,14})(\.\d{1,15})?")
# The first of them that the header has.
_SEPARATORS: Final = (";", "\t", ",")


@dataclass(frozen=True)
class TableOr(Generic[Found]):
    """A CSV file, or what it stands for."""

    other: Shape[Found]
    example: str

    @property
    def words(self) -> str:
        """The file, or the rest."""
        return f"a CSV file, or {self.other.words}"

    def schema(self) -> Schema:
        """A text, or the rest."""
        return {"oneOf": [TEXT.schema(), self.other.schema()]}

    def read(self, value: Value, path: str, log: ProblemLog) -> str | Found | None:
        """Take the name of the file, which nobody has looked for yet, or the rest."""
        if isinstance(value, Table):
            return self.other.read(value, path, log)
        if isinstance(value, Text) and isinstance(plain(value), str):
            return TEXT.read(value, path, log)
        log.add(
            value.position,
            path,
            f"expected {self.words}, as in {self.example}, got {describe(value)}",
        )
        return None


def read_text(path: Path) -> str:
    """Read a table's text.

    Raises:
        WorkflowError: there is no such file, or it cannot be a table of datasets.
    """
    try:
        with open_file(path) as stream:
            content = stream.read(MOST_BYTES + 1)
    except OSError as error:
        raise WorkflowError(
            f"there is no table of datasets {path}"
            if isinstance(error, FileNotFoundError)
            else f"the table of datasets {path} cannot be read: {error.strerror}"
        ) from error
    if len(content) > MOST_BYTES:
        raise WorkflowError(f"the table of datasets {path} has more than {MOST_BYTES} bytes")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise WorkflowError(
            f"{path}:{line}: expected UTF-8 text, got the byte 0x{content[error.start]:02x}; save "
            "the table as CSV UTF-8"
        ) from error


def read_rows(text: str, log: ProblemLog) -> Table:
    """Read a table as a mapping from names to datasets, with the places in its file.

    Columns are separated by semicolons, tabs or commas. A column with a dot in its name goes into
    the dataset's `set`, its values read as YAML; empty places are left out. Keys have the position
    of their column in the header, so that what is wrong with a column is said once.

    Args:
        text: of the file.
        log: takes the problems; its lines are those of the text.
    """
    rows = _rows(text, log)
    header = next(rows, None)
    start = Position(line=1, column=1)
    if header is None:
        log.add(start, "", "a table of datasets begins with a line of column names, got none")
        return Table(position=start, entries=())
    columns = _columns(header, log)
    if _NAME not in columns:
        return Table(position=start, entries=())
    entries: dict[str, Entry] = {}
    for row in rows:
        entry = _dataset(row, columns, log)
        if entry is None:
            continue
        if entry.key in entries:
            line = entries[entry.key].position.line
            log.add(
                entry.position,
                _NAME,
                f"the dataset {entry.key} is there already, in line {line}; give it another name",
            )
        elif len(entries) == MOST_DATASETS:
            log.add(entry.position, "", f"a table has at most {MOST_DATASETS} datasets")
            break
        else:
            entries[entry.key] = entry
    return Table(position=start, entries=tuple(entries.values()))


def _rows(text: str, log: ProblemLog) -> Iterator[tuple[Text, ...]]:
    """Give the fields of every line that holds something, each a text with its place."""
    separator = ""
    for number, line in enumerate(log.lines, start=1):
        start = Position(line=number, column=1)
        if not line.strip() or line.lstrip()[0] == "#":
            continue
        if len(line) > MOST_LINE:
            log.add(start, "", f"a line has at most {MOST_LINE} letters, got {len(line)}")
            return
        separator = separator or next((mark for mark in _SEPARATORS if mark in line), ",")
        try:
            fields = next(csv.reader([line], delimiter=separator, strict=True))
        except (csv.Error, StopIteration) as error:
            log.add(start, "", f"the line cannot be read as CSV: {error}")
            continue
        yield tuple(_placed(fields, line, number))


def _placed(fields: list[str], line: str, number: int) -> Iterator[Text]:
    at = 0
    for field in fields:
        # A field with doubled quotes is not found as it is written; its place is then about right.
        at = max(at, line.find(field, at))
        yield Text(position=Position(line=number, column=at + 1), value=field.strip())
        at += len(field)


@dataclass(frozen=True, kw_only=True)
class _Column:
    """Where a column stands, and where its name does."""

    index: int
    position: Position


def _columns(header: tuple[Text, ...], log: ProblemLog) -> dict[str, _Column]:
    """Give the columns by name; those without one are left out."""
    columns: dict[str, _Column] = {}
    if len(header) > MOST_COLUMNS:
        log.add(
            header[0].position, "", f"a table has at most {MOST_COLUMNS} columns, got {len(header)}"
        )
        return {}
    for index, field in enumerate(header):
        name = str(field.value)
        if name in columns:
            log.add(field.position, name, f"the column {name} is there twice; remove one of them")
        elif name:
            columns[name] = _Column(index=index, position=field.position)
    if _NAME not in columns:
        listed = ", ".join(columns) or "none"
        is_mapping = any(": " in name or name.endswith(":") for name in columns)
        way_out = "; a mapping stands in the workflow, under datasets:" if is_mapping else ""
        log.add(
            header[0].position,
            "",
            f"a table of datasets needs the column name; its columns are {listed}{way_out}",
        )
    return columns


def _dataset(row: tuple[Text, ...], columns: dict[str, _Column], log: ProblemLog) -> Entry | None:
    """What a line says of its dataset."""
    start = row[0].position
    places = [index for index, field in enumerate(row) if field.value]
    if not places:
        return None
    named = {column.index for column in columns.values()}
    if strangers := [index for index in places if index not in named]:
        field = row[strangers[0]]
        log.add(
            field.position,
            "",
            f"{field.value} stands in column {strangers[0] + 1}, which has no name in the header",
        )
        return None
    if columns[_NAME].index not in places:
        log.add(start, _NAME, "the dataset needs a name in the column name")
        return None
    name = row[columns[_NAME].index]
    files, sets = [], []
    for key, column in columns.items():
        if key == _NAME or column.index not in places:
            continue
        field = row[column.index]
        if "." not in key:
            files.append(Entry(position=column.position, key=key, value=field))
        elif (value := _as_yaml(field, key, log)) is not None:
            sets.append(Entry(position=column.position, key=key, value=value))
    if sets:
        table = Table(position=start, entries=tuple(sets))
        files.append(Entry(position=start, key=_SET, value=table))
    inner = Table(position=start, entries=tuple(files))
    return Entry(position=name.position, key=str(name.value), value=inner)


def _as_yaml(field: Text, key: str, log: ProblemLog) -> Value | None:
    """Read what stands in a column of parameters, as behind `--set`."""
    text = str(field.value)
    if _NUMBER.fullmatch(text):
        # A thousand rooms have a thousand numbers, and to read each as YAML takes milliseconds.
        return replace(field, value=float(text) if "." in text else int(text))
    own = ProblemLog(file="")
    value = read_yaml(text, own)
    if value is None or own.has_any:
        log.add(field.position, key, "the value cannot be read as YAML; quote it")
        return None
    return replace(value, position=field.position)
