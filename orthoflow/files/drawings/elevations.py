"""Elevations: the walls of a room or the facades of a building unfolded at their true heights."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.papers import MARGIN_MM, SCALES, SIZES_MM, Paper, Part, paper_of
from orthoflow.files.drawings.pens import (
    POINTS_PER_MM,
    line,
    sheet_canvas,
    text_width_mm,
    write_text,
)
from orthoflow.files.drawings.printed_pictures import picture_file, write_picture
from orthoflow.files.drawings.words import Language, label
from orthoflow.geometry import WallFrame
from orthoflow.geometry.directions import basis_from_up

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

_GAP_MM: Final = 8.0
# For heights on the left, and for names, scale and origin below.
_LEFT_MM: Final = 20.0
_BELOW_MM: Final = 34.0
_TEXT_MM: Final = 2.5
# Walls this close to parallel follow each other along one facade.
_PARALLEL_DEG: Final = 10.0


@dataclass(frozen=True, kw_only=True)
class ElevationWall:
    """A wall of an elevation.

    Attributes:
        name: what it is called.
        frame: frame of its picture.
        raster: GeoTIFF of the picture.
    """

    name: str
    frame: WallFrame
    raster: Path

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height."""
        return self.frame.width * self.frame.gsd_m, self.frame.height * self.frame.gsd_m


def unfolded(
    walls: Sequence[ElevationWall], up: NDArray[np.float64]
) -> tuple[tuple[ElevationWall, ...], bool]:
    """Sort walls in the order in which a viewer who turns or walks to the right sees them.

    Inside a room the viewer turns clockwise, seen from above; around a building the facades follow
    each other counter-clockwise. The order begins after the widest gap of directions.

    Returns:
        The walls, and whether they form a room seen from inside.
    """
    e1, e2, _ = basis_from_up(up)
    middles = np.array([wall.frame.corners_world().mean(axis=0) for wall in walls])
    normals = np.array([wall.frame.normal_world for wall in walls])
    outwards = np.einsum("wi,wi->w", middles - middles.mean(axis=0), normals)
    is_inside = bool(outwards.sum() <= 0.0)
    looks = -normals
    turn = -1.0 if is_inside else 1.0
    angles = turn * np.degrees(np.arctan2(looks @ e2, looks @ e1)) % 360.0
    order = np.argsort(angles)
    gaps = np.diff(np.append(angles[order], angles[order[0]] + 360.0))
    order = np.roll(order, -(int(np.argmax(gaps)) + 1))
    groups: list[list[int]] = []
    for k in order.tolist():
        first = groups[-1][0] if groups else None
        if first is not None and _turned_deg(angles[k], angles[first]) <= _PARALLEL_DEG:
            groups[-1].append(k)
        else:
            groups.append([k])
    for group in groups:
        right = walls[group[0]].frame.u_world
        group.sort(key=lambda k: float(middles[k] @ right))
    return tuple(walls[k] for group in groups for k in group), is_inside


def _turned_deg(one: float, other: float) -> float:
    return abs(math.remainder(one - other, 360.0))


def elevation_scale(
    walls: Sequence[ElevationWall], up: NDArray[np.float64], scale: int | None, paper: str | None
) -> tuple[int, Paper, list[list[ElevationWall]]]:
    """Choose scale and paper, and the walls of each sheet.

    Without a scale, all walls are on one sheet of A3 (or the given paper) at the largest usual
    scale; with one, on the smallest paper that fits them, else on several sheets of A0.
    """
    rows = list(walls)
    low, high = _heights(walls, up)
    ways = [paper_of(paper)] if paper else [paper_of(name) for name in reversed(SIZES_MM)]
    ways = [turned for way in ways for turned in (way, way.turned)]
    if scale is None:
        first = paper_of(paper or "A3")
        scale = next(
            (
                n
                for n in SCALES
                if any(_fits(rows, high - low, way, n) for way in (first, first.turned))
            ),
            SCALES[-1],
        )
    way = next((way for way in ways if _fits(rows, high - low, way, scale)), None)
    if way is not None:
        return scale, way, [rows]
    way = paper_of(paper or "A0")
    sheets: list[list[ElevationWall]] = [[]]
    for wall in rows:
        if sheets[-1] and not _fits([*sheets[-1], wall], high - low, way, scale):
            sheets.append([])
        sheets[-1].append(wall)
    return scale, way, sheets


