"""PCD (Point Cloud Library): ascii, binary and binary_compressed."""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    MOST_FIELDS,
    PointBlock,
    Scan,
    ScanFile,
    short_file_error,
)
from orthoflow.files.points.fields import (
    Columns,
    axes_of,
    columns_of_names,
    point_block,
    record_blocks,
)
from orthoflow.files.points.tables import Layout, read_stated
from orthoflow.files.points.units import StatedUnit, unit_of_comments

FORMAT: Final = "PCD"
_HEADER_BYTES: Final = 1 << 16
_KINDS: Final = {"I": "i", "U": "u", "F": "f"}
_KEYS: Final = ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA")


@dataclass(frozen=True, kw_only=True)
class PcdHeader:
    """What the header states.

    Attributes:
        fields: names of the fields.
        dtype: one point as it lies in a binary file.
        n_points: number of points.
        width: points per row of an organised cloud, else all.
        height: rows, 1 for a cloud without grid.
        data: `ascii`, `binary` or `binary_compressed`.
        viewpoint: (3,) where the sensor stood, or None when the header states nothing.
        n_bytes: length of the header.
        columns: what the fields are.
        unit: of the coordinates, where a comment states it.
    """

    fields: tuple[str, ...]
    dtype: np.dtype[np.void]
    n_points: int
    width: int
    height: int
    data: str
    viewpoint: NDArray[np.float64] | None
    n_bytes: int

    columns: Columns
    unit: StatedUnit | None


def open_pcd(path: Path, *, intensity_field: str | None = None) -> ScanFile:
    """Open a PCD file."""
    header = _read_header(path, intensity_field)
    fields = header.columns.fields - {"grid"}
    scan = Scan(
        fields=fields | {"grid"} if header.height > 1 else fields,
        fields_used=header.columns.labels_of(used=True),
        fields_not_used=tuple(
            name for name in header.columns.labels_of(used=False) if not name.startswith("_")
        ),
        rgb_limit=255.0 if "rgb" in header.columns.used else None,
        unit=header.unit,
        station=header.viewpoint,
    )
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=header.n_points,
        scans=[scan],
        read=lambda: _blocks(path, header),
    )


def _blocks(path: Path, header: PcdHeader) -> Iterator[PointBlock]:
    if header.data == "ascii":
        named = _text_fields(path, header)
    elif header.data == "binary":
        named = record_blocks(
            path,
            header.dtype,
            header.columns,
            offset=header.n_bytes,
            n_points=header.n_points,
            what="data",
        )
    else:
        named = _unpacked_fields(path, header)
    start = 0
    for values in named:
        if header.height > 1:
            index = np.arange(start, start + len(values["x"]), dtype=np.int64)
            values["row"], values["column"] = index // header.width, index % header.width
        start += len(values["x"])
        yield point_block(axes_of(values), values)


def _text_fields(path: Path, header: PcdHeader) -> Iterator[dict[str, NDArray[np.generic]]]:
    columns = header.columns
    widths = [math.prod(header.dtype[name].shape) for name in header.fields]
    starts = [0, *itertools.accumulate(widths)]
    layout = Layout(separator=r"\s+", decimal=".", n_columns=starts[-1])
    places = [starts[position] for position in columns.positions]
    with path.open("rb") as file:
        line = file.read(header.n_bytes).count(b"\n") + 1
        for table in read_stated(
            file, layout, places, n_points=header.n_points, first_line=line, what="data"
        ):
            values: dict[str, NDArray[np.generic]] = dict(zip(columns.used, table.T, strict=True))
            if "rgb" in values:
                kind = header.dtype[columns.names.index("rgb")].base
                values["rgb"] = values["rgb"].astype(kind)
            yield values


