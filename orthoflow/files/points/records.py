"""PLY and PCD files: a header that names the fields, then binary records or lines of text.

Records of constant size are read a block at a time. If the vertices of a PLY file contain lists, or
a binary file has lists before its vertices, plyfile reads the whole file at once: such records vary
in size, but the files are small. Compressed PCD files are stored field by field, not point by
point.
"""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.fields import Columns, columns_of_names
from orthoflow.files.points.scan_file import (
    BLOCK_POINTS,
    MOST_POINTS,
    PointBlock,
    ScanFile,
    Values,
    axes_of,
    cut_off,
    load_library,
    point_block,
    reading,
)
from orthoflow.files.points.text import Layout, read_tables, take_lines, values_of
from orthoflow.files.points.units import unit_of_comments

_HEADER_BYTES: Final = 1 << 20
# The limit includes unknown fields.
#: fields of a point in PLY and PCD files
MOST_FIELDS: Final = 1000
_PLY_TYPES: Final = {
    name: kind
    for names, kind in (
        (("char", "int8"), "i1"),
        (("uchar", "uint8"), "u1"),
        (("short", "int16"), "i2"),
        (("ushort", "uint16"), "u2"),
        (("int", "int32"), "i4"),
        (("uint", "uint32"), "u4"),
        (("float", "float32"), "f4"),
        (("double", "float64"), "f8"),
    )
    for name in names
}
# Placeholder type for lists; plyfile reads the elements that contain lists.
_LIST: Final = "O"
_VERTEX_NAMES: Final = ("vertex", "vertices", "point", "points")
_BYTE_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_PCD_KINDS: Final = {"I": "i", "U": "u", "F": "f"}
_PCD_KEYS: Final = ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA")

# Name, number of entries, property names and property types of a PLY element.
_Element = tuple[str, int, list[str], list[str]]


def open_ply(path: Path, *, intensity_field: str | None = None) -> ScanFile:
    """Open a PLY file; only its vertices are read."""
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES)
    end = start.find(b"end_header")
    offset = start.find(b"\n", end) + 1
    try:
        order, elements, comments = _ply_header(
            start[:end].decode("utf-8", "replace") if end >= 0 and offset else ""
        )
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(
            f"{path.name} has no readable PLY header ({error}); export it again"
        ) from error
    known = [name.lower() for name, *_ in elements]
    position = next((known.index(name) for name in _VERTEX_NAMES if name in known), -1)
    columns = None
    if position >= 0:
        _, n_points, names, kinds = elements[position]
        single = ["" if kind == _LIST else name for name, kind in zip(names, kinds, strict=True)]
        columns = columns_of_names(single, intensity_field=intensity_field)
    if columns is None:
        listed = "; ".join(f"{name}: {' '.join(labels)}" for name, _, labels, _ in elements)
        raise InputError(
            f"{path.name} has no element vertex with the scalar properties x, y and z, but "
            f"{listed[:300]}: expected a point cloud; export it as points"
        )
    columns = replace(columns, labels=tuple(names))
    before, what = elements[:position], "vertex element"
    if _LIST in kinds or (order and any(_LIST in types for *_, types in before)):
        # Each value needs at least one byte, and plyfile allocates the declared number of values.
        n_stated = sum(count * len(types) for _, count, _, types in elements)
        n_present = path.stat().st_size - offset
        if n_stated > n_present:
            raise cut_off(path, "data", f"{n_present} bytes", f"{n_stated} values")
        read = partial(_by_plyfile, path, position, columns)
    else:
        row = np.dtype([(f"p{k}", order + kind) for k, kind in enumerate(kinds)])
        if order:
            offset += sum(n * sum(np.dtype(k).itemsize for k in types) for _, n, _, types in before)
            read = partial(_binary, path, row, columns, offset, n_points, what)
        else:
            n_skipped = sum(count for _, count, *_ in before)
            read = partial(_text, path, row, columns, offset, n_points, what, n_skipped)
    colours = {kinds[columns.places[name]] for name in "rgb" if name in columns.places}
    return ScanFile(
        name=path.name,
        format_name="PLY",
        n_most=n_points,
        scans=[
            columns.scan(
                rgb_limit=255.0 if colours == {"u1"} else None, unit=unit_of_comments(comments)
            )
        ],
        read=partial(_blocks, read),
    )


