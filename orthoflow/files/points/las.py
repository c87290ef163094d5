"""LAS, LAZ and COPC through laspy, block by block.

Header and chunk table are checked before the libraries believe them: a damaged count of records
keeps laspy busy for hours, and a damaged chunk table makes the decompressor ask for any amount of
memory, which ends the process without a word that Python could catch.

The decompressor keeps Python's lock while it decodes, so that in one process nothing else gets on
meanwhile. Of a large file other processes decode blocks of whole chunks, in turns, into memory that
they share with this one, which converts and stores a block while the next ones are decoded.

Of point formats 6 and up, whose fields are compressed apart, only the fields are decoded that make
a cloud. Of a COPC file only those nodes of the octree are decoded that hold points asked for.
"""

from __future__ import annotations

import contextlib
import itertools
import struct
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    PointBlock,
    ScanFile,
    point_fields,
    short_file_error,
)
from orthoflow.files.points.copc import Node, Wish, read_octree
from orthoflow.files.points.decoders import Decoder, can_share_memory
from orthoflow.files.points.libraries import guarded, load_library, reading

FORMAT: Final = "LAS/LAZ"
_COLOURS: Final = ("red", "green", "blue")
_FARTHEST: Final = 1e12
_PART_POINTS: Final = 1 << 15
_HEADER_BYTES: Final = 375
_VLR_BYTES: Final = 54
_EVLR_BYTES: Final = 60
_OFFSET_BYTES: Final = 8
_CHUNKED: Final = (2, 3)
# Of the compression's record: which compressor, where its items are listed, and of their types how
# many layers each takes (point, colours, colours with infrared, wave packets).
_LAYERED: Final = 3
_ITEMS_AT: Final = 32
_LAYERS: Final = {10: 9, 11: 1, 12: 2, 13: 1}
_EXTRA_BYTES: Final = 14
MOST_FIXED_CHUNK: Final = 50_000_000
_WORKER: Final = Path(__file__).with_name("las_worker.py")
# Files with fewer blocks are read before other processes would be up.
_BLOCKS_LEAST: Final = 8
# Chunks much larger than a block would be decoded again for each block that begins within.
_LARGEST_CHUNK: Final = 2 * BLOCK_POINTS
_PROCESSES_MOST: Final = 16


def open_las(
    path: Path, *, classes: Collection[int] = (), cores: int = 1, wish: Wish | None = None
) -> ScanFile:
    """Open a LAS, LAZ or COPC file.

    Args:
        path: the file.
        classes: only points of these classes are given; all when empty.
        cores: processes that may decode its points.
        wish: of a COPC file only the nodes are read that hold such points.
    """
    laspy = load_library("laspy", path)
    _check_header(path)
    # Records behind the points are of no use here, and may claim any size.
    with reading(path, FORMAT), laspy.open(path, read_evlrs=False) as reader:
        header = reader.header
        names = set(header.point_format.dimension_names)
        bounds = np.vstack([header.mins, header.maxs]).astype(np.float64)
        n_points = int(header.point_count)
        details: dict[str, str | int | float] = {
            "version": str(header.version),
            "point_format": int(header.point_format.id),
            "scale": float(np.max(header.scales)),
        }
        chunks = _checked_chunks(path, header) if n_points > 0 else []
    nodes: tuple[Node, ...] | None = None
    octree = read_octree(path, chunks) if wish and chunks else None
    if octree is not None and wish:
        nodes = octree.chosen(wish)
        n_points = sum(node.n_points for node in nodes)
        details["octree"] = (
            f"{len(nodes)} of {len(octree.nodes)} nodes, levels 0 to "
            f"{max(node.level for node in nodes)} of 0 to {octree.deepest}"
        )
    notes: list[str] = []
    wanted = _Wanted(n_points=n_points, classes=frozenset(classes), cores=cores, nodes=nodes)
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=n_points,
        # Points of every format have an intensity.
        fields=point_fields(has_intensity=True, has_rgb=names.issuperset(_COLOURS)),
        read=lambda: _blocks(path, laspy, bounds, notes, wanted),
        details=details,
        notes=notes,
        is_chosen=nodes is not None,
    )


