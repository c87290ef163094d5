"""LAS, LAZ and COPC through laspy, block by block.

Header and chunk table are checked before the libraries use them: a damaged number of records keeps
laspy busy for hours, and a damaged chunk table makes the decompressor allocate any amount of
memory, which ends the process without an exception.

lazrs decodes the chunks of a block in its own threads.

For point formats 6 and up, whose fields are compressed separately, only the fields of a cloud are
decoded. Of a COPC file only those nodes of the octree are decoded that hold requested points.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    PointBlock,
    Scan,
    ScanFile,
    short_file_error,
)
from orthoflow.files.points.copc import Node, Wish, read_octree
from orthoflow.files.points.fields import columns_of_names, point_block
from orthoflow.files.points.libraries import guarded, load_library, reading
from orthoflow.files.points.units import StatedUnit, unit_of_crs, unit_of_geo_keys

FORMAT: Final = "LAS/LAZ"
_COLOURS: Final = ("red", "green", "blue")
_FARTHEST: Final = 1e12
_PART_POINTS: Final = 1 << 15
_HEADER_BYTES: Final = 375
_VLR_BYTES: Final = 54
_EVLR_BYTES: Final = 60
_OFFSET_BYTES: Final = 8
_CHUNKED: Final = (2, 3)
# From the compression's record: the compressor, the position of its list of items, and the number
# of layers of each type (point, colours, colours with infrared, wave packets).
_LAYERED: Final = 3
_ITEMS_AT: Final = 32
_LAYERS: Final = {10: 9, 11: 1, 12: 2, 13: 1}
_EXTRA_BYTES: Final = 14
#: points of a LAZ chunk, or twice those of the file
MOST_FIXED_CHUNK: Final = 50_000_000
_WKT_RECORD: Final = 2112
_GEO_KEYS: Final = 34735
_LONGEST_WKT: Final = 100_000
_MOST_EVLRS: Final = 1000
_SAMPLE_POINTS: Final = 50_000


def open_las(
    path: Path,
    *,
    classes: Collection[int] = (),
    wish: Wish | None = None,
    intensity_field: str | None = None,
) -> ScanFile:
    """Open a LAS, LAZ or COPC file.

    Args:
        path: the file.
        classes: only points of these classes are read; all if empty.
        wish: of a COPC file only nodes with such points are read.
        intensity_field: name of the field to use as the intensity; None for the usual one.
    """
    laspy = load_library("laspy", path)
    _check_header(path)
    notes: list[str] = []
    # Records after the points may state any size: only that of the coordinate system is read.
    with reading(path, FORMAT), laspy.open(path, read_evlrs=False) as reader:
        header = reader.header
        n_points = _n_points(path, header, notes)
        chunks = _checked_chunks(path, header) if n_points > 0 else []
        unit = _unit(path, header)
    nodes: tuple[Node, ...] | None = None
    octree = read_octree(path, chunks) if wish and chunks else None
    if octree is not None and wish:
        nodes = octree.chosen(wish)
        n_points = sum(node.n_points for node in nodes)
    names = tuple(header.point_format.dimension_names)
    extra = tuple(header.point_format.extra_dimension_names)
    columns = columns_of_names(names, intensity_field=intensity_field)
    intensity = "intensity" if columns is None else names[columns.names.index("intensity")]
    if intensity == "intensity" and intensity_field is None and n_points:
        intensity = _in_place_of_zeros(path, laspy, extra)
    has_rgb = set(names) >= set(_COLOURS)
    used = ("X", "Y", "Z", intensity, *(_COLOURS if has_rgb else ()))
    wanted = _Wanted(
        n_points=n_points, classes=frozenset(classes), intensity=intensity, nodes=nodes
    )
    scan = Scan(
        # Points of every format have an intensity.
        fields=frozenset({"intensity", "rgb"} if has_rgb else {"intensity"}),
        fields_used=used,
        fields_not_used=tuple(
            name for name in (*extra, "intensity", "nir") if name in names and name not in used
        ),
        unit=unit,
    )
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=n_points,
        scans=[scan],
        read=lambda: _blocks(path, laspy, notes, wanted),
        notes=notes,
        is_chosen=nodes is not None,
    )


@dataclass(frozen=True, kw_only=True)
class _Wanted:
    """The requested parts of a file.

    Attributes:
        n_points: stated by its header, or by its octree for the nodes.
        classes: classes of the points; empty for all.
        intensity: name of the field to use as the intensity.
        nodes: nodes of the octree, in the order of the file; None for all points of the file.
    """

    n_points: int
    classes: frozenset[int]
    intensity: str
    nodes: tuple[Node, ...] | None = None


def _n_points(path: Path, header: Any, notes: list[str]) -> int:
    """Number of points; if an uncompressed file holds more than its header states, that."""
    stated = int(header.point_count)
    if header.are_points_compressed:
        return stated
    start, n_bytes = int(header.offset_to_point_data), int(header.point_format.size)
    ends = [path.stat().st_size]
    if header.version.minor >= 4 and header.number_of_evlrs:
        ends.append(int(header.start_of_first_evlr))
    if header.version.minor >= 3 and header.start_of_waveform_data_packet_record > start:
        ends.append(int(header.start_of_waveform_data_packet_record))
    present, rest = divmod(min(ends) - start, n_bytes)
    if present > stated and rest == 0:
        notes.append(
            f"{path.name}: its header states {stated} points, but it holds {present}: all are read"
        )
        return int(present)
    return stated


def _unit(path: Path, header: Any) -> StatedUnit | None:
    """Unit of the coordinate system, from WKT if the file has it, else from GeoTIFF keys."""
    texts = [getattr(vlr, "string", "") for vlr in header.vlrs if vlr.record_id == _WKT_RECORD]
    texts += _wkt_behind_points(path)
    for text in texts:
        found = unit_of_crs(str(text), "WKT")
        if found is not None:
            return found
    keys = {}
    for vlr in header.vlrs:
        if vlr.user_id.strip("\0") == "LASF_Projection" and vlr.record_id == _GEO_KEYS:
            raw = vlr.record_data_bytes()
            words = struct.unpack(f"<{len(raw) // 2}H", raw[: len(raw) // 2 * 2])
            for place in range(4, len(words) - 3, 4):
                key, location, _, value = words[place : place + 4]
                if location == 0:
                    keys[key] = value
    return unit_of_geo_keys(keys)


def _wkt_behind_points(path: Path) -> list[str]:
    """Yield coordinate systems in the records after the points, limited in number and size."""
    found = []
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
        if header[25] < 4 or len(header) < _HEADER_BYTES:
            return []
        start, n_records = struct.unpack_from("<QI", header, 235)
        for _ in range(min(n_records, _MOST_EVLRS)):
            file.seek(start)
            head = file.read(_EVLR_BYTES)
            if len(head) < _EVLR_BYTES:
                break
            _, _, record, n_bytes = struct.unpack_from("<H16sHQ", head)
            if record == _WKT_RECORD and n_bytes < _LONGEST_WKT:
                found.append(file.read(n_bytes).decode("utf-8", "replace"))
            start += _EVLR_BYTES + n_bytes
            if start > path.stat().st_size:
                break
    return found


def _in_place_of_zeros(path: Path, laspy: Any, extra: tuple[str, ...]) -> str:
    """Name of the extra field to use as the intensity if the usual one holds only zeros."""
    columns = columns_of_names(("x", "y", "z", *extra))
    if columns is None or "intensity" not in columns.names:
        return "intensity"
    with reading(path, FORMAT), laspy.open(path, read_evlrs=False) as reader:
        sample = next(reader.chunk_iterator(_SAMPLE_POINTS))
    if np.asarray(sample.intensity).any():
        return "intensity"
    return extra[columns.names.index("intensity") - 3]


def _blocks(path: Path, laspy: Any, notes: list[str], wanted: _Wanted) -> Iterator[PointBlock]:
    n_read = 0
    with reading(path, FORMAT), laspy.open(path, read_evlrs=False) as reader:
        header = reader.header
    check = _BoundsCheck(path, header)
    for chunk in guarded(_records(path, laspy, header, wanted), path, FORMAT):
        with reading(path, FORMAT):
            block = _block(chunk, wanted)
        n_read += block.n_read
        check.add(block)
        yield block
    if n_read != wanted.n_points:
        raise short_file_error(path, "data", f"{n_read} points", f"{wanted.n_points}")
    notes.extend(check.notes())


def _block(chunk: Any, wanted: _Wanted) -> PointBlock:
    values: dict[str, NDArray[np.generic]] = {"intensity": np.asarray(chunk[wanted.intensity])}
    if set(chunk.point_format.dimension_names) >= set(_COLOURS):
        values |= {name[0]: np.asarray(chunk[name]) for name in _COLOURS}
    causes: dict[str, NDArray[np.bool_]] = {}
    for cause in ("withheld", "synthetic"):
        flags = getattr(chunk, cause)
        if np.bitwise_or.reduce(flags.array) & flags.bit_mask:
            causes[cause] = np.asarray(flags, dtype=np.bool_)
    if wanted.classes:
        causes["other_class"] = ~np.isin(np.asarray(chunk.classification), list(wanted.classes))
    block = point_block(_coordinates(chunk), values, causes=causes)
    return replace(block, bounds=_bounds(block.points.T))


def _coordinates(chunk: Any) -> NDArray[np.float64]:
    """Return (3, n) coordinates of a record, axis by axis: later passes run along the axes."""
    axes = np.empty((3, len(chunk)))
    # In parts, so that a part stays in the processor's cache from one step to the next.
    for start in range(0, len(chunk), _PART_POINTS):
        part = slice(start, start + _PART_POINTS)
        for place, name in enumerate("XYZ"):
            # Scale and offset in float64: survey coordinates keep every digit.
            np.multiply(chunk[name][part], chunk.scales[place], out=axes[place, part])
            axes[place, part] += chunk.offsets[place]
    return axes


def _bounds(axes: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return (2, 3) bounds of coordinates (3, n); None without any or if some are not finite."""
    if not axes.size:
        return None
    bounds = np.stack([axes.min(axis=1), axes.max(axis=1)])
    return bounds if np.isfinite(bounds).all() else None


