"""Sheets: a wall's pictures on paper to scale, as PDF.

Pictures are embedded once; everything else is vectors and text. Lengths on the paper are
millimetres from its bottom-left corner until they are passed to reportlab, in points.
"""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import StoreError
from orthoflow.files.drawings.papers import FOOT_M, View
from orthoflow.files.drawings.pens import (
    BEFORE,
    BEHIND,
    FINE_MM,
    MATCH_DASHES_MM,
    MEDIUM_MM,
    OPENING,
    POINTS_PER_MM,
    RED,
    TEXT_MM,
    WHITE,
    WIDE_MM,
    arrow,
    box,
    cross,
    height_mark,
    line,
    sheet_canvas,
    text_width_mm,
    write_on_white,
    write_text,
)
from orthoflow.files.drawings.printed_pictures import (
    contours,
    label_place,
    picture_file,
    write_picture,
)
from orthoflow.files.drawings.sheet_blocks import Furniture
from orthoflow.files.drawings.sheet_contents import Sheet, WallDrawing
from orthoflow.files.drawings.words import label
from orthoflow.foreign_text import shown

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

_TICK_MM: Final = 1.5
# Minimum distance between adjacent items.
_APART_MM: Final = 1.5
_MARK_ROW_MM: Final = 4.2


def write_sheet(path: Path, drawing: WallDrawing, sheet: Sheet, furniture: Furniture) -> None:
    """Write one sheet.

    Raises:
        StoreError: it cannot be written.
        InputError: no font has a letter of its texts.
    """
    try:
        with (
            tempfile.TemporaryDirectory(dir=path.parent) as folder,
            sheet_canvas(path, sheet.paper) as canvas,
        ):
            canvas.setTitle(shown(f"{drawing.text.block.project} {drawing.text.name}".strip()))
            canvas.setAuthor(shown(drawing.text.block.author))
            canvas.setSubject(f"1:{drawing.scale}; record sha256:{drawing.text.digest}")
            for place, view in enumerate(sheet.views):
                _draw_view(canvas, drawing, sheet, view, Path(folder) / f"picture_{place}")
            if sheet.number == 0:
                _draw_cuts(canvas, drawing, sheet)
            furniture.draw(canvas)
            canvas.showPage()
            canvas.save()
    except OSError as error:
        raise StoreError(f"{path.name} cannot be written: {error}; free some space") from error


def _draw_view(
    canvas: Canvas, drawing: WallDrawing, sheet: Sheet, view: View, picture: Path
) -> None:
    """Draw a picture with its frame, contours, crosses, coordinates, heights and match lines."""
    raster = drawing.rasters[view.kind]
    left, bottom, right, top = _edges(drawing, view)
    write_picture(raster, view.part, picture, scale=drawing.scale, is_flipped=drawing.is_flipped)
    canvas.drawImage(
        str(picture_file(picture)),
        *(POINTS_PER_MM * number for number in (left, bottom, right - left, top - bottom)),
    )
    if view.kind == "depth":
        _draw_contours(canvas, drawing, view)
    _draw_areas(canvas, drawing, view)
    if drawing.grid > 0.0:
        _draw_grid(canvas, drawing, view)
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    line(canvas, corners, width_mm=MEDIUM_MM, is_closed=True)
    neighbours = _neighbours(sheet, view) if sheet.number else {}
    _draw_match_lines(canvas, drawing, view, neighbours)
    if drawing.heights and "right" not in neighbours:
        _draw_heights(canvas, drawing, view)
    if drawing.north is not None:
        foot = np.array([right + 12.0, top - 14.0])
        middle = foot + np.array([0.0, 6.0])
        half = 6.0 * np.array(drawing.north)
        arrow(canvas, np.array([middle - half, middle + half]))
        name = drawing.plan.up_label if drawing.plan is not None else "y"
        write_text(
            canvas, name, tuple(middle + 1.35 * half - [0.0, 0.5 * TEXT_MM]), is_centred=True
        )


def _edges(drawing: WallDrawing, view: View) -> tuple[float, float, float, float]:
    """Return left, bottom, right and top of a picture on the paper."""
    left, bottom = view.corner_mm
    wide, high = (1e3 * edge / drawing.scale for edge in view.part.size_m)
    return left, bottom, left + wide, bottom + high


