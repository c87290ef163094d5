"""PTX files (Leica): several scans on grids, each with the scanner's pose; 0 0 0 means no return.

Some files have scans with fewer lines than rows times columns, or blank lines between scans.
Therefore, scans are found by two consecutive lines with one number each, which occur only in
headers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.fields import Columns
from orthoflow.files.points.scan_file import (
    PointBlock,
    Scan,
    ScanFile,
    axes_of,
    point_block,
)
from orthoflow.files.points.text import (
    MOST_LINE_BYTES,
    Layout,
    find_layout,
    line_at,
    long_line,
    read_tables,
    take_lines,
    values_of,
)

HEADER_LINES: Final = 10
_COLUMNS: Final = {
    3: "x y z",
    4: "x y z intensity",
    6: "x y z r g b",
    7: "x y z intensity r g b",
}
_HEADER: Final = re.compile(rb"^[ \t]*\d{1,9}[ \t]*\r?\n[ \t]*\d{1,9}[ \t]*\r?\n", re.MULTILINE)
_BLANK: Final = re.compile(rb"^[ \t]*\r?\n", re.MULTILINE)
_SAMPLE_LINES: Final = 200
_SEARCH_BYTES: Final = 1 << 24
# Maximum length of two numbers with their line ends.
_MOST_HEADER_BYTES: Final = 100
_MOST_SCANS: Final = 1 << 16


@dataclass(frozen=True, kw_only=True)
class _Part:
    """Position, grid, pose and line format of a scan in the file.

    Attributes:
        start: offset of the first line of points in bytes.
        end: offset of the end of the last line of points in bytes.
        n_points: number of lines with points.
        n_rows: number of rows of the grid; points are stored column by column.
        n_places: number of grid positions (rows times columns).
        pose: rotation and translation from scan to world.
        layout: widths and separators of the numbers in a line.
    """

    start: int
    end: int
    n_points: int
    n_rows: int
    n_places: int
    pose: tuple[NDArray[np.float64], NDArray[np.float64]]
    layout: Layout

    @property
    def is_whole(self) -> bool:
        return self.n_points == self.n_places

    @property
    def columns(self) -> Columns:
        return Columns(names=tuple(_COLUMNS[self.layout.n_columns].split()))

    def scan(self) -> Scan:
        scan = self.columns.scan(station=self.pose[1])
        if self.is_whole:
            scan.fields |= {"grid"}
        # These are the standard ranges of the format; data outside are scaled by their own range.
        scan.intensity_limits = (0.0, 1.0) if "intensity" in scan.fields else None
        scan.rgb_limit = 255.0 if "rgb" in scan.fields else None
        return scan


def open_ptx(path: Path, *, intensity_field: str | None = None) -> ScanFile:
    """Open a PTX file; its fields have no names, so `intensity_field` is ignored."""
    del intensity_field
    places = _find_headers(path)
    if len(places) < 2 or places[0][0] > 0:
        raise _bad_header(path, 0)
    with path.open("rb") as file:
        parts = [_read_header(path, file, *first, *behind) for first, behind in pairwise(places)]
    notes = [
        f"{path.name}: scan {k} has {part.n_points} lines of points, but its header declares "
        f"{part.n_places // part.n_rows if part.n_rows else 0} x {part.n_rows} = {part.n_places}: "
        "their positions in the scan's grid are ignored"
        for k, part in enumerate(parts)
        if not part.is_whole
    ]
    return ScanFile(
        name=path.name,
        format_name="PTX",
        n_most=sum(part.n_points for part in parts),
        scans=[part.scan() for part in parts],
        read=partial(_blocks, path, parts),
        notes=notes,
    )


def _blocks(path: Path, parts: list[_Part]) -> Iterator[PointBlock]:
    with path.open("rb") as file:
        for scan, part in enumerate(parts):
            file.seek(part.start)
            n_read, places = 0, part.columns.places.values()
            for table in read_tables(file, part.layout, places, end=part.end):
                values = values_of(table, part.columns)
                if part.is_whole:
                    index = np.arange(n_read, n_read + len(table[0]), dtype=np.int64)
                    values["row"], values["column"] = index % part.n_rows, index // part.n_rows
                yield point_block(axes_of(values), values, scan=scan, pose=part.pose)
                n_read += len(table[0])


def _find_headers(path: Path) -> list[tuple[int, int]]:
    """Return the offset of each header and of the end, with the number of filled lines before."""
    found: list[tuple[int, int]] = []
    offset, n_filled, kept = 0, 0, b""
    with path.open("rb") as file:
        is_last = False
        while not is_last:
            block = file.read(_SEARCH_BYTES)
            is_last = len(block) < _SEARCH_BYTES
            text = kept + block
            # Search only whole lines. A header may begin at the end of the text, so keep the end
            # for the next block.
            cut = len(text)
            if not is_last:
                cut = text.rfind(b"\n", 0, len(text) - _MOST_HEADER_BYTES) + 1
            if not cut and len(text) > MOST_LINE_BYTES:
                raise long_line(path, offset + 1) if found else _bad_header(path, offset)
            begins = [match.start() for match in _HEADER.finditer(text) if match.start() < cut]
            counted = 0
            for place in [*begins, cut]:
                piece = text[counted:place]
                n_filled += piece.count(b"\n") - len(_BLANK.findall(piece))
                counted = place
                if place < cut or is_last:
                    n_open = bool(piece.rpartition(b"\n")[2].strip())
                    found.append((offset + place, n_filled + n_open))
            offset, kept = offset + cut, text[cut:]
            if len(found) > _MOST_SCANS:
                raise InputError(f"{path.name} has more than {_MOST_SCANS} scans")
    return found


def _read_header(
    path: Path,
    file: BinaryIO,
    start: int,
    n_before: int,
    end: int,
    n_behind: int,
) -> _Part:
    file.seek(start)
    lines = [item.decode("ascii", "replace") for item in take_lines(file, HEADER_LINES)]
    try:
        n_columns, n_rows = (int(item) for item in lines[:2])
        numbers = [[float(item) for item in row.split()] for row in lines[2:]]
        # The file stores row vectors: point @ matrix, with the translation in the last row.
        matrix = np.array(numbers[4:], dtype=np.float64).T
        is_whole = [len(row) for row in numbers] == [3] * 4 + [4] * 4
    except ValueError:
        is_whole = False
    if not is_whole or not np.isfinite(matrix).all():
        raise _bad_header(path, start)
    begin = file.tell()
    layout, first = None, ""
    for sample in take_lines(file, _SAMPLE_LINES):
        if begin >= end:
            break
        text = sample.decode("ascii", "replace").strip()
        if not first and not text:
            begin += len(sample)
            continue
        first = first or text
        found = find_layout(text)
        # Lines of points without a return may be shorter than other lines.
        if found and found.n_columns in _COLUMNS:
            layout = max(layout or found, found, key=lambda item: item.n_columns)
        elif found is None and re.fullmatch(r"\d+", text):
            break
    n_points = n_behind - n_before - HEADER_LINES
    if layout is None and n_points:
        raise InputError(
            f"{path.name}, line {line_at(path, begin)}: expected x y z, with intensity and r g "
            f"b if the scan has them, got {first[:60]!r}"
        )
    return _Part(
        start=begin,
        end=end,
        n_points=n_points,
        n_rows=n_rows,
        n_places=n_rows * n_columns,
        pose=(matrix[:3, :3], matrix[:3, 3]),
        layout=layout or Layout(n_columns=3),
    )


def _bad_header(path: Path, place: int) -> InputError:
    return InputError(
        f"{path.name}, line {line_at(path, place)}: expected the ten header lines of a PTX scan "
        "(columns, rows, scanner position, three axes, a 4 x 4 matrix); export the file again"
    )
