"""PCD (Point Cloud Library): ascii, binary and binary_compressed."""

from __future__ import annotations

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
    columns_of_names,
    unpacked,
    without_returns,
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
        details={"encoding": header.data},
    )


def _blocks(path: Path, header: PcdHeader) -> Iterator[PointBlock]:
    columns = (
        _ascii_columns(path, header)
        if header.data == "ascii"
        else _binary_columns(path, header)
        if header.data == "binary"
        else _compressed_columns(path, header)
    )
    start = 0
    for values in columns:
        block = _block(values, header, start)
        start += block.n_read
        yield block


def _block(values: Mapping[str, NDArray[np.generic]], header: PcdHeader, start: int) -> PointBlock:
    columns = header.columns
    named = {name: values[columns.labels[columns.names.index(name)]] for name in columns.used}
    points = np.column_stack([named[axis].astype(np.float64) for axis in "xyz"])
    n_read = len(points)
    index = np.arange(start, start + n_read, dtype=np.int64)
    rgb: NDArray[np.generic] | None = None
    if "rgb" in named:
        rgb = unpacked(named["rgb"])
    elif "r" in named:
        rgb = np.column_stack([named[name] for name in "rgb"])
    intensity = named["intensity"].astype(np.float32) if "intensity" in named else None
    is_void = without_returns(points)
    n_void = int(np.count_nonzero(is_void))
    if n_void:
        points, index = points[~is_void], index[~is_void]
        rgb = None if rgb is None else rgb[~is_void]
        intensity = None if intensity is None else intensity[~is_void]
    is_grid = header.height > 1
    return PointBlock(
        points=points,
        n_read=n_read,
        left_out={"no_return": n_void} if n_void else {},
        intensity=intensity,
        rgb=rgb,
        row=index // header.width if is_grid else None,
        column=index % header.width if is_grid else None,
    )


def _ascii_columns(path: Path, header: PcdHeader) -> Iterator[dict[str, NDArray[np.generic]]]:
    widths = [_count(header, name) for name in header.fields]
    starts = np.concatenate([[0], np.cumsum(widths)])
    positions = {name: int(starts[index]) for index, name in enumerate(header.fields)}
    wanted = _wanted(header)
    packed = None
    if "rgb" in header.columns.used:
        packed = header.columns.labels[header.columns.names.index("rgb")]
    layout = Layout(separator=r"\s+", decimal=".", n_columns=int(starts[-1]))
    columns = [positions[name] for name in wanted]
    with path.open("rb") as file:
        line = file.read(header.n_bytes).count(b"\n") + 1
        for table in read_stated(
            file, layout, columns, n_points=header.n_points, first_line=line, what="data"
        ):
            yield {
                name: table[:, index].astype(_base(header, name))
                if name == packed
                else table[:, index]
                for index, name in enumerate(wanted)
            }


def _binary_columns(path: Path, header: PcdHeader) -> Iterator[dict[str, NDArray[np.generic]]]:
    n_present = (path.stat().st_size - header.n_bytes) // header.dtype.itemsize
    if n_present < header.n_points:
        raise short_file_error(path, "data", f"{n_present} points", str(header.n_points))
    points = np.memmap(
        path, dtype=header.dtype, mode="r", offset=header.n_bytes, shape=(header.n_points,)
    )
    for start in range(0, header.n_points, BLOCK_POINTS):
        part = points[start : start + BLOCK_POINTS]
        yield {name: np.asarray(part[name]) for name in _wanted(header)}


def _compressed_columns(path: Path, header: PcdHeader) -> Iterator[dict[str, NDArray[np.generic]]]:
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
    fields = _field_arrays(plain, header)
    for start in range(0, header.n_points, BLOCK_POINTS):
        yield {name: fields[name][start : start + BLOCK_POINTS] for name in _wanted(header)}


def _field_arrays(plain: NDArray[np.uint8], header: PcdHeader) -> dict[str, NDArray[np.generic]]:
    """Compressed files hold field after field, not point after point."""
    arrays: dict[str, NDArray[np.generic]] = {}
    offset = 0
    for name in header.fields:
        n_bytes = header.dtype[name].itemsize * header.n_points
        if _count(header, name) == 1:
            arrays[name] = plain[offset : offset + n_bytes].view(_base(header, name))
        offset += n_bytes
    return arrays


def _wanted(header: PcdHeader) -> list[str]:
    return [header.columns.labels[position] for position in header.columns.positions]


def _base(header: PcdHeader, name: str) -> np.dtype[np.generic]:
    return header.dtype[name].base


def _count(header: PcdHeader, name: str) -> int:
    shape = header.dtype[name].shape
    return shape[0] if shape else 1


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
