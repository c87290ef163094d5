"""A cloud as COPC 1.0: a LAZ file whose chunks are octree nodes, in order of increasing density.

A node contains one point per cell of its grid, and its child nodes add points in between; a node
whose volume has few points contains all of them. Points are buffered in files next to the output,
so memory does not grow with their number. They are sorted into groups along a Morton curve; a cell
of the root's grid is never split between groups.
"""

from __future__ import annotations

import io
import itertools
import struct
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.clouds.attributes import BLOCK, AttributedCloud
from orthoflow.files.clouds.writers import las_header, las_record
from orthoflow.files.points.scan_file import load_library

# Bits of a position along an axis; a node's grid has 2^7 cells per side.
_PLACE_BITS: Final = 21
_GRID_BITS: Final = 7
_DEEPEST: Final = _PLACE_BITS - _GRID_BITS
KEPT_WHOLE: Final = 1 << 15
IN_MEMORY_POINTS: Final = 1 << 22
_KEY_BITS: Final = 3 * _DEEPEST
_SPREADS: Final = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
_INFO: Final = struct.Struct("<5d2Q2d88x")
_ENTRY: Final = struct.Struct("<4iQ2i")
# Eight bytes before the first chunk contain the offset of the chunk table.
_TABLE_BYTES: Final = 8


@dataclass(frozen=True, kw_only=True)
class _Waiting:
    """Buffered points in memory-mapped files.

    Attributes:
        records: (n,) points as LAS records.
        codes: (n,) uint64 positions along the Morton curve of the root.
        order: (n,) int64 point indices, group after group.
        counts: number of points in each cell of the root's grid, along the curve.
        low: (3,) int64 lowest corner of the root, in steps of the file's scale.
        side: side length of the root, in the same steps as `low`.
    """

    records: NDArray[np.void]
    codes: NDArray[np.uint64]
    order: NDArray[np.int64]
    counts: NDArray[np.int64]
    low: NDArray[np.int64]
    side: int

    @property
    def groups(self) -> NDArray[np.int64]:
        return (np.cumsum(self.counts) - self.counts) // IN_MEMORY_POINTS


@dataclass(frozen=True, kw_only=True)
class _Nodes:
    """Runs of points, from coarse to fine nodes; a run belongs to one node and to one group.

    Attributes:
        key: (r,) uint64 level of the node, followed by 42 bits of its position along the curve.
        first: (r,) int64 start of the run in `_Waiting.order`.
        count: (r,) int64 number of points.
    """

    key: NDArray[np.uint64]
    first: NDArray[np.int64]
    count: NDArray[np.int64]


def write_copc(path: Path, attributed: AttributedCloud) -> int:
    """Write the selected points and return their number.

    Raises:
        PluginError: laspy or lazrs cannot be imported.
        OSError: the file cannot be written.
    """
    laspy = load_library("laspy", path)
    header = las_header(laspy, attributed)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        waiting = _waiting(laspy, header, attributed, Path(folder))
        if waiting is None:
            return 0
        with path.open("w+b") as file:
            _write(file, laspy, header, waiting)
        return len(waiting.records)


