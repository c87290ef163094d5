"""Header and chunk table of LAS and LAZ files, checked before the libraries believe them.

A damaged count of records keeps laspy busy for hours; a damaged chunk table makes the decompressor
ask for any amount of memory, which ends the process without a word that Python could catch.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Final

from orthoflow.errors import InputError
from orthoflow.files.points.foreign import load_library

_HEADER_BYTES: Final = 375
_VLR_BYTES: Final = 54
_EVLR_BYTES: Final = 60
_OFFSET_BYTES: Final = 8
_CHUNKED: Final = (2, 3)
_MOST_FIXED_CHUNK: Final = 50_000_000


def check_header(path: Path) -> None:
    """Compare the counts and offsets of the header with the file's size.

    Raises:
        InputError: they do not fit.
    """
    n_file = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
    if len(header) < 227:
        raise _damaged(path, "it ends within its header")
    header_size, start, n_records = struct.unpack_from("<HII", header, 94)
    if not header_size <= start <= n_file:
        raise _damaged(path, "its points begin outside the file, which is cut off")
    if n_records * _VLR_BYTES > start - header_size:
        raise _damaged(path, f"its header states {n_records} records that have no room")
    if header[25] >= 4 and len(header) >= _HEADER_BYTES:
        first, n_extended = struct.unpack_from("<QI", header, 235)
        if n_extended and first + n_extended * _EVLR_BYTES > n_file:
            raise _damaged(path, "records at its end are missing, it is cut off")


def check_chunks(path: Path, header: Any) -> None:
    """Compare the chunk table with the file's size and the header's number of points.

    Args:
        path: the file.
        header: laspy's header of it.

    Raises:
        InputError: the table cannot belong to this file.
    """
    if not header.are_points_compressed:
        return
    record = header.vlrs[header.vlrs.index("LasZipVlr")].record_data
    if len(record) < 2 or struct.unpack_from("<H", record)[0] not in _CHUNKED:
        return
    lazrs = load_library("lazrs", path)
    compression = lazrs.LazVlr(record)
    if compression.item_size() != header.point_format.size:
        raise _damaged(path, "its points are not as large as its header states")
    start = int(header.offset_to_point_data)
    with path.open("rb") as file:
        n_bytes = _check_size(path, file, start, int(header.point_count))
        file.seek(start)
        table = lazrs.read_chunk_table(file, compression)
    if sum(size for _, size in table) > n_bytes:
        raise _damaged(path, "its chunks are larger than the file")
    is_variable = compression.uses_variable_size_chunks()
    if not is_variable and compression.chunk_size() > max(
        _MOST_FIXED_CHUNK, 2 * header.point_count
    ):
        raise _damaged(path, f"its chunks are said to hold {compression.chunk_size()} points each")
    n_points = sum(count for count, _ in table)
    if n_points < header.point_count or (is_variable and n_points != header.point_count):
        raise _damaged(
            path, f"its chunks hold {n_points} points, its header states {header.point_count}"
        )


def _check_size(path: Path, file: Any, start: int, n_points: int) -> int:
    """Check where the table lies and how long it is; give the bytes of the chunks before it."""
    n_file = path.stat().st_size
    file.seek(start)
    table = _read_offset(path, file)
    if table <= 0:
        # Written at the end by programs that could not go back.
        file.seek(n_file - _OFFSET_BYTES)
        table = _read_offset(path, file)
    if not start + _OFFSET_BYTES <= table <= n_file - _OFFSET_BYTES:
        raise _damaged(path, "its chunk table lies outside the file, which is cut off")
    file.seek(table)
    _, n_chunks = struct.unpack("<II", file.read(_OFFSET_BYTES))
    n_bytes = table - start - _OFFSET_BYTES
    if n_chunks > min(n_points, n_bytes):
        raise _damaged(path, f"its chunk table states {n_chunks} chunks")
    return n_bytes


def _read_offset(path: Path, file: Any) -> int:
    raw = file.read(_OFFSET_BYTES)
    if len(raw) < _OFFSET_BYTES:
        raise _damaged(path, "it ends before its points begin")
    return int(struct.unpack("<q", raw)[0])


def _damaged(path: Path, reason: str) -> InputError:
    return InputError(f"{path.name} cannot be read as LAS/LAZ: {reason}; copy or export it again")