def _draw_contours(canvas: Canvas, drawing: WallDrawing, view: View) -> None:
    found = contours(
        drawing.rasters[view.kind],
        view.part,
        scale=drawing.scale,
        interval_m=drawing.interval_m,
        is_flipped=drawing.is_flipped,
    )
    placed: list[NDArray[np.float64]] = []
    for level, points in found:
        colour = BEFORE if level > 0.0 else BEHIND
        on_paper = np.array([_on_paper(drawing, view, x, y) for x, y in points.tolist()])
        line(canvas, on_paper, width_mm=FINE_MM, colour=colour)
        text = f"{round(1e3 * level, 6):+g}"
        place = label_place(on_paper, text_width_mm(text), placed)
        if place is not None:
            placed.append(np.array(place.middle_mm))
            turned_deg = place.turned_deg
            write_on_white(canvas, text, place.middle_mm, turned_deg=turned_deg, colour=colour)


def _draw_areas(canvas: Canvas, drawing: WallDrawing, view: View) -> None:
    """Outline openings, clipped to the picture."""
    left, bottom, right, top = _edges(drawing, view)
    canvas.saveState()
    frame = canvas.beginPath()
    frame.rect(*(POINTS_PER_MM * number for number in (left, bottom, right - left, top - bottom)))
    canvas.clipPath(frame, stroke=0, fill=0)
    for area in drawing.areas:
        outline = [_on_paper(drawing, view, x, y) for x, y in area.outline_m.tolist()]
        # White below, so that the line is visible on any picture.
        line(canvas, outline, width_mm=1.0, colour=WHITE, is_closed=True)
        line(canvas, outline, width_mm=MEDIUM_MM, colour=OPENING, is_closed=True)
        xs, ys = zip(*outline, strict=True)
        seen = (max(min(xs), left), min(max(xs), right), max(min(ys), bottom), min(max(ys), top))
        _write_inside(canvas, area.text, seen)
    canvas.restoreState()


def _write_inside(canvas: Canvas, text: str, limits_mm: Sequence[float]) -> None:
    """Write the parts of a text on white, from the top, if there is room."""
    left, right, bottom, top = limits_mm
    rows = shown(text).split(", ")
    wide = max(text_width_mm(row) for row in rows) + 2.0
    high = 1.7 * TEXT_MM * len(rows) + 1.0
    if right - left < wide + 2.0 or top - bottom < high + 2.0:
        return
    box(canvas, (left + 1.0, top - 1.0 - high, wide, high), WHITE)
    for place, row in enumerate(rows):
        at = (left + 2.0, top - 1.2 - 1.7 * TEXT_MM * (place + 0.8))
        write_text(canvas, row, at, colour=OPENING)


def _draw_grid(canvas: Canvas, drawing: WallDrawing, view: View) -> None:
    """Draw crosses at round coordinates, and as many coordinates beside the frame as fit."""
    part = view.part
    left, bottom, right, top = _edges(drawing, view)
    unit_m = FOOT_M if drawing.unit == "ft" else 1.0
    columns = {
        value: _on_paper(drawing, view, place, part.top_m)[0]
        for place, value in _marks(
            drawing.axes.across, (part.left_m, part.right_m), drawing.grid, unit_m
        )
    }
    rows = {
        value: _on_paper(drawing, view, part.left_m, place)[1]
        for place, value in _marks(
            drawing.axes.down, (part.top_m, part.bottom_m), drawing.grid, unit_m
        )
    }
    # A quarter of a metre needs two digits.
    digits = len(f"{drawing.grid:.4f}".rstrip("0").partition(".")[2])
    for x in columns.values():
        line(canvas, [(x, bottom), (x, bottom - _TICK_MM)])
        line(canvas, [(x, top), (x, top + _TICK_MM)])
    for y in rows.values():
        line(canvas, [(left, y), (left - _TICK_MM, y)])
        line(canvas, [(right, y), (right + _TICK_MM, y)])
    for text, x in _with_room(columns, digits, (left - 4.0, right + 4.0)):
        at = (x, bottom - _TICK_MM - 1.0 - TEXT_MM)
        write_text(canvas, text, at, is_centred=True)
    # Beside the picture, not overlapping those below it.
    for text, y in _with_room(rows, digits, (bottom, top)):
        write_text(canvas, text, (left - _TICK_MM - 1.0, y), turned_deg=90.0, is_centred=True)
    for x in columns.values():
        for y in rows.values():
            cross(canvas, x, y)


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
                half = 0.5 * text_width_mm(text)
                low, high = limits_mm[0] + half, max(limits_mm[1] - half, limits_mm[0] + half)
                middle = min(max(places[value], low), high)
                found.append((text, middle))
                ends.append((middle - half, middle + half))
        ends.sort()
        if all(after[0] - before[1] >= _APART_MM for before, after in itertools.pairwise(ends)):
            break
    yield from found