# Any: laspy and lazrs have no types.
def _write(file: BinaryIO, laspy: Any, header: Any, waiting: _Waiting) -> None:
    lazrs = load_library("lazrs", Path(file.name))
    # A cube in the file's integer coordinates is also a cube in metres, since all axes have the
    # same scale.
    half = 0.5 * waiting.side * float(header.scales[0])
    middle = header.offsets + header.scales * waiting.low + half
    sizes = (*middle.tolist(), half, 2.0 * half / 2**_GRID_BITS)
    info = laspy.VLR("copc", 1, "COPC info", bytes(_INFO.size))
    header.vlrs.insert(0, info)
    packed = lazrs.LazVlr.new_for_compression(
        header.point_format.id, header.point_format.num_extra_bytes, use_variable_size_chunks=True
    )
    header.vlrs.append(laspy.vlrs.known.LasZipVlr(packed.record_data()))
    header.are_points_compressed = True
    # Reset the extents, so that they do not include 0.
    header.partial_reset()
    header.write_to(file)
    compressor = lazrs.LasZipCompressor(file, packed)
    nodes = _nodes(waiting)
    for index in _points_of(waiting, nodes):
        # The last chunk ends with the compression; finishing it here would add an empty one.
        if header.point_count:
            compressor.finish_current_chunk()
        points = waiting.records[index]
        header.grow(laspy.PackedPointRecord(points, header.point_format))
        compressor.compress_many(np.frombuffer(points, np.uint8))
    compressor.done()
    file.seek(header.offset_to_point_data)
    chunks = lazrs.read_chunk_table(file, packed)
    tree = _tree(nodes, chunks, header.offset_to_point_data + _TABLE_BYTES)
    header.start_of_first_evlr, header.number_of_evlrs = file.seek(0, io.SEEK_END), 1
    hierarchy = laspy.VLR("copc", 1000, "EPT hierarchy", tree)
    laspy.vlrs.vlrlist.VLRList([hierarchy]).write_to(file, as_extended=True)
    info.record_data = _INFO.pack(*sizes, file.tell() - len(tree), len(tree), 0.0, 0.0)
    file.seek(0)
    header.write_to(file, ensure_same_size=True)


def _waiting(laspy: Any, header: Any, attributed: AttributedCloud, folder: Path) -> _Waiting | None:
    """Write the selected points with their positions on the curve to files, sorted into groups."""
    lowest, highest = [], []
    kind = None
    with (folder / "records").open("wb") as stream:
        for points in attributed.blocks():
            array = las_record(laspy, header, points).array
            kind = array.dtype
            stream.write(array.tobytes())
            lowest.append([int(array[axis].min()) for axis in "XYZ"])
            highest.append([int(array[axis].max()) for axis in "XYZ"])
    if kind is None:
        return None
    records = np.memmap(folder / "records", dtype=kind, mode="r")
    n_points = len(records)
    # Readers compute the borders between nodes from rounded metres. A margin of one unit of the
    # integer coordinates, and an odd number of units per side, keep all points off these borders.
    low = np.min(lowest, axis=0) - 1
    span = int((np.max(highest, axis=0) - low).max())
    waiting = _Waiting(
        records=records,
        codes=np.memmap(folder / "codes", dtype=np.uint64, mode="w+", shape=n_points),
        order=np.memmap(folder / "order", dtype=np.int64, mode="w+", shape=n_points),
        counts=np.zeros(8**_GRID_BITS, dtype=np.int64),
        low=low,
        side=(span + 2) | 1,
    )
    for first in range(0, n_points, BLOCK):
        part = slice(first, first + BLOCK)
        waiting.codes[part] = codes = _codes(waiting, part)
        waiting.counts[:] += np.bincount(_root_cells(codes), minlength=len(waiting.counts))
    groups = waiting.groups
    begins = np.cumsum(np.bincount(groups, weights=waiting.counts)).astype(np.int64)
    begins = np.concatenate([[0], begins])
    for first in range(0, n_points, BLOCK):
        own = groups[_root_cells(waiting.codes[first : first + BLOCK])]
        sorted_own = np.argsort(own, kind="stable")
        for piece in np.split(sorted_own, np.flatnonzero(np.diff(own[sorted_own])) + 1):
            group = own[piece[0]]
            waiting.order[begins[group] : begins[group] + len(piece)] = first + piece
            begins[group] += len(piece)
    return waiting


