"""Run as a program: reads point files, one block for each line of input, into shared memory.

The first line says which.
"""

from __future__ import annotations

import json
import mmap
import os
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from orthoflow.errors import OrthoflowError
from orthoflow.files.points.blocks import PointBlock
from orthoflow.files.points.columns import Columns
from orthoflow.files.points.formats import open_scan


def main() -> None:
    """Read until there are no more files, or nobody asks for blocks."""
    # What libraries print must not come between the lines.
    lines = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    shared, slot_bytes, told = int(sys.argv[1]), int(sys.argv[2]), json.loads(sys.stdin.readline())
    memory = memoryview(mmap.mmap(shared, 0))
    slots = [memory[k : k + slot_bytes] for k in range(0, len(memory), slot_bytes)]
    columns = None
    if told["columns"] is not None:
        columns = Columns(names=tuple(told["columns"]["names"]), rule=told["columns"]["rule"])
    n_written = 0

    def say(message: dict[str, Any]) -> None:
        lines.write(json.dumps(message) + "\n")
        lines.flush()

    try:
        for path in told["paths"]:
            scan = open_scan(Path(path), columns)
            with np.errstate(all="ignore"):
                for block in scan.read():
                    if not sys.stdin.readline():
                        return
                    say(_written(block, slots[n_written % len(slots)]))
                    n_written += 1
            say({"end": scan.notes})
    except OrthoflowError as error:
        say({"refused": str(error)})
    except (BrokenPipeError, KeyboardInterrupt):
        sys.exit(0)


def _written(block: PointBlock, slot: memoryview) -> dict[str, Any]:
    """Copy a block's arrays into a slot; give what is needed to find them there."""
    message: dict[str, Any] = {}
    place = 0
    for field in fields(block):
        value = getattr(block, field.name)
        if not isinstance(value, np.ndarray):
            message[field.name] = value.item() if isinstance(value, np.generic) else value
            continue
        message[field.name] = [value.dtype.str, value.shape, place]
        into = np.frombuffer(slot, value.dtype, value.size, place).reshape(value.shape)
        np.copyto(into, value)
        # Arrays begin where the next one's numbers are whole words.
        place += -(-value.nbytes // 8) * 8
    return message


if __name__ == "__main__":
    main()
