"""Paper, scale, and which part of a wall each sheet shows."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from orthoflow.errors import ArgumentError

SIZES_MM: Final = {
    "A0": (1189.0, 841.0),
    "A1": (841.0, 594.0),
    "A2": (594.0, 420.0),
    "A3": (420.0, 297.0),
    "A4": (297.0, 210.0),
}
MOST_SHEETS: Final = 200
SCALES: Final = (1, 2, 5, 10, 20, 25, 50, 100, 200, 250, 500, 1000, 2000, 5000, 10_000)
_EDGE_MM: Final = (150.0, 5000.0)
MARGIN_MM: Final = 10.0
# Around a picture: for its frame and the coordinates beside it.
LABELS_MM: Final = 9.0


@dataclass(frozen=True, kw_only=True)
class Paper:
    """A sheet of paper.

    Attributes:
        width_mm: of the sheet as it is read.
        height_mm: likewise.
    """

    width_mm: float
    height_mm: float

    @property
    def column_mm(self) -> float:
        """Width of the column with the title block."""
        return min(180.0, max(62.0, 0.24 * self.width_mm))

    @property
    def area_mm(self) -> tuple[float, float]:
        """Width and height that pictures can take."""
        width_mm = self.width_mm - 2 * MARGIN_MM - self.column_mm - 2 * LABELS_MM
        return width_mm, self.height_mm - 2 * MARGIN_MM - 2 * LABELS_MM

    @property
    def turned(self) -> Paper:
        """The same paper, upright instead of lying, or lying instead of upright."""
        return Paper(width_mm=self.height_mm, height_mm=self.width_mm)


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a wall's raster, metres from its top-left corner, to the right and down."""

    left_m: float
    top_m: float
    right_m: float
    bottom_m: float

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height."""
        return self.right_m - self.left_m, self.bottom_m - self.top_m


@dataclass(frozen=True, kw_only=True)
class View:
    """A picture on a sheet.

    Attributes:
        kind: which picture of the wall: `ortho`, `depth`, `intensity`.
        part: what of the wall it shows.
        corner_mm: its bottom-left corner on the paper, from the paper's.
    """

    kind: str
    part: Part
    corner_mm: tuple[float, float]


def paper_of(text: str) -> Paper:
    """Read the name of a paper, `A0` to `A4`, or its width and height as `700x500`, in mm.

    Raises:
        ArgumentError: it is neither.
    """
    if text.upper() in SIZES_MM:
        width_mm, height_mm = SIZES_MM[text.upper()]
        return Paper(width_mm=width_mm, height_mm=height_mm)
    found = re.fullmatch(r"(\d{2,4}(?:\.\d+)?)x(\d{2,4}(?:\.\d+)?)", text)
    low, high = _EDGE_MM
    if found and all(low <= float(edge) <= high for edge in found.groups()):
        return Paper(width_mm=float(found[1]), height_mm=float(found[2]))
    raise ArgumentError(
        f"--paper must be {', '.join(SIZES_MM)}, or width x height of {low:g} to {high:g} mm such "
        f"as 700x500, got {text[:100]!r}"
    )


def fitting_scale(sizes_m: Sequence[tuple[float, float]], paper: Paper) -> int:
    """The largest usual scale, 1 : n, at which each of some walls fits onto one sheet; gives n."""
    for scale in SCALES:
        if all(
            any(_fits(size, scale, way.area_mm) for way in (paper, paper.turned))
            for size in sizes_m
        ):
            return scale
    return SCALES[-1]


def placed_views(
    kinds: Sequence[str],
    size_m: tuple[float, float],
    paper: Paper,
    *,
    scale: int,
    grid_m: float,
) -> tuple[Paper, tuple[tuple[View, ...], ...]]:
    """Lay the pictures of a wall onto sheets: all onto one, else each onto as many as it needs.

    Args:
        kinds: the pictures.
        size_m: width and height of the wall's raster.
        paper: of the sheets; it is turned where that saves some.
        scale: n of 1 : n.
        grid_m: where a wall is cut, it is cut at whole steps of the grid; 0 for anywhere.

    Returns:
        The paper, perhaps turned, and the views of each sheet.

    Raises:
        ArgumentError: it takes more than `MOST_SHEETS`.
    """
    ways = [(way, _sheets(kinds, size_m, way, scale, grid_m)) for way in (paper, paper.turned)]
    return min(ways, key=lambda way: len(way[1]))


def _fits(size_m: tuple[float, float], scale: int, area_mm: tuple[float, float]) -> bool:
    return all(
        # A micrometre of slack: 12.0 m at 1:50 are 240.00000000000003 mm.
        1e3 * edge / scale <= limit + 1e-3
        for edge, limit in zip(size_m, area_mm, strict=True)
    )


def paper_for_one(walls: Sequence[tuple[Sequence[str], tuple[float, float]]], scale: int) -> str:
    """Name the smallest usual paper that takes each wall on one sheet; empty where none does.

    Args:
        walls: the pictures of each, and width and height of its raster.
        scale: n of 1 : n.
    """
    for name in reversed(SIZES_MM):
        paper = paper_of(name)
        if all(
            any(_on_one(kinds, size_m, way, scale) for way in (paper, paper.turned))
            for kinds, size_m in walls
        ):
            return name
    return ""


def _sheets(
    kinds: Sequence[str], size_m: tuple[float, float], paper: Paper, scale: int, grid_m: float
) -> tuple[tuple[View, ...], ...]:
    together = _on_one(kinds, size_m, paper, scale)
    if together:
        return (together,)
    parts = _parts(size_m, paper.area_mm, scale, grid_m)
    return tuple((_alone(kind, part, paper, scale),) for kind in kinds for part in parts)


def _on_one(
    kinds: Sequence[str], size_m: tuple[float, float], paper: Paper, scale: int
) -> tuple[View, ...]:
    """The pictures of a wall beside or below each other on one sheet; none if they do not fit."""
    area = paper.area_mm
    whole = Part(left_m=0.0, top_m=0.0, right_m=size_m[0], bottom_m=size_m[1])
    wide, high = (1e3 * edge / scale for edge in size_m)
    gap, count = 2 * LABELS_MM, len(kinds)
    for columns, rows in ((count, 1), (1, count)):
        needed = (columns * wide + (columns - 1) * gap, rows * high + (rows - 1) * gap)
        if needed[0] <= area[0] + 1e-3 and needed[1] <= area[1] + 1e-3:
            left = MARGIN_MM + LABELS_MM + 0.5 * (area[0] - needed[0])
            top = paper.height_mm - MARGIN_MM - LABELS_MM - 0.5 * (area[1] - needed[1])
            return tuple(
                View(
                    kind=kind,
                    part=whole,
                    corner_mm=(
                        left + (place * (wide + gap) if rows == 1 else 0.0),
                        top - high - (place * (high + gap) if rows > 1 else 0.0),
                    ),
                )
                for place, kind in enumerate(kinds)
            )
    return ()


def _parts(
    size_m: tuple[float, float], area_mm: tuple[float, float], scale: int, grid_m: float
) -> list[Part]:
    """Parts of a wall in reading order, each no larger than an area on the paper."""
    steps = []
    for limit_mm in area_mm:
        step = limit_mm * scale / 1e3
        steps.append(step if not 0.0 < grid_m <= step else math.floor(step / grid_m) * grid_m)
    across, down = (
        max(1, math.ceil(size / step - 1e-6)) for size, step in zip(size_m, steps, strict=True)
    )
    if across * down > MOST_SHEETS:
        raise ArgumentError(
            f"a wall of {size_m[0]:.2f} x {size_m[1]:.2f} m takes {across * down:,} sheets at "
            f"1:{scale}, at most {MOST_SHEETS} are drawn: take a larger --paper or --scale"
        )
    return [
        Part(
            left_m=column * steps[0],
            top_m=row * steps[1],
            right_m=min(size_m[0], (column + 1) * steps[0]),
            bottom_m=min(size_m[1], (row + 1) * steps[1]),
        )
        for row in range(down)
        for column in range(across)
    ]


def _alone(kind: str, part: Part, paper: Paper, scale: int) -> View:
    """One picture at the top left of its sheet, where cut sheets meet when they are laid out."""
    high_mm = 1e3 * part.size_m[1] / scale
    return View(
        kind=kind,
        part=part,
        corner_mm=(
            MARGIN_MM + LABELS_MM,
            paper.height_mm - MARGIN_MM - LABELS_MM - high_mm,
        ),
    )


def nice_step(least: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is at least as large.

    >>> nice_step(0.3), nice_step(2.0), nice_step(60.0)
    (0.5, 2.0, 100.0)
    """
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least * (1 - 1e-9))
