"""PTX (Leica): several scans on grids, each with the pose of its scanner; 0 0 0 means no return."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import PointBlock, ScanFile, point_fields
from orthoflow.files.points.columns import Columns, point_block
from orthoflow.files.points.tables import Layout, count_lines, find_layout, read_stated, take_lines

FORMAT: Final = "PTX"
HEADER_LINES: Final = 10
_COLUMNS: Final = {
    3: "x y z",
    4: "x y z intensity",
    6: "x y z r g b",
    7: "x y z intensity r g b",
}


@dataclass(frozen=True, kw_only=True)
class ScanHeader:
    """The ten lines before each scan.

    Attributes:
        n_columns: columns of the scan grid; points come column by column.
        n_rows: rows.
        world_from_scan: (4, 4), points as columns.
        first_line: number of the first line of points.
    """

    n_columns: int
    n_rows: int
    world_from_scan: NDArray[np.float64]
    first_line: int


def open_ptx(path: Path) -> ScanFile:
    """Open a PTX file."""
    with path.open("rb") as file:
        _read_header(path, file, 1)
        (points,) = take_lines(file, 1, first_line=HEADER_LINES + 1) or (b"",)
        layout = _layout(path, points)
    columns = Columns(names=tuple(_COLUMNS[layout.n_columns].split()), rule="format")
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=count_lines(path) - HEADER_LINES,
        fields=point_fields(
            has_intensity="intensity" in columns.names,
            has_rgb="r" in columns.names,
            has_grid=True,
        ),
        read=lambda: _blocks(path, layout, columns),
        # The format's own scale; data beyond it are scaled by what is there.
        intensity_limits=(0.0, 1.0) if "intensity" in columns.names else None,
        rgb_limit=255.0 if "r" in columns.names else None,
    )


def _blocks(path: Path, layout: Layout, columns: Columns) -> Iterator[PointBlock]:
    line = 1
    scan = 0
    with path.open("rb") as file:
        while (header := _read_header(path, file, line)) is not None:
            yield from _scan_blocks(file, header, layout, columns, scan)
            line = header.first_line + header.n_columns * header.n_rows
            scan += 1


def _scan_blocks(
    file: BinaryIO, header: ScanHeader, layout: Layout, columns: Columns, scan: int
) -> Iterator[PointBlock]:
    start = 0
    for table in read_stated(
        file,
        layout,
        columns.positions,
        n_points=header.n_columns * header.n_rows,
        first_line=header.first_line,
        what=f"scan {scan}",
    ):
        yield _placed(table, columns, header, scan, start)
        start += len(table)


def _placed(
    table: NDArray[np.float64], columns: Columns, header: ScanHeader, scan: int, start: int
) -> PointBlock:
    index = np.arange(start, start + len(table), dtype=np.int64)
    is_seen = np.any(table[:, :3] != 0.0, axis=1)
    block = point_block(table[is_seen], columns)
    rotation, translation = header.world_from_scan[:3, :3], header.world_from_scan[:3, 3]
    return PointBlock(
        points=block.points @ rotation.T + translation,
        scan=scan,
        n_read=len(table),
        n_invalid=int(np.count_nonzero(~is_seen)),
        intensity=block.intensity,
        rgb=block.rgb,
        row=index[is_seen] % header.n_rows,
        column=index[is_seen] // header.n_rows,
        station=translation,
    )


def _read_header(path: Path, file: BinaryIO, line: int) -> ScanHeader | None:
    """Header of the next scan, or None at the end of the file."""
    raw = take_lines(file, HEADER_LINES, first_line=line)
    lines = [item.decode("ascii", "replace") for item in raw]
    if line > 1 and not "".join(lines).strip():
        return None
    try:
        n_columns, n_rows = (int(item) for item in lines[:2])
        numbers = [[float(item) for item in row.split()] for row in lines[2:]]
        # Row vectors in the file: point @ matrix, the translation in the last row.
        matrix = np.array(numbers[4:], dtype=np.float64).T
        is_whole = [len(row) for row in numbers] == [3] * 4 + [4] * 4
    except ValueError:
        is_whole = False
    if not is_whole or n_columns <= 0 or n_rows <= 0 or not np.isfinite(matrix).all():
        raise InputError(
            f"{path.name}, line {line}: expected the ten header lines of a PTX scan (columns, "
            "rows, scanner position, three axes, a 4 x 4 matrix); export the file again"
        )
    return ScanHeader(
        n_columns=n_columns, n_rows=n_rows, world_from_scan=matrix, first_line=line + HEADER_LINES
    )


def _layout(path: Path, line: bytes) -> Layout:
    layout = find_layout(line.decode("ascii", "replace").strip())
    if layout is None or layout.n_columns not in _COLUMNS:
        raise InputError(
            f"{path.name}, line {HEADER_LINES + 1}: expected x y z, with intensity and r g b where "
            f"the scan has them, got {line[:60].decode('ascii', 'replace').strip()!r}"
        )
    return layout