def _ply_header(text: str) -> tuple[str, list[_Element], list[str]]:
    """Return the byte order (empty for ASCII), the elements and the comments of a PLY header.

    plyfile's own parser is stricter: it refuses repeated property names and some line orders.
    """
    if not text:
        raise ValueError("no end_header")
    byte_order: str | None = None
    elements: list[_Element] = []
    comments: list[str] = []
    for line in text.splitlines()[1:]:
        key, *words = line.split() or [""]
        if key in ("comment", "obj_info"):
            comments.append(line.partition(key)[2].strip())
        elif key == "format":
            byte_order = _BYTE_ORDERS[words[0]]
        elif key == "element":
            if not 0 <= int(words[1]) < MOST_POINTS:
                raise ValueError(f"element {words[0]} has {words[1]} entries")
            elements.append((words[0], int(words[1]), [], []))
        elif key == "property":
            name, _, names, kinds = elements[-1]
            if len(names) == MOST_FIELDS:
                raise ValueError(f"element {name} has more than {MOST_FIELDS} properties")
            names.append(words[-1])
            kinds.append(_LIST if words[0] == "list" else _PLY_TYPES[words[0]])
    if byte_order is None:
        raise ValueError("it has no format line")
    return byte_order, elements, comments


def open_pcd(path: Path, *, intensity_field: str | None = None) -> ScanFile:
    """Open a PCD file: ascii, binary or binary_compressed."""
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES)
    entries: dict[str, list[str]] = {}
    comments: list[str] = []
    offset = 0
    while "DATA" not in entries and offset < len(start):
        end = start.find(b"\n", offset) + 1 or len(start)
        words = start[offset:end].decode("utf-8", "replace").split()
        offset = end
        if words and words[0].startswith("#"):
            comments.append(" ".join(words).lstrip("# "))
        elif words:
            # PCD 0.5 and older use COLUMNS instead of FIELDS.
            entries[words[0].upper().replace("COLUMNS", "FIELDS")] = words[1:]
    try:
        return _open_pcd(path, entries, comments, offset, intensity_field)
    except (ValueError, KeyError, IndexError, TypeError) as error:
        missing = [key for key in _PCD_KEYS if key not in entries]
        reason = f"it lacks {', '.join(missing)}" if missing else str(error)
        raise InputError(
            f"{path.name} has no readable PCD header ({reason}); export it again"
        ) from error


def _open_pcd(
    path: Path,
    entries: dict[str, list[str]],
    comments: list[str],
    offset: int,
    intensity_field: str | None,
) -> ScanFile:
    labels = entries["FIELDS"]
    counts = [int(item) for item in entries.get("COUNT", ["1"] * len(labels))]
    if sum(max(count, 1) for count in counts) > MOST_FIELDS:
        raise ValueError(f"a point has more than {MOST_FIELDS} fields")
    kinds = [
        "<" + _PCD_KINDS[kind.upper()] + str(int(size))
        for kind, size in zip(entries["TYPE"], entries["SIZE"], strict=True)
    ]
    row = np.dtype(
        [
            (f"p{k}", kind, (count,) if count != 1 else ())
            for k, (kind, count) in enumerate(zip(kinds, counts, strict=True))
        ]
    )
    # Ignore fields with several values, such as descriptors.
    single = [label if count == 1 else "" for label, count in zip(labels, counts, strict=True)]
    columns = columns_of_names(single, intensity_field=intensity_field)
    if columns is None:
        raise ValueError(f"its fields are {' '.join(labels)[:300]}; expected x, y and z")
    columns = replace(columns, labels=tuple(labels))
    data = entries["DATA"][0].lower()
    if data not in {"ascii", "binary", "binary_compressed"}:
        raise ValueError(f"data are {data}; expected ascii, binary or binary_compressed")
    if "POINTS" in entries:
        entries = {"WIDTH": entries["POINTS"], "HEIGHT": ["1"]} | entries
    width, height = int(entries["WIDTH"][0]), int(entries["HEIGHT"][0])
    n_points = int(entries.get("POINTS", [str(width * height)])[0])
    if height > 1 and width * height != n_points:
        raise ValueError(f"it declares {height} rows of {width} points, but {n_points} points")
    pose = [float(item) for item in entries.get("VIEWPOINT", ["0"] * 7)]
    if len(pose) < 3:
        raise ValueError(f"VIEWPOINT has {len(pose)} numbers; expected 7")
    if data == "binary_compressed":
        read = partial(_compressed, path, row, columns, offset, n_points)
    else:
        reader = _text if data == "ascii" else _binary
        read = partial(reader, path, row, columns, offset, n_points, "data")
    scan = columns.scan(
        rgb_limit=255.0 if "rgb" in columns.places else None,
        unit=unit_of_comments(comments),
        # The default viewpoint, 0 0 0 without rotation, means that the position is unknown.
        station=np.array(pose[:3]) if any(pose[:3]) else None,
    )
    scan.fields = scan.fields - {"grid"} | ({"grid"} if height > 1 else frozenset())
    return ScanFile(
        name=path.name,
        format_name="PCD",
        n_most=n_points,
        scans=[scan],
        read=partial(_blocks, read, width if height > 1 else 0),
    )


