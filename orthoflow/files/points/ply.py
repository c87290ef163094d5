"""PLY: ASCII and binary of both byte orders, memory-mapped or line by line.

Rows of one size are read a block at a time. Where lists stand in the vertices, or in binary files
before them, plyfile reads the file, as a whole: rows then differ in size, and such files are small.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    MOST_FIELDS,
    MOST_POINTS,
    PointBlock,
    Scan,
    ScanFile,
    short_file_error,
)
from orthoflow.files.points.fields import (
    Columns,
    axes_of,
    block_of_table,
    columns_of_names,
    point_block,
    record_blocks,
    used_fields,
)
from orthoflow.files.points.libraries import load_library, reading
from orthoflow.files.points.tables import Layout, read_stated, take_lines
from orthoflow.files.points.units import unit_of_comments

FORMAT: Final = "PLY"
_TYPES: Final = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
# The type of a list, whose rows plyfile reads.
_LIST: Final = "O"
_VERTEX_NAMES: Final = ("vertex", "vertices", "point", "points")
_BYTE_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_BYTES: Final = 1 << 20


@dataclass(kw_only=True)
class _Element:
    """One `element` of the header: its name, count, and properties with their numpy types."""

    name: str
    count: int
    properties: list[str]
    types: list[str]

    @property
    def has_list(self) -> bool:
        """Whether entries differ in size."""
        return _LIST in self.types

    def dtype(self, byte_order: str) -> np.dtype[np.void]:
        """Type of an entry without lists; its fields are named by their places."""
        return np.dtype([(f"p{k}", byte_order + kind) for k, kind in enumerate(self.types)])


@dataclass(frozen=True, kw_only=True)
class _Header:
    """Byte order (empty for ASCII), elements, comments, and where the data begin."""

    byte_order: str
    elements: list[_Element]
    comments: list[str]
    n_bytes: int


def open_ply(path: Path, *, intensity_field: str | None = None) -> ScanFile:
    """Open a PLY file; only its vertices are read."""
    header = _read_header(path)
    names = [element.name.lower() for element in header.elements]
    position = next((names.index(name) for name in _VERTEX_NAMES if name in names), 0)
    columns = None
    if set(names) & set(_VERTEX_NAMES):
        vertex = header.elements[position]
        labels = [
            "" if kind == _LIST else name
            for name, kind in zip(vertex.properties, vertex.types, strict=True)
        ]
        columns = columns_of_names(labels, intensity_field=intensity_field)
    if columns is None:
        found = "; ".join(f"{e.name}: {' '.join(e.properties)}" for e in header.elements)
        raise InputError(
            f"{path.name} has no element vertex with single x, y and z, but {found[:300]}: "
            "expected a point cloud; export it as points"
        )
    columns = replace(columns, labels=tuple(vertex.properties))
    colours = {vertex.types[columns.names.index(name)] for name in "rgb" if "r" in columns.used}
    scan = Scan(
        fields=columns.fields,
        fields_used=columns.labels_of(used=True),
        fields_not_used=columns.labels_of(used=False),
        rgb_limit=255.0 if colours == {"u1"} else None,
        unit=unit_of_comments(header.comments),
    )
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=vertex.count,
        scans=[scan],
        read=lambda: _blocks(path, header, position, columns),
    )


def _blocks(path: Path, header: _Header, position: int, columns: Columns) -> Iterator[PointBlock]:
    before, vertex = header.elements[:position], header.elements[position]
    has_lists = any(element.has_list for element in before)
    if vertex.has_list or (header.byte_order and has_lists):
        named = _rows_by_library(path, header, position, columns)
    elif header.byte_order:
        named = record_blocks(
            path,
            vertex.dtype(header.byte_order),
            columns,
            offset=header.n_bytes + sum(e.count * e.dtype("<").itemsize for e in before),
            n_points=vertex.count,
            what="vertex element",
        )
    else:
        yield from _text_blocks(path, header, position, columns)
        return
    for values in named:
        yield point_block(axes_of(values), values)


def _rows_by_library(
    path: Path, header: _Header, position: int, columns: Columns
) -> Iterator[dict[str, NDArray[np.generic]]]:
    plyfile = load_library("plyfile", path)
    # A value takes a byte at least; plyfile makes room for what a header states.
    n_stated = sum(element.count * len(element.types) for element in header.elements)
    n_present = path.stat().st_size - header.n_bytes
    if n_stated > n_present:
        raise short_file_error(path, "data", f"{n_present} bytes", f"{n_stated} values")
    with reading(path, FORMAT):
        rows = plyfile.PlyData.read(str(path)).elements[position].data
    for start in range(0, len(rows), BLOCK_POINTS):
        yield used_fields(rows[start : start + BLOCK_POINTS], columns)


def _text_blocks(
    path: Path, header: _Header, position: int, columns: Columns
) -> Iterator[PointBlock]:
    vertex = header.elements[position]
    n_skipped = sum(element.count for element in header.elements[:position])
    layout = Layout(separator=r"\s+", decimal=".", n_columns=len(vertex.properties))
    with path.open("rb") as file:
        line = file.read(header.n_bytes).count(b"\n") + 1
        for start in range(0, n_skipped, BLOCK_POINTS):
            count = min(BLOCK_POINTS, n_skipped - start)
            if len(take_lines(file, count, first_line=line + start)) != count:
                raise short_file_error(path, "elements", "fewer lines", str(n_skipped))
        packed = None
        if "rgb" in columns.used:
            packed = np.dtype(vertex.types[columns.names.index("rgb")])
        for table in read_stated(
            file,
            layout,
            columns.positions,
            n_points=vertex.count,
            first_line=line + n_skipped,
            what="vertex element",
        ):
            yield block_of_table(table, columns, packed)


def _read_header(path: Path) -> _Header:
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES)
    end = start.find(b"end_header")
    end_of_line = start.find(b"\n", end)
    problem: object = "no end_header"
    if end >= 0 and end_of_line >= 0:
        try:
            return _parse_header(start[:end].decode("utf-8", "replace"), end_of_line + 1)
        except (ValueError, KeyError, IndexError) as error:
            problem = error
    raise InputError(f"{path.name} has no PLY header that can be read ({problem}); export it again")


def _parse_header(text: str, n_bytes: int) -> _Header:
    # plyfile's own, stricter, refuses two properties of one name and other orders of lines.
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
            count = int(words[1])
            if not 0 <= count < MOST_POINTS:
                raise ValueError(f"element {words[0]} has {count} entries")
            elements.append(_Element(name=words[0], count=count, properties=[], types=[]))
        elif key == "property":
            element = elements[-1]
            if len(element.properties) == MOST_FIELDS:
                raise ValueError(f"element {element.name} has more than {MOST_FIELDS} properties")
            element.properties.append(words[-1])
            element.types.append(_LIST if words[0] == "list" else _TYPES[words[0]])
    if byte_order is None:
        raise ValueError("it has no line that names the format")
    return _Header(byte_order=byte_order, elements=elements, comments=comments, n_bytes=n_bytes)
