"""Sheets: a wall's pictures on paper in exact scale, as PDF.

Pictures are embedded once; all else is vectors and text. Lengths on the paper are millimetres from
its bottom-left corner until reportlab takes them, in points.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import StoreError
from orthoflow.files.drawings.contour_labels import label_place
from orthoflow.files.drawings.papers import MARGIN_MM, Paper, View
from orthoflow.files.drawings.pens import (
    FONT,
    LABEL_MM,
    POINTS_PER_MM,
    THIN_MM,
    line,
    text_width_mm,
    write_on_white,
    write_text,
)
from orthoflow.files.drawings.printed_pictures import contours, picture_file, write_picture
from orthoflow.files.drawings.sheet_columns import draw_column
from orthoflow.files.drawings.sheet_contents import Axes, Sheet, WallDrawing
from orthoflow.foreign_text import shown
from orthoflow.geometry import WallFrame

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

_THICK_MM: Final = 0.35
_CONTOUR_TEXT_MM: Final = 1.5
_CROSS_MM: Final = 1.5
_BEFORE: Final = (0.80, 0.25, 0.05)
_BEHIND: Final = (0.05, 0.30, 0.75)
_OPENING: Final = (0.0, 0.40, 0.45)


def axes_of(frame: WallFrame) -> Axes:
    """Coordinates of a raster, those of its GeoTIFF."""
    left_m, top_m = frame.raster_corner_m
    said = {
        "map": f"X east, Y north ({frame.map_crs}), m",
        "wall": "X along the wall from its left edge, H height: "
        f"{_axis_words(np.array(frame.up))}, m",
        "level": "X and Y: the horizontal axes of the scan, m",
        "plane": "X to the right and Y upwards from the top-left corner of the orthoimage, m",
    }[frame.raster_axes]
    return Axes(across=(left_m, 1.0), down=(top_m, frame.raster_down), said=said)


def _axis_words(up: NDArray[np.float64]) -> str:
    """Say which of the scan's axes heights count along, backwards or not."""
    if up.shape != (3,):
        return "unknown"
    axis = int(np.argmax(np.abs(up)))
    if abs(float(up[axis])) < 1.0 - 1e-9:
        return f"along ({', '.join(f'{value:.3f}' for value in up.tolist())}) of the scan"
    return f"{'minus ' if up[axis] < 0.0 else ''}{'xyz'[axis]} of the scan"