# Any: `read` is a partial function that yields values by meaning.
def _blocks(read: Any, width: int = 0) -> Iterator[PointBlock]:
    """Yield blocks of points; `width` is the grid width of an organised cloud, else 0."""
    start = 0
    for values in read():
        if width:
            index = np.arange(start, start + len(values["x"]), dtype=np.int64)
            values["row"], values["column"] = index // width, index % width
        start += len(values["x"])
        yield point_block(axes_of(values), values)


def _used(rows: NDArray[Any], columns: Columns) -> Iterator[Values]:
    names = rows.dtype.names or ()
    for start in range(0, len(rows), BLOCK_POINTS):
        part = rows[start : start + BLOCK_POINTS]
        yield {name: part[names[place]] for name, place in columns.places.items()}


def _by_plyfile(path: Path, position: int, columns: Columns) -> Iterator[Values]:
    plyfile = load_library("plyfile", path)
    with reading(path, "PLY"), warnings.catch_warnings():
        # numpy warns about each empty list in an ASCII file.
        warnings.simplefilter("ignore", UserWarning)
        rows = plyfile.PlyData.read(str(path)).elements[position].data
    yield from _used(rows, columns)


def _binary(
    path: Path, row: np.dtype[Any], columns: Columns, offset: int, n_points: int, what: str
) -> Iterator[Values]:
    n_present = (path.stat().st_size - offset) // row.itemsize
    if n_present < n_points:
        raise cut_off(path, what, f"{max(n_present, 0)} points", str(n_points))
    yield from _used(
        np.memmap(path, dtype=row, mode="r", offset=offset, shape=(n_points,)), columns
    )


def _text(
    path: Path,
    row: np.dtype[Any],
    columns: Columns,
    offset: int,
    n_points: int,
    what: str,
    n_skipped: int = 0,
) -> Iterator[Values]:
    widths = [math.prod(row[k].shape) for k in range(len(columns.names))]
    starts = [0, *accumulate(widths)]
    places = [starts[place] for place in columns.places.values()]
    packed = row[columns.places["rgb"]].base if "rgb" in columns.places else None
    layout = Layout(n_columns=starts[-1])
    with path.open("rb") as file:
        file.seek(offset)
        for start in range(0, n_skipped, BLOCK_POINTS):
            count = min(BLOCK_POINTS, n_skipped - start)
            if len(take_lines(file, count)) != count:
                raise cut_off(path, "elements", "fewer lines", str(n_skipped))
        n_read = 0
        for table in read_tables(file, layout, places, n_rows=n_points):
            n_read += len(table[0])
            yield values_of(table, columns, packed)
    if n_read < n_points:
        raise cut_off(path, what, f"{n_read} points", str(n_points))


def _compressed(
    path: Path, row: np.dtype[Any], columns: Columns, offset: int, n_points: int
) -> Iterator[Values]:
    from orthoflow.files.points.lzf_kernels import decompress_lzf

    n_plain = n_points * row.itemsize
    with path.open("rb") as file:
        file.seek(offset)
        sizes = file.read(8)
        n_packed, n_stated = struct.unpack("<II", sizes) if len(sizes) == 8 else (8, 0)
        packed = np.frombuffer(file.read(n_packed), np.uint8)
    if len(packed) != n_packed:
        raise cut_off(path, "compressed data", f"{len(packed)} bytes", str(n_packed))
    # LZF expands 3 bytes to at most 264, so memory is not allocated for a larger declared size.
    is_possible = n_stated == n_plain and n_plain <= 264 * n_packed
    plain = np.zeros(n_plain if is_possible else 0, dtype=np.uint8)
    if not is_possible or decompress_lzf(packed, plain) != n_plain:
        raise InputError(
            f"{path.name} cannot be decompressed: {n_points} points need {n_plain} "
            "bytes; the file is damaged: export it again"
        )
    kinds = [row[k] for k in range(len(columns.names))]
    parts = np.split(plain, np.cumsum([kind.itemsize for kind in kinds])[:-1] * n_points)
    for start in range(0, n_points, BLOCK_POINTS):
        block = slice(start, start + BLOCK_POINTS)
        yield {name: parts[k].view(kinds[k].base)[block] for name, k in columns.places.items()}
