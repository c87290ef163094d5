"""Paper, scale, and the part of a wall on each sheet."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, Literal

from orthoflow.errors import ArgumentError

Layout = Literal["column", "strip"]

SIZES_MM: Final = {
    "A0": (1189.0, 841.0),
    "A1": (841.0, 594.0),
    "A2": (594.0, 420.0),
    "A3": (420.0, 297.0),
    "A4": (297.0, 210.0),
}
# Of the elongated papers of ISO 5457 those that rolls of 297, 420 and 594 mm give.
LONG_MM: Final = {
    "A3.2": (594.0, 297.0),
    "A3.1": (841.0, 297.0),
    "A3.0": (1189.0, 297.0),
    "A2.1": (841.0, 420.0),
    "A2.0": (1189.0, 420.0),
    "A1.0": (1189.0, 594.0),
}
#: sheets of a picture of a wall
MOST_SHEETS: Final = 200
SCALES: Final = (1, 2, 5, 10, 20, 25, 50, 100, 200, 250, 500, 1000, 2000, 5000, 10_000)
# Inches to the foot: 12", 6", 3", 1 1/2", 1", 3/4" ... 1/16", and engineers' 1" = 20 ft ...
SCALES_FT: Final = (1, 2, 4, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 240, 480, 1200, 2400, 6000)
FOOT_M: Final = 0.3048
_EDGE_MM: Final = (150.0, 5000.0)
MARGIN_MM: Final = 10.0
# Around a picture: for its frame and the coordinates and heights beside it.
LEFT_MM: Final = 11.0
BELOW_MM: Final = 11.0
_AROUND_MM: Final = (LEFT_MM + 24.0, BELOW_MM + 11.0)


@dataclass(frozen=True, kw_only=True)
class Paper:
    """A sheet of paper and the position of its title block.

    Attributes:
        width_mm: width of the sheet in reading direction.
        height_mm: likewise.
        name: of the paper, empty for any other size.
        layout: the title block is in a column on the right, or in a strip along the lower edge.
        block_mm: width of that column, or height of that strip.
    """

    width_mm: float
    height_mm: float
    name: str = ""
    layout: Layout = "column"
    block_mm: float = 0.0

    @property
    def area_mm(self) -> tuple[float, float]:
        """Width and height available for pictures with their margins."""
        wide, high = self.width_mm - 2 * MARGIN_MM, self.height_mm - 2 * MARGIN_MM
        if self.layout == "column":
            return wide - self.block_mm, high
        return wide, high - self.block_mm

    @property
    def corner_mm(self) -> tuple[float, float]:
        """Bottom-left corner of that area on the paper."""
        return MARGIN_MM, MARGIN_MM + (self.block_mm if self.layout == "strip" else 0.0)

    @property
    def turned(self) -> Paper:
        """Return the same paper in the other orientation."""
        return replace(self, width_mm=self.height_mm, height_mm=self.width_mm)


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a drawn wall, metres from its top-left corner, to the right and down."""

    left_m: float
    top_m: float
    right_m: float
    bottom_m: float

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height."""
        return self.right_m - self.left_m, self.bottom_m - self.top_m

    @property
    def corners_m(self) -> list[tuple[float, float]]:
        """Its corners, metres to the right and down, from the top-left one clockwise."""
        xs, ys = (self.left_m, self.right_m), (self.top_m, self.bottom_m)
        return [(xs[0], ys[0]), (xs[1], ys[0]), (xs[1], ys[1]), (xs[0], ys[1])]


def whole_of(size_m: tuple[float, float]) -> Part:
    """Return all of a drawing of this width and height."""
    return Part(left_m=0.0, top_m=0.0, right_m=size_m[0], bottom_m=size_m[1])


@dataclass(frozen=True, kw_only=True)
class View:
    """A picture on a sheet.

    Attributes:
        kind: which picture of the drawing.
        part: the part of the wall.
        corner_mm: its bottom-left corner on the paper.
    """

    kind: str
    part: Part
    corner_mm: tuple[float, float]


def paper_of(text: str) -> Paper:
    """Parse the name of a paper, `A0` to `A4`, `A3.1` ..., or its size as `700x500`, in mm.

    Raises:
        ArgumentError: it is neither.
    """
    known = SIZES_MM | LONG_MM
    if (name := text.upper()) in known:
        return Paper(width_mm=known[name][0], height_mm=known[name][1], name=name)
    found = re.fullmatch(r"(\d{2,4}(?:\.\d+)?)x(\d{2,4}(?:\.\d+)?)", text)
    low, high = _EDGE_MM
    if found and all(low <= float(edge) <= high for edge in found.groups()):
        return Paper(width_mm=float(found[1]), height_mm=float(found[2]))
    raise ArgumentError(
        f"--paper must be {', '.join(known)}, or width x height of {low:g} to {high:g} mm such "
        f"as 700x500, got {text[:100]!r}"
    )


def usual_papers() -> list[Paper]:
    """Return usual papers, smallest first."""
    papers = SIZES_MM | LONG_MM
    return [paper_of(name) for name in sorted(papers, key=lambda name: math.prod(papers[name]))]


def placed(kinds: Sequence[str], part: Part, paper: Paper, scale: int) -> tuple[View, ...]:
    """Place pictures of a part of a wall beside or below each other; none if they are too large.

    Args:
        kinds: the pictures.
        part: the part.
        paper: paper of the sheet.
        scale: n of 1 : n.
    """
    wide, high = (
        1e3 * edge / scale + around for edge, around in zip(part.size_m, _AROUND_MM, strict=True)
    )
    across, up = paper.area_mm
    for columns, rows in ((len(kinds), 1), (1, len(kinds))):
        # A tolerance of a micrometre: 12.0 m at 1:50 are 240.00000000000003 mm.
        if columns * wide > across + 1e-3 or rows * high > up + 1e-3:
            continue
        left = paper.corner_mm[0] + 0.5 * (across - columns * wide) + LEFT_MM
        bottom = paper.corner_mm[1] + 0.5 * (up + rows * high) - high + BELOW_MM
        right_mm, down_mm = (wide, 0.0) if rows == 1 else (0.0, high)
        return tuple(
            View(kind=kind, part=part, corner_mm=(left + k * right_mm, bottom - k * down_mm))
            for k, kind in enumerate(kinds)
        )
    return ()


def cut_up(
    size_m: tuple[float, float], paper: Paper, *, scale: int, grid_m: float
) -> tuple[Part, ...]:
    """Distribute a wall evenly over as many sheets as it needs.

    Args:
        size_m: width and height of the drawn wall.
        paper: paper of the sheets.
        scale: n of 1 : n.
        grid_m: the wall is cut at whole steps of the grid if the sheets have room; 0 for anywhere.

    Raises:
        ArgumentError: it needs more than `MOST_SHEETS`.
    """
    limits = [
        1e-3 * scale * max(1.0, limit - around)
        for limit, around in zip(paper.area_mm, _AROUND_MM, strict=True)
    ]
    counts = [
        max(1, math.ceil(size / limit - 1e-6)) for size, limit in zip(size_m, limits, strict=True)
    ]
    if math.prod(counts) > MOST_SHEETS:
        raise ArgumentError(
            f"a wall of {size_m[0]:.2f} x {size_m[1]:.2f} m takes {math.prod(counts):,} sheets at "
            f"1:{scale}, at most {MOST_SHEETS} are drawn: take a larger --paper or --scale"
        )
    across, down = (
        _even_cuts(size, limit, count, grid_m)
        for size, limit, count in zip(size_m, limits, counts, strict=True)
    )
    return tuple(
        Part(left_m=left, top_m=top, right_m=right, bottom_m=bottom)
        for top, bottom in pairwise(down)
        for left, right in pairwise(across)
    )


def _even_cuts(size_m: float, limit_m: float, count: int, grid_m: float) -> list[float]:
    """Return where an edge is cut: into equal parts, or at whole steps of the grid if these fit."""
    step_m = size_m / count
    if grid_m > 0.0 and math.ceil(step_m / grid_m - 1e-9) * grid_m <= limit_m + 1e-9:
        step_m = math.ceil(step_m / grid_m - 1e-9) * grid_m
    return [*(place * step_m for place in range(count) if place * step_m < size_m), size_m]


def round_below(most: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is at most as large.

    >>> round_below(0.3), round_below(2.0), round_below(60.0)
    (0.2, 2.0, 50.0)
    """
    power = 10.0 ** math.floor(math.log10(most))
    return power * max(factor for factor in (1, 2, 5) if factor * power <= most * (1 + 1e-9))


def nice_step(least: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is at least as large.

    >>> nice_step(0.3), nice_step(2.0), nice_step(60.0)
    (0.5, 2.0, 100.0)
    """
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least * (1 - 1e-9))
