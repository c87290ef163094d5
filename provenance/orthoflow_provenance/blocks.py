"""Walking arrays of any size and memory layout in C order, a few megabytes at a time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

BLOCK_BYTES: Final = 8 << 20

Index: TypeAlias = tuple[int | slice, ...]


def block_indices(shape: tuple[int, ...], itemsize: int) -> Iterator[Index]:
    """Give indices that cut an array into blocks of at most about 8 MiB.

    Joined in order, the blocks' elements are the array's elements in C order. An array without
    elements has no blocks; a scalar has one, `()`.

    >>> list(block_indices((3,), 8))
    [(slice(0, 3, None),)]
    """
    if math.prod(shape) == 0:
        return
    if not shape:
        yield ()
        return
    row_bytes = itemsize * math.prod(shape[1:])
    if row_bytes > BLOCK_BYTES:
        for index in range(shape[0]):
            for rest in block_indices(shape[1:], itemsize):
                yield (index, *rest)
        return
    step = max(1, BLOCK_BYTES // row_bytes)
    for start in range(0, shape[0], step):
        yield (slice(start, min(start + step, shape[0])),)


def little_endian(dtype: np.dtype[np.generic]) -> np.dtype[np.generic]:
    """Give the dtype with its bytes in little-endian order."""
    return dtype.newbyteorder("<")


def byte_blocks(array: NDArray[np.generic]) -> Iterator[NDArray[np.uint8]]:
    """Give the array's bytes: little-endian, C order, flat.

    A contiguous little-endian array is given whole and not copied, memory-mapped or not; any other
    is copied block by block.
    """
    wanted = little_endian(array.dtype)
    if array.size == 0:
        return
    if array.flags.c_contiguous and array.dtype == wanted:
        yield _as_bytes(array)
        return
    for index in block_indices(array.shape, array.dtype.itemsize):
        yield _as_bytes(np.ascontiguousarray(array[index], dtype=wanted))


def _as_bytes(array: NDArray[np.generic]) -> NDArray[np.uint8]:
    return np.asarray(array).reshape(-1).view(np.uint8)