def _codes(waiting: _Waiting, part: slice) -> NDArray[np.uint64]:
    """Return each point's position on the curve: interleaved bits of x, y and z, lowest first."""
    records = waiting.records[part]
    codes = np.zeros(len(records), dtype=np.uint64)
    for axis, name in enumerate("XYZ"):
        steps = records[name].astype(np.int64) - waiting.low[axis]
        bits = ((steps << _PLACE_BITS) // waiting.side).astype(np.uint64)
        for shift, mask in _SPREADS:
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        codes |= bits << np.uint64(axis)
    return codes


def _root_cells(codes: NDArray[np.uint64]) -> NDArray[np.int64]:
    return _ancestors(codes, _GRID_BITS).astype(np.int64)


def _ancestors(codes: NDArray[np.uint64], level: int) -> NDArray[np.uint64]:
    """Return the nodes of a level (8^level in total) that contain the given positions."""
    return codes >> np.uint64(3 * (_PLACE_BITS - level))


def _nodes(waiting: _Waiting) -> _Nodes:
    counts, order = waiting.counts, waiting.order
    totals = [counts.reshape(8**level, -1).sum(axis=1) for level in range(_GRID_BITS + 1)]
    sizes = np.bincount(waiting.groups, weights=counts).astype(np.int64)
    # A cell with more points than fit into a group leaves the following group numbers unused.
    sizes = sizes[sizes > 0]
    keys, firsts, runs = [], [], []
    for end, size in zip(np.cumsum(sizes), sizes, strict=True):
        group = slice(end - size, end)
        codes = waiting.codes[order[group]]
        along = np.argsort(codes, kind="stable")
        levels = np.empty(size, dtype=np.uint64)
        levels[along] = _levels(codes[along], totals)
        key = (levels << np.uint64(_KEY_BITS)) | (
            codes >> (np.uint64(3) * (np.uint64(_PLACE_BITS) - levels))
        )
        by_node = np.argsort(key, kind="stable")
        order[group] = order[group][by_node]
        found, first, count = np.unique(key[by_node], return_index=True, return_counts=True)
        keys.append(found)
        firsts.append(first + group.start)
        runs.append(count)
    key = np.concatenate(keys)
    by_key = np.argsort(key, kind="stable")
    return _Nodes(
        key=key[by_key],
        first=np.concatenate(firsts)[by_key],
        count=np.concatenate(runs)[by_key],
    )


def _levels(codes: NDArray[np.uint64], totals: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Return the level of the node that contains each point; points are sorted along the curve."""
    levels = np.full(len(codes), _DEEPEST, dtype=np.int64)
    left = np.arange(len(codes))
    for level in range(_DEEPEST):
        node = _ancestors(codes[left], level)
        if level < len(totals):
            total = totals[level][node]
        else:
            # The node is smaller than a cell of the root's grid, so all its points are in this
            # group.
            every = _ancestors(codes, level)
            total = np.searchsorted(every, node, "right") - np.searchsorted(every, node, "left")
        cell = _ancestors(codes[left], level + _GRID_BITS)
        begins = np.flatnonzero(np.append(True, cell[1:] != cell[:-1]))
        kept = total <= KEPT_WHOLE
        kept[(begins + np.append(begins[1:], len(cell))) // 2] = True
        levels[left[kept]] = level
        left = left[~kept]
        if len(left) == 0:
            break
    return levels


def _points_of(waiting: _Waiting, nodes: _Nodes) -> Iterator[NDArray[np.int64]]:
    begins = np.flatnonzero(np.append(True, np.diff(nodes.key) != 0))
    for begin, end in itertools.pairwise([*begins.tolist(), len(nodes.key)]):
        runs = zip(nodes.first[begin:end], nodes.count[begin:end], strict=True)
        index = np.concatenate([waiting.order[first : first + count] for first, count in runs])
        # The original order of the points compresses best and does not reveal the groups.
        yield np.sort(index)


def _tree(nodes: _Nodes, chunks: Sequence[tuple[int, int]], offset: int) -> bytes:
    """Return the hierarchy: level, x, y, z, offset, byte count and point count of each chunk."""
    entries = []
    for key, (n_points, n_bytes) in zip(np.unique(nodes.key).tolist(), chunks, strict=True):
        # A position on level n has n bits per axis.
        level = key >> _KEY_BITS
        x, y, z = (
            sum((key >> (3 * bit + axis) & 1) << bit for bit in range(level)) for axis in range(3)
        )
        entries.append(_ENTRY.pack(level, x, y, z, offset, n_bytes, n_points))
        offset += n_bytes
    return b"".join(entries)
