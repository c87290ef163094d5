"""PLY: ASCII and binary of both byte orders, memory-mapped."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    MOST_FIELDS,
    MOST_POINTS,
    PointBlock,
    ScanFile,
    point_fields,
    short_file_error,
)
from orthoflow.files.points.columns import Columns, columns_of_header, point_block
from orthoflow.files.points.tables import Layout, read_stated, take_lines

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
_BYTE_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_BYTES: Final = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Element:
    """One `element` of the header.

    Attributes:
        name: e.g. `vertex`.
        count: number of entries.
        properties: names of the properties.
        types: numpy type of each, or (type of the length, type of the items) for a list.
    """

    name: str
    count: int
    properties: tuple[str, ...]
    types: tuple[str | tuple[str, str], ...]

    @property
    def has_list(self) -> bool:
        """Whether entries differ in size."""
        return any(isinstance(item, tuple) for item in self.types)


@dataclass(frozen=True, kw_only=True)
class PlyHeader:
    """The header: byte order (empty for ASCII), elements, and where the data begin."""

    byte_order: str
    elements: tuple[Element, ...]
    n_bytes: int

    @property
    def vertex_position(self) -> int | None:
        """Position of the vertex element; None without one."""
        names = [element.name for element in self.elements]
        return names.index("vertex") if "vertex" in names else None


def open_ply(path: Path) -> ScanFile:
    """Open a PLY file; only its vertices are read."""
    header = _read_header(path)
    position = header.vertex_position
    vertex = None if position is None else header.elements[position]
    columns = columns_of_header(vertex.properties) if vertex else None
    if vertex is None or columns is None or vertex.has_list:
        raise InputError(
            f"{path.name} has no element vertex with single x, y and z: expected a point cloud; "
            "export it as points"
        )
    colour_types = {
        vertex.types[columns.names.index(name)] for name in "rgb" if name in columns.names
    }
    limits = {"u1": 255.0, "u2": 65535.0}
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=vertex.count,
        fields=point_fields(
            has_intensity="intensity" in columns.names,
            has_rgb=bool(columns.index_of(["r", "g", "b"])),
        ),
        read=lambda: (
            _binary_blocks(path, header, vertex, columns)
            if header.byte_order
            else _text_blocks(path, header, vertex, columns)
        ),
        rgb_limit=limits.get(str(colour_types.pop())) if len(colour_types) == 1 else None,
        details={"encoding": "binary" if header.byte_order else "ascii"},
    )


def _binary_blocks(
    path: Path, header: PlyHeader, vertex: Element, columns: Columns
) -> Iterator[PointBlock]:
    dtype = np.dtype(
        [(f"p{index}", header.byte_order + str(kind)) for index, kind in enumerate(vertex.types)]
    )
    with path.open("rb") as file:
        file.seek(header.n_bytes)
        for element in header.elements[: header.vertex_position]:
            _skip_binary(path, file, element, header.byte_order)
        offset = file.tell()
    n_present = (path.stat().st_size - offset) // dtype.itemsize
    if n_present < vertex.count:
        found = f"{max(n_present, 0)} points"
        raise short_file_error(path, "vertex element", found, str(vertex.count))
    vertices = np.memmap(path, dtype=dtype, mode="r", offset=offset, shape=(vertex.count,))
    for start in range(0, vertex.count, BLOCK_POINTS):
        part = vertices[start : start + BLOCK_POINTS]
        table = np.column_stack(
            [part[f"p{position}"].astype(np.float64) for position in columns.positions]
        )
        yield point_block(table, columns)


def _text_blocks(
    path: Path, header: PlyHeader, vertex: Element, columns: Columns
) -> Iterator[PointBlock]:
    layout = Layout(separator=r"\s+", decimal=".", n_columns=len(vertex.properties))
    n_skipped = sum(element.count for element in header.elements[: header.vertex_position])
    with path.open("rb") as file:
        line = file.read(header.n_bytes).count(b"\n") + n_skipped + 1
        for start in range(0, n_skipped, BLOCK_POINTS):
            count = min(BLOCK_POINTS, n_skipped - start)
            if len(take_lines(file, count, first_line=line - n_skipped + start)) != count:
                raise short_file_error(path, "elements", "fewer lines", str(n_skipped))
        for table in read_stated(
            file,
            layout,
            columns.positions,
            n_points=vertex.count,
            first_line=line,
            what="vertex element",
        ):
            yield point_block(table, columns)


def _skip_binary(path: Path, file: BinaryIO, element: Element, byte_order: str) -> None:
    """Move past an element that comes before the vertices."""
    if not element.has_list:
        sizes = [np.dtype(str(kind)).itemsize for kind in element.types]
        file.seek(element.count * sum(sizes), 1)
        return
    for _ in range(element.count):
        for kind in element.types:
            if isinstance(kind, str):
                file.seek(np.dtype(kind).itemsize, 1)
                continue
            length = np.dtype(byte_order + kind[0])
            raw = file.read(length.itemsize)
            if len(raw) != length.itemsize:
                raise short_file_error(
                    path, f"element {element.name}", "fewer entries", str(element.count)
                )
            n_items = int(np.frombuffer(raw, length)[0])
            if n_items < 0:
                # Back and forth in a file of a hundred bytes, as often as the header likes.
                raise InputError(
                    f"{path.name} is damaged: element {element.name} has a list of {n_items} "
                    "entries; export it again"
                )
            file.seek(n_items * np.dtype(kind[1]).itemsize, 1)


def _read_header(path: Path) -> PlyHeader:
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES)
    end = start.find(b"end_header")
    end_of_line = start.find(b"\n", end)
    if end < 0 or end_of_line < 0:
        raise InputError(
            f"{path.name} has no PLY header that can be read (no end_header); export it again"
        )
    try:
        lines = start[:end].decode("ascii", "replace").splitlines()
        byte_order, elements = _parse_header([line.split() for line in lines[1:] if line.strip()])
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(
            f"{path.name} has no PLY header that can be read ({error}); export it again"
        ) from error
    return PlyHeader(byte_order=byte_order, elements=elements, n_bytes=end_of_line + 1)


def _parse_header(lines: list[list[str]]) -> tuple[str, tuple[Element, ...]]:
    byte_order: str | None = None
    elements: list[Element] = []
    for words in lines:
        if words[0] == "format":
            byte_order = _BYTE_ORDERS[words[1]]
        elif words[0] == "element":
            count = int(words[2])
            if not 0 <= count < MOST_POINTS:
                raise ValueError(f"element {words[1]} has {count} entries")
            elements.append(Element(name=words[1], count=count, properties=(), types=()))
        elif words[0] == "property":
            element = elements[-1]
            if len(element.properties) == MOST_FIELDS:
                raise ValueError(f"element {element.name} has more than {MOST_FIELDS} properties")
            kind: str | tuple[str, str] = (
                (_TYPES[words[2]], _TYPES[words[3]]) if words[1] == "list" else _TYPES[words[1]]
            )
            elements[-1] = Element(
                name=element.name,
                count=element.count,
                properties=(*element.properties, words[-1]),
                types=(*element.types, kind),
            )
    if byte_order is None:
        raise ValueError("it has no line that names the format")
    return byte_order, tuple(elements)
