"""The octree of a COPC file: which of its chunks hold points of a box at a given spacing.

A COPC file is a LAZ file whose chunks are the nodes of an octree (copc.io, 1.0): the root holds
some points of the whole cloud, each node below holds points between those, at twice the density.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError

_HEADER_BYTES: Final = 375
_RECORD: Final = struct.Struct("<H16sHH32s")
_INFO: Final = struct.Struct("<5d2Q")
_ENTRY: Final = struct.Struct("<4iQii")
_PAGE: Final = -1
# Deeper trees have nodes smaller than any scanner's point spacing.
_LEVELS_MOST: Final = 32


@dataclass(frozen=True, kw_only=True)
class Wish:
    """The requested points of a file; a reader may return more.

    Attributes:
        box: (2, 3) lowest and highest coordinates in the file's unit, or None for all.
        spacing: minimum spacing of points, in the file's unit; None for all.
    """

    box: NDArray[np.float64] | None = None
    spacing: float | None = None

    def __bool__(self) -> bool:
        return self.box is not None or self.spacing is not None


@dataclass(frozen=True, kw_only=True)
class Node:
    """A node of the octree, which is a chunk of the file.

    Attributes:
        level: 0 for the root.
        place: position of the node in its level, along x, y and z.
        offset: of the chunk in the file, bytes.
        n_bytes: of the chunk.
        n_points: in the chunk.
    """

    level: int
    place: tuple[int, int, int]
    offset: int
    n_bytes: int
    n_points: int


@dataclass(frozen=True, kw_only=True)
class Octree:
    """All nodes of a file that hold points.

    Attributes:
        nodes: in the order of the file.
        low: (3,) lowest corner of the root, in the file's unit.
        side: of the root.
        spacing: between the points of the root.
    """

    nodes: tuple[Node, ...]
    low: NDArray[np.float64]
    side: float
    spacing: float

    def chosen(self, wish: Wish) -> tuple[Node, ...]:
        """Return the requested nodes with points, in the order of the file.

        The first level whose points are no farther apart than requested is the last one. If no node
        meets the box, the root is returned, whose points show where the cloud is.
        """
        last = _LEVELS_MOST
        if wish.spacing is not None:
            # One by one: a damaged file's spacing may be so large that the quotient is not finite.
            levels = math.log2(self.spacing) - math.log2(wish.spacing)
            last = max(0, math.ceil(levels - 1e-9))
        found = [node for node in self.nodes if node.level <= last and self._meets(node, wish)]
        return tuple(found or [node for node in self.nodes if node.level == 0])

    def _meets(self, node: Node, wish: Wish) -> bool:
        if wish.box is None:
            return True
        side = self.side / 2.0**node.level
        low = self.low + side * np.array(node.place)
        # Coordinates are rounded to steps of the file.
        slack = 1e-6 * self.side
        return bool(
            np.all(wish.box[0] <= low + side + slack) and np.all(wish.box[1] >= low - slack)
        )


def read_octree(path: Path, chunks: Collection[tuple[int, int, int]]) -> Octree | None:
    """Read the octree of a LAZ file; None if it has none.

    Args:
        path: the file, whose header has been checked.
        chunks: offset, bytes and points of each of its chunks.

    Raises:
        InputError: the octree does not fit the file.
    """
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES + _RECORD.size + _INFO.size)
    if len(start) < _HEADER_BYTES + _RECORD.size + _INFO.size:
        return None
    _, user, record, _, _ = _RECORD.unpack_from(start, _HEADER_BYTES)
    if user.rstrip(b"\0") != b"copc" or record != 1:
        return None
    *middle, half, spacing, offset, n_bytes = _INFO.unpack_from(start, _HEADER_BYTES + _RECORD.size)
    sizes = np.array([*middle, half, spacing])
    if not (np.isfinite(sizes).all() and half > 0.0 and spacing > 0.0):
        raise _damaged(path, "its root has no size")
    nodes = _read_nodes(path, (offset, n_bytes))
    if not {(node.offset, node.n_bytes, node.n_points) for node in nodes} <= set(chunks):
        raise _damaged(path, "it names chunks that the file does not have")
    nodes.sort(key=lambda node: node.offset)
    return Octree(nodes=tuple(nodes), low=np.array(middle) - half, side=2.0 * half, spacing=spacing)


def _read_nodes(path: Path, root: tuple[int, int]) -> list[Node]:
    n_file = n_left = path.stat().st_size
    nodes: dict[tuple[int, ...], Node] = {}
    pages, seen = [root], {root}
    with path.open("rb") as file:
        while pages:
            offset, n_bytes = pages.pop()
            # Pages are adjacent, so that together they are no longer than the file.
            n_left -= n_bytes
            if offset + n_bytes > n_file or n_left < 0:
                raise _damaged(path, "its pages lie outside the file")
            file.seek(offset)
            page = file.read(n_bytes // _ENTRY.size * _ENTRY.size)
            for level, x, y, z, begin, size, count in _ENTRY.iter_unpack(page):
                if not (0 <= level < _LEVELS_MOST and min(x, y, z) >= 0 and size >= 0):
                    raise _damaged(path, "a node lies outside the root")
                if max(x, y, z) >= 2**level or count < _PAGE:
                    raise _damaged(path, "a node lies outside the root")
                if count == _PAGE and (begin, size) not in seen:
                    seen.add((begin, size))
                    pages.append((begin, size))
                elif count > 0:
                    nodes[level, x, y, z] = Node(
                        level=level, place=(x, y, z), offset=begin, n_bytes=size, n_points=count
                    )
    if not nodes:
        raise _damaged(path, "it has no nodes")
    return list(nodes.values())


def _damaged(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path.name} cannot be read as COPC: its octree is damaged, {reason}; copy or export it "
        "again, or leave out box and gsd_m, without which all of its points are read"
    )
