"""Pictures of a wall for its sheets: a raster with contours of its depth, and openings."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings import pens
from orthoflow.files.drawings.printed_pictures import (
    contours,
    encode_part,
    label_place,
    stretch_of,
)
from orthoflow.files.drawings.sheet_contents import LegendRow, Picture, Placed
from orthoflow.files.drawings.words import Language, label
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

# An area outlined on a picture: a text, written into it if it is wide enough, its parts (", ")
# below each other; and its outline (n, 2) in metres right and down from the top-left corner.
Area = tuple[str, NDArray[np.float64]]
_MIDDLE: Final = [(1.0, 2.0), (13.0, 2.0)]
_BOX: Final = [(3.0, 0.3), (11.0, 0.3), (11.0, 3.7), (3.0, 3.7)]


def wall_picture(
    raster: Path,
    *,
    is_depth: bool = False,
    is_flipped: bool = False,
    areas: Sequence[Area] = (),
    language: Language = "en",
) -> Picture:
    """Return a picture of a wall.

    Args:
        raster: GeoTIFF.
        is_depth: it has depths, which are drawn with contours.
        is_flipped: its rows go up the paper, as those of ceilings do.
        areas: openings of the wall.
        language: of the legend.
    """

    def draw(placed: Placed) -> None:
        draw_raster(placed, raster, is_flipped=is_flipped)
        if is_depth:
            _draw_contours(placed, raster, is_flipped=is_flipped)
        _draw_areas(placed, areas)

    legend: list[LegendRow] = []
    if areas:
        legend.append(
            (
                lambda canvas: pens.line(
                    canvas, _BOX, width_mm=pens.MEDIUM_MM, colour=pens.OPENING, is_closed=True
                ),
                label("legend_opening", language),
            )
        )
    if is_depth:
        stretch = stretch_of(raster)
        interval = f"{1e3 * stretch.interval:g}"
        low, high = (f"{1e3 * value:+.0f}" for value in (stretch.low, stretch.high))
        legend += [
            (
                lambda canvas: pens.line(
                    canvas, _MIDDLE, width_mm=pens.THIN_MM, colour=pens.BEFORE
                ),
                label("legend_before", language, interval=interval),
            ),
            (
                lambda canvas: pens.line(
                    canvas, _MIDDLE, width_mm=pens.THIN_MM, colour=pens.BEHIND
                ),
                label("legend_behind", language, interval=interval),
            ),
            (
                _grey_ramp,
                label("legend_grey", language, low=low, high=high),
            ),
        ]
    legend.append(
        (
            lambda canvas: pens.line(canvas, _BOX, colour=pens.GREY, is_closed=True),
            label("legend_empty", language),
        )
    )
    return Picture(draw=draw, legend=tuple(legend))


def _grey_ramp(canvas: Canvas) -> None:
    for step in range(24):
        pens.box(canvas, (1.0 + 0.5 * step, 0.5, 0.5, 3.0), (step / 23.0,) * 3)


def draw_raster(placed: Placed, raster: Path, *, is_flipped: bool = False) -> None:
    """Draw the part of a raster that a picture shows, white where empty."""
    from reportlab.lib.utils import ImageReader

    picture = encode_part(raster, placed.view.part, scale=placed.scale, is_flipped=is_flipped)
    left, bottom, right, top = placed.edges_mm
    placed.canvas.drawImage(
        ImageReader(BytesIO(picture)),
        *(pens.POINTS_PER_MM * number for number in (left, bottom, right - left, top - bottom)),
    )


def _draw_contours(placed: Placed, raster: Path, *, is_flipped: bool) -> None:
    found = contours(
        raster,
        placed.view.part,
        scale=placed.scale,
        interval_m=stretch_of(raster).interval,
        is_flipped=is_flipped,
    )
    labelled: list[NDArray[np.float64]] = []
    for level, points in found:
        colour = pens.BEFORE if level > 0.0 else pens.BEHIND
        on_paper = placed.on_paper(points)
        pens.line(placed.canvas, on_paper, width_mm=pens.FINE_MM, colour=colour)
        text = f"{round(1e3 * level, 6):+g}"
        place = label_place(on_paper, pens.text_width_mm(text), labelled)
        if place is not None:
            middle_mm, turned_deg = place
            labelled.append(np.array(middle_mm))
            pens.write_on_white(
                placed.canvas, text, middle_mm, turned_deg=turned_deg, colour=colour
            )


def _draw_areas(placed: Placed, areas: Sequence[Area]) -> None:
    """Outline openings, clipped to the picture."""
    left, bottom, right, top = placed.edges_mm
    with placed.clipped() as canvas:
        for text, outline_m in areas:
            outline = placed.on_paper(outline_m)
            # White below, so that the line is visible on any picture.
            pens.line(canvas, outline, width_mm=1.0, colour=pens.WHITE, is_closed=True)
            pens.line(canvas, outline, width_mm=pens.MEDIUM_MM, colour=pens.OPENING, is_closed=True)
            low = np.maximum(outline.min(axis=0), (left, bottom))
            high = np.minimum(outline.max(axis=0), (right, top))
            # The parts of the text on white, from the top, if there is room.
            rows = shown(text).split(", ")
            wide_mm = max(pens.text_width_mm(row) for row in rows) + 2.0
            high_mm = 1.7 * pens.TEXT_MM * len(rows) + 1.0
            if high[0] - low[0] >= wide_mm + 2.0 and high[1] - low[1] >= high_mm + 2.0:
                pens.box(
                    canvas, (low[0] + 1.0, high[1] - 1.0 - high_mm, wide_mm, high_mm), pens.WHITE
                )
                for place, row in enumerate(rows):
                    at = (low[0] + 2.0, high[1] - 1.2 - 1.7 * pens.TEXT_MM * (place + 0.8))
                    pens.write_text(canvas, row, at, colour=pens.OPENING)
