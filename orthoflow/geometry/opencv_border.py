"""The border to OpenCV, which has the centre of the first pixel at (0, 0) instead of (0.5, 0.5)."""

from __future__ import annotations

from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

# What a pixel coordinate of ours is larger by.
HALF_PIXEL: Final = 0.5


class Lens(Protocol):
    """What a camera matrix is made of: pixels, first pixel centre at (0.5, 0.5)."""

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
    """Pixel coordinates of ours as OpenCV counts them; the type stays."""
    return pixels - HALF_PIXEL


def from_opencv(pixels: NDArray[Any]) -> NDArray[Any]:
    """OpenCV's pixel coordinates as ours; the type stays."""
    return pixels + HALF_PIXEL


def opencv_matrix(lens: Lens) -> NDArray[np.float64]:
    """Camera matrix (3, 3) for OpenCV, whose own functions overlook the skew in it."""
    return np.array(
        [
            [lens.fx, lens.skew or 0.0, lens.cx - HALF_PIXEL],
            [0.0, lens.fy, lens.cy - HALF_PIXEL],
            [0.0, 0.0, 1.0],
        ]
    )
