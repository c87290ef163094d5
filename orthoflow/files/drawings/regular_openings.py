"""Openings in regular form, as rectangles and arches with their deviation stated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

_SAMPLE_M: Final = 0.01
# Permitted deviation of a side from a straight line: stones and outlines are about this accurate.
_TOLERANCE_M: Final = 0.02
_SPRINGINGS: Final = 40
_ARC_POINTS: Final = 33


@dataclass(frozen=True, kw_only=True)
class RegularOpening:
    """An opening of a wall in regular form.

    Attributes:
        kind: `rectangle`, `arch` (a rectangle under a circular segment), or `outline` if neither
            fits.
        outline_m: (n, 2) X and Y, counter-clockwise, not closed; an arch has its arc as a polygon.
        deviation_m: largest distance of the found outline from this one.
    """

    kind: Literal["rectangle", "arch", "outline"]
    outline_m: NDArray[np.float64]
    deviation_m: float


def regular_opening(outline_m: NDArray[np.float64], sigma_m: float | None) -> RegularOpening:
    """Fit a rectangle, or else an arch, to an outline.

    Args:
        outline_m: (n, 2) X and Y of an upright wall, counter-clockwise.
        sigma_m: standard deviation of its sides, None if unknown.

    A form is accepted if 95 % of the outline is within three sigma, at least 20 mm, of it.
    """
    limit_m = max(_TOLERANCE_M, 3.0 * (sigma_m or 0.0))
    samples, directions = _sampled(outline_m)
    left, bottom, right, top = _sides(samples, directions)
    forms: list[tuple[Literal["rectangle", "arch"], NDArray[np.float64]]] = []
    if right > left and top > bottom:
        box = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        forms.append(("rectangle", box))
        forms += [("arch", arch) for arch in _arches(samples, left, bottom, right)]
    judged = [(kind, form, _distances(samples, form)) for kind, form in forms]
    for wanted in ("rectangle", "arch"):
        fitting = [
            (float(np.percentile(far, 95.0)), form, float(far.max()))
            for kind, form, far in judged
            if kind == wanted
        ]
        if fitting:
            share, form, largest = min(fitting, key=lambda one: one[0])
            if share <= limit_m:
                return RegularOpening(kind=wanted, outline_m=form, deviation_m=largest)
    return RegularOpening(kind="outline", outline_m=outline_m, deviation_m=0.0)


def _sampled(outline_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points along an outline, and the direction of the side of each."""
    points, directions = [], []
    for begin, end in zip(outline_m, np.roll(outline_m, -1, axis=0), strict=True):
        length = float(np.linalg.norm(end - begin))
        if length > 0.0:
            count = max(2, int(length / _SAMPLE_M))
            shares = (np.arange(count) + 0.5) / count
            points.append(begin + shares[:, None] * (end - begin))
            directions.append(np.tile((end - begin) / length, (count, 1)))
    return np.concatenate(points), np.concatenate(directions)


def _sides(
    samples: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    """Return left, bottom, right and top, each the median of the samples of that side.

    In a counter-clockwise outline the left side goes down, the lower one right, and so on.
    """
    found = []
    for axis, direction in ((0, (0.0, -1.0)), (1, (1.0, 0.0)), (0, (0.0, 1.0)), (1, (-1.0, 0.0))):
        own = samples[directions @ np.array(direction) > 0.9, axis]
        is_low = direction in ((0.0, -1.0), (1.0, 0.0))
        edge = samples[:, axis].min() if is_low else samples[:, axis].max()
        found.append(float(np.median(own)) if len(own) else float(edge))
    return found[0], found[1], found[2], found[3]


def _arches(
    samples: NDArray[np.float64], left: float, bottom: float, right: float
) -> list[NDArray[np.float64]]:
    """Rectangles under circular segments with the apex of the outline, for springing heights."""
    apex = float(samples[:, 1].max())
    half = 0.5 * (right - left)
    rises = np.linspace(0.0, min(half, apex - bottom), _SPRINGINGS + 1)[1:]
    found = []
    for rise in rises.tolist():
        radius = (half**2 + rise**2) / (2.0 * rise)
        middle = np.array([left + half, apex - radius])
        angle = np.arcsin(min(1.0, half / radius))
        turns = np.linspace(angle, -angle, _ARC_POINTS)
        arc = middle + radius * np.column_stack([np.sin(turns), np.cos(turns)])
        found.append(np.vstack([[left, bottom], [right, bottom], arc]))
    return found


def _distances(points: NDArray[np.float64], outline: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return distances (n,) of points from a closed outline."""
    nearest = np.full(len(points), np.inf)
    for begin, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        side = end - begin
        square = float(side @ side)
        if square > 0.0:
            share = np.clip((points - begin) @ side / square, 0.0, 1.0)
            away = points - begin - share[:, None] * side
            nearest = np.minimum(nearest, np.linalg.norm(away, axis=1))
    return nearest
