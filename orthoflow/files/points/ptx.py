"""PTX (Leica): several scans on grids, each with the pose of its scanner; 0 0 0 means no return.

Files are met whose scans have fewer lines than rows times columns, and blank lines between scans.
So scans are found by what only their headers have, two lines of one number each.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import BLOCK_POINTS, PointBlock, Scan, ScanFile
from orthoflow.files.points.fields import Columns, axes_of, point_block
from orthoflow.files.points.tables import Layout, find_data, read_table, take_lines

FORMAT: Final = "PTX"
HEADER_LINES: Final = 10
_COLUMNS: Final = {
    3: "x y z",
    4: "x y z intensity",
    6: "x y z r g b",
    7: "x y z intensity r g b",
}
_HEADER: Final = re.compile(rb"^[ \t]*\d{1,9}[ \t]*\r?\n[ \t]*\d{1,9}[ \t]*\r?\n", re.MULTILINE)
_HEADER_NUMBER: Final = re.compile(r"\d+")
_BLANK: Final = re.compile(rb"^[ \t]*\r?\n", re.MULTILINE)
_SAMPLE_LINES: Final = 200
_SEARCH_BYTES: Final = 1 << 24
# Two numbers and their ends of line.
_MOST_HEADER_BYTES: Final = 100
_MOST_SCANS: Final = 1 << 16


@dataclass(frozen=True, kw_only=True)
class ScanHeader:
    """The ten lines before each scan, and where its points lie.

    Attributes:
        n_columns: columns of the scan grid; points come column by column.
        n_rows: rows.
        world_from_scan: (4, 4), points as columns.
        start: of the first line of points in the file, bytes.
        end: of the last one.
        first_line: number of the first line of points.
        n_points: lines with points.
        layout: how the numbers of a line are told apart.
        columns: what they are.
    """

    n_columns: int
    n_rows: int
    world_from_scan: NDArray[np.float64]
    start: int
    end: int
    first_line: int
    n_points: int
    layout: Layout
    columns: Columns

    @property
    def is_whole(self) -> bool:
        """Whether there is a line for each place of the grid."""
        return self.n_points == self.n_columns * self.n_rows


def open_ptx(path: Path, *, intensity_field: str | None = None) -> ScanFile:
    """Open a PTX file; its fields have no names, so that there is no choice among them."""
    starts = _find_headers(path)
    if not starts or starts[0][0] > 0:
        raise _bad_header(path, 1)
    ends = [start for start, _ in starts[1:]] + [path.stat().st_size]
    with path.open("rb") as file:
        headers = [
            _read_header(path, file, start, end, line)
            for (start, line), end in zip(starts, ends, strict=True)
        ]
    notes = []
    for k, header in enumerate(headers):
        n_places = header.n_columns * header.n_rows
        if not header.is_whole:
            notes.append(
                f"{path.name}: scan {k} has {header.n_points} lines of points, its header states "
                f"{header.n_columns} x {header.n_rows} = {n_places}: they are read without their "
                "places in the scan's grid"
            )
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=sum(header.n_points for header in headers),
        scans=[_scan(header) for header in headers],
        read=lambda: _blocks(path, headers),
        notes=notes,
    )


def _scan(header: ScanHeader) -> Scan:
    fields = header.columns.fields
    return Scan(
        fields=fields | {"grid"} if header.is_whole else fields,
        fields_used=header.columns.names,
        # The format's own scale; data beyond it are scaled by what is there.
        intensity_limits=(0.0, 1.0) if "intensity" in fields else None,
        rgb_limit=255.0 if "rgb" in fields else None,
        station=header.world_from_scan[:3, 3],
    )


def _blocks(path: Path, headers: list[ScanHeader]) -> Iterator[PointBlock]:
    with path.open("rb") as file:
        for scan, header in enumerate(headers):
            file.seek(header.start)
            n_read, line = 0, header.first_line
            while n_read < header.n_points:
                n_lines = min(BLOCK_POINTS, header.n_points - n_read)
                table = read_table(
                    file,
                    header.layout,
                    header.columns.positions,
                    n_lines=n_lines,
                    first_line=line,
                )
                line += n_lines
                if file.tell() >= header.end and not len(table):
                    break
                yield _placed(table, header, scan, n_read)
                n_read += len(table)


def _placed(table: NDArray[np.float64], header: ScanHeader, scan: int, start: int) -> PointBlock:
    rotation, translation = header.world_from_scan[:3, :3], header.world_from_scan[:3, 3]
    values: dict[str, NDArray[np.generic]]
    values = dict(zip(header.columns.used, table.T, strict=True))
    if header.is_whole:
        index = np.arange(start, start + len(table), dtype=np.int64)
        values["row"], values["column"] = index % header.n_rows, index // header.n_rows
    block = point_block(axes_of(values), values, scan=scan)
    return replace(block, points=block.points @ rotation.T + translation)


def _find_headers(path: Path) -> list[tuple[int, int]]:
    """Offset in bytes and number of line, from 1, of each header."""
    found: list[tuple[int, int]] = []
    with path.open("rb") as file:
        offset = line = 0
        kept = b""
        while block := file.read(_SEARCH_BYTES):
            text = kept + block
            counted = 0
            for match in _HEADER.finditer(text):
                # A match at the first byte of what was kept may be the end of a number.
                if match.start() == 0 and offset > 0:
                    continue
                if found and found[-1][0] == offset + match.start():
                    continue
                n_lines = text.count(b"\n", counted, match.start())
                line, counted = line + n_lines, match.start()
                found.append((offset + match.start(), line + 1))
                if len(found) > _MOST_SCANS:
                    raise InputError(f"{path.name} has more than {_MOST_SCANS} scans")
            # The end, where a header may begin, is looked through again.
            cut = max(counted, len(text) - _MOST_HEADER_BYTES)
            line += text.count(b"\n", counted, cut)
            offset, kept = offset + cut, text[cut:]
            if len(block) < _SEARCH_BYTES:
                break
    return found


def _read_header(path: Path, file: BinaryIO, start: int, end: int, line: int) -> ScanHeader:
    file.seek(start)
    raw = take_lines(file, HEADER_LINES, first_line=line)
    lines = [item.decode("ascii", "replace") for item in raw]
    try:
        n_columns, n_rows = (int(item) for item in lines[:2])
        numbers = [[float(item) for item in row.split()] for row in lines[2:]]
        # Row vectors in the file: point @ matrix, the translation in the last row.
        matrix = np.array(numbers[4:], dtype=np.float64).T
        is_whole = [len(row) for row in numbers] == [3] * 4 + [4] * 4
    except ValueError:
        is_whole = False
    if not is_whole or not np.isfinite(matrix).all():
        raise _bad_header(path, line)
    begin = file.tell()
    layout, first = None, ""
    for sample in take_lines(file, _SAMPLE_LINES, first_line=line + HEADER_LINES):
        if begin >= end:
            break
        text = sample.decode("ascii", "replace").strip()
        if not first and not text:
            begin, line = begin + len(sample), line + 1
            continue
        first = first or text
        found = find_data(text)
        # Points without a return may be shorter than others.
        if found and found.n_columns in _COLUMNS:
            layout = max(layout or found, found, key=lambda item: item.n_columns)
        elif found is None and _HEADER_NUMBER.fullmatch(text):
            break
    n_points = _count_points(file, begin, end)
    if layout is None and n_points:
        raise InputError(
            f"{path.name}, line {line + HEADER_LINES}: expected x y z, with intensity and r g "
            f"b where the scan has them, got {first[:60]!r}"
        )
    layout = layout or Layout(separator=r"\s+", decimal=".", n_columns=3)
    columns = Columns(names=tuple(_COLUMNS[layout.n_columns].split()))
    return ScanHeader(
        n_columns=n_columns,
        n_rows=n_rows,
        world_from_scan=matrix,
        start=begin,
        end=end,
        first_line=line + HEADER_LINES,
        n_points=n_points,
        layout=layout,
        columns=columns,
    )


def _count_points(file: BinaryIO, start: int, end: int) -> int:
    """Count the lines that are not blank."""
    file.seek(start)
    n_points, left, tail = 0, end - start, b""
    while left > 0 and (block := file.read(min(_SEARCH_BYTES, left))):
        left -= len(block)
        text = tail + block
        cut = text.rfind(b"\n") + 1 if left > 0 else len(text)
        n_points += text.count(b"\n", 0, cut) - len(_BLANK.findall(text, 0, cut))
        if left <= 0 and not text.endswith(b"\n") and text[text.rfind(b"\n") + 1 :].strip():
            n_points += 1
        tail = text[cut:]
    return n_points


def _bad_header(path: Path, line: int) -> InputError:
    return InputError(
        f"{path.name}, line {line}: expected the ten header lines of a PTX scan (columns, "
        "rows, scanner position, three axes, a 4 x 4 matrix); export the file again"
    )
