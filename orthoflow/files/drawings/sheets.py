"""Sheets: PDF drawings to scale, divided among several sheets if they do not fit on one.

Each picture is embedded once; everything else is vectors and text. Positions on the paper are in
millimetres from the bottom-left corner, and are converted to points for reportlab.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np

from orthoflow.errors import ArgumentError
from orthoflow.files.drawings import pens
from orthoflow.files.drawings.sheet_blocks import Furniture, furnished
from orthoflow.files.drawings.sheet_contents import (
    Drawing,
    Layout,
    Paper,
    Placed,
    Sheet,
    View,
    cut_up,
    paper_of,
    placed,
    usual_papers,
    whole_of,
)
from orthoflow.files.drawings.words import label, numerals
from orthoflow.files.sidecars import write_bytes
from orthoflow.untrusted_text import shown

_TICK_MM: Final = 1.5
# Minimum distance between adjacent items.
_APART_MM: Final = 1.5
_MARK_ROW_MM: Final = 4.2


def write_sheet(path: Path, drawing: Drawing, sheet: Sheet, furniture: Furniture) -> None:
    """Write one sheet.

    Raises:
        StoreError: the file cannot be written.
        InputError: no font contains a letter of the text.
    """
    stream = BytesIO()
    size_mm = (sheet.paper.width_mm, sheet.paper.height_mm)
    with pens.sheet_canvas(stream, size_mm) as canvas:
        canvas.setTitle(shown(f"{drawing.text.block.project} {drawing.text.name}".strip()))
        canvas.setAuthor(shown(drawing.text.block.author))
        canvas.setSubject(f"1:{drawing.scale}; record sha256:{drawing.text.digest}")
        for view in sheet.views:
            placed = Placed(canvas=canvas, view=view, scale=drawing.scale)
            drawing.pictures[view.kind].draw(placed)
            _draw_around(placed, drawing, sheet)
        furniture.draw(canvas)
        canvas.showPage()
        canvas.save()
    write_bytes(path, stream.getvalue())


def _draw_around(placed: Placed, drawing: Drawing, sheet: Sheet) -> None:
    canvas = placed.canvas
    left, bottom, right, top = placed.edges_mm
    if drawing.grid > 0.0:
        _draw_grid(placed, drawing)
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    pens.line(canvas, corners, width_mm=pens.MEDIUM_MM, is_closed=True)
    _draw_match_lines(placed, drawing, sheet)
    if drawing.heights and placed.view.part.right_m == drawing.size_m[0]:
        _draw_heights(placed, drawing)
    if drawing.north is not None:
        foot = np.array([right + 12.0, top - 14.0])
        middle = foot + np.array([0.0, 6.0])
        direction = np.array(drawing.north)
        pens.arrow(canvas, middle + np.outer([-6.0, 6.0], direction))
        # The middle of the label is 3.2 mm from the tip of the arrow, so that descenders do not
        # touch it.
        at = tuple(middle + 9.2 * direction - [0.0, 0.5 * pens.TEXT_MM])
        pens.write_text(canvas, drawing.up_label, at, is_centred=True)


def _draw_grid(placed: Placed, drawing: Drawing) -> None:
    canvas, part = placed.canvas, placed.view.part
    left, bottom, right, top = placed.edges_mm
    columns: dict[float, float] = {}
    bottom_m = part.bottom_m
    if drawing.axes.across is None:
        # The space below the lowest height mark is for names.
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
    for x in columns.values():
        pens.line(canvas, [(x, bottom), (x, bottom - _TICK_MM)])
        pens.line(canvas, [(x, top), (x, top + _TICK_MM)])
    for y in rows.values():
        pens.line(canvas, [(left, y), (left - _TICK_MM, y)])
        pens.line(canvas, [(right, y), (right + _TICK_MM, y)])
        if not columns:
            pens.line(canvas, [(left, y), (right, y)], width_mm=pens.FINE_MM)
    for text, x in _with_room(columns, drawing, (left - 4.0, right + 4.0)):
        at = (x, bottom - _TICK_MM - 1.0 - pens.TEXT_MM)
        pens.write_text(canvas, text, at, is_centred=True)
    # Write the coordinates of rows beside the picture, without overlapping those below it.
    for text, y in _with_room(rows, drawing, (bottom, top)):
        pens.write_text(canvas, text, (left - _TICK_MM - 1.0, y), turned_deg=90.0, is_centred=True)
    for x in columns.values():
        for y in rows.values():
            pens.cross(canvas, x, y)


def _with_room(
    places: dict[float, float], drawing: Drawing, limits_mm: tuple[float, float]
) -> Iterator[tuple[str, float]]:
    """Yield the coordinate of every 1st, 2nd, 5th ... mark, as densely as the labels permit.

    Args:
        places: positions along the edge by coordinate.
        drawing: the drawing.
        limits_mm: limits of the text; a coordinate at an end is moved inside them.
    """
    # A grid of a quarter of a metre, for example, needs two decimals.
    digits = len(f"{drawing.grid:.4f}".rstrip("0").partition(".")[2])
    values = sorted(places)
    step = values[1] - values[0] if len(values) > 1 else 1.0
    found: list[tuple[str, float]] = []
    for every in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000):
        found, ends = [], []
        for value in values:
            if round(value / step) % every == 0:
                text = numerals(f"{value:.{digits}f}", drawing.language)
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
    """Yield positions at which a coordinate is a multiple of the step, and the coordinate."""
    start, slope = axis
    step_m = drawing.grid * drawing.unit_m
    low, high = sorted(start + slope * place for place in limits_m)
    for count in range(math.ceil(low / step_m - 1e-6), math.floor(high / step_m + 1e-6) + 1):
        yield (count * step_m - start) / slope, count * drawing.grid


def _draw_heights(placed: Placed, drawing: Drawing) -> None:
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
        # If there are too many marks, keep the lowest, the highest and every nth in between.
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
        pens.height_mark(canvas, (right + 6.0, place), numerals(f"{value:+.2f}", drawing.language))


def _draw_match_lines(placed: Placed, drawing: Drawing, sheet: Sheet) -> None:
    own = np.array(placed.view.part.corners_m)[[0, 2]]
    for number, part in sheet.numbered:
        other = np.array(part.corners_m)[[0, 2]]
        edge = np.array([np.maximum(own[0], other[0]), np.minimum(own[1], other[1])])
        # The intersection of adjacent parts is an edge, which has a length but no width.
        along = int(np.argmax(edge[1] - edge[0]))
        if edge[1, along] <= edge[0, along] or edge[1, 1 - along] != edge[0, 1 - along]:
            continue
        (left, bottom), (right, top) = np.sort(placed.on_paper(edge), axis=0).tolist()
        middle = (0.5 * (left + right), 0.5 * (bottom + top))
        is_before = bool(other[0, 1 - along] < own[0, 1 - along])
        # On the left and lower edges, the number is placed outside the coordinates.
        if along == 1:
            ends, turned_deg = [(left, bottom - 5.0), (left, top + 5.0)], 90.0
            at = (left + (-6.8 if is_before else 6.0), middle[1])
        else:
            ends, turned_deg = [(left - 5.0, bottom), (right + 5.0, bottom)], 0.0
            at = (middle[0], bottom + (3.0 if is_before else -9.5))
        pens.line(placed.canvas, ends, width_mm=pens.WIDE_MM, dashes_mm=pens.MATCH_DASHES_MM)
        text = label("match_line", drawing.language, number=number)
        pens.write_text(placed.canvas, text, at, turned_deg=turned_deg, is_centred=True)


# Paper size of the sheets if a wall does not fit on a single sheet.
_CUT_PAPER: Final = "A1"
#: a sheet with its pictures, and the blocks beside them
LaidOut: TypeAlias = tuple[Sheet, Furniture]


def fitting_scale(
    drawn: Callable[[int], Sequence[Drawing]], scales: Sequence[int], papers: Sequence[Paper]
) -> int:
    """Return the denominator n of the largest scale 1 : n at which each wall fits on one sheet.

    Args:
        drawn: function that returns the drawings at a scale.
        scales: denominators of the permitted scales, largest scale first.
        papers: available papers.
    """
    for scale in scales:
        if all(_on_one(drawing, papers) for drawing in drawn(scale)):
            return scale
    return scales[-1]


def lay_out(drawing: Drawing, given: Sequence[Paper] = ()) -> tuple[LaidOut, ...]:
    """Place a wall on one sheet, or divide it into several of the same size.

    Args:
        drawing: the drawing.
        given: permitted papers; if empty, the smallest usual paper on which the wall fits is used.

    Raises:
        ArgumentError: the title block does not fit on the paper, or the wall needs too many sheets.
    """
    # Key plans are omitted only if they do not fit on the office's paper.
    for is_brief in (False, True) if given else (False,):
        if alone := _on_one(drawing, given or usual_papers(), is_brief=is_brief):
            return (alone,)
    paper = given[0] if given else paper_of(_CUT_PAPER)
    for is_brief in (False, True):
        divided = (_cut(drawing, way, is_brief=is_brief) for way in _ways(drawing, [paper]))
        if fitting := [sheets for sheets in divided if sheets]:
            return min(fitting, key=len)
    raise ArgumentError(
        f"--paper {paper.name or f'{paper.width_mm:g}x{paper.height_mm:g}'} is too small for the "
        "title block, the legend and the notes next to a picture: choose a larger one, or "
        "shorten the title block"
    )


def _ways(drawing: Drawing, papers: Sequence[Paper]) -> Iterator[Paper]:
    """Yield papers, landscape before portrait, with the title block in each permitted position."""
    given = drawing.text.block.layout
    layouts: tuple[Layout, ...] = (given,) if given else ("column", "strip")
    for paper in papers:
        for turned in (paper, paper.turned):
            yield from (replace(turned, layout=layout) for layout in layouts)


def _on_one(drawing: Drawing, papers: Sequence[Paper], *, is_brief: bool = False) -> LaidOut | None:
    content = (tuple(drawing.pictures), whole_of(drawing.size_m))
    for paper in _ways(drawing, papers):
        if views := placed(*content, paper, drawing.scale):
            sheet = Sheet(paper=paper, views=views)
            furniture = furnished(paper, drawing, sheet, is_brief=is_brief)
            if furniture and (views := placed(*content, furniture.paper, drawing.scale)):
                return Sheet(paper=furniture.paper, views=views), furniture
    return None


def _cut(drawing: Drawing, paper: Paper, *, is_brief: bool) -> tuple[LaidOut, ...]:
    """Return the sheets of a divided wall; empty if the paper is too small."""
    kinds, whole = tuple(drawing.pictures), whole_of(drawing.size_m)
    # The blocks of this sheet need the most space, because it has a key to several sheets.
    view = View(kind=max(kinds, key=len), part=whole, corner_mm=(0.0, 0.0))
    longest = Sheet(paper=paper, views=(view,), count=99, numbered=((1, whole), (2, whole)))
    first = furnished(paper, drawing, longest, is_brief=is_brief)
    if first is None:
        return ()
    grid_m = drawing.grid * drawing.unit_m
    parts = cut_up(drawing.size_m, first.paper, scale=drawing.scale, grid_m=grid_m)
    found = []
    for place, kind in enumerate(kinds):
        numbered = tuple(enumerate(parts, start=1 + place * len(parts)))
        for number, part in numbered:
            sheet = Sheet(
                paper=first.paper,
                views=placed([kind], part, first.paper, drawing.scale),
                number=number,
                count=len(kinds) * len(parts),
                numbered=numbered if len(parts) > 1 else (),
            )
            furniture = furnished(first.paper, drawing, sheet, is_brief=is_brief)
            if furniture is None or not sheet.views:
                return ()
            found.append((sheet, furniture))
    return tuple(found)
