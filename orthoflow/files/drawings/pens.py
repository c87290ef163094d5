"""Lines and text on a sheet, in millimetres from its bottom-left corner."""

from __future__ import annotations

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
    is_upright: bool = False,
    is_centred: bool = False,
) -> None:
    """Write a line of text, its height that of its capital letters; foreign letters harmless."""
    canvas.saveState()
    canvas.setFont(f"{FONT}-Bold" if is_bold else FONT, font_points(high_mm))
    canvas.translate(at_mm[0] * POINTS_PER_MM, at_mm[1] * POINTS_PER_MM)
    if is_upright:
        canvas.rotate(90)
    (canvas.drawCentredString if is_centred else canvas.drawString)(0, 0, shown(text))
    canvas.restoreState()


def font_points(high_mm: float) -> float:
    """Size of the font whose capital letters are so high."""
    return high_mm * POINTS_PER_MM / 0.729