def write_sheet(path: Path, drawing: WallDrawing, sheet: Sheet) -> None:
    """Write one sheet.

    Raises:
        StoreError: it cannot be written.
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
                _draw_view(canvas, drawing, view, Path(folder) / f"picture_{place}")
            if sheet.number == 0:
                _draw_cuts(canvas, drawing, sheet)
            _draw_border(canvas, sheet.paper)
            draw_column(canvas, drawing, sheet)
            canvas.showPage()
            canvas.save()
    except OSError as error:
        raise StoreError(f"{path.name} cannot be written: {error}; free some space") from error


@contextmanager
def sheet_canvas(path: Path, paper: Paper) -> Iterator[Canvas]:
    """A page whose unit is the millimetre, with a font that has the letters of Europe."""
    import matplotlib as mpl
    from reportlab import rl_config
    from reportlab.pdfbase.pdfmetrics import registerFont
    from reportlab.pdfbase.ttfonts import TTFont
    from reportlab.pdfgen.canvas import Canvas

    # Pictures as bytes: as text they would be a quarter larger, and slow to write.
    rl_config.useA85 = 0
    fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
    registerFont(TTFont(FONT, str(fonts / "DejaVuSans.ttf")))
    registerFont(TTFont(f"{FONT}-Bold", str(fonts / "DejaVuSans-Bold.ttf")))
    size = (paper.width_mm * POINTS_PER_MM, paper.height_mm * POINTS_PER_MM)
    canvas = Canvas(str(path), pagesize=size, pageCompression=1, invariant=1)
    canvas.setCreator("orthoflow")
    yield canvas


def _draw_view(canvas: Canvas, drawing: WallDrawing, view: View, picture: Path) -> None:
    """Draw a picture with its frame, contours, crosses and coordinates."""
    raster = drawing.rasters[view.kind]
    left, bottom = view.corner_mm
    wide, high = (1e3 * edge / drawing.scale for edge in view.part.size_m)
    write_picture(raster, view.part, picture, scale=drawing.scale)
    canvas.drawImage(
        str(picture_file(picture)),
        *(POINTS_PER_MM * number for number in (left, bottom, wide, high)),
    )
    if view.kind == "depth":
        _draw_contours(canvas, drawing, view)
    _draw_areas(canvas, drawing, view)
    canvas.setStrokeColorRGB(0.0, 0.0, 0.0)
    if drawing.grid_m > 0.0:
        _draw_grid(canvas, drawing, view)
    corners = ((left, bottom), (left + wide, bottom), (left + wide, bottom + high))
    line(canvas, [*corners, (left, bottom + high)], width_mm=_THICK_MM, is_closed=True)


def _draw_contours(canvas: Canvas, drawing: WallDrawing, view: View) -> None:
    found = contours(
        drawing.rasters[view.kind], view.part, scale=drawing.scale, interval_m=drawing.interval_m
    )
    placed: list[NDArray[np.float64]] = []
    for level, points in found:
        colour = _BEFORE if level > 0.0 else _BEHIND
        canvas.setStrokeColorRGB(*colour)
        on_paper = np.array([_on_paper(drawing, view, x, y) for x, y in points.tolist()])
        line(canvas, on_paper, width_mm=0.13)
        label = f"{round(1e3 * level, 6):+g}"
        place = label_place(on_paper, text_width_mm(label, _CONTOUR_TEXT_MM), placed)
        if place is not None:
            placed.append(np.array(place.middle_mm))
            canvas.setFillColorRGB(*colour)
            write_on_white(
                canvas,
                label,
                place.middle_mm,
                high_mm=_CONTOUR_TEXT_MM,
                turned_deg=place.turned_deg,
            )
    canvas.setFillColorRGB(0.0, 0.0, 0.0)


def _draw_areas(canvas: Canvas, drawing: WallDrawing, view: View) -> None:
    """Outline openings, cut off where the picture ends."""
    left, bottom = view.corner_mm
    wide, high = (1e3 * edge / drawing.scale for edge in view.part.size_m)
    canvas.saveState()
    frame = canvas.beginPath()
    frame.rect(*(POINTS_PER_MM * number for number in (left, bottom, wide, high)))
    canvas.clipPath(frame, stroke=0, fill=0)
    for area in drawing.areas:
        outline = [_on_paper(drawing, view, x, y) for x, y in area.outline_m.tolist()]
        # White below, so that the line is seen on any picture.
        for colour, width_mm in (((1.0, 1.0, 1.0), 0.6), (_OPENING, 0.25)):
            canvas.setStrokeColorRGB(*colour)
            line(canvas, outline, width_mm=width_mm, is_closed=True)
        xs, ys = zip(*outline, strict=True)
        _write_inside(canvas, area.text, (min(xs), max(xs), max(ys)))
    canvas.restoreState()


def _write_inside(canvas: Canvas, text: str, limits_mm: tuple[float, float, float]) -> None:
    """Write the parts of a text on white, from the top, where left and right are far enough."""
    left, right, top = limits_mm
    rows = shown(text).split(", ")
    wide = max(text_width_mm(row, LABEL_MM, is_bold=False) for row in rows)
    if right - left < wide + 2.0 * LABEL_MM:
        return
    high = 1.7 * LABEL_MM * len(rows)
    box = (left + 0.5 * LABEL_MM, top - high - LABEL_MM, wide + LABEL_MM, high + 0.5 * LABEL_MM)
    canvas.setFillColorRGB(1.0, 1.0, 1.0)
    canvas.rect(*(POINTS_PER_MM * number for number in box), stroke=0, fill=1)
    canvas.setFillColorRGB(*_OPENING)
    for place, row in enumerate(rows):
        at = (left + LABEL_MM, top - 0.5 * LABEL_MM - 1.7 * LABEL_MM * (place + 0.8))
        write_text(canvas, row, at)
    canvas.setFillColorRGB(0.0, 0.0, 0.0)


def _draw_grid(canvas: Canvas, drawing: WallDrawing, view: View) -> None:
    """Crosses at round coordinates, and the coordinates beside the frame."""
    part = view.part
    columns = list(_marks(drawing.axes.across, part.left_m, part.right_m, drawing.grid_m))
    rows = list(_marks(drawing.axes.down, part.top_m, part.bottom_m, drawing.grid_m))
    left, bottom = view.corner_mm
    right, top = _on_paper(drawing, view, part.right_m, part.top_m)
    # A quarter of a metre needs two.
    digits = len(f"{drawing.grid_m:.4f}".rstrip("0").partition(".")[2])
    for place, value in columns:
        x, _ = _on_paper(drawing, view, place, part.top_m)
        for y, end in ((bottom, bottom - 1.5), (top, top + 1.5)):
            line(canvas, [(x, y), (x, end)])
        write_text(canvas, f"{value:.{digits}f}", (x, bottom - 2.5 - LABEL_MM), is_centred=True)
    for place, value in rows:
        _, y = _on_paper(drawing, view, part.left_m, place)
        for x, end in ((left, left - 1.5), (right, right + 1.5)):
            line(canvas, [(x, y), (end, y)])
        label = (left - 2.5, y)
        write_text(canvas, f"{value:.{digits}f}", label, turned_deg=90.0, is_centred=True)
    # White below black, so that a cross is seen on any picture.
    for colour, width_mm in ((1.0, 0.35), (0.0, THIN_MM)):
        canvas.setStrokeColorRGB(colour, colour, colour)
        for place, _ in columns:
            for down, _ in rows:
                x, y = _on_paper(drawing, view, place, down)
                line(canvas, [(x - _CROSS_MM, y), (x + _CROSS_MM, y)], width_mm=width_mm)
                line(canvas, [(x, y - _CROSS_MM), (x, y + _CROSS_MM)], width_mm=width_mm)


def _marks(
    axis: tuple[float, float], begin_m: float, end_m: float, step: float
) -> Iterator[tuple[float, float]]:
    """Places on the wall where a coordinate is a whole number of steps, and the coordinate."""
    start, slope = axis
    values = sorted(start + slope * place for place in (begin_m, end_m))
    for count in range(math.ceil(values[0] / step - 1e-6), math.floor(values[1] / step + 1e-6) + 1):
        yield (count * step - start) / slope, count * step


def _draw_cuts(canvas: Canvas, drawing: WallDrawing, sheet: Sheet) -> None:
    """Draw onto the index what of the wall is on which sheet."""
    canvas.setStrokeColorRGB(0.8, 0.0, 0.0)
    canvas.setFillColorRGB(0.8, 0.0, 0.0)
    for number, part in sheet.numbered:
        corners = [
            _on_paper(drawing, sheet.views[0], x, y)
            for x, y in (
                *((part.left_m, part.top_m), (part.right_m, part.top_m)),
                *((part.right_m, part.bottom_m), (part.left_m, part.bottom_m)),
            )
        ]
        line(canvas, corners, width_mm=_THICK_MM, is_closed=True)
        (left, top), _, (right, bottom), _ = corners
        high = min(12.0, 0.4 * (top - bottom), 0.3 * (right - left))
        middle = (0.5 * (left + right), 0.5 * (top + bottom) - 0.5 * high)
        write_text(canvas, str(number), middle, high_mm=high, is_bold=True, is_centred=True)
    canvas.setStrokeColorRGB(0.0, 0.0, 0.0)
    canvas.setFillColorRGB(0.0, 0.0, 0.0)


def _on_paper(
    drawing: WallDrawing, view: View, right_m: float, down_m: float
) -> tuple[float, float]:
    """Where a place of the wall lies on the paper, in mm."""
    left, bottom = view.corner_mm
    return (
        left + 1e3 * (right_m - view.part.left_m) / drawing.scale,
        bottom + 1e3 * (view.part.bottom_m - down_m) / drawing.scale,
    )


def _draw_border(canvas: Canvas, paper: Paper) -> None:
    canvas.setStrokeColorRGB(0.0, 0.0, 0.0)
    left, bottom = MARGIN_MM, MARGIN_MM
    right, top = paper.width_mm - MARGIN_MM, paper.height_mm - MARGIN_MM
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    line(canvas, corners, width_mm=0.7, is_closed=True)
    split = right - paper.column_mm
    line(canvas, [(split, bottom), (split, top)], width_mm=_THICK_MM)
