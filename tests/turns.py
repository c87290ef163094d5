"""The eight ways in which a raster may be turned and mirrored, of arrays and of what lies on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tests.long_loops import long_only

_Value = TypeVar("_Value", bound=np.generic)


@dataclass(frozen=True)
class Turn:
    """Mirrored, left for right, and then turned to the left by quarters."""

    is_mirrored: bool
    quarters: int

    def raster(self, values: NDArray[_Value]) -> NDArray[_Value]:
        seen = values[:, ::-1] if self.is_mirrored else values
        return np.ascontiguousarray(np.rot90(seen, self.quarters))

    def places(self, places: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
        """Places (n, 2) = (column, row) on a raster of a shape, where they come to lie."""
        (column, row), (height, width) = places.T, shape
        if self.is_mirrored:
            column = width - column
        for _ in range(self.quarters):
            column, row = row, width - column
            height, width = width, height
        return np.column_stack([column, row])

    def shape(self, shape: tuple[int, int]) -> tuple[int, int]:
        return shape[::-1] if self.quarters % 2 else shape

    def __str__(self) -> str:
        return f"{'mirrored ' if self.is_mirrored else ''}{90 * self.quarters} deg"


TURNS = [Turn(is_mirrored, quarters) for is_mirrored in (False, True) for quarters in range(4)]
# A quarter and a mirror image lead to all others, which only the long run tries.
OTHER_TURNS = [TURNS[1], TURNS[4], *long_only(*(TURNS[k] for k in (2, 3, 5, 6, 7)))]