class _BoundsCheck:
    """Compares points with the bounds that the header states.

    Compressed points have no checksum, so the bounds are the only indication of a changed byte:
    some points far outside are damage. Bounds elsewhere (the points were moved, or others appended)
    are stale, and only reported.
    """

    def __init__(self, path: Path, header: Any) -> None:
        self._path = path
        self._is_compressed = bool(header.are_points_compressed)
        self._low, self._high = (np.asarray(b, np.float64) for b in (header.mins, header.maxs))
        self._extent = float((self._high - self._low).max())
        bounds = np.stack([self._low, self._high])
        # Implausible bounds are ignored; NaN compares as False.
        self._is_usable = bool(
            np.all(np.abs(bounds) < _FARTHEST)
            and np.all(self._high >= self._low)
            and self._extent > 0.0
        )
        self._n_outside = 0

    def add(self, block: PointBlock) -> None:
        """Compare a block.

        Raises:
            InputError: a compressed file is damaged.
        """
        if not self._is_usable or not len(block.points):
            return
        # Headers are often rounded to the last digit.
        slack = 1e-3 * max(self._extent, 1.0)
        found = block.bounds
        if (
            found is not None
            and np.all(found[0] >= self._low - slack)
            and np.all(found[1] <= self._high + slack)
        ):
            return
        beyond = np.maximum(self._low - block.points, block.points - self._high).max(axis=1)
        is_outside = beyond > slack
        far = float(beyond.max())
        if self._is_compressed and far > max(self._extent, 1.0):
            low, high = np.percentile(block.points, (5, 95), axis=0)
            is_moved = is_outside.mean() > 0.5 and (high - low).max() < 2.0 * self._extent
            if not is_moved:
                raise InputError(
                    f"{self._path.name} is damaged: points lie {far:.0f} units outside the bounds "
                    f"its header states ({self._low.tolist()} to {self._high.tolist()}); copy or "
                    "export it again"
                )
        self._n_outside += int(np.count_nonzero(is_outside))

    def notes(self) -> list[str]:
        """Return what to report."""
        if not self._n_outside:
            return []
        text = f"{self._path.name}: {self._n_outside} points lie outside the bounds its header "
        return [text + "states; they are kept, but check that the file is whole"]


