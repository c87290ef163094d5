"""Conversion to and from OpenCV, where the centre of the first pixel is (0, 0), not (0.5, 0.5)."""

from __future__ import annotations

from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

# Difference between our pixel coordinates and OpenCV's.
HALF_PIXEL: Final = 0.5


class Lens(Protocol):
    """The elements of a camera matrix: pixels, first pixel centre at (0.5, 0.5)."""

    @property
    def fx(self) -> float: ...  # noqa: D102 - as `Intrinsics` has it
    @property
    def fy(self) -> float: ...  # noqa: D102
    @property
    def cx(self) -> float: ...  # noqa: D102
    @property
    def cy(self) -> float: ...  # noqa: D102
    @property
    def skew(self) -> float | None: ...  # noqa: D102


def to_opencv(pixels: NDArray[Any]) -> NDArray[Any]:
    """Convert our pixel coordinates to OpenCV's; the type is kept."""
    return pixels - HALF_PIXEL


def from_opencv(pixels: NDArray[Any]) -> NDArray[Any]:
    """Convert OpenCV's pixel coordinates to ours; the type is kept."""
    return pixels + HALF_PIXEL


def opencv_matrix(lens: Lens) -> NDArray[np.float64]:
    """Return the camera matrix (3, 3) for OpenCV, whose own functions ignore the skew in it."""
    return np.array(
        [
            [lens.fx, lens.skew or 0.0, lens.cx - HALF_PIXEL],
            [0.0, lens.fy, lens.cy - HALF_PIXEL],
            [0.0, 0.0, 1.0],
        ]
    )
