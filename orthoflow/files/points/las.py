"""LAS, LAZ and COPC files, read with laspy block by block.

Header and chunk table are checked before the libraries use them: a damaged point count can make
laspy run for hours, and a damaged chunk table can make the decompressor allocate so much memory
that the process ends without an exception.

Point formats 6 and up compress each field separately, so only the fields that a cloud needs are
decoded. A COPC file is a LAZ file whose chunks are the nodes of an octree (copc.io, 1.0): the root
contains a sparse sample of the whole cloud, and each child node adds points in between at twice the
density. Only nodes with requested points are decoded.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.fields import columns_of_names
from orthoflow.files.points.scan_file import (
    BLOCK_POINTS,
    PointBlock,
    PointQuery,
    Scan,
    ScanFile,
    Values,
    cut_off,
    load_library,
    point_block,
    reading,
)
from orthoflow.files.points.units import (
    StatedUnit,
    unit_of_comments,
    unit_of_crs,
    unit_of_geo_keys,
)

FORMAT: Final = "LAS/LAZ"
_COLOURS: Final = ("red", "green", "blue")
_FARTHEST: Final = 1e12
_PART_POINTS: Final = 1 << 15
_HEADER_BYTES: Final = 375
_VLR_BYTES: Final = 54
_EVLR_BYTES: Final = 60
_OFFSET_BYTES: Final = 8
_CHUNKED: Final = (2, 3)
# In the LASzip record: the number of the layered compressor, the position of the item list, and the
# number of layers by item type (point, colours, colours with infrared, wave packets).
_LAYERED: Final = 3
_ITEMS_AT: Final = 32
_LAYERS: Final = {10: 9, 11: 1, 12: 2, 13: 1}
_EXTRA_BYTES: Final = 14
#: points of a LAZ chunk, unless twice the number of points in the file is larger
MOST_FIXED_CHUNK: Final = 50_000_000
_WKT_RECORD: Final = 2112
_GEO_KEYS: Final = 34735
_GEO_TEXTS: Final = 34737
_LONGEST_WKT: Final = 100_000
_MOST_EVLRS: Final = 1000
_SAMPLE_POINTS: Final = 50_000
_COPC_RECORD: Final = struct.Struct("<H16sHH32s")
_COPC_INFO: Final = struct.Struct("<5d2Q")
_COPC_ENTRY: Final = struct.Struct("<4iQii")
_PAGE: Final = -1
# Nodes at deeper levels would be smaller than the point spacing of any scanner.
_LEVELS_MOST: Final = 32


class _Chunk(NamedTuple):
    offset: int
    n_bytes: int
    n_points: int


def open_las(
    path: Path,
    *,
    classes: Collection[int] = (),
    query: PointQuery | None = None,
    intensity_field: str | None = None,
) -> ScanFile:
    """Open a LAS, LAZ or COPC file.

    Args:
        path: the file.
        classes: classes of points to read; empty for all classes.
        query: requested points; of a COPC file, only nodes with such points are read.
        intensity_field: name of the field to use as intensity; None for the usual one.
    """
    laspy = load_library("laspy", path)
    _check_header(path)
    notes: list[str] = []
    # Records after the points may declare any size; only the coordinate system is read from these
    # records.
    with reading(path, FORMAT), laspy.open(path, read_evlrs=False) as reader:
        header = reader.header
        n_points = _count_points(path, header, notes)
        chunks = _checked_chunks(path, header) if n_points > 0 else []
        unit = _unit(path, header)
    nodes = _chosen_nodes(path, chunks, query) if query and chunks else None
    if nodes is not None:
        n_points = sum(node.n_points for node in nodes)
    names = tuple(header.point_format.dimension_names)
    extra = tuple(header.point_format.extra_dimension_names)
    columns = columns_of_names(names, intensity_field=intensity_field)
    intensity = "intensity" if columns is None else names[columns.names.index("intensity")]
    if intensity == "intensity" and intensity_field is None and n_points:
        # If the standard field contains only zeros, use an extra field instead.
        others = columns_of_names(("x", "y", "z", *extra))
        if others is not None and "intensity" in others.names:
            with reading(path, FORMAT), laspy.open(path, read_evlrs=False) as reader:
                sample = next(reader.chunk_iterator(_SAMPLE_POINTS))
            if not np.asarray(sample.intensity).any():
                intensity = extra[others.names.index("intensity") - 3]
    has_rgb = set(names) >= set(_COLOURS)
    used = ("X", "Y", "Z", intensity, *(_COLOURS if has_rgb else ()))
    scan = Scan(
        # All point formats have an intensity.
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
        read=partial(_blocks, path, laspy, notes, n_points, frozenset(classes), intensity, nodes),
        notes=notes,
        is_chosen=nodes is not None,
    )


def _count_points(path: Path, header: Any, notes: list[str]) -> int:
    """Return the declared number of points, or the actual one of an uncompressed file if larger."""
    stated = int(header.point_count)
    if header.are_points_compressed:
        return stated
    start = int(header.offset_to_point_data)
    ends = [path.stat().st_size]
    if header.version.minor >= 4 and header.number_of_evlrs:
        ends.append(int(header.start_of_first_evlr))
    if header.version.minor >= 3 and header.start_of_waveform_data_packet_record > start:
        ends.append(int(header.start_of_waveform_data_packet_record))
    present, rest = divmod(min(ends) - start, int(header.point_format.size))
    if present <= stated or rest:
        return stated
    notes.append(
        f"{path.name}: its header declares {stated} points, but the file contains {present}: all "
        "are read"
    )
    return int(present)


def _unit(path: Path, header: Any) -> StatedUnit | None:
    """Return the unit of the coordinate system, from WKT if present, else from GeoTIFF keys."""
    texts = [getattr(vlr, "string", "") for vlr in header.vlrs if vlr.record_id == _WKT_RECORD]
    for text in [*texts, *_wkt_behind_points(path)]:
        found = unit_of_crs(str(text), "WKT")
        if found is not None:
            return found
    keys: dict[int, int] = {}
    citations: list[str] = []
    for vlr in header.vlrs:
        if vlr.user_id.strip("\0") != "LASF_Projection":
            continue
        raw = vlr.record_data_bytes()
        if vlr.record_id == _GEO_KEYS:
            entries = np.frombuffer(raw[: len(raw) // 8 * 8], "<u2").reshape(-1, 4)[1:]
            keys |= {int(key): int(value) for key, place, _, value in entries if place == 0}
        elif vlr.record_id == _GEO_TEXTS:
            citations += raw.decode("ascii", "replace").strip("\0").split("|")
    return unit_of_geo_keys(keys) or unit_of_comments(citations, "GeoTIFF citation")


def _wkt_behind_points(path: Path) -> Iterator[str]:
    """Yield coordinate systems from records after the points, limited in number and size."""
    n_file = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
        if header[25] < 4 or len(header) < _HEADER_BYTES:
            return
        start, n_records = struct.unpack_from("<QI", header, 235)
        for _ in range(min(n_records, _MOST_EVLRS)):
            if start + _EVLR_BYTES > n_file:
                return
            file.seek(start)
            _, _, record, n_bytes = struct.unpack_from("<H16sHQ", file.read(_EVLR_BYTES))
            if record == _WKT_RECORD and n_bytes < _LONGEST_WKT:
                yield file.read(n_bytes).decode("utf-8", "replace")
            start += _EVLR_BYTES + n_bytes


def _blocks(
    path: Path,
    laspy: Any,
    notes: list[str],
    n_points: int,
    classes: frozenset[int],
    intensity: str,
    nodes: Sequence[_Chunk] | None,
) -> Iterator[PointBlock]:
    with reading(path, FORMAT), laspy.open(path, read_evlrs=False) as reader:
        header = reader.header
    n_read = n_outside = 0
    records = _records(path, laspy, header, n_points, classes, intensity, nodes)
    while True:
        with reading(path, FORMAT):
            chunk = next(records, None)
            if chunk is None:
                break
            block = _block(chunk, classes, intensity)
        n_read += block.n_read
        n_outside += _count_outside(path, header, block)
        yield block
    if n_read != n_points:
        raise cut_off(path, "data", f"{n_read} points", f"{n_points}")
    if n_outside:
        notes.append(
            f"{path.name}: {n_outside} points are outside the bounding box in its header; they are "
            "kept, but check that the file is complete"
        )


def _block(chunk: Any, classes: frozenset[int], intensity: str) -> PointBlock:
    values: Values = {"intensity": np.asarray(chunk[intensity])}
    if set(chunk.point_format.dimension_names) >= set(_COLOURS):
        values |= {name[0]: np.asarray(chunk[name]) for name in _COLOURS}
    causes: dict[str, NDArray[np.bool_]] = {}
    for cause in ("withheld", "synthetic"):
        flags = getattr(chunk, cause)
        if np.bitwise_or.reduce(flags.array) & flags.bit_mask:
            causes[cause] = np.asarray(flags, dtype=np.bool_)
    if classes:
        causes["other_class"] = ~np.isin(np.asarray(chunk.classification), list(classes))
    axes = np.empty((3, len(chunk)))
    # Convert the coordinates in parts that fit into the processor's cache.
    for start in range(0, len(chunk), _PART_POINTS):
        part = slice(start, start + _PART_POINTS)
        for place, name in enumerate("XYZ"):
            # Scale and offset in float64 preserve all digits of survey coordinates.
            np.multiply(chunk[name][part], chunk.scales[place], out=axes[place, part])
            axes[place, part] += chunk.offsets[place]
    return point_block(axes, values, causes=causes)


def _count_outside(path: Path, header: Any, block: PointBlock) -> int:
    """Count points outside the bounding box in the header.

    Compressed points have no checksum, so the bounding box is the only way to detect a changed
    byte: if some points are far outside, the file is damaged. If the box is in another place, it is
    out of date (points were moved or appended); this is only reported.

    Raises:
        InputError: a compressed file is damaged.
    """
    low, high = (np.asarray(bound, np.float64) for bound in (header.mins, header.maxs))
    extent = float((high - low).max())
    # Ignore implausible bounds; comparisons with NaN are False.
    is_usable = np.all(np.abs([low, high]) < _FARTHEST) and np.all(high >= low) and extent > 0.0
    # Many programs round the bounds to the last digit.
    slack = 1e-3 * max(extent, 1.0)
    if not is_usable or (
        np.all(block.bounds[0] >= low - slack) and np.all(block.bounds[1] <= high + slack)
    ):
        return 0
    beyond = np.maximum(low - block.points, block.points - high).max(axis=1)
    is_outside, far = beyond > slack, float(beyond.max())
    if header.are_points_compressed and far > max(extent, 1.0):
        ends = np.percentile(block.points, (5, 95), axis=0)
        is_moved = is_outside.mean() > 0.5 and np.ptp(ends, axis=0).max() < 2.0 * extent
        if not is_moved:
            raise InputError(
                f"{path.name} is damaged: points are {far:.0f} units outside the bounding box "
                f"in its header ({low.tolist()} to {high.tolist()}); copy or "
                "export it again"
            )
    return int(np.count_nonzero(is_outside))


def _check_header(path: Path) -> None:
    """Compare counts and offsets in the header with the size of the file.

    Raises:
        InputError: the header is inconsistent with the file.
    """
    n_file = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
    if len(header) < 227:
        raise _damaged(path, "it ends within its header")
    header_size, start, n_records = struct.unpack_from("<HII", header, 94)
    if not header_size <= start <= n_file:
        raise _damaged(path, "its points begin outside the file, which is truncated")
    if n_records * _VLR_BYTES > start - header_size:
        raise _damaged(
            path, f"its header declares {n_records} records, which the file cannot contain"
        )
    if header[25] >= 4 and len(header) >= _HEADER_BYTES:
        first, n_extended = struct.unpack_from("<QI", header, 235)
        if n_extended and first + n_extended * _EVLR_BYTES > n_file:
            raise _damaged(path, "it is truncated: records at its end are missing")


def _checked_chunks(path: Path, header: Any) -> list[_Chunk]:
    """Compare the chunk table with the size of the file and the point count in the header.

    Args:
        path: the file.
        header: header of the file, as read by laspy.

    Returns:
        The chunks; empty if the file is not compressed in chunks.

    Raises:
        InputError: the table is inconsistent with the file.
    """
    if not header.are_points_compressed:
        return []
    record = header.vlrs[header.vlrs.index("LasZipVlr")].record_data
    if len(record) < 2 or struct.unpack_from("<H", record)[0] not in _CHUNKED:
        return []
    lazrs = load_library("lazrs", path)
    compression = lazrs.LazVlr(record)
    if compression.item_size() != header.point_format.size:
        raise _damaged(path, "the size of its points differs from that in its header")
    start, n_stated = int(header.offset_to_point_data), int(header.point_count)
    n_file = path.stat().st_size
    with path.open("rb") as file:
        at = _offset_at(path, file, start)
        if at <= 0:
            # Programs that cannot seek write the offset of the chunk table at the end of the file.
            at = _offset_at(path, file, n_file - _OFFSET_BYTES)
        if not start + _OFFSET_BYTES <= at <= n_file - _OFFSET_BYTES:
            raise _damaged(path, "its chunk table is outside the file, which is truncated")
        n_bytes = at - start - _OFFSET_BYTES
        n_chunks = _offset_at(path, file, at) >> 32 & 0xFFFFFFFF
        if n_chunks > min(n_stated, n_bytes):
            raise _damaged(path, f"its chunk table declares {n_chunks} chunks, which is impossible")
        file.seek(start)
        table = lazrs.read_chunk_table(file, compression)
    _check_chunks(path, header, compression, table, n_bytes)
    if struct.unpack_from("<H", record)[0] == _LAYERED:
        _check_layers(path, record, start + _OFFSET_BYTES, [size for _, size in table])
    begins = itertools.accumulate((size for _, size in table), initial=start + _OFFSET_BYTES)
    return [_Chunk(begin, size, n) for begin, (n, size) in zip(begins, table, strict=False)]


def _offset_at(path: Path, file: BinaryIO, place: int) -> int:
    file.seek(place)
    raw = file.read(_OFFSET_BYTES)
    if len(raw) < _OFFSET_BYTES:
        raise _damaged(path, "it ends before its points begin")
    return int(struct.unpack("<q", raw)[0])


def _check_chunks(
    path: Path, header: Any, compression: Any, table: list[tuple[int, int]], n_bytes: int
) -> None:
    n_stated, n_points = int(header.point_count), sum(count for count, _ in table)
    if sum(size for _, size in table) > n_bytes:
        raise _damaged(path, "its chunks are larger than the file")
    is_variable = compression.uses_variable_size_chunks()
    if not is_variable and compression.chunk_size() > max(MOST_FIXED_CHUNK, 2 * n_stated):
        raise _damaged(
            path,
            f"its header declares chunks of {compression.chunk_size()} points, which is too many",
        )
    if n_points < n_stated or (is_variable and n_points != n_stated):
        raise _damaged(
            path, f"its chunks contain {n_points} points, but its header declares {n_stated}"
        )


def _check_layers(path: Path, record: bytes, start: int, chunks: list[int]) -> None:
    """Check a chunk's layer sizes against its own, since the decompressor allocates all layers.

    A chunk of point formats 6 and up consists of its first point, its number of points, the size
    of each layer, and the layers.
    """
    (n_items,) = struct.unpack_from("<H", record, _ITEMS_AT)
    items = [struct.unpack_from("<HH", record, _ITEMS_AT + 2 + 6 * k) for k in range(n_items)]
    if not all(kind in _LAYERS or kind == _EXTRA_BYTES for kind, _ in items):
        raise _damaged(path, "its compression is not that of point formats 6 and above")
    n_layers = sum(size if kind == _EXTRA_BYTES else _LAYERS[kind] for kind, size in items)
    sizes = struct.Struct(f"<I{n_layers}I")
    n_head = sum(size for _, size in items) + sizes.size
    with path.open("rb") as file:
        for n_bytes in chunks:
            file.seek(start + n_head - sizes.size)
            raw = file.read(sizes.size)
            if len(raw) < sizes.size or n_head + sum(sizes.unpack(raw)[1:]) != n_bytes:
                raise _damaged(path, "the layers of its chunks do not have the declared sizes")
            start += n_bytes


def _damaged(path: Path, reason: str) -> InputError:
    return InputError(f"{path.name} cannot be read as LAS/LAZ: {reason}; copy or export it again")


def _records(
    path: Path,
    laspy: Any,
    header: Any,
    n_points: int,
    classes: frozenset[int],
    intensity: str,
    nodes: Sequence[_Chunk] | None,
) -> Iterator[Any]:
    """Yield laspy records with up to `BLOCK_POINTS` points each, in file order.

    Raises:
        BaseException: any error that the library raises for a damaged file.
    """

    def record(points: NDArray[Any]) -> Any:
        return laspy.ScaleAwarePointRecord(
            points, header.point_format, header.scales, header.offsets
        )

    row = header.point_format.dtype()
    if not header.are_points_compressed:
        # Map the file to memory, so that all points are read even if the header declares too few.
        start = int(header.offset_to_point_data)
        n_present = min(n_points, (path.stat().st_size - start) // row.itemsize)
        mapped = np.memmap(path, dtype=row, mode="r", offset=start, shape=(n_present,))
        for first in range(0, n_present, BLOCK_POINTS):
            yield record(np.asarray(mapped[first : first + BLOCK_POINTS]))
        return
    fields = laspy.DecompressionSelection.base().decompress_z().decompress_flags()
    fields = fields.decompress_intensity().decompress_rgb()
    if classes:
        fields = fields.decompress_classification()
    if intensity != "intensity":
        fields = fields.decompress_all_extra_bytes()
    if nodes is None:
        with laspy.open(path, decompression_selection=fields, read_evlrs=False) as reader:
            yield from reader.chunk_iterator(BLOCK_POINTS)
        return
    # Decode as many nodes at once as fit into a block.
    lazrs = load_library("lazrs", path)
    compression = bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
    totals = itertools.accumulate(node.n_points for node in nodes)
    by_block = zip(nodes, totals, strict=True)
    with path.open("rb") as file:
        for _, members in itertools.groupby(by_block, key=lambda item: item[1] // BLOCK_POINTS):
            group = [node for node, _ in members]
            packed = bytearray()
            for node in group:
                file.seek(node.offset)
                packed += file.read(node.n_bytes)
            points = np.zeros(sum(node.n_points for node in group) * row.itemsize, dtype=np.uint8)
            table = [(node.n_points, node.n_bytes) for node in group]
            lazrs.decompress_points_with_chunk_table(
                bytes(packed), compression, points, table, fields.to_lazrs()
            )
            yield record(points.view(row))


def _chosen_nodes(path: Path, chunks: Sequence[_Chunk], query: PointQuery) -> list[_Chunk] | None:
    """Return the nodes of a COPC file that contain requested points, in file order.

    The deepest level read is the first at which the point spacing is not larger than requested. If
    no node intersects the box, the root is returned, which shows where the cloud is.

    Returns:
        The nodes, or None for a file without an octree.

    Raises:
        InputError: the octree is inconsistent with the file.
    """
    n_start = _HEADER_BYTES + _COPC_RECORD.size + _COPC_INFO.size
    with path.open("rb") as file:
        start = file.read(n_start)
    if len(start) < n_start:
        return None
    _, user, record, _, _ = _COPC_RECORD.unpack_from(start, _HEADER_BYTES)
    if user.rstrip(b"\0") != b"copc" or record != 1:
        return None
    *middle, half, spacing, offset, n_bytes = _COPC_INFO.unpack_from(
        start, _HEADER_BYTES + _COPC_RECORD.size
    )
    if not (np.isfinite([*middle, half, spacing]).all() and half > 0.0 and spacing > 0.0):
        raise _bad_octree(path, "the size or spacing of its root is invalid")
    nodes = _read_nodes(path, (offset, n_bytes))
    if not set(nodes.values()) <= set(chunks):
        raise _bad_octree(path, "it references chunks that the file does not contain")
    last = _LEVELS_MOST
    if query.spacing is not None:
        # The logarithms are separate because a damaged file's spacing may be so large that the
        # quotient overflows.
        levels = math.log2(spacing) - math.log2(query.spacing)
        last = max(0, math.ceil(levels - 1e-9))
    # The margin is needed because coordinates are rounded to the resolution of the file.
    slack = 2e-6 * half

    def is_wanted(level: int, *place: int) -> bool:
        if query.box is None or level > last:
            return level <= last
        side = 2.0 * half / 2.0**level
        low = np.array(middle) - half + side * np.array(place)
        return bool(
            np.all(query.box[0] <= low + side + slack) and np.all(query.box[1] >= low - slack)
        )

    found = [chunk for key, chunk in nodes.items() if is_wanted(*key)]
    return sorted(found or [chunk for key, chunk in nodes.items() if key[0] == 0])


def _read_nodes(path: Path, root: tuple[int, int]) -> dict[tuple[int, ...], _Chunk]:
    """Return the chunks of all nodes with points, by level and position."""
    n_file = n_left = path.stat().st_size
    nodes: dict[tuple[int, ...], _Chunk] = {}
    pages, seen = [root], {root}
    with path.open("rb") as file:
        while pages:
            offset, n_bytes = pages.pop()
            # Pages do not overlap, so their total size cannot exceed that of the file.
            n_left -= n_bytes
            if offset + n_bytes > n_file or n_left < 0:
                raise _bad_octree(path, "its pages are outside the file")
            file.seek(offset)
            page = file.read(n_bytes // _COPC_ENTRY.size * _COPC_ENTRY.size)
            for level, x, y, z, begin, size, count in _COPC_ENTRY.iter_unpack(page):
                is_inside = 0 <= level < _LEVELS_MOST and min(x, y, z) >= 0
                if not is_inside or max(x, y, z) >= 2**level or size < 0 or count < _PAGE:
                    raise _bad_octree(path, "a node is outside the root")
                if count == _PAGE and (begin, size) not in seen:
                    seen.add((begin, size))
                    pages.append((begin, size))
                elif count > 0:
                    nodes[level, x, y, z] = _Chunk(begin, size, count)
    if not nodes:
        raise _bad_octree(path, "it has no nodes")
    return nodes


def _bad_octree(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path.name} cannot be read as COPC: its octree is damaged, {reason}; copy or export it "
        "again, or remove box and gsd_m to read all of its points"
    )
