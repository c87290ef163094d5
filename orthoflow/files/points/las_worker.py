"""Run as a program: decodes blocks of a LAZ file into shared memory, one for each line of input.

It imports nothing but the decompressor, so that it is up at once.
"""

from __future__ import annotations

import importlib
import mmap
import os
import sys


def main() -> None:
    """Decode until there are no more blocks, or nobody asks for them."""
    shared, slot_bytes_text, path, start, has_classes, record, *numbers = sys.argv[1:]
    slot_bytes = int(slot_bytes_text)
    step, point_bytes, first, stride, n_points = (int(text) for text in numbers)
    try:
        lazrs = importlib.import_module("lazrs")
        memory = memoryview(mmap.mmap(int(shared), 0))
        fields = (
            lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL
            | lazrs.SELECTIVE_DECOMPRESS_Z
            | lazrs.SELECTIVE_DECOMPRESS_FLAGS
            | lazrs.SELECTIVE_DECOMPRESS_INTENSITY
            | lazrs.SELECTIVE_DECOMPRESS_RGB
            | int(has_classes) * lazrs.SELECTIVE_DECOMPRESS_CLASSIFICATION
        )
        with open(path, "rb") as source:  # noqa: PTH123 - pathlib would take longer than the rest
            source.seek(int(start))
            decompressor = lazrs.LasZipDecompressor(
                source, bytes.fromhex(record), lazrs.DecompressionSelection(fields)
            )
            for turn, block in enumerate(range(first, -(-n_points // step), stride)):
                if not sys.stdin.readline():
                    return
                count = min(step, n_points - block * step)
                begins = turn % (len(memory) // slot_bytes) * slot_bytes
                decompressor.seek(block * step)
                decompressor.decompress_many(memory[begins : begins + count * point_bytes])
                _say("decoded")
    except BaseException as error:  # noqa: BLE001 - a panic in Rust is not an Exception
        _say(" ".join(str(error).split()) or type(error).__name__)


def _say(text: str) -> None:
    try:
        os.write(1, f"{text}\n".encode())
    except BrokenPipeError:
        sys.exit(0)


if __name__ == "__main__":
    main()