def _unpacked_fields(path: Path, header: PcdHeader) -> Iterator[dict[str, NDArray[np.generic]]]:
    """Fields of a compressed file, which holds field after field, not point after point."""
    from orthoflow.files.points.lzf_kernels import decompress_lzf

    n_plain = header.n_points * header.dtype.itemsize
    with path.open("rb") as file:
        file.seek(header.n_bytes)
        sizes = file.read(8)
        n_packed, n_stated = struct.unpack("<II", sizes) if len(sizes) == 8 else (8, 0)
        packed = np.frombuffer(file.read(n_packed), np.uint8)
    if len(packed) != n_packed:
        raise short_file_error(path, "compressed data", f"{len(packed)} bytes", str(n_packed))
    # LZF turns three bytes into 264 at best: more cannot be meant, and is not allocated.
    is_possible = n_stated == n_plain and n_plain <= 264 * n_packed
    plain = np.zeros(n_plain if is_possible else 0, dtype=np.uint8)
    if not is_possible or decompress_lzf(packed, plain) != n_plain:
        raise InputError(
            f"{path.name} cannot be unpacked: {header.n_points} points need {n_plain} bytes; the "
            "file is damaged, export it again"
        )
    kinds = [header.dtype[name] for name in header.fields]
    ends = np.cumsum([kind.itemsize for kind in kinds]) * header.n_points
    parts = np.split(plain, ends[:-1])
    for start in range(0, header.n_points, BLOCK_POINTS):
        block = slice(start, start + BLOCK_POINTS)
        yield {
            name: parts[place].view(kinds[place].base)[block]
            for name, place in zip(header.columns.used, header.columns.positions, strict=True)
        }


def _read_header(path: Path, intensity_field: str | None) -> PcdHeader:
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES)
    entries: dict[str, list[str]] = {}
    comments: list[str] = []
    n_bytes = 0
    for line in start.splitlines(keepends=True):
        n_bytes += len(line)
        words = line.decode("utf-8", "replace").split()
        if words and words[0].startswith("#"):
            comments.append(" ".join(words).lstrip("# "))
        elif words:
            # PCD 0.5 and before call the fields COLUMNS.
            entries[words[0].upper().replace("COLUMNS", "FIELDS")] = words[1:]
        if "DATA" in entries:
            break
    try:
        return _parse_header(entries, n_bytes, comments, intensity_field)
    except (ValueError, KeyError, IndexError, TypeError) as error:
        missing = [key for key in _KEYS if key not in entries]
        reason = f"without {', '.join(missing)}" if missing else str(error)
        raise InputError(
            f"{path.name} has no PCD header that can be read ({reason}); export it again"
        ) from error


def _parse_header(
    entries: Mapping[str, list[str]],
    n_bytes: int,
    comments: list[str],
    intensity_field: str | None,
) -> PcdHeader:
    fields = entries["FIELDS"]
    counts = [int(item) for item in entries.get("COUNT", ["1"] * len(fields))]
    if sum(max(count, 1) for count in counts) > MOST_FIELDS:
        raise ValueError(f"a point has more than {MOST_FIELDS} fields")
    kinds = [
        "<" + _KINDS[kind.upper()] + str(int(size))
        for kind, size in zip(entries["TYPE"], entries["SIZE"], strict=True)
    ]
    # Padding fields are all called `_`; numpy wants names to differ.
    names = [
        name if name not in ("_", *fields[:index]) else f"_{index}"
        for index, name in enumerate(fields)
    ]
    members = [
        (name, kind, (count,)) if count != 1 else (name, kind)
        for name, kind, count in zip(names, kinds, counts, strict=True)
    ]
    # Fields of several values, as descriptors are, mean nothing here.
    single = [name if count == 1 else "" for name, count in zip(names, counts, strict=True)]
    columns = columns_of_names(single, intensity_field=intensity_field)
    if columns is None:
        raise ValueError(f"its fields are {' '.join(fields)[:300]}, expected x, y and z")
    columns = replace(columns, labels=tuple(names))
    data = entries["DATA"][0].lower()
    if data not in {"ascii", "binary", "binary_compressed"}:
        raise ValueError(f"data are {data}, expected ascii, binary or binary_compressed")
    width, height = int(entries["WIDTH"][0]), int(entries["HEIGHT"][0])
    n_points = int(entries["POINTS"][0]) if "POINTS" in entries else width * height
    if height > 1 and width * height != n_points:
        raise ValueError(f"it has {height} rows of {width} points, but {n_points} points")
    pose = [float(item) for item in entries.get("VIEWPOINT", ["0"] * 7)]
    if len(pose) < 3:
        raise ValueError(f"VIEWPOINT has {len(pose)} numbers, expected 7")
    return PcdHeader(
        fields=tuple(names),
        dtype=np.dtype(members),
        n_points=n_points,
        width=width,
        height=height,
        data=data,
        # The default, 0 0 0 and no rotation, says nothing.
        viewpoint=np.array(pose[:3]) if any(pose[:3]) else None,
        n_bytes=n_bytes,
        columns=columns,
        unit=unit_of_comments(comments),
    )
