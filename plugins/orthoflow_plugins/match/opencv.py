"""OpenCV as the matchers use it: several pictures at once, results in order, and its version."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Final, TypeVar

from orthoflow.geometry.threads import in_order

_OPENCV: Final = ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless")
# Each works on a picture of its own, which takes up to a gigabyte.
_MOST: Final = 4

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def one_by_one(
    function: Callable[[_Item], _Result], items: Sequence[_Item], cores: int
) -> Iterator[_Result]:
    """Give a function's results item by item, several computed at once in threads.

    OpenCV's own threads help little with pictures of this size: each worker gets its share of
    them, and the rest is Python's.
    """
    import cv2

    workers = max(1, min(cores, _MOST))
    cv2.setNumThreads(max(1, cores // workers))
    yield from in_order(function, items, threads=workers)


def opencv_version() -> dict[str, str]:
    """OpenCV's distribution and version, whichever of its distributions is installed."""
    for name in _OPENCV:
        try:
            return {name: version(name)}
        except PackageNotFoundError:
            continue
    return {}
