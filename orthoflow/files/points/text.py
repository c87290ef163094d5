"""Text scans: a point per line, with or without a header or a leading count."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    PointBlock,
    Scan,
    ScanFile,
    short_file_error,
)
from orthoflow.files.points.fields import (
    IGNORED,
    Columns,
    block_of_table,
    columns_of_names,
    columns_of_values,
    meaning_of,
)
from orthoflow.files.points.tables import (
    Layout,
    count_lines,
    find_data,
    is_comment,
    numbers_of,
    read_tables,
    split_fields,
    take_lines,
    unquoted,
)
from orthoflow.files.points.units import StatedUnit, unit_of_comments, unit_of_name

FORMAT: Final = "text"
HEADER_LINES: Final = 200
SAMPLE_LINES: Final = 1000
# Of the number of points; a number that is longer counts nothing.
_MOST_DIGITS: Final = 20
_COMMENT: Final = "#/ \t;!%"
# `Points:0`, `P_x`: what no sentence holds, but the names of columns may be.
_NO_WORD: Final = re.compile(
    r"[A-Za-z]+(?:[:_.\[(]?[0-2]|[:_.\[(][xyzXYZ])[\])]?|//?X|[PL][xyz]|[A-Za-z]+Time"
)


@dataclass(frozen=True, kw_only=True)
class TextHead:
    """What the first lines of a text scan state.

    Attributes:
        n_header_lines: lines before the first point.
        n_stated: number of points that a leading line states, or None.
        layout: how numbers are told apart.
        columns: what they are.
        unit: of the coordinates, where comments or names of columns state it.
    """

    n_header_lines: int
    n_stated: int | None
    layout: Layout
    columns: Columns
    unit: StatedUnit | None


def open_text(
    path: Path, columns: Columns | None = None, *, intensity_field: str | None = None
) -> ScanFile:
    """Open a text scan (.xyz, .txt, .csv, .asc, .pts).

    Args:
        path: the file.
        columns: what the columns are, if the user says so.
        intensity_field: name of the column that is the intensity; None for the usual one.

    Raises:
        InputError: it is not known what the columns are.
    """
    head = _read_head(path, columns, intensity_field)
    scan = Scan(
        fields=head.columns.fields,
        fields_used=head.columns.labels_of(used=True),
        fields_not_used=head.columns.labels_of(used=False),
        unit=head.unit,
    )
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=count_lines(path) - head.n_header_lines,
        scans=[scan],
        read=lambda: _blocks(path, head),
    )


def _blocks(path: Path, head: TextHead) -> Iterator[PointBlock]:
    n_read = 0
    with path.open("rb") as file:
        take_lines(file, head.n_header_lines, first_line=1)
        tables = read_tables(
            file,
            head.layout,
            head.columns.positions,
            block_lines=BLOCK_POINTS,
            first_line=head.n_header_lines + 1,
        )
        for table in tables:
            n_read += len(table)
            yield block_of_table(table, head.columns)
    if head.n_stated is not None and n_read < head.n_stated:
        raise short_file_error(path, "list", f"{n_read} points", str(head.n_stated))


def _read_head(path: Path, columns: Columns | None, intensity_field: str | None) -> TextHead:
    lines = _first_lines(path)
    n_stated: int | None = None
    comments: list[str] = []
    headers: list[str] = []
    for index, line in enumerate(lines[:HEADER_LINES]):
        layout = None if is_comment(line.encode()) else find_data(line)
        if layout is None:
            if line.isascii() and line.isdigit() and len(line) <= _MOST_DIGITS:
                n_stated = int(line)
            elif line:
                comments.append(line.lstrip(_COMMENT))
                headers.append(line)
            continue
        chosen = _chosen_columns(path, columns, headers, lines[index:], layout, intensity_field)
        unit = unit_of_comments(comments)
        if unit is None and chosen.unit is not None:
            unit = unit_of_name(chosen.unit, "names of the columns")
        return TextHead(
            n_header_lines=index, n_stated=n_stated, layout=layout, columns=chosen, unit=unit
        )
    raise InputError(
        f"{path.name} has no line with three numbers among its first "
        f"{min(len(lines), HEADER_LINES)}: expected a point per line, e.g. x y z"
    )


def _chosen_columns(
    path: Path,
    columns: Columns | None,
    headers: list[str],
    lines: list[str],
    layout: Layout,
    intensity_field: str | None,
) -> Columns:
    """Columns as the user names them, else a header, else their values (in `lines`)."""
    if columns is None:
        found = _columns_of_header(path, headers, lines[0], layout, intensity_field)
        if found is not None:
            return found
        sample = [numbers_of(item, layout) for item in lines if item]
        whole = [item for item in sample if len(item) == layout.n_columns]
        is_pts = path.suffix.lower() == ".pts"
        return columns_of_values(path.name, np.array(whole), lines[0], is_pts=is_pts)
    if len(columns.names) > layout.n_columns:
        raise InputError(
            f"{path.name} has {layout.n_columns} columns, but cloud.columns names "
            f"{len(columns.names)}: {' '.join(columns.names)}; its first line is {lines[0][:80]!r}"
        )
    labels = _labels(headers[-1]) if headers else []
    return replace(columns, labels=tuple(labels)) if len(labels) == len(columns.names) else columns


def _columns_of_header(
    path: Path, headers: list[str], line: str, layout: Layout, intensity_field: str | None
) -> Columns | None:
    """Columns as the last header line names them; None where there is no such line.

    Raises:
        InputError: there is one, and it names no x, y and z for the columns there are.
    """
    for header in reversed(headers):
        labels = _labels(header)
        found = columns_of_names(labels, intensity_field=intensity_field)
        fits = len(labels) == layout.n_columns
        if found is not None and fits:
            return found
        is_remark = header != header.lstrip(_COMMENT)
        known = [label for label in labels if meaning_of(label) != IGNORED]
        names_something = bool(known) or any(_NO_WORD.fullmatch(label) for label in labels)
        if found is not None or (fits and (not is_remark or names_something)):
            raise _unknown_columns(path, header, labels, line, layout)
    return None


def _unknown_columns(
    path: Path, header: str, labels: list[str], line: str, layout: Layout
) -> InputError:
    text = (
        f"{path.name} has the header {header[:120]!r}, which does not name x, y and z for the "
        f"{layout.n_columns} columns below it (first line {line[:80]!r})"
    )
    if any(re.match(r"lat(?!er)|lon(?!ger)", label, re.IGNORECASE) for label in labels):
        text += "; if these are degrees, project them to a plane system in metres first"
    # What is known stays, and x, y, z that are missing are as like to be the last of the others.
    names = [meaning_of(label) for label in labels] if len(labels) == layout.n_columns else []
    missing = [axis for axis in "xyz" if axis not in names]
    others = [place for place, name in enumerate(names) if name == IGNORED]
    if len(others) >= len(missing):
        for place, axis in zip(others[len(others) - len(missing) :], missing, strict=True):
            names[place] = axis
    else:
        names = [*"xyz", *[IGNORED] * layout.n_columns][: layout.n_columns]
    return InputError(
        f"{text}: name the columns with cloud.columns, e.g. --set "
        f"'cloud.columns=[{', '.join(names)}]', with {IGNORED} for one to skip"
    )


def _labels(header: str) -> list[str]:
    # A semicolon begins a comment, unless it parts columns of which the first has no name.
    stripped = header.lstrip(_COMMENT if header.count(";") == 1 else _COMMENT.replace(";", ""))
    return [unquoted(field) for field in split_fields(stripped)[0]]


def _first_lines(path: Path) -> list[str]:
    with path.open("rb") as file:
        raw = take_lines(file, HEADER_LINES + SAMPLE_LINES, first_line=1)
    if raw and raw[0].startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"{path.name} is UTF-16 text: save it as UTF-8 or plain ASCII")
    if any(b"\0" in line for line in raw):
        raise InputError(
            f"{path.name} is named as a text file but holds binary data: give it the suffix of "
            "its format, or export it as text"
        )
    if raw:
        raw[0] = raw[0].removeprefix(codecs.BOM_UTF8)
    return [line.decode("utf-8", "replace").strip() for line in raw]
