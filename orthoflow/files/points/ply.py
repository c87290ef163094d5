"""PLY: ASCII and binary of both byte orders, memory-mapped.

plyfile is not used: it holds ASCII files as a whole in memory, and reads elements with lists row by
row and property by property.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Final

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
_STRUCT_CODES: Final = {
    "i1": "b",
    "u1": "B",
    "i2": "h",
    "u2": "H",
    "i4": "i",
    "u4": "I",
    "f4": "f",
    "f8": "d",
}
_VERTEX_NAMES: Final = ("vertex", "vertices", "point", "points")
_COMMENTS: Final = (["comment"], ["obj_info"])
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

    comments: tuple[str, ...] = ()


def open_ply(path: Path, *, intensity_field: str | None = None) -> ScanFile:
    """Open a PLY file; only its vertices are read."""
    header = _read_header(path)
    names = [element.name.lower() for element in header.elements]
    position = next((names.index(name) for name in _VERTEX_NAMES if name in names), None)
    vertex = None if position is None else header.elements[position]
    columns = None
    if vertex is not None:
        labels = [
            "" if isinstance(kind, tuple) else name
            for name, kind in zip(vertex.properties, vertex.types, strict=True)
        ]
        columns = columns_of_names(labels, intensity_field=intensity_field)
    if vertex is None or position is None or columns is None:
        found = "; ".join(f"{e.name}: {' '.join(e.properties)}" for e in header.elements)
        raise InputError(
            f"{path.name} has no element vertex with single x, y and z, but {found[:300]}: "
            "expected a point cloud; export it as points"
        )
    types = {str(vertex.types[columns.names.index(name)]) for name in "rgb" if "r" in columns.used}
    before = header.elements[:position]
    columns = replace(columns, labels=vertex.properties)
    scan = Scan(
        fields=columns.fields,
        fields_used=columns.labels_of(used=True),
        fields_not_used=columns.labels_of(used=False),
        rgb_limit=255.0 if types == {"u1"} else None,
        unit=unit_of_comments(header.comments),
    )
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=vertex.count,
        scans=[scan],
        read=lambda: (
            _binary_blocks(path, header, before, vertex, columns)
            if header.byte_order
            else _text_blocks(path, header, before, vertex, columns)
        ),
        details={"encoding": "binary" if header.byte_order else "ascii"},
    )


def _binary_blocks(
    path: Path, header: PlyHeader, before: tuple[Element, ...], vertex: Element, columns: Columns
) -> Iterator[PointBlock]:
    with path.open("rb") as file:
        file.seek(header.n_bytes)
        for element in before:
            _skip_binary(path, file, element, header.byte_order)
        offset = file.tell()
    named: Iterator[dict[str, NDArray[np.generic]]]
    if vertex.has_list:
        rows = _rows_with_lists(path, header, vertex, offset)
        named = (used_fields(part, columns) for part in rows)
    else:
        dtype = _dtype(vertex.types, header.byte_order)
        named = record_blocks(
            path, dtype, columns, offset=offset, n_points=vertex.count, what="vertex element"
        )
    for values in named:
        yield point_block(axes_of(values), values)


def _dtype(kinds: Sequence[str | tuple[str, str]], byte_order: str) -> np.dtype[np.void]:
    """Type of a record; lists, which are read apart, take no room in it."""
    return np.dtype(
        [
            (f"p{k}", "V0" if isinstance(kind, tuple) else byte_order + kind)
            for k, kind in enumerate(kinds)
        ]
    )


def _rows_with_lists(
    path: Path, header: PlyHeader, vertex: Element, offset: int
) -> Iterator[NDArray[np.void]]:
    """Rows without their lists, whose lengths differ from row to row.

    Where a row's parts begin is found one by one, what they hold for a block of rows at once.
    """
    # Single values between lists are one part; each list is a length and the bytes of an item.
    parts: list[list[tuple[str, str]]] = [[]]
    lists: list[tuple[struct.Struct, int]] = []
    for k, kind in enumerate(vertex.types):
        if isinstance(kind, tuple):
            length = struct.Struct((header.byte_order or "<") + _STRUCT_CODES[kind[0]])
            lists.append((length, np.dtype(kind[1]).itemsize))
            parts.append([])
        else:
            parts[-1].append((f"p{k}", header.byte_order + kind))
    dtypes = [np.dtype(part) for part in parts]
    sizes = [dtype.itemsize for dtype in dtypes]
    whole = _dtype(vertex.types, header.byte_order)
    data = np.memmap(path, dtype=np.uint8, mode="r")
    n_bytes = len(data)
    place = offset
    for start in range(0, vertex.count, BLOCK_POINTS):
        count = min(BLOCK_POINTS, vertex.count - start)
        begins = np.empty((count, len(parts)), dtype=np.int64)
        for row in range(count):
            place = _find_parts(data, place, sizes, lists, begins[row])
            if place > n_bytes:
                found = f"{start + row} points"
                raise short_file_error(path, "vertex element", found, str(vertex.count))
        rows = np.empty(count, dtype=whole)
        for k, dtype in enumerate(dtypes):
            if dtype.names:
                raw = data[begins[:, k, np.newaxis] + np.arange(dtype.itemsize)]
                values = np.ascontiguousarray(raw).view(dtype)[:, 0]
                for name in dtype.names:
                    rows[name] = values[name]
        yield rows


def _find_parts(
    data: NDArray[np.uint8],
    place: int,
    sizes: list[int],
    lists: list[tuple[struct.Struct, int]],
    begins: NDArray[np.int64],
) -> int:
    """Find where the parts of a row begin, and return where it ends; beyond the file if cut off."""
    begins[0] = place
    place += sizes[0]
    for k, (length, item_bytes) in enumerate(lists, start=1):
        if place + length.size > len(data):
            return len(data) + 1
        (n_items,) = length.unpack(data[place : place + length.size].tobytes())
        if n_items < 0:
            return len(data) + 1
        place += length.size + int(n_items) * item_bytes
        begins[k] = place
        place += sizes[k]
    return place


def _text_blocks(
    path: Path, header: PlyHeader, before: tuple[Element, ...], vertex: Element, columns: Columns
) -> Iterator[PointBlock]:
    n_skipped = sum(element.count for element in before)
    what = "vertex element"
    with path.open("rb") as file:
        line = file.read(header.n_bytes).count(b"\n") + n_skipped + 1
        for start in range(0, n_skipped, BLOCK_POINTS):
            count = min(BLOCK_POINTS, n_skipped - start)
            if len(take_lines(file, count, first_line=line - n_skipped + start)) != count:
                raise short_file_error(path, "elements", "fewer lines", str(n_skipped))
        if vertex.has_list:
            tables = _tables_with_lists(path, file, vertex, columns, line)
        else:
            layout = Layout(separator=r"\s+", decimal=".", n_columns=len(vertex.properties))
            tables = read_stated(
                file,
                layout,
                columns.positions,
                n_points=vertex.count,
                first_line=line,
                what=what,
            )
        packed = None
        if "rgb" in columns.used:
            packed = np.dtype(str(vertex.types[columns.names.index("rgb")]))
        for table in tables:
            yield block_of_table(table, columns, packed)


def _tables_with_lists(
    path: Path, file: BinaryIO, vertex: Element, columns: Columns, first_line: int
) -> Iterator[NDArray[np.float64]]:
    """Columns of lines that hold lists, whose lengths differ from line to line."""
    for start in range(0, vertex.count, BLOCK_POINTS):
        count = min(BLOCK_POINTS, vertex.count - start)
        lines = take_lines(file, count, first_line=first_line + start)
        table = np.full((count, len(columns.positions)), np.nan)
        for row, line in enumerate(lines):
            words, places, at = line.split(), [], 0
            try:
                for kind in vertex.types:
                    places.append(at)
                    at += 1 + (int(words[at]) if isinstance(kind, tuple) else 0)
                table[row] = [float(words[places[position]]) for position in columns.positions]
            except (IndexError, ValueError) as error:
                raise InputError(
                    f"{path.name}, line {first_line + start + row}: expected "
                    f"{' '.join(vertex.properties)}, got {line[:60].decode('ascii', 'replace')!r}; "
                    "correct the line or export the file again"
                ) from error
        if len(lines) < count:
            found = f"{start + len(lines)} points"
            raise short_file_error(path, "vertex element", found, str(vertex.count))
        yield table


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
        lines = start[:end].decode("utf-8", "replace").splitlines()
        byte_order, elements = _parse_header([line.split() for line in lines[1:] if line.strip()])
        comments = [line.split(None, 1) for line in lines if line.split()[:1] in _COMMENTS]
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(
            f"{path.name} has no PLY header that can be read ({error}); export it again"
        ) from error
    return PlyHeader(
        byte_order=byte_order,
        elements=elements,
        n_bytes=end_of_line + 1,
        comments=tuple(words[1] for words in comments if len(words) > 1),
    )


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
