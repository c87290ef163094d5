"""Versions of the libraries that change what matching finds."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import Final

_OPENCV: Final = ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless")


def opencv_version() -> dict[str, str]:
    """OpenCV's distribution and version, whichever of its distributions is installed."""
    for name in _OPENCV:
        try:
            return {name: version(name)}
        except PackageNotFoundError:
            continue
    return {}