def _check_header(path: Path) -> None:
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
        raise _damaged(path, f"its header states {n_records} records that do not fit")
    if header[25] >= 4 and len(header) >= _HEADER_BYTES:
        first, n_extended = struct.unpack_from("<QI", header, 235)
        if n_extended and first + n_extended * _EVLR_BYTES > n_file:
            raise _damaged(path, "records at its end are missing, it is cut off")


def _checked_chunks(path: Path, header: Any) -> list[tuple[int, int, int]]:
    """Compare the chunk table with the file's size and the header's number of points.

    Args:
        path: the file.
        header: laspy's header of it.

    Returns:
        Offset in the file, bytes and points of each chunk; none without compression by chunks.

    Raises:
        InputError: the table cannot belong to this file.
    """
    if not header.are_points_compressed:
        return []
    record = header.vlrs[header.vlrs.index("LasZipVlr")].record_data
    if len(record) < 2 or struct.unpack_from("<H", record)[0] not in _CHUNKED:
        return []
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
    if not is_variable and compression.chunk_size() > max(MOST_FIXED_CHUNK, 2 * header.point_count):
        raise _damaged(path, f"its header states chunks of {compression.chunk_size()} points each")
    n_points = sum(count for count, _ in table)
    if _is_layered(record):
        _check_layers(path, record, start + _OFFSET_BYTES, [size for _, size in table])
    if n_points < header.point_count or (is_variable and n_points != header.point_count):
        raise _damaged(
            path, f"its chunks hold {n_points} points, its header states {header.point_count}"
        )
    sizes = [size for _, size in table]
    begins = itertools.accumulate(sizes, initial=start + _OFFSET_BYTES)
    return [(begin, size, count) for begin, (count, size) in zip(begins, table, strict=False)]


