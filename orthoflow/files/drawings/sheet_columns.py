"""The column of a sheet: title block, scale bar, key plan, accuracy, and the seal of the record."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.key_plans import KeyPlan
from orthoflow.files.drawings.papers import MARGIN_MM, Part
from orthoflow.files.drawings.pens import (
    LABEL_MM,
    POINTS_PER_MM,
    line,
    text_width_mm,
    write_on_white,
    write_text,
)
from orthoflow.files.drawings.sheet_contents import Sheet, WallDrawing
from orthoflow.files.drawings.title_blocks import FIELDS
from orthoflow.foreign_text import shown

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

_PADDING_MM: Final = 3.0
_TEXT_MM: Final = 1.7
# The column whose text is as high as it says: that of A3, 1.7 mm; A1 has 3.0.
_PLAIN_COLUMN_MM: Final = 0.24 * 420.0
_LEAST_PLAN_MM: Final = 15.0
_MOST_PLAN_MM: Final = 90.0
_MOST_SEGMENTS: Final = 5
_SEGMENT_MM: Final = 25.0
_KINDS: Final = {"ortho": "orthoimage", "depth": "depth contours", "intensity": "laser intensity"}
# Where the laser saw no intensity, it stands in.
_GREY: Final = "grey of the scan's colours"


@dataclass
class _Column:
    """Where the next thing goes, in mm: down from the top, or up from the bottom.

    Text is `size` times as high as it says, which grows with the paper: large sheets hang.
    """

    canvas: Canvas
    left: float
    width: float
    top: float
    bottom: float
    size: float

    def write(self, text: str, *, high_mm: float = _TEXT_MM, is_bold: bool = False) -> None:
        """Write a paragraph at the top."""
        high_mm *= self.size
        for row in self.rows(text, high_mm):
            self.top -= 1.7 * high_mm
            write_text(self.canvas, row, (self.left, self.top), high_mm=high_mm, is_bold=is_bold)

    def rows(self, text: str, high_mm: float) -> list[str]:
        """Break a text into rows as wide as the column; words that are wider are broken too."""
        # As wide as bold letters are.
        rows, row = [], ""
        for word in _pieces(shown(text)):
            if row and text_width_mm((row + word).rstrip(), high_mm) > 0.98 * self.width:
                rows.append(row.strip())
                row = ""
            row += word
        return [*rows, row.strip()] if row.strip() else rows

    def rule(self) -> None:
        """Draw a line across the column at the top."""
        self.top -= 0.5 * _PADDING_MM
        left = self.left - _PADDING_MM
        line(self.canvas, [(left, self.top), (left + self.width + 2 * _PADDING_MM, self.top)])
        self.top -= 0.5 * _PADDING_MM


def draw_column(canvas: Canvas, drawing: WallDrawing, sheet: Sheet) -> None:
    """Draw the column of a sheet."""
    column = _Column(
        canvas=canvas,
        left=sheet.paper.width_mm - MARGIN_MM - sheet.paper.column_mm + _PADDING_MM,
        width=sheet.paper.column_mm - 2 * _PADDING_MM,
        top=sheet.paper.height_mm - MARGIN_MM - _PADDING_MM,
        bottom=MARGIN_MM + _PADDING_MM,
        size=max(1.0, sheet.paper.column_mm / _PLAIN_COLUMN_MM),
    )
    _draw_seal(column, drawing)
    _write_title(column, drawing, sheet)
    column.rule()
    _draw_scale_bar(column, drawing.scale)
    column.rule()
    for note in _notes(drawing, sheet):
        column.write(note)
        column.top -= 0.5 * _TEXT_MM
    column.rule()
    pictures = int(drawing.plan is not None) + int(bool(sheet.numbered) and sheet.number > 0)
    room = (column.top - column.bottom) / max(1, pictures) - 5.0
    if room < _LEAST_PLAN_MM:
        return
    room = min(room, _MOST_PLAN_MM * column.size)
    if sheet.numbered and sheet.number > 0:
        column.write(f"sheets of {drawing.text.name}")
        _draw_sheet_key(column, sheet, room)
    if drawing.plan is not None:
        column.write(
            "from above, walls with their numbers; the wall of this sheet, and the side it is seen "
            "from, in red"
        )
        _draw_plan(column, drawing.plan, room, number=drawing.number)


def _write_title(column: _Column, drawing: WallDrawing, sheet: Sheet) -> None:
    block = drawing.text.block
    if block.project:
        column.write(block.project, high_mm=3.5, is_bold=True)
    column.write(block.title or drawing.text.name, high_mm=2.8, is_bold=True)
    if block.title:
        column.write(drawing.text.name, high_mm=2.2)
    named = _KINDS | ({"intensity": _GREY} if drawing.intensity_is_grey else {})
    kinds = " and ".join(named[kind] for kind in dict.fromkeys(view.kind for view in sheet.views))
    column.write(kinds, high_mm=2.2)
    column.top -= 1.5
    column.write(f"scale 1:{drawing.scale}", high_mm=3.5, is_bold=True)
    number = f"sheet {sheet.number} of {sheet.count}"
    column.write(number if sheet.number else f"index of {sheet.count} sheets", high_mm=2.2)
    for name in FIELDS:
        value = getattr(block, name)
        if value and name not in {"project", "title"}:
            if name == "drawing":
                place = f"sheet {sheet.number}" if sheet.number else "index"
                value = f"{value}, wall {drawing.number}, {place}"
            column.write(f"{name.replace('_', ' ')}: {value}", high_mm=2.0)


def _notes(drawing: WallDrawing, sheet: Sheet) -> Iterator[str]:
    yield from drawing.text.notes
    if any(view.kind == "depth" for view in sheet.views):
        first_mm, next_mm = 500.0 * drawing.interval_m, 1500.0 * drawing.interval_m
        yield (
            f"depth contours {first_mm:g}, {next_mm:g} ... mm from the wall's plane: red before "
            "it, towards the viewer, blue behind it"
        )
        if drawing.depth_range_m is not None:
            black_mm, white_mm = (1e3 * value for value in drawing.depth_range_m)
            yield (
                f"its grey: black {black_mm:+.0f} mm and below, white {white_mm:+.0f} mm and above"
            )
    if drawing.grid_m > 0.0:
        yield f"grid {drawing.grid_m:g} m: {drawing.axes.said}"


def _draw_scale_bar(column: _Column, scale: int) -> None:
    """Draw segments of a round length, black and white, with its length at each end."""
    least_m = 1e-3 * scale * _SEGMENT_MM / 2.5
    # The largest round length that is at most 25 mm long.
    power = 10.0 ** math.floor(math.log10(least_m))
    lengths = [factor * power for factor in (1.0, 2.0, 5.0, 10.0, 20.0)]
    length_m = max(m for m in lengths if 1e3 * m / scale <= _SEGMENT_MM + 1e-6)
    segment = 1e3 * length_m / scale
    count = max(1, min(_MOST_SEGMENTS, int((column.width - 8.0) / segment)))
    column.top -= 5.0 + 2.0 * column.size
    canvas, left = column.canvas, column.left + 2.0
    canvas.setLineWidth(0.1 * POINTS_PER_MM)
    for place in range(count):
        grey = float(place % 2)
        canvas.setFillColorRGB(grey, grey, grey)
        canvas.rect(
            *(POINTS_PER_MM * v for v in (left + place * segment, column.top, segment, 2.0)),
            fill=1,
        )
    canvas.setFillColorRGB(0.0, 0.0, 0.0)
    for place in range(count + 1):
        text = f"{place * length_m:g}" + (" m" if place == count else "")
        at = (left + place * segment, column.top + 3.2)
        write_text(canvas, text, at, high_mm=1.8 * column.size, is_centred=True)
    column.top -= 1.0


def _draw_plan(column: _Column, plan: KeyPlan, room: float, *, number: int = -1) -> None:
    """Draw the room from above as large as there is room, with the number of the marked wall."""
    lines = [*plan.walls, *plan.outlines, plan.marked]
    if plan.arrow is not None:
        lines.append(plan.arrow)
    place = _Placing(column, np.vstack(lines), room)
    canvas = column.canvas
    canvas.setStrokeColorRGB(0.6, 0.6, 0.6)
    for wall in plan.walls:
        line(canvas, place(wall), width_mm=0.12)
    canvas.setStrokeColorRGB(0.0, 0.0, 0.0)
    for outline in plan.outlines:
        line(canvas, place(outline), width_mm=0.3)
    canvas.setStrokeColorRGB(0.8, 0.0, 0.0)
    line(canvas, place(plan.marked), width_mm=0.8, is_closed=len(plan.marked) > 2)
    if plan.arrow is not None:
        _draw_arrow(canvas, place(plan.arrow), width_mm=0.4)
    canvas.setStrokeColorRGB(0.0, 0.0, 0.0)
    right = column.left + column.width - 3.0
    _draw_arrow(
        canvas, np.array([[right, column.top + 1.0], [right, column.top + 9.0]]), width_mm=0.3
    )
    write_text(
        canvas,
        plan.up_label,
        (right, column.top + 10.0),
        high_mm=LABEL_MM * column.size,
        is_centred=True,
    )
    # The marked one first: where walls lie close, not all of them have room.
    on_paper = {n: place(wall) for n, wall in zip(plan.numbers, plan.walls, strict=True)}
    in_order = sorted(on_paper, key=lambda n: (n != number, -_length(on_paper[n])))
    _number_walls(canvas, {n: on_paper[n] for n in in_order}, high_mm=_TEXT_MM * column.size)


def _number_walls(
    canvas: Canvas, on_paper: Mapping[int, NDArray[np.float64]], *, high_mm: float
) -> None:
    """Write the numbers of walls into their middles, in this order, where there is room."""
    placed: list[NDArray[np.float64]] = []
    for number, wall in on_paper.items():
        middle = wall.mean(axis=0)
        room = 1.5 * text_width_mm(str(number), high_mm) + high_mm
        if _length(wall) < room or any(
            float(np.linalg.norm(middle - other)) < room for other in placed
        ):
            continue
        placed.append(middle)
        at = (float(middle[0]), float(middle[1]))
        write_on_white(canvas, str(number), at, high_mm=high_mm)


def _length(ends: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(ends[1] - ends[0]))


def _draw_sheet_key(column: _Column, sheet: Sheet, room: float) -> None:
    """Draw how a wall is cut into sheets, this one filled."""
    boxes = [_corners(part) for _, part in sheet.numbered]
    place = _Placing(column, np.vstack(boxes), room)
    canvas = column.canvas
    for (number, _), box in zip(sheet.numbered, boxes, strict=True):
        corners = place(box)
        (left, bottom), (right, top) = corners.min(axis=0), corners.max(axis=0)
        if number == sheet.number:
            canvas.setFillColorRGB(1.0, 0.75, 0.75)
            sides = (left, bottom, right - left, top - bottom)
            canvas.rect(*(POINTS_PER_MM * side for side in sides), stroke=0, fill=1)
            canvas.setFillColorRGB(0.0, 0.0, 0.0)
        line(canvas, corners, is_closed=True)
        high = min(2.5 * column.size, 0.5 * (top - bottom), 0.4 * (right - left))
        middle = (0.5 * (left + right), 0.5 * (bottom + top - high))
        write_text(canvas, str(number), middle, high_mm=high, is_centred=True)
    column.top -= 2.0


class _Placing:
    """Lays plan metres (n, 2) onto the paper, below the top of the column, which it lowers."""

    def __init__(self, column: _Column, points: NDArray[np.float64], room: float) -> None:
        self._low = points.min(axis=0)
        size = np.maximum(points.max(axis=0) - self._low, 1e-6)
        limits = np.array([column.width - 8.0, room - 5.0])
        self._mm_per_m = float((limits / size).min())
        high = float(size[1]) * self._mm_per_m
        column.top -= high + 2.0
        self._corner = np.array([column.left, column.top])

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self._corner + self._mm_per_m * (points - self._low))


def _corners(part: Part) -> NDArray[np.float64]:
    """Corners (4, 2) of a part of a wall, upwards positive."""
    left, top, right, bottom = part.left_m, -part.top_m, part.right_m, -part.bottom_m
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


def _draw_arrow(canvas: Canvas, ends: NDArray[np.float64], *, width_mm: float) -> None:
    line(canvas, ends, width_mm=width_mm)
    along = (ends[1] - ends[0]) / max(float(np.linalg.norm(ends[1] - ends[0])), 1e-9)
    aside = np.array([-along[1], along[0]])
    barbs = [ends[1] - 2.0 * along + side * 0.8 * aside for side in (1.0, -1.0)]
    line(canvas, [tuple(barbs[0]), tuple(ends[1]), tuple(barbs[1])], width_mm=width_mm)


def _draw_seal(column: _Column, drawing: WallDrawing) -> None:
    """Draw the digest of the record as a QR code and as text, at the bottom of the column."""
    import segno

    code = segno.make(f"sha256:{drawing.text.digest}", error="m", micro=False)
    dots = [list(row) for row in code.matrix]
    # Phones want 0.5 mm a dot; four dots of quiet around it.
    side = min(28.0 * column.size, 0.45 * column.width)
    dot = side / (len(dots) + 8)
    canvas, left, bottom = column.canvas, column.left, column.bottom
    for row, values in enumerate(dots):
        for place, is_dark in enumerate(values):
            if is_dark:
                x, y = left + (place + 4) * dot, bottom + side - (row + 5) * dot
                sides = (POINTS_PER_MM * v for v in (x, y, dot, dot))
                canvas.rect(*sides, stroke=0, fill=1)
    beside = replace(
        column, left=left + side + 2.0, width=column.width - side - 2.0, top=bottom + side
    )
    beside.write("provenance", high_mm=1.7, is_bold=True)
    digest = drawing.text.digest
    for text in (
        drawing.text.run,
        "record sha256:",
        *(digest[k : k + 16] for k in (0, 16, 32, 48)),
    ):
        beside.write(text, high_mm=1.4)
    column.bottom += side + 2.0


def _pieces(text: str) -> Iterator[str]:
    """Words with the space behind them; long ones in pieces."""
    for word in text.split():
        pieces = [word[k : k + 24] for k in range(0, len(word), 24)]
        yield from pieces[:-1]
        yield f"{pieces[-1]} "
