"""Points of LAS and LAZ files in the order of the file; large compressed ones by several processes.

The decompressor keeps Python's lock while it decodes, so that in one process nothing else gets on
meanwhile. Of a large file other processes decode blocks of whole chunks, in turns, into memory that
they share with this one, which converts and stores a block while the next ones are decoded.

Of point formats 6 and up, whose fields are compressed apart, only the fields are decoded that make
a cloud.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoflow.files.points.blocks import BLOCK_POINTS
from orthoflow.files.points.foreign import load_library

_WORKER: Final = Path(__file__).with_name("las_worker.py")
# Blocks that a process may be ahead.
_SLOTS: Final = 2
# Files with fewer blocks are read before other processes would be up.
_BLOCKS_LEAST: Final = 8
# Chunks much larger than a block would be decoded again for each block that begins within.
_LARGEST_CHUNK: Final = 2 * BLOCK_POINTS
_PROCESSES_MOST: Final = 16


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """What other processes must know of a compressed file.

    Attributes:
        step: points of a block; whole chunks.
        start: of the compressed points in the file, bytes.
        record: description of the compression, as the file has it.
        point_bytes: of a point that is not compressed.
    """

    step: int
    start: int
    record: bytes
    point_bytes: int


def records(path: Path, laspy: Any, *, cores: int) -> Iterator[Any]:
    """Give laspy's records of up to `BLOCK_POINTS` points each, in the order of the file.

    A record is to be done with before the next one is asked for.

    Args:
        path: the file; its header and chunk table have been checked.
        laspy: the library.
        cores: processes that may decode at the same time.

    Raises:
        BaseException: whatever the library throws at a damaged file.
    """
    fields = laspy.DecompressionSelection
    wanted = fields.base().decompress_z().decompress_flags()
    wanted = wanted.decompress_intensity().decompress_rgb()
    with laspy.open(path, decompression_selection=wanted) as reader:
        # Where memory cannot be shared without a name, this process decodes all by itself.
        is_shared_out = cores > 1 and hasattr(os, "memfd_create")
        layout = _layout(path, reader.header) if is_shared_out else None
        if layout is None:
            yield from reader.chunk_iterator(BLOCK_POINTS)
        else:
            n_processes = min(cores, _PROCESSES_MOST)
            yield from _decoded_elsewhere(path, laspy, reader.header, layout, n_processes)


def _layout(path: Path, header: Any) -> _Layout | None:
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
        record=record,
        point_bytes=int(header.point_format.size),
    )


class _Decoder:
    """A process that decodes every n-th block into memory shared with it."""

    def __init__(
        self, path: Path, layout: _Layout, *, first: int, stride: int, n_points: int
    ) -> None:
        slot_bytes = layout.step * layout.point_bytes
        shared = os.memfd_create("points")
        try:
            os.ftruncate(shared, _SLOTS * slot_bytes)
            self._memory = mmap.mmap(shared, _SLOTS * slot_bytes)
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-P", str(_WORKER), str(path), str(shared)),
                    *(str(layout.start), layout.record.hex()),
                    *(str(slot_bytes), str(layout.step), str(layout.point_bytes)),
                    *(str(first), str(stride), str(n_points)),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                pass_fds=(shared,),
                # It imports what this process would, wherever that came from.
                env=dict(os.environ) | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            )
        finally:
            os.close(shared)
        self._slot_bytes = slot_bytes
        self._slot = 0
        for _ in range(_SLOTS):
            self.allow()

    def allow(self) -> None:
        """Let it decode one more block, since the oldest one is done with."""
        assert self._process.stdin is not None  # noqa: S101 - of a pipe that was asked for
        # Where it has ended, the next block says why.
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(b"\n")

    def block(self, n_bytes: int) -> memoryview:
        """Wait for its next block.

        Raises:
            ValueError: the decompressor failed, with what it said.
        """
        assert self._process.stdout is not None  # noqa: S101 - as above
        said = self._process.stdout.readline().decode("utf-8", errors="replace").strip()
        if said != "decoded":
            raise ValueError(said or f"its decoder ended with {self._process.wait()}")
        start = self._slot * self._slot_bytes
        self._slot = (self._slot + 1) % _SLOTS
        return memoryview(self._memory)[start : start + n_bytes]

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.wait()


def _decoded_elsewhere(
    path: Path, laspy: Any, header: Any, layout: _Layout, n_processes: int
) -> Iterator[Any]:
    with contextlib.ExitStack() as stack:
        decoders = []
        for first in range(n_processes):
            decoder = _Decoder(
                path, layout, first=first, stride=n_processes, n_points=header.point_count
            )
            stack.callback(decoder.close)
            decoders.append(decoder)
        for block, start in enumerate(range(0, header.point_count, layout.step)):
            decoder = decoders[block % n_processes]
            count = min(layout.step, header.point_count - start)
            decoded = decoder.block(count * layout.point_bytes)
            yield laspy.ScaleAwarePointRecord(
                np.frombuffer(decoded, dtype=header.point_format.dtype()),
                header.point_format,
                header.scales,
                header.offsets,
            )
            decoder.allow()