def _is_layered(record: bytes) -> bool:
    return bool(struct.unpack_from("<H", record)[0] == _LAYERED)


def _check_layers(path: Path, record: bytes, start: int, chunks: list[int]) -> None:
    """Compare the layers of each chunk with its size: the decompressor allocates them first.

    A chunk of point formats 6 and up is its first point, the number of its points, the size of each
    layer, and the layers.
    """
    (n_items,) = struct.unpack_from("<H", record, _ITEMS_AT)
    items = [struct.unpack_from("<HH", record, _ITEMS_AT + 2 + 6 * k) for k in range(n_items)]
    if not all(kind in _LAYERS or kind == _EXTRA_BYTES for kind, _ in items):
        raise _damaged(path, "its compression is none of point formats 6 and up")
    n_layers = sum(size if kind == _EXTRA_BYTES else _LAYERS[kind] for kind, size in items)
    sizes = struct.Struct(f"<I{n_layers}I")
    n_head = sum(size for _, size in items) + sizes.size
    with path.open("rb") as file:
        for n_bytes in chunks:
            file.seek(start + n_head - sizes.size)
            raw = file.read(sizes.size)
            if len(raw) < sizes.size or n_head + sum(sizes.unpack(raw)[1:]) != n_bytes:
                raise _damaged(path, "the layers of its chunks do not have the stated sizes")
            start += n_bytes


def _check_size(path: Path, file: Any, start: int, n_points: int) -> int:
    """Check position and length of the table; return the bytes of the chunks before it."""
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


def _records(path: Path, laspy: Any, header: Any, wanted: _Wanted) -> Iterator[Any]:
    """Yield laspy's records of up to `BLOCK_POINTS` points each, in the order of the file.

    Args:
        path: the file; its header and chunk table have been checked.
        laspy: the library.
        header: laspy's header of it.
        wanted: what is read of it.

    Raises:
        BaseException: whatever the library raises for a damaged file.
    """
    if not header.are_points_compressed:
        # Mapped, so that also a file can be read whose header states too few points.
        start, dtype = int(header.offset_to_point_data), header.point_format.dtype()
        n_present = min(wanted.n_points, (path.stat().st_size - start) // dtype.itemsize)
        points = np.memmap(path, dtype=dtype, mode="r", offset=start, shape=(n_present,))
        for first in range(0, n_present, BLOCK_POINTS):
            part = np.asarray(points[first : first + BLOCK_POINTS])
            yield laspy.ScaleAwarePointRecord(
                part, header.point_format, header.scales, header.offsets
            )
        return
    fields = laspy.DecompressionSelection.base().decompress_z().decompress_flags()
    fields = fields.decompress_intensity().decompress_rgb()
    if wanted.classes:
        fields = fields.decompress_classification()
    if wanted.intensity != "intensity":
        fields = fields.decompress_all_extra_bytes()
    if wanted.nodes is not None:
        yield from _nodes_decoded(path, laspy, header, wanted.nodes, fields.to_lazrs())
        return
    with laspy.open(path, decompression_selection=fields, read_evlrs=False) as reader:
        yield from reader.chunk_iterator(BLOCK_POINTS)


def _nodes_decoded(
    path: Path, laspy: Any, header: Any, nodes: Sequence[Node], fields: Any
) -> Iterator[Any]:
    """Decode some chunks of a file, as many at once as make a block."""
    lazrs = load_library("lazrs", path)
    record = bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
    totals = itertools.accumulate(node.n_points for node in nodes)
    by_block = zip(nodes, totals, strict=True)
    with path.open("rb") as file:
        for _, members in itertools.groupby(by_block, key=lambda item: item[1] // BLOCK_POINTS):
            group = [node for node, _ in members]
            packed = bytearray()
            for node in group:
                file.seek(node.offset)
                packed += file.read(node.n_bytes)
            n_points = sum(node.n_points for node in group)
            points = np.zeros(n_points * int(header.point_format.size), dtype=np.uint8)
            table = [(node.n_points, node.n_bytes) for node in group]
            lazrs.decompress_points_with_chunk_table(bytes(packed), record, points, table, fields)
            yield laspy.ScaleAwarePointRecord(
                points.view(header.point_format.dtype()),
                header.point_format,
                header.scales,
                header.offsets,
            )
