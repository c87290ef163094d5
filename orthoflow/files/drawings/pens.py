"""Lines and text on a sheet, in millimetres from its bottom-left corner."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.foreign_text import shown

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

POINTS_PER_MM: Final = 72.0 / 25.4
FONT: Final = "DejaVuSans"
THIN_MM: Final = 0.1
LABEL_MM: Final = 2.0


def line(
    canvas: Canvas,
    points_mm: Sequence[tuple[float, float]] | NDArray[np.float64],
    *,
    width_mm: float = THIN_MM,
    is_closed: bool = False,
) -> None:
    """Draw a line through points (n, 2) on the paper."""
    canvas.setLineWidth(width_mm * POINTS_PER_MM)
    path = canvas.beginPath()
    for place, (x, y) in enumerate(points_mm):
        (path.lineTo if place else path.moveTo)(x * POINTS_PER_MM, y * POINTS_PER_MM)
    if is_closed:
        path.close()
    canvas.drawPath(path)


def write_text(
    canvas: Canvas,
    text: str,
    at_mm: tuple[float, float],
    *,
    high_mm: float = LABEL_MM,
    is_bold: bool = False,
    turned_deg: float = 0.0,
    is_centred: bool = False,
) -> None:
    """Write a line of text, its height that of its capital letters; foreign letters harmless.

    It is turned counter-clockwise about where it begins, or about its middle where it is centred.
    """
    canvas.saveState()
    canvas.setFont(f"{FONT}-Bold" if is_bold else FONT, font_points(high_mm))
    canvas.translate(at_mm[0] * POINTS_PER_MM, at_mm[1] * POINTS_PER_MM)
    if turned_deg:
        canvas.rotate(turned_deg)
    (canvas.drawCentredString if is_centred else canvas.drawString)(0, 0, shown(text))
    canvas.restoreState()


def font_points(high_mm: float) -> float:
    """Size of the font whose capital letters are so high."""
    return high_mm * POINTS_PER_MM / 0.729


def write_on_white(
    canvas: Canvas,
    text: str,
    middle_mm: tuple[float, float],
    *,
    high_mm: float = LABEL_MM,
    turned_deg: float = 0.0,
) -> None:
    """Write a line of text around a place, on white: what lies below is cut out for it."""
    along = np.array([math.cos(math.radians(turned_deg)), math.sin(math.radians(turned_deg))])
    middle = np.array(middle_mm)
    half = 0.5 * text_width_mm(text, high_mm) + 0.4 * high_mm
    canvas.saveState()
    canvas.setStrokeColorRGB(1.0, 1.0, 1.0)
    line(canvas, np.array([middle - half * along, middle + half * along]), width_mm=1.6 * high_mm)
    canvas.restoreState()
    # Its capital letters stand as far above the middle as below it.
    x, y = middle + 0.5 * high_mm * np.array([along[1], -along[0]])
    write_text(
        canvas,
        text,
        (float(x), float(y)),
        high_mm=high_mm,
        turned_deg=turned_deg,
        is_centred=True,
    )


def text_width_mm(text: str, high_mm: float, *, is_bold: bool = True) -> float:
    """How wide a line of text is on the paper."""
    from reportlab.pdfbase.pdfmetrics import stringWidth

    font = f"{FONT}-Bold" if is_bold else FONT
    return float(stringWidth(shown(text), font, font_points(high_mm))) / POINTS_PER_MM
