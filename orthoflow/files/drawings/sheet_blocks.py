"""The blocks beside the pictures of a sheet: scale bar, notes, legend, key plan and title block.

reportlab's flowables measure and wrap text; this module creates the blocks, and packs them into a
column on the right of the sheet or a strip along its lower edge.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from reportlab.lib.colors import Color
from reportlab.platypus import Flowable, Image, Table

from orthoflow.files.drawings import pens
from orthoflow.files.drawings.key_plans import NORTH, KeyPlan
from orthoflow.files.drawings.sheet_contents import (
    MARGIN_MM,
    SCALES_FT,
    Drawing,
    LegendRow,
    Paper,
    Sheet,
    round_below,
)
from orthoflow.files.drawings.words import label, numerals

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

_PADDING_MM: Final = 3.0
_GAP_MM: Final = 2.0
_COLUMNS_MM: Final = (90.0, 110.0, 130.0, 150.0, 180.0)
# ISO 7200: a title block is 180 mm wide at most.
_TITLE_MM: Final = 180.0
_STRIP_COLUMN_MM: Final = 85.0
# Minimum height of strips; if necessary, it is increased in steps of _STRIP_STEP_MM.
_LOWEST_MM: Final = 40.0
_STRIP_STEP_MM: Final = 2.5
# Maximum share of the paper for everything except pictures.
_MOST_SHARE: Final = 0.55
_PLAN_MM: Final = (35.0, 90.0)
_MOST_SEGMENTS: Final = 5
_SEGMENT_MM: Final = 25.0
_SYMBOL_MM: Final = 14.0
_QR_MM: Final = 28.0
_SIGNATURE_MM: Final = 14.0
_LOGO_MM: Final = 16.0
# Title blocks wider than this have four columns instead of two.
_FOUR_COLUMNS_MM: Final = 140.0
_PLAIN: Final = [
    *((f"{side}PADDING", (0, 0), (-1, -1), 0) for side in ("LEFT", "RIGHT", "TOP", "BOTTOM")),
    ("VALIGN", (0, 0), (-1, -1), "TOP"),
]


class _Picture(Flowable):  # type: ignore[misc] # reportlab has no types
    """A flowable as wide as the available space, drawn in mm from its bottom-left corner."""

    def __init__(
        self, high_mm: float, draw: Callable[[Canvas, float], None], *, can_grow: bool = False
    ) -> None:
        super().__init__()
        self.high_mm, self.draw_mm, self.can_grow = high_mm, draw, can_grow

    def wrap(self, wide: float, _high: float) -> tuple[float, float]:
        self.width = wide
        return wide, self.high_mm * pens.POINTS_PER_MM

    def draw(self) -> None:
        self.draw_mm(self.canv, self.width / pens.POINTS_PER_MM)


@dataclass(frozen=True, kw_only=True)
class Furniture:
    """The blocks beside the pictures of a sheet.

    Attributes:
        paper: paper, including the size of the space for the blocks.
        placed: flowables, each with left, bottom and width on the paper in mm.
    """

    paper: Paper
    placed: tuple[tuple[Any, tuple[float, float, float]], ...]

    def draw(self, canvas: Canvas) -> None:
        """Draw all blocks, and the frame of the sheet."""
        paper = self.paper
        for flowable, (left, bottom, wide) in self.placed:
            flowable.wrapOn(canvas, wide * pens.POINTS_PER_MM, paper.height_mm * pens.POINTS_PER_MM)
            flowable.drawOn(canvas, left * pens.POINTS_PER_MM, bottom * pens.POINTS_PER_MM)
        right, top = paper.width_mm - MARGIN_MM, paper.height_mm - MARGIN_MM
        corners = [(MARGIN_MM, MARGIN_MM), (right, MARGIN_MM), (right, top), (MARGIN_MM, top)]
        pens.line(canvas, corners, width_mm=pens.FRAME_MM, is_closed=True)
        split = [(right - paper.block_mm, MARGIN_MM), (right - paper.block_mm, top)]
        if paper.layout == "strip":
            height = MARGIN_MM + paper.block_mm
            split = [(MARGIN_MM, height), (right, height)]
        pens.line(canvas, split, width_mm=pens.MEDIUM_MM)


def furnished(
    paper: Paper, drawing: Drawing, sheet: Sheet, *, is_brief: bool = False
) -> Furniture | None:
    """Pack the blocks beside the pictures; None if the paper is too small.

    Text is at least 2.5 mm high. The narrowest column or the lowest strip that fits is used, unless
    the paper fixes its size. With `is_brief`, key plans are omitted, so that a smaller paper
    suffices.
    """
    is_column = paper.layout == "column"
    wide, high = paper.width_mm - 2 * MARGIN_MM, paper.height_mm - 2 * MARGIN_MM
    most_mm = _MOST_SHARE * (wide if is_column else high)
    sizes = _COLUMNS_MM if is_column else np.arange(_LOWEST_MM, most_mm, _STRIP_STEP_MM).tolist()
    notes: list[Any] = []
    for block_mm in [paper.block_mm] if paper.block_mm else sizes:
        if block_mm > most_mm:
            break
        # The title block goes at the bottom of a column, or at the right end of a strip.
        title_mm = block_mm - 2 * _PADDING_MM if is_column else min(_TITLE_MM, 0.5 * wide)
        if is_column or not notes:  # a strip has blocks of the same width, whatever its height
            title = _title_block(drawing, sheet, title_mm)
            title_high = _high_mm(title, title_mm)
            notes = _notes(drawing, sheet, is_brief=is_brief)
        if not is_column and title_high > block_mm:
            continue
        if is_column:
            lefts, column_mm = [MARGIN_MM + wide - block_mm + _PADDING_MM], title_mm
            corner, room = (lefts[0], MARGIN_MM + _PADDING_MM), high - title_high - _GAP_MM
        else:
            n_columns = max(1, int((wide - title_mm) / _STRIP_COLUMN_MM))
            pitch_mm = (wide - title_mm) / n_columns
            lefts = [MARGIN_MM + _PADDING_MM + k * pitch_mm for k in range(n_columns)]
            column_mm = pitch_mm - 2 * _PADDING_MM
            corner, room = (MARGIN_MM + wide - title_mm, MARGIN_MM), block_mm
        top = MARGIN_MM + (high if is_column else block_mm)
        packed = _packed(notes, column_mm, lefts, top, room - 2 * _PADDING_MM)
        if packed is not None:
            return Furniture(
                paper=replace(paper, block_mm=block_mm),
                placed=(*packed, (title, (*corner, title_mm))),
            )
    return None


def _high_mm(flowable: Any, wide_mm: float) -> float:
    return float(flowable.wrap(wide_mm * pens.POINTS_PER_MM, 1e5)[1]) / pens.POINTS_PER_MM


def _packed(
    flowables: Sequence[Any],
    wide_mm: float,
    lefts: Sequence[float],
    top_mm: float,
    high_mm: float,
) -> list[tuple[Any, tuple[float, float, float]]] | None:
    """Fill columns from the left, each from the top; None if they do not fit.

    Key plans come last, and use the remaining height of a column, up to their maximum height.
    """
    placed: list[tuple[Any, tuple[float, float, float]]] = []
    column, used = 0, 0.0
    for place, flowable in enumerate(flowables):
        is_plan = getattr(flowable, "can_grow", False)
        high = _PLAN_MM[0] if is_plan else _high_mm(flowable, wide_mm)
        if used and used + high > high_mm:
            column, used = column + 1, 0.0
        if column == len(lefts) or used + high > high_mm + 1e-6:
            return None
        if is_plan:
            later = _PLAN_MM[0] * len(flowables[place + 1 :])
            high = max(high, min(_PLAN_MM[1], high_mm - used - later))
            flowable.high_mm = high
        top = top_mm - _PADDING_MM - used
        placed.append((flowable, (lefts[column], top - high, wide_mm)))
        used += high + _GAP_MM
    return placed


def _notes(drawing: Drawing, sheet: Sheet, *, is_brief: bool) -> list[Any]:
    language = drawing.language
    found: list[Any] = [_scale_bar(drawing)]
    if drawing.grid > 0.0:
        digits = f"{drawing.grid:.6g}"
        axes = drawing.axes.phrase.text(language)
        grid = label("grid_note", language, step=digits, unit=drawing.unit, axes=axes)
        found.append(pens.paragraph(grid))
    found += [pens.paragraph(note.text(language)) for note in drawing.text.notes]
    found += _legend(drawing, sheet)
    if is_brief:
        return found
    if sheet.numbered:
        found.append(_plan(*_sheet_key(drawing, sheet)))
    if drawing.plan is not None:
        found.append(_plan(*_key_plan(drawing, drawing.plan)))
    return found


def _scale_bar(drawing: Drawing) -> _Picture:
    mm_per_unit = 1e3 * drawing.unit_m / drawing.scale
    length = round_below(_SEGMENT_MM / mm_per_unit)
    segment = length * mm_per_unit

    def draw(canvas: Canvas, wide_mm: float) -> None:
        count = max(1, min(_MOST_SEGMENTS, int((wide_mm - 14.0) / segment)))
        for place in range(count):
            left = 4.0 + place * segment
            pens.box(
                canvas, (left, 0.5, segment, 2.0), pens.BLACK if place % 2 == 0 else (1.0, 1.0, 1.0)
            )
            sides = [(left, 0.5), (left + segment, 0.5), (left + segment, 2.5), (left, 2.5)]
            pens.line(canvas, sides, is_closed=True)
        for place, text in ((0, "0"), (count, f"{count * length:g} {drawing.unit}")):
            at = (4.0 + place * segment, 4.2)
            pens.write_text(canvas, numerals(text, drawing.language), at, is_centred=True)

    return _Picture(8.0, draw)


def _legend(drawing: Drawing, sheet: Sheet) -> Iterator[Any]:
    language = drawing.language
    rows: list[LegendRow] = []
    if drawing.grid > 0.0 and drawing.axes.across is not None:
        rows.append((partial(pens.cross, x=7.0, y=2.0), label("legend_cross", language)))
    if drawing.heights:
        symbol = partial(pens.height_mark, at_mm=(4.0, 0.6), text="")
        rows.append((symbol, f"{label('legend_height', language)}, {drawing.unit}"))
    if drawing.north is not None:
        symbol = partial(pens.arrow, ends_mm=np.array([[7.0, -0.5], [7.0, 4.5]]))
        meaning = "legend_north" if drawing.up_label == NORTH else "legend_axis"
        rows.append((symbol, f"{drawing.up_label}: {label(meaning, language)}"))
    # Symbols common to several pictures are listed once.
    own = {row[1]: row for view in sheet.views for row in drawing.pictures[view.kind].legend}
    rows += own.values()
    if sheet.numbered:
        symbol = partial(
            pens.line,
            points_mm=[(1.0, 2.0), (13.0, 2.0)],
            width_mm=pens.WIDE_MM,
            dashes_mm=pens.MATCH_DASHES_MM,
        )
        rows.append((symbol, label("legend_match", language)))
    for place, (draw, text) in enumerate(rows):
        # Keep the heading together with the first row.
        heading = (
            [[pens.paragraph(label("legend", language), is_bold=True), ""]] if place == 0 else []
        )
        spans = [("SPAN", (0, 0), (-1, 0))] if heading else []
        symbol = _Picture(4.3, partial(_draw_symbol, draw))
        yield Table(
            [*heading, [symbol, pens.paragraph(text)]],
            colWidths=[_SYMBOL_MM * pens.POINTS_PER_MM, "*"],
            style=[*_PLAIN, *spans],
        )


def _draw_symbol(draw: Callable[[Canvas], None], canvas: Canvas, _wide_mm: float) -> None:
    draw(canvas)


def _plan(
    heading: str,
    points: NDArray[np.float64],
    draw_lines: Callable[
        [Canvas, Callable[[NDArray[np.float64]], NDArray[np.float64]], float], None
    ],
) -> _Picture:
    """Return a heading and, below it, a plan that is drawn as large as the space permits."""
    title = pens.paragraph(heading)

    def draw(canvas: Canvas, wide_mm: float) -> None:
        title_mm = _high_mm(title, wide_mm)
        title.drawOn(canvas, 0.0, (plan.high_mm - title_mm) * pens.POINTS_PER_MM)
        low = points.min(axis=0)
        size = np.maximum(points.max(axis=0) - low, 1e-6)
        # Leave room for the direction arrow on the right.
        limits = np.array([wide_mm - 14.0, plan.high_mm - title_mm - 5.0])
        mm_per_m = float((limits / size).min())
        corner = np.array([2.0, 0.5 * (limits[1] - mm_per_m * size[1]) + 2.0])
        draw_lines(canvas, lambda some: np.asarray(corner + mm_per_m * (some - low)), wide_mm)

    plan = _Picture(_PLAN_MM[0], draw, can_grow=True)
    return plan


def _key_plan(drawing: Drawing, plan: KeyPlan) -> tuple[str, NDArray[np.float64], Any]:
    arrows = [] if plan.arrow is None else [plan.arrow]
    lines = [*plan.walls, *plan.outlines, plan.marked, *arrows]

    def draw(canvas: Canvas, place: Any, wide_mm: float) -> None:
        for wall in plan.walls:
            pens.line(canvas, place(wall), colour=pens.GREY)
        for outline in plan.outlines:
            pens.line(canvas, place(outline), width_mm=pens.MEDIUM_MM)
        is_area = len(plan.marked) > 2
        pens.line(
            canvas, place(plan.marked), width_mm=pens.FRAME_MM, colour=pens.RED, is_closed=is_area
        )
        if plan.arrow is not None:
            pens.arrow(canvas, place(plan.arrow), pens.RED)
        right = wide_mm - 4.0
        pens.arrow(canvas, np.array([[right, 2.0], [right, 10.0]]))
        pens.write_text(canvas, plan.up_label, (right, 11.0), is_centred=True)
        # The marked wall is numbered first, because not all numbers fit where walls are close
        # together.
        placed = {n: place(wall) for n, wall in zip(plan.numbers, plan.walls, strict=True)}
        numbered: list[NDArray[np.float64]] = []
        for number in sorted(placed, key=lambda n: (n != plan.number, -_length(placed[n]))):
            middle = placed[number].mean(axis=0)
            room = 1.5 * pens.text_width_mm(str(number)) + pens.TEXT_MM
            is_close = any(float(np.linalg.norm(middle - other)) < room for other in numbered)
            if _length(placed[number]) >= room and not is_close:
                numbered.append(middle)
                pens.write_on_white(canvas, str(number), (float(middle[0]), float(middle[1])))

    heading = "key_plan"
    if plan.arrow is None or plan.number < 0:
        heading = "key_level" if plan.arrow is None else "key_section"
    return label(heading, drawing.language), np.vstack(lines), draw


def _length(ends: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(ends[1] - ends[0]))


def _sheet_key(drawing: Drawing, sheet: Sheet) -> tuple[str, NDArray[np.float64], Any]:
    """Return a diagram of how a wall is divided into sheets, with this sheet filled."""
    boxes = {number: np.array(part.corners_m) * [1.0, -1.0] for number, part in sheet.numbered}

    def draw(canvas: Canvas, place: Any, _wide_mm: float) -> None:
        for number, corners in boxes.items():
            on_paper = place(corners)
            (left, bottom), (right, top) = on_paper.min(axis=0), on_paper.max(axis=0)
            if number == sheet.number:
                pens.box(canvas, (left, bottom, right - left, top - bottom), (1.0, 0.75, 0.75))
            pens.line(canvas, on_paper, is_closed=True)
            if (
                min(right - left - pens.text_width_mm(str(number)), top - bottom - pens.TEXT_MM)
                > 0.6
            ):
                middle = (0.5 * (left + right), 0.5 * (bottom + top - pens.TEXT_MM))
                pens.write_text(canvas, str(number), middle, is_centred=True)

    heading = label("key_sheets", drawing.language, wall=drawing.text.name)
    return heading, np.vstack(list(boxes.values())), draw


def _title_block(drawing: Drawing, sheet: Sheet, wide_mm: float) -> Any:
    tables = [_revisions(drawing, wide_mm)] if drawing.text.block.revisions else []
    tables.append(_title_table(drawing, sheet, wide_mm))
    return Table(
        [[table] for table in tables], colWidths=[wide_mm * pens.POINTS_PER_MM], style=_PLAIN
    )


def _revisions(drawing: Drawing, wide_mm: float) -> Any:
    rows = [
        [pens.paragraph(text) for text in (one.mark, one.date, one.text, one.by)]
        for one in reversed(drawing.text.block.revisions)
    ]
    shares = (0.12, 0.28, 0.42, 0.18)
    return Table(
        rows, colWidths=[share * wide_mm * pens.POINTS_PER_MM for share in shares], style=_style()
    )


def _title_table(drawing: Drawing, sheet: Sheet, wide_mm: float) -> Any:
    block = drawing.text.block
    cells: list[tuple[list[Any], bool]] = []
    if block.logo is not None or block.organisation:
        head = [_logo(str(block.logo), 0.9 * wide_mm)] if block.logo is not None else []
        if block.organisation:
            head.append(_bold(block.organisation))
        cells.append((head, True))
    if block.project:
        cells.append(([_bold(block.project)], True))
    names = [block.title, drawing.text.name] if block.title else [drawing.text.name]
    title = [_bold(names[0]), *map(pens.paragraph, names[1:])]
    cells.append(
        (
            [*title, pens.paragraph(", ".join(dict.fromkeys(view.kind for view in sheet.views)))],
            True,
        )
    )
    cells += [
        ([_small(name), pens.paragraph(value)], False) for name, value in _named(drawing, sheet)
    ]
    cells += list(_scale_and_sheet(drawing, sheet))
    if block.note:
        cells.append(([_small(label("note", drawing.language)), pens.paragraph(block.note)], True))
    if block != type(block)():
        room = _Picture(_SIGNATURE_MM - 5.0, lambda _canvas, _wide: None)
        cells.append(([_small(label("signature", drawing.language)), room], True))
    seal_mm = wide_mm if wide_mm < _FOUR_COLUMNS_MM else 0.5 * wide_mm
    cells.append(([_seal(drawing, seal_mm)], True))
    n_columns = 2 if wide_mm < _FOUR_COLUMNS_MM else 4
    width = wide_mm * pens.POINTS_PER_MM
    return Table([*_rows(cells, n_columns, wide_mm)], colWidths=[width], style=_PLAIN)


def _named(drawing: Drawing, sheet: Sheet) -> Iterator[tuple[str, str]]:
    """Yield the title block's labelled fields, with the client's own fields in the middle."""
    language, block = drawing.language, drawing.text.block
    number = f"{label('sheet', language)} {sheet.number}"
    last = block.revisions[-1].mark if block.revisions else ""
    drawn = f"{block.drawing}, {drawing.text.name}, {number}" if block.drawing else ""
    for key in ("client", "site"):
        if getattr(block, key):
            yield label(key, language), getattr(block, key)
    yield from block.fields.items()
    values = {key: getattr(block, key) for key in ("author", "checked_by", "date")}
    for key, value in {**values, "drawing": drawn, "revision": block.revision or last}.items():
        if value:
            yield label(key, language), value


def _scale_and_sheet(drawing: Drawing, sheet: Sheet) -> Iterator[tuple[list[Any], bool]]:
    language = drawing.language
    # Architects' imperial scales are given in inches on paper per foot.
    is_ruler = drawing.unit == "ft" and 12 <= drawing.scale <= 192 and drawing.scale in SCALES_FT
    inches = Fraction(12, drawing.scale) if is_ruler else None
    text = f"1:{drawing.scale}" + (f' ({inches}" = 1\'-0")' if inches else "")
    high_mm = pens.TITLE_MM if inches is None else pens.HEADING_MM
    large = pens.paragraph(text, high_mm=high_mm, is_bold=True)
    yield [_small(label("scale", language)), large], False
    which = label("sheet_of", language, number=sheet.number, count=sheet.count)
    size = sheet.paper.name or f"{sheet.paper.width_mm:g} x {sheet.paper.height_mm:g} mm"
    yield [pens.paragraph(which), pens.paragraph(f"{label('paper', language)} {size}")], False


def _rows(
    cells: Sequence[tuple[list[Any], bool]], n_columns: int, wide_mm: float
) -> Iterator[list[Any]]:
    """Arrange cells in rows; wide cells take two columns, and the last cell the rest of its row."""
    rows: list[list[tuple[list[Any], int]]] = [[]]
    for content, is_wide in cells:
        span = 2 if is_wide else 1
        if sum(taken for _, taken in rows[-1]) + span > n_columns:
            rows.append([])
        rows[-1].append((content, span))
    column = wide_mm * pens.POINTS_PER_MM / n_columns
    for row in rows:
        widths = [column * span for _, span in row]
        widths[-1] += column * n_columns - sum(widths)
        yield [Table([[content for content, _ in row]], colWidths=widths, style=_style())]


def _style() -> list[Any]:
    black = Color(0, 0, 0)
    whole = ((0, 0), (-1, -1))
    return [
        ("GRID", *whole, pens.THIN_MM * pens.POINTS_PER_MM, black),
        ("BOX", *whole, pens.WIDE_MM * pens.POINTS_PER_MM, black),
        ("VALIGN", *whole, "TOP"),
        *((f"{side}PADDING", *whole, 1.2 * pens.POINTS_PER_MM) for side in ("LEFT", "RIGHT")),
        *((f"{side}PADDING", *whole, 0.6 * pens.POINTS_PER_MM) for side in ("TOP", "BOTTOM")),
    ]


def _bold(text: str) -> Any:
    return pens.paragraph(text, high_mm=pens.HEADING_MM, is_bold=True)


def _small(text: str) -> Any:
    return pens.paragraph(text, colour=pens.GREY)


def _logo(path: str, most_mm: float) -> Any:
    logo = Image(path, hAlign="LEFT")
    factor = min(
        _LOGO_MM * pens.POINTS_PER_MM / logo.imageHeight,
        most_mm * pens.POINTS_PER_MM / logo.imageWidth,
    )
    logo.drawHeight, logo.drawWidth = factor * logo.imageHeight, factor * logo.imageWidth
    return logo


def _seal(drawing: Drawing, wide_mm: float) -> Any:
    from reportlab.graphics.barcode.qr import QrCodeWidget
    from reportlab.graphics.shapes import Drawing

    digest = drawing.text.digest
    side = _QR_MM * pens.POINTS_PER_MM
    code = QrCodeWidget(
        f"sha256:{digest}", barLevel="M", barWidth=side, barHeight=side, barBorder=4
    )
    rows = [
        pens.paragraph(label("record", drawing.language)),
        *(pens.paragraph(digest[k : k + 16]) for k in (0, 16, 32, 48)),
        pens.paragraph(drawing.text.run),
    ]
    left = side + 1.0 * pens.POINTS_PER_MM
    cells = [[Drawing(side, side, code), rows]]
    return Table(cells, colWidths=[left, (wide_mm - 2.4) * pens.POINTS_PER_MM - left], style=_PLAIN)
