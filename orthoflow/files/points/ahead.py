"""Point files read by another process, a block or two ahead of the one that keeps the points.

Libraries that decode hold Python's lock, so that threads would not do. One process reads all files
one after the other: it is the first of a file already while the last of the one before is stored.
LAZ files have decoders of their own, and are read where they are.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import BLOCK_POINTS, PointBlock, ScanFile
from orthoflow.files.points.columns import Columns
from orthoflow.files.points.decoders import Decoder, can_share_memory
from orthoflow.files.points.formats import LAS

_WORKER: Final = Path(__file__).with_name("ahead_worker.py")
# Fewer points are read before another process would be up.
_POINTS_LEAST: Final = 4_000_000
# Of a point: coordinates, colours, row and column as 64 bits, and an intensity; bounds and station.
_BLOCK_BYTES: Final = 72 * BLOCK_POINTS + 256
_KEPT: Final = ("station", "bounds")


@contextmanager
def read_ahead(
    files: Sequence[ScanFile], paths: Sequence[Path], columns: Columns | None, *, cores: int
) -> Iterator[list[ScanFile]]:
    """Give the files again, those that are not LAS or LAZ read by another process if it pays.

    They are to be read in their order. A block is to be done with before the next one is asked for.

    Args:
        files: opened by `open_scan`.
        paths: of the files.
        columns: what the columns of text files are, if the user says so.
        cores: that may be used; with one nothing changes.
    """
    others = [k for k, file in enumerate(files) if file.format_name != LAS.name]
    n_points = sum(files[k].n_most for k in others)
    if cores < 2 or n_points < _POINTS_LEAST or not can_share_memory():
        yield list(files)
        return
    told = {
        "paths": [str(paths[k].absolute()) for k in others],
        "columns": None if columns is None else asdict(columns),
    }
    order = json.dumps(told)
    with closing(Decoder(_WORKER, (), slot_bytes=_BLOCK_BYTES, order=order)) as decoder:
        yield [
            replace(file, read=partial(_blocks, decoder, file)) if k in others else file
            for k, file in enumerate(files)
        ]


def _blocks(decoder: Decoder, file: ScanFile) -> Iterator[PointBlock]:
    while True:
        line = decoder.line()
        if not line:
            raise InputError(
                f"{file.name} cannot be read as {file.format_name}: what reads it ended with "
                f"{decoder.ended_with()}; the file is damaged or cut off, copy or export it again"
            )
        said = json.loads(line)
        if "refused" in said:
            raise InputError(said["refused"])
        if "end" in said:
            file.notes.extend(said["end"])
            return
        yield _block(said, decoder.slot())
        decoder.allow()


def _block(said: dict[str, Any], slot: memoryview) -> PointBlock:
    arrays = {}
    for name, value in said.items():
        if isinstance(value, list):
            dtype, shape, place = value
            values = np.frombuffer(slot, np.dtype(dtype), math.prod(shape), place).reshape(shape)
            # What is said of a block as a whole outlives it.
            arrays[name] = values.copy() if name in _KEPT else values
    return PointBlock(**(said | arrays))