def _fits(walls: Sequence[ElevationWall], high_m: float, paper: Paper, scale: int) -> bool:
    wide_mm = sum(1e3 * wall.size_m[0] / scale for wall in walls) + _GAP_MM * (len(walls) - 1)
    return (
        wide_mm + _LEFT_MM + 2 * MARGIN_MM <= paper.width_mm
        and 1e3 * high_m / scale + _BELOW_MM + 2 * MARGIN_MM <= paper.height_mm
    )


def _heights(walls: Sequence[ElevationWall], up: NDArray[np.float64]) -> tuple[float, float]:
    """Return the heights of the lowest and the highest corner."""
    heights = np.array([wall.frame.corners_world() @ up for wall in walls])
    return float(heights.min()), float(heights.max())


def write_elevation(
    path: Path,
    walls: Sequence[ElevationWall],
    up: NDArray[np.float64],
    place: tuple[int, Paper],
    texts: tuple[str, Language],
) -> None:
    """Write one sheet as PDF.

    Args:
        path: output file.
        walls: from left to right.
        up: (3,) unit vector of the scan.
        place: n of 1 : n, and the paper.
        texts: one line about the origin of the data, and the language of labels.
    """
    scale, paper = place
    origin, language = texts
    low, high = _heights(walls, up)
    bottom = MARGIN_MM + _BELOW_MM
    left = MARGIN_MM + _LEFT_MM
    with tempfile.TemporaryDirectory() as scratch, sheet_canvas(path, paper) as canvas:
        widths = [1e3 * wall.size_m[0] / scale for wall in walls]
        right = left + sum(widths) + _GAP_MM * (len(walls) - 1)
        _draw_heights(canvas, (left, right), bottom, (low, high), scale)
        total, named = left, -math.inf
        for number, wall in enumerate(walls):
            wide, tall = (1e3 * edge / scale for edge in wall.size_m)
            base = bottom + 1e3 * (float(wall.frame.corners_world()[1] @ up) - low) / scale
            picture = Path(scratch) / str(number)
            whole = Part(left_m=0.0, top_m=0.0, right_m=wall.size_m[0], bottom_m=wall.size_m[1])
            write_picture(wall.raster, whole, picture, scale=scale)
            canvas.drawImage(
                str(picture_file(picture)),
                *(POINTS_PER_MM * value for value in (total, base, wide, tall)),
            )
            box = [(total, base), (total + wide, base), (total + wide, base + tall)]
            line(canvas, [*box, (total, base + tall)], width_mm=0.25, is_closed=True)
            # The name of a narrow wall is one line lower.
            below = 10.0 if total < named else 6.0
            write_text(canvas, wall.name, (total, bottom - below), high_mm=_TEXT_MM)
            named = total + text_width_mm(wall.name, _TEXT_MM) + 1.0 if below < 8.0 else -math.inf
            total += wide + _GAP_MM
        title = f"{label('elevation', language)}   {label('scale', language)} 1:{scale}"
        write_text(canvas, title, (left, MARGIN_MM + 16.0), high_mm=3.5, is_bold=True)
        note = f"{label('height', language)}, {label('metres', language)}"
        write_text(canvas, note, (left, MARGIN_MM + 10.0), high_mm=_TEXT_MM)
        write_text(canvas, origin, (left, MARGIN_MM + 4.0), high_mm=_TEXT_MM)
        canvas.save()


def _draw_heights(
    canvas: Canvas,
    across_mm: tuple[float, float],
    bottom_mm: float,
    heights_m: tuple[float, float],
    scale: int,
) -> None:
    """Draw level lines at round heights, with numbers that do not overlap."""
    low, high = heights_m
    step = next(s for s in (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 50.0) if 1e3 * s / scale >= 8.0)
    for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1):
        y = bottom_mm + 1e3 * (k * step - low) / scale
        line(canvas, [(across_mm[0] - 4.0, y), (across_mm[1], y)], width_mm=0.13)
        write_text(canvas, f"{k * step:+.2f}", (MARGIN_MM, y - 1.0), high_mm=_TEXT_MM)
