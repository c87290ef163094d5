"""Where the number of a contour stands on it: where it is long and straight, apart from others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

# A contour has so many times the width of its number, else it has none.
_LEAST_WIDTHS: Final = 5.0
_APART_MM: Final = 12.0
_TRIED: Final = (0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875)
# The chord over the length of the line below a number, at least: it would lie beside it else.
_STRAIGHT: Final = 0.9


@dataclass(frozen=True, kw_only=True)
class LabelPlace:
    """Where a number stands.

    Attributes:
        middle_mm: of the number, on the paper.
        turned_deg: counter-clockwise, so that it is never upside down.
    """

    middle_mm: tuple[float, float]
    turned_deg: float


def label_place(
    points_mm: NDArray[np.float64], wide_mm: float, placed_mm: Sequence[NDArray[np.float64]]
) -> LabelPlace | None:
    """Find a place for a number on a line, None where there is none.

    Args:
        points_mm: the line, (n, 2) on the paper.
        wide_mm: how wide the number is.
        placed_mm: the middles of other numbers, (2,) each.
    """
    steps = np.linalg.norm(np.diff(points_mm, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    if along[-1] < _LEAST_WIDTHS * wide_mm:
        return None
    for share in _TRIED:
        middle = share * along[-1]
        ends = np.array(
            [
                [
                    np.interp(middle + side * 0.5 * wide_mm, along, points_mm[:, axis])
                    for axis in (0, 1)
                ]
                for side in (-1.0, 1.0)
            ]
        )
        chord = ends[1] - ends[0]
        place = ends.mean(axis=0)
        if float(np.linalg.norm(chord)) < _STRAIGHT * wide_mm:
            continue
        if any(float(np.linalg.norm(place - other)) < _APART_MM for other in placed_mm):
            continue
        turned_deg = math.degrees(math.atan2(chord[1], chord[0]))
        if not -90.0 < turned_deg <= 90.0:
            turned_deg -= math.copysign(180.0, turned_deg)
        return LabelPlace(middle_mm=(float(place[0]), float(place[1])), turned_deg=turned_deg)
    return None
