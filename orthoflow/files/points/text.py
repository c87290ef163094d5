"""Text scans: a point per line, with or without a header or a leading count."""

from __future__ import annotations

import codecs
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    PointBlock,
    ScanFile,
    point_fields,
    short_file_error,
)
from orthoflow.files.points.columns import (
    Columns,
    columns_of_count,
    columns_of_header,
    point_block,
)
from orthoflow.files.points.tables import (
    Layout,
    count_lines,
    find_layout,
    numbers_of,
    read_tables,
    split_fields,
    take_lines,
)

FORMAT: Final = "text"
HEADER_LINES: Final = 200
# Of the number of points; a number that is longer counts nothing.
_MOST_DIGITS: Final = 20
SAMPLE_LINES: Final = 1000


@dataclass(frozen=True, kw_only=True)
class TextHead:
    """What the first lines of a text scan say.

    Attributes:
        n_header_lines: lines before the first point.
        n_stated: number of points that a leading line states, or None.
        layout: how numbers are told apart.
        columns: what they are.
    """

    n_header_lines: int
    n_stated: int | None
    layout: Layout
    columns: Columns


def open_text(path: Path, columns: Columns | None = None) -> ScanFile:
    """Open a text scan (.xyz, .txt, .csv, .asc, .pts).

    Args:
        path: the file.
        columns: what the columns are, if the user says so.
    """
    head = _read_head(path, columns)
    has = head.columns.index_of
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=count_lines(path) - head.n_header_lines,
        fields=point_fields(
            has_intensity=bool(has(["intensity"])),
            has_rgb=bool(has(["r", "g", "b"])),
            has_grid=bool(has(["row", "column"])),
        ),
        read=lambda: _blocks(path, head),
        details={"columns": " ".join(head.columns.names), "columns_from": head.columns.rule},
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
            yield point_block(table, head.columns)
    if head.n_stated is not None and n_read < head.n_stated:
        raise short_file_error(path, "list", f"{n_read} points", str(head.n_stated))


def _read_head(path: Path, columns: Columns | None) -> TextHead:
    lines = _first_lines(path)
    header: Columns | None = None
    n_stated: int | None = None
    for index, line in enumerate(lines[:HEADER_LINES]):
        layout = find_layout(line)
        if layout is not None:
            chosen = columns or _fitting(header, layout)
            if chosen is None:
                sample = [numbers_of(item, layout) for item in lines[index:] if item]
                whole = [item for item in sample if len(item) == layout.n_columns]
                is_pts = path.suffix.lower() == ".pts"
                chosen = columns_of_count(path.name, whole, is_pts=is_pts)
            _check_count(path, chosen, layout)
            return TextHead(n_header_lines=index, n_stated=n_stated, layout=layout, columns=chosen)
        bare = line.lstrip("#/ \t")
        header = columns_of_header(split_fields(bare)[0]) or header
        if line.isascii() and line.isdigit() and len(line) <= _MOST_DIGITS:
            n_stated = int(line)
    raise InputError(
        f"{path.name} has no line that begins with three numbers among its first "
        f"{min(len(lines), HEADER_LINES)}: expected a point per line, x y z first"
    )


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


def _fitting(header: Columns | None, layout: Layout) -> Columns | None:
    """The header's columns if there are as many as in the data."""
    return header if header is not None and len(header.names) == layout.n_columns else None


def _check_count(path: Path, columns: Columns, layout: Layout) -> None:
    if len(columns.names) > layout.n_columns:
        raise InputError(
            f"{path.name} has {layout.n_columns} columns, but columns names "
            f"{len(columns.names)}: {' '.join(columns.names)}"
        )