@dataclass(frozen=True, kw_only=True)
class _Wanted:
    """What is read of a file.

    Attributes:
        n_points: that its header states, or its octree for the nodes.
        classes: of the points; empty for all.
        cores: processes that may decode at the same time.
        nodes: of the octree, in the order of the file; None for all points of the file.
    """

    n_points: int
    classes: frozenset[int]
    cores: int
    nodes: tuple[Node, ...] | None = None


def _blocks(
    path: Path, laspy: Any, bounds: NDArray[np.float64], notes: list[str], wanted: _Wanted
) -> Iterator[PointBlock]:
    n_read = 0
    n_outside = 0
    for chunk in guarded(_records(path, laspy, wanted), path, FORMAT):
        with reading(path, FORMAT):
            block = _block(chunk, wanted.classes)
        n_read += block.n_read
        n_outside += _outside(path, block, bounds)
        yield block
    if n_read != wanted.n_points:
        raise short_file_error(path, "data", f"{n_read} points", f"{wanted.n_points}")
    if n_outside:
        notes.append(
            f"{path.name}: {n_outside} points lie outside the bounds its header states; they are "
            "kept, but check that the file is whole"
        )


def _block(chunk: Any, classes: frozenset[int]) -> PointBlock:
    axes = _coordinates(chunk)
    points = axes.T
    intensity = np.asarray(chunk.intensity, dtype=np.float32)
    rgb = None
    if set(chunk.point_format.dimension_names).issuperset(_COLOURS):
        rgb = np.column_stack([np.asarray(chunk[name]) for name in _COLOURS])
    block = PointBlock(
        points=points,
        scan=0,
        n_read=len(points),
        intensity=intensity,
        rgb=rgb,
        bounds=_bounds(axes),
    )
    flags = chunk.withheld
    if not (classes or np.bitwise_or.reduce(flags.array) & flags.bit_mask):
        return block
    withheld = np.asarray(flags, dtype=np.bool_)
    kept = ~withheld
    if classes:
        kept &= np.isin(np.asarray(chunk.classification), list(classes))
    axes = axes[:, kept]
    return PointBlock(
        points=axes.T,
        scan=0,
        n_read=len(points),
        n_withheld=int(withheld.sum()),
        n_unwanted=int((~kept & ~withheld).sum()),
        intensity=intensity[kept],
        rgb=None if rgb is None else rgb[kept],
        bounds=_bounds(axes),
    )


def _coordinates(chunk: Any) -> NDArray[np.float64]:
    """(3, n) coordinates of a record, axis by axis in memory: later passes go along the axes."""
    axes = np.empty((3, len(chunk)))
    # Part by part, so that a part stays in the processor's cache from one step to the next.
    for start in range(0, len(chunk), _PART_POINTS):
        part = slice(start, start + _PART_POINTS)
        for place, name in enumerate("XYZ"):
            # Scale and offset in float64: survey coordinates keep every digit.
            np.multiply(chunk[name][part], chunk.scales[place], out=axes[place, part])
            axes[place, part] += chunk.offsets[place]
    return axes


