"""Several photos or walls at once, their results in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final, TypeVar

from orthoflow.geometry.threads import in_order

# Each works on a picture of its own, which takes up to a gigabyte.
_MOST: Final = 4

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def n_workers(cores: int) -> int:
    """How many pictures are worked on at once."""
    return max(1, min(cores, _MOST))


def one_by_one(
    function: Callable[[_Item], _Result], items: Sequence[_Item], cores: int
) -> Iterator[_Result]:
    """Give a function's results item by item, several computed at once in threads.

    OpenCV's own threads help little with pictures of this size: each worker gets its share of
    them, and the rest is Python's.
    """
    import cv2

    workers = n_workers(cores)
    cv2.setNumThreads(max(1, cores // workers))
    yield from in_order(function, items, threads=workers)