def _marks(
    axis: tuple[float, float], limits_m: tuple[float, float], step: float, unit_m: float
) -> Iterator[tuple[float, float]]:
    """Positions on the wall where a coordinate is a whole number of steps, and the coordinate."""
    start, slope = axis
    step_m = step * unit_m
    low, high = sorted(start + slope * place for place in limits_m)
    for count in range(math.ceil(low / step_m - 1e-6), math.floor(high / step_m + 1e-6) + 1):
        yield (count * step_m - start) / slope, count * step


def _draw_heights(canvas: Canvas, drawing: WallDrawing, view: View) -> None:
    """Draw height marks right of the picture, moved apart if they would overlap."""
    _, bottom, right, top = _edges(drawing, view)
    unit_m = FOOT_M if drawing.unit == "ft" else 1.0
    start, slope = drawing.axes.down
    levels = sorted(
        (_on_paper(drawing, view, 0.0, down)[1], (start + slope * down) / unit_m)
        for down in drawing.heights
        if view.part.top_m - 1e-9 <= down <= view.part.bottom_m + 1e-9
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
        line(canvas, [(right + _TICK_MM, level), (right + 4.0, place)])
        height_mark(canvas, (right + 6.0, place), f"{value:+.2f}")


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


def _draw_match_lines(
    canvas: Canvas, drawing: WallDrawing, view: View, neighbours: dict[str, int]
) -> None:
    """Draw dash-dotted lines where the wall continues, each with the number of the sheet."""
    left, bottom, right, top = _edges(drawing, view)
    middle = (0.5 * (left + right), 0.5 * (bottom + top))
    # Left and below they are beyond the coordinates.
    for side, ends, at, turned_deg in (
        ("left", [(left, bottom - 5.0), (left, top + 5.0)], (left - 6.8, middle[1]), 90.0),
        ("right", [(right, bottom - 5.0), (right, top + 5.0)], (right + 6.0, middle[1]), 90.0),
        ("below", [(left - 5.0, bottom), (right + 5.0, bottom)], (middle[0], bottom - 9.5), 0.0),
        ("above", [(left - 5.0, top), (right + 5.0, top)], (middle[0], top + 3.0), 0.0),
    ):
        if side in neighbours:
            line(canvas, ends, width_mm=WIDE_MM, dashes_mm=MATCH_DASHES_MM)
            text = label("match_line", drawing.language, number=neighbours[side])
            write_text(canvas, text, at, turned_deg=turned_deg, is_centred=True)


def _draw_cuts(canvas: Canvas, drawing: WallDrawing, sheet: Sheet) -> None:
    """Draw the parts of the wall on each sheet into the index."""
    for number, part in sheet.numbered:
        corners = [
            _on_paper(drawing, sheet.views[0], x, y)
            for x, y in (
                *((part.left_m, part.top_m), (part.right_m, part.top_m)),
                *((part.right_m, part.bottom_m), (part.left_m, part.bottom_m)),
            )
        ]
        line(canvas, corners, width_mm=MEDIUM_MM, colour=RED, is_closed=True)
        (left, top), _, (right, bottom), _ = corners
        high = max(TEXT_MM, min(10.0, 0.4 * (top - bottom), 0.3 * (right - left)))
        middle = (0.5 * (left + right), 0.5 * (top + bottom) - 0.5 * high)
        write_text(
            canvas, str(number), middle, high_mm=high, is_bold=True, is_centred=True, colour=RED
        )


def _on_paper(
    drawing: WallDrawing, view: View, right_m: float, down_m: float
) -> tuple[float, float]:
    """Return the position on the paper, in mm, of a position on the wall."""
    left, bottom = view.corner_mm
    return (
        left + 1e3 * (right_m - view.part.left_m) / drawing.scale,
        bottom + 1e3 * (view.part.bottom_m - down_m) / drawing.scale,
    )