def _bounds(axes: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """(2, 3) bounds of coordinates (3, n); None where some are not finite, or there are none."""
    if not axes.size:
        return None
    bounds = np.stack([axes.min(axis=1), axes.max(axis=1)])
    return bounds if np.isfinite(bounds).all() else None


def _outside(path: Path, block: PointBlock, bounds: NDArray[np.float64]) -> int:
    """Count points outside the header's bounds; far outside is what damaged bytes decode to.

    Compressed points carry no checksum, so the bounds are the only witness of a changed byte.
    """
    low, high = bounds
    points = block.points
    # Bounds that no scan has say nothing; NaN compares as False.
    if not (np.all(np.abs(bounds) < _FARTHEST) and np.all(high >= low)) or not len(points):
        return 0
    extent = float((high - low).max())
    if extent == 0.0:
        return 0
    # Headers are often rounded to the last digit.
    slack = 1e-3 * max(extent, 1.0)
    found = block.bounds
    if found is not None and np.all(found[0] >= low - slack) and np.all(found[1] <= high + slack):
        return 0
    beyond = np.maximum(low - points, points - high).max(axis=1)
    far = float(beyond.max())
    if far > max(extent, 1.0):
        raise InputError(
            f"{path.name} is damaged: points lie {far:.0f} units outside the bounds its header "
            f"states ({low.tolist()} to {high.tolist()}); copy or export it again"
        )
    return int(np.count_nonzero(beyond > slack))


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
        raise _damaged(path, f"its header states {n_records} records that have no room")
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
        raise _damaged(path, f"its chunks are said to hold {compression.chunk_size()} points each")
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
    """Compare the layers of each chunk with its size: the decompressor makes room for them first.

    A chunk of point formats 6 and up is its first point, the number of its points, the size of
    each layer, and the layers.
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
                raise _damaged(path, "the layers of its chunks are not as large as they are said")
            start += n_bytes


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


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """What other processes must know of a compressed file.

    Attributes:
        step: points of a block; whole chunks.
        start: of the compressed points in the file, bytes.
        has_classes: whether the classes of the points are decoded, too.
        record: description of the compression, as the file has it.
        point_bytes: of a point that is not compressed.
    """

    step: int
    start: int
    has_classes: bool
    record: bytes
    point_bytes: int


def _records(path: Path, laspy: Any, wanted: _Wanted) -> Iterator[Any]:
    """Give laspy's records of up to `BLOCK_POINTS` points each, in the order of the file.

    A record is to be done with before the next one is asked for.

    Args:
        path: the file; its header and chunk table have been checked.
        laspy: the library.
        wanted: what is read of it.

    Raises:
        BaseException: whatever the library throws at a damaged file.
    """
    fields = laspy.DecompressionSelection.base().decompress_z().decompress_flags()
    fields = fields.decompress_intensity().decompress_rgb()
    if wanted.classes:
        fields = fields.decompress_classification()
    with laspy.open(path, decompression_selection=fields, read_evlrs=False) as reader:
        if wanted.nodes is not None:
            yield from _nodes_decoded(path, laspy, reader.header, wanted.nodes, fields.to_lazrs())
            return
        # Where memory cannot be shared without a name, this process decodes all by itself.
        is_shared_out = wanted.cores > 1 and can_share_memory()
        layout = _layout(path, reader.header, wanted) if is_shared_out else None
        if layout is None:
            yield from reader.chunk_iterator(BLOCK_POINTS)
        else:
            n_processes = min(wanted.cores, _PROCESSES_MOST)
            yield from _decoded_elsewhere(path, laspy, reader.header, layout, n_processes)


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


def _layout(path: Path, header: Any, wanted: _Wanted) -> _Layout | None:
    """How to share a file out; None for small files, and where blocks cannot begin at a chunk."""
    if not header.are_points_compressed or header.point_count < _BLOCKS_LEAST * BLOCK_POINTS:
        return None
    record = bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
    compression = load_library("lazrs", path).LazVlr(record)
    size = int(compression.chunk_size())
    if compression.uses_variable_size_chunks() or not 0 < size <= _LARGEST_CHUNK:
        return None
    return _Layout(
        step=size * max(1, BLOCK_POINTS // size),
        start=int(header.offset_to_point_data),
        has_classes=bool(wanted.classes),
        record=record,
        point_bytes=int(header.point_format.size),
    )


def _decoded_elsewhere(
    path: Path, laspy: Any, header: Any, layout: _Layout, n_processes: int
) -> Iterator[Any]:
    slot_bytes = layout.step * layout.point_bytes
    with contextlib.ExitStack() as stack:
        decoders = []
        for first in range(n_processes):
            told = [str(path), str(layout.start), str(int(layout.has_classes))]
            told += [layout.record.hex(), str(layout.step), str(layout.point_bytes)]
            told += [str(first), str(n_processes), str(header.point_count)]
            decoder = Decoder(_WORKER, told, slot_bytes=slot_bytes)
            stack.callback(decoder.close)
            decoders.append(decoder)
        for block, start in enumerate(range(0, header.point_count, layout.step)):
            decoder = decoders[block % n_processes]
            said = decoder.line()
            if said != "decoded":
                raise ValueError(said or f"its decoder ended with {decoder.ended_with()}")
            count = min(layout.step, header.point_count - start)
            decoded = decoder.slot()[: count * layout.point_bytes]
            yield laspy.ScaleAwarePointRecord(
                np.frombuffer(decoded, dtype=header.point_format.dtype()),
                header.point_format,
                header.scales,
                header.offsets,
            )
            decoder.allow()
