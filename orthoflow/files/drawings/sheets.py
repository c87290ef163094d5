"""Sheets: drawings on paper to scale, as PDF.

Pictures are embedded once; everything else is vectors and text. Lengths on the paper are
millimetres from its bottom-left corner until they are passed to reportlab, in points.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from orthoflow.errors import StoreError
from orthoflow.files.drawings import pens
from orthoflow.files.drawings.papers import View
from orthoflow.files.drawings.sheet_blocks import Furniture
from orthoflow.files.drawings.sheet_contents import Drawing, Placed, Sheet
from orthoflow.files.drawings.words import label
from orthoflow.untrusted_text import shown

_TICK_MM: Final = 1.5
# Minimum distance between adjacent items.
_APART_MM: Final = 1.5
_MARK_ROW_MM: Final = 4.2


def write_sheet(path: Path, drawing: Drawing, sheet: Sheet, furniture: Furniture) -> None:
    """Write one sheet.

    Raises:
        StoreError: it cannot be written.
        InputError: no font has a letter of its texts.
    """
    try:
        with pens.sheet_canvas(path, sheet.paper) as canvas:
            canvas.setTitle(shown(f"{drawing.text.block.project} {drawing.text.name}".strip()))
            canvas.setAuthor(shown(drawing.text.block.author))
            canvas.setSubject(f"1:{drawing.scale}; record sha256:{drawing.text.digest}")
            for view in sheet.views:
                placed = Placed(canvas=canvas, view=view, scale=drawing.scale)
                drawing.pictures[view.kind].draw(placed)
                _draw_around(placed, drawing, _neighbours(sheet, view))
            furniture.draw(canvas)
            canvas.showPage()
            canvas.save()
    except OSError as error:
        raise StoreError(f"{path.name} cannot be written: {error}; free some space") from error


def _draw_around(placed: Placed, drawing: Drawing, neighbours: dict[str, int]) -> None:
    """Draw the frame of a picture, crosses, coordinates, heights, match lines and north arrow."""
    canvas = placed.canvas
    left, bottom, right, top = placed.edges_mm
    if drawing.grid > 0.0:
        _draw_grid(placed, drawing)
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    pens.line(canvas, corners, width_mm=pens.MEDIUM_MM, is_closed=True)
    _draw_match_lines(placed, drawing, neighbours)
    if drawing.heights and "right" not in neighbours:
        _draw_heights(placed, drawing)
    if drawing.north is not None:
        foot = np.array([right + 12.0, top - 14.0])
        middle = foot + np.array([0.0, 6.0])
        direction = np.array(drawing.north)
        pens.arrow(canvas, middle + np.outer([-6.0, 6.0], direction))
        # The middle of its label lies 3.2 mm before its tip, clear of a descender.
        at = tuple(middle + 9.2 * direction - [0.0, 0.5 * pens.TEXT_MM])
        pens.write_text(canvas, drawing.up_label, at, is_centred=True)


def _draw_grid(placed: Placed, drawing: Drawing) -> None:
    """Draw crosses at round coordinates, and as many coordinates beside the frame as fit."""
    canvas, part = placed.canvas, placed.view.part
    left, bottom, right, top = placed.edges_mm
    columns: dict[float, float] = {}
    bottom_m = part.bottom_m
    if drawing.axes.across is None:
        # Below the lowest height are the names of what is drawn.
        bottom_m = min(bottom_m, max(drawing.heights, default=bottom_m) + 1e-6)
    else:
        limits = (part.left_m, part.right_m)
        columns = {
            value: float(placed.on_paper([(place, part.top_m)])[0, 0])
            for place, value in _marks(drawing.axes.across, limits, drawing)
        }
    rows = {
        value: float(placed.on_paper([(part.left_m, place)])[0, 1])
        for place, value in _marks(drawing.axes.down, (part.top_m, bottom_m), drawing)
    }
    # A quarter of a metre needs two digits.
    digits = len(f"{drawing.grid:.4f}".rstrip("0").partition(".")[2])
    for x in columns.values():
        pens.line(canvas, [(x, bottom), (x, bottom - _TICK_MM)])
        pens.line(canvas, [(x, top), (x, top + _TICK_MM)])
    for y in rows.values():
        pens.line(canvas, [(left, y), (left - _TICK_MM, y)])
        pens.line(canvas, [(right, y), (right + _TICK_MM, y)])
        if not columns:
            pens.line(canvas, [(left, y), (right, y)], width_mm=pens.FINE_MM)
    for text, x in _with_room(columns, digits, (left - 4.0, right + 4.0)):
        at = (x, bottom - _TICK_MM - 1.0 - pens.TEXT_MM)
        pens.write_text(canvas, text, at, is_centred=True)
    # Beside the picture, not overlapping those below it.
    for text, y in _with_room(rows, digits, (bottom, top)):
        pens.write_text(canvas, text, (left - _TICK_MM - 1.0, y), turned_deg=90.0, is_centred=True)
    for x in columns.values():
        for y in rows.values():
            pens.cross(canvas, x, y)


def _with_room(
    places: dict[float, float], digits: int, limits_mm: tuple[float, float]
) -> Iterator[tuple[str, float]]:
    """Return numbers at multiples of the smallest step of 1, 2, 5 ... marks at which all fit.

    Args:
        places: coordinate -> its position along the edge.
        digits: decimal places.
        limits_mm: a number at an end is moved inside them.
    """
    values = sorted(places)
    step = values[1] - values[0] if len(values) > 1 else 1.0
    found: list[tuple[str, float]] = []
    for every in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000):
        found, ends = [], []
        for value in values:
            if round(value / step) % every == 0:
                text = f"{value:.{digits}f}"
                half = 0.5 * pens.text_width_mm(text)
                low, high = limits_mm[0] + half, max(limits_mm[1] - half, limits_mm[0] + half)
                middle = min(max(places[value], low), high)
                found.append((text, middle))
                ends.append((middle - half, middle + half))
        ends.sort()
        if all(after[0] - before[1] >= _APART_MM for before, after in itertools.pairwise(ends)):
            break
    yield from found


def _marks(
    axis: tuple[float, float], limits_m: tuple[float, float], drawing: Drawing
) -> Iterator[tuple[float, float]]:
    """Positions in a drawing where a coordinate is a whole number of steps, and the coordinate."""
    start, slope = axis
    step_m = drawing.grid * drawing.unit_m
    low, high = sorted(start + slope * place for place in limits_m)
    for count in range(math.ceil(low / step_m - 1e-6), math.floor(high / step_m + 1e-6) + 1):
        yield (count * step_m - start) / slope, count * drawing.grid


def _draw_heights(placed: Placed, drawing: Drawing) -> None:
    """Draw height marks right of the picture, moved apart if they would overlap."""
    canvas, part = placed.canvas, placed.view.part
    _, bottom, right, top = placed.edges_mm
    start, slope = drawing.axes.down
    levels = sorted(
        (float(placed.on_paper([(0.0, down)])[0, 1]), (start + slope * down) / drawing.unit_m)
        for down in drawing.heights
        if part.top_m - 1e-9 <= down <= part.bottom_m + 1e-9
    )
    room = max(1, int((top - bottom) / _MARK_ROW_MM))
    if len(levels) > room + 1:
        # Of many the lowest and the highest, and every nth of the others.
        every = math.ceil((len(levels) - 2) / max(1, room - 1))
        levels = [levels[0], *levels[1:-1][::every], levels[-1]]
    places: list[float] = []
    for level, _ in levels:
        places.append(max(level, places[-1] + _MARK_ROW_MM if places else level))
    limit = max(levels[-1][0], places[-1] - _MARK_ROW_MM) if levels else 0.0
    for k in range(len(places) - 1, -1, -1):
        places[k] = min(places[k], limit)
        limit = places[k] - _MARK_ROW_MM
    for place, (level, value) in zip(places, levels, strict=True):
        pens.line(canvas, [(right + _TICK_MM, level), (right + 4.0, place)])
        pens.height_mark(canvas, (right + 6.0, place), f"{value:+.2f}")


def _neighbours(sheet: Sheet, view: View) -> dict[str, int]:
    """Return sheets on which a part continues: side of the picture -> number."""
    found: dict[str, int] = {}
    part = view.part
    for number, other in sheet.numbered:
        is_level = (other.top_m, other.bottom_m) == (part.top_m, part.bottom_m)
        is_below = (other.left_m, other.right_m) == (part.left_m, part.right_m)
        if is_level and other.left_m == part.right_m:
            found["right"] = number
        elif is_level and other.right_m == part.left_m:
            found["left"] = number
        elif is_below and other.top_m == part.bottom_m:
            found["below"] = number
        elif is_below and other.bottom_m == part.top_m:
            found["above"] = number
    return found


def _draw_match_lines(placed: Placed, drawing: Drawing, neighbours: dict[str, int]) -> None:
    """Draw dash-dotted lines where the drawing continues, each with the number of the sheet."""
    canvas = placed.canvas
    left, bottom, right, top = placed.edges_mm
    middle = (0.5 * (left + right), 0.5 * (bottom + top))
    # Left and below they are beyond the coordinates.
    for side, ends, at, turned_deg in (
        ("left", [(left, bottom - 5.0), (left, top + 5.0)], (left - 6.8, middle[1]), 90.0),
        ("right", [(right, bottom - 5.0), (right, top + 5.0)], (right + 6.0, middle[1]), 90.0),
        ("below", [(left - 5.0, bottom), (right + 5.0, bottom)], (middle[0], bottom - 9.5), 0.0),
        ("above", [(left - 5.0, top), (right + 5.0, top)], (middle[0], top + 3.0), 0.0),
    ):
        if side in neighbours:
            pens.line(canvas, ends, width_mm=pens.WIDE_MM, dashes_mm=pens.MATCH_DASHES_MM)
            text = label("match_line", drawing.language, number=neighbours[side])
            pens.write_text(canvas, text, at, turned_deg=turned_deg, is_centred=True)
