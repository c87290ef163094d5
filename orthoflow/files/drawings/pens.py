"""Pages, lines and text, in millimetres from the bottom-left corner of the paper.

Line widths are those of ISO 128-2, text heights those of ISO 3098, with a minimum of 2.5 mm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from html import escape
from io import BytesIO
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

POINTS_PER_MM: Final = 72.0 / 25.4
FONT: Final = "DejaVuSans"
# Line widths of the ISO 128-2 series, whose ratio is about sqrt(2); 0.18 is not used.
FINE_MM: Final = 0.13
THIN_MM: Final = 0.25
MEDIUM_MM: Final = 0.35
WIDE_MM: Final = 0.5
FRAME_MM: Final = 0.7
# Text heights from ISO 3098.
TEXT_MM: Final = 2.5
HEADING_MM: Final = 3.5
TITLE_MM: Final = 5.0
BLACK: Final = (0.0, 0.0, 0.0)
WHITE: Final = (1.0, 1.0, 1.0)
RED: Final = (0.8, 0.0, 0.0)
GREY: Final = (0.5, 0.5, 0.5)
# Colours of contours in front of the plane, of contours behind it, and of openings.
BEFORE: Final = (0.80, 0.25, 0.05)
BEHIND: Final = (0.05, 0.30, 0.75)
OPENING: Final = (0.0, 0.40, 0.45)
# Line type 10 of ISO 128-2: long dash, gap, dot, gap.
MATCH_DASHES_MM: Final = (8.0, 1.5, 0.5, 1.5)
# Height of the capital letters of the font, relative to the font size.
_CAPITALS: Final = 0.729

Colour = tuple[float, float, float]


@contextmanager
def sheet_canvas(stream: BytesIO, size_mm: tuple[float, float]) -> Iterator[Canvas]:
    """Open a PDF page whose coordinates are millimetres."""
    from reportlab import rl_config
    from reportlab.pdfgen.canvas import Canvas

    # Embed pictures as binary data; encoded as text, they would be 25 % larger and slow to write.
    rl_config.useA85 = 0
    register_fonts()
    size = tuple(POINTS_PER_MM * edge for edge in size_mm)
    canvas = Canvas(stream, pagesize=size, pageCompression=1, invariant=1)
    canvas.setCreator("orthoflow")
    yield canvas


def line(
    canvas: Canvas,
    points_mm: Sequence[tuple[float, float]] | NDArray[np.float64],
    *,
    width_mm: float = FINE_MM,
    colour: Colour = BLACK,
    dashes_mm: Sequence[float] = (),
    is_closed: bool = False,
) -> None:
    """Draw a line through points (n, 2) on the paper."""
    canvas.setLineWidth(width_mm * POINTS_PER_MM)
    canvas.setStrokeColorRGB(*colour)
    if dashes_mm:
        canvas.setDash([POINTS_PER_MM * length for length in dashes_mm])
    path = canvas.beginPath()
    for place, (x, y) in enumerate(points_mm):
        (path.lineTo if place else path.moveTo)(x * POINTS_PER_MM, y * POINTS_PER_MM)
    if is_closed:
        path.close()
    canvas.drawPath(path)
    if dashes_mm:
        canvas.setDash()


def fill(
    canvas: Canvas, outlines_mm: Sequence[NDArray[np.float64]], colour: Colour = BLACK
) -> None:
    """Fill the areas within outlines, (n, 2) each; an outline inside another one is a hole."""
    path = canvas.beginPath()
    for outline in outlines_mm:
        for place, (x, y) in enumerate(outline):
            (path.lineTo if place else path.moveTo)(x * POINTS_PER_MM, y * POINTS_PER_MM)
        path.close()
    canvas.setFillColorRGB(*colour)
    canvas.drawPath(path, stroke=0, fill=1, fillMode=0)


def box(
    canvas: Canvas, sides_mm: tuple[float, float, float, float], colour: Colour = BLACK
) -> None:
    """Fill a rectangle: left, bottom, width and height."""
    canvas.setFillColorRGB(*colour)
    canvas.rect(*(POINTS_PER_MM * side for side in sides_mm), stroke=0, fill=1)


def arrow(canvas: Canvas, ends_mm: NDArray[np.float64], colour: Colour = BLACK) -> None:
    """Draw an arrow from the first to the second of two positions (2, 2)."""
    along = (ends_mm[1] - ends_mm[0]) / max(float(np.linalg.norm(ends_mm[1] - ends_mm[0])), 1e-9)
    aside = np.array([-along[1], along[0]])
    barbs = [ends_mm[1] - 2.5 * along + side * 0.9 * aside for side in (1.0, -1.0)]
    for points in (ends_mm, np.array([barbs[0], ends_mm[1], barbs[1]])):
        line(canvas, points, width_mm=MEDIUM_MM, colour=colour)


def cross(canvas: Canvas, x: float, y: float) -> None:
    """Draw a 3 mm cross, black on white, so that it is visible on any picture."""
    for colour, width_mm in ((WHITE, WIDE_MM), (BLACK, FINE_MM)):
        line(canvas, [(x - 1.5, y), (x + 1.5, y)], width_mm=width_mm, colour=colour)
        line(canvas, [(x, y - 1.5), (x, y + 1.5)], width_mm=width_mm, colour=colour)


def height_mark(canvas: Canvas, at_mm: tuple[float, float], text: str) -> None:
    """Draw a height mark with its tip at a position, and the height beside it."""
    x, y = at_mm
    line(canvas, [(x - 2.0, y), (x + 2.0, y)])
    tip = [(x, y), (x - 1.2, y + 2.1), (x + 1.2, y + 2.1)]
    line(canvas, tip, width_mm=THIN_MM, is_closed=True)
    write_text(canvas, text, (x + 2.2, y + 0.3))


def write_text(  # noqa: PLR0913 - properties of a text
    canvas: Canvas,
    text: str,
    at_mm: tuple[float, float],
    *,
    high_mm: float = TEXT_MM,
    is_bold: bool = False,
    turned_deg: float = 0.0,
    is_centred: bool = False,
    colour: Colour = BLACK,
) -> None:
    """Write a line of text with capital letters of a given height; untrusted text is escaped.

    The line is rotated counter-clockwise about its beginning, or about its centre if centred.
    """
    canvas.saveState()
    canvas.translate(at_mm[0] * POINTS_PER_MM, at_mm[1] * POINTS_PER_MM)
    if turned_deg:
        canvas.rotate(turned_deg)
    canvas.setFillColorRGB(*colour)
    left = -0.5 * text_width_mm(text, high_mm, is_bold=is_bold) if is_centred else 0.0
    for font, part in _runs(shown(text), is_bold=is_bold):
        canvas.setFont(font, font_points(high_mm))
        canvas.drawString(left * POINTS_PER_MM, 0, part)
        left += float(canvas.stringWidth(part, font, font_points(high_mm))) / POINTS_PER_MM
    canvas.restoreState()


def write_on_white(
    canvas: Canvas,
    text: str,
    middle_mm: tuple[float, float],
    *,
    turned_deg: float = 0.0,
    colour: Colour = BLACK,
) -> None:
    """Write a line of text around a position, on a white background."""
    along = np.array([math.cos(math.radians(turned_deg)), math.sin(math.radians(turned_deg))])
    aside = np.array([-along[1], along[0]])
    half = 0.5 * text_width_mm(text, TEXT_MM) + 0.4 * TEXT_MM
    corners = [
        np.array(middle_mm) + side * half * along + up * 0.8 * TEXT_MM * aside
        for side, up in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    fill(canvas, [np.array(corners)], WHITE)
    # The capital letters are centred vertically on the position.
    x, y = np.array(middle_mm) - 0.5 * TEXT_MM * aside
    at = (float(x), float(y))
    write_text(canvas, text, at, turned_deg=turned_deg, is_centred=True, colour=colour)


def font_points(high_mm: float) -> float:
    """Return the font size at which capital letters have this height."""
    return high_mm * POINTS_PER_MM / _CAPITALS


def text_width_mm(text: str, high_mm: float = TEXT_MM, *, is_bold: bool = False) -> float:
    """Return the width of a line of text on the paper."""
    from reportlab.pdfbase.pdfmetrics import stringWidth

    register_fonts()
    widths = (
        stringWidth(part, font, font_points(high_mm))
        for font, part in _runs(shown(text), is_bold=is_bold)
    )
    return float(sum(widths)) / POINTS_PER_MM


def paragraph(
    text: str, *, high_mm: float = TEXT_MM, is_bold: bool = False, colour: Colour = BLACK
) -> Any:
    """Return a flowable of wrapped text, with fonts that contain its letters."""
    from reportlab.lib.colors import Color
    from reportlab.lib.styles import ParagraphStyle
    from reportlab.platypus import Paragraph

    register_fonts()
    style = ParagraphStyle(
        name="sheet",
        fontName=f"{FONT}-Bold" if is_bold else FONT,
        fontSize=font_points(high_mm),
        leading=1.7 * high_mm * POINTS_PER_MM,
        textColor=Color(*colour),
        splitLongWords=True,
    )
    parts = (
        escape(part) if font.startswith(FONT) else f'<font name="{font}">{escape(part)}</font>'
        for font, part in _runs(shown(text), is_bold=is_bold)
    )
    return Paragraph("".join(parts), style)


@lru_cache(maxsize=1)
def register_fonts() -> frozenset[int]:
    """Register the fonts for Latin, Greek and Cyrillic, and return their code points."""
    import matplotlib as mpl
    from reportlab.pdfbase.pdfmetrics import registerFont
    from reportlab.pdfbase.ttfonts import TTFont

    folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    bold, plain = (
        TTFont(name, str(folder / f"DejaVuSans{suffix}.ttf"))
        for name, suffix in ((f"{FONT}-Bold", "-Bold"), (FONT, ""))
    )
    registerFont(bold)
    registerFont(plain)
    return frozenset(set(plain.face.charToGlyph) & set(bold.face.charToGlyph))


def _runs(text: str, *, is_bold: bool) -> Iterator[tuple[str, str]]:
    usual = f"{FONT}-Bold" if is_bold else FONT
    known = register_fonts()
    for font, letters in groupby(
        text, lambda letter: usual if ord(letter) in known else fallback_font(letter)
    ):
        yield font, "".join(letters)


@lru_cache(maxsize=4096)
def fallback_font(letter: str) -> str:
    """Create a font with a single letter from an installed font, and return the new font's name.

    reportlab only embeds fonts with TrueType outlines, so others are converted.

    Raises:
        InputError: no installed font has the letter.
    """
    from fontTools.fontBuilder import FontBuilder
    from fontTools.pens.cu2quPen import Cu2QuPen
    from fontTools.pens.ttGlyphPen import TTGlyphPen
    from fontTools.ttLib import TTFont as FontFile
    from reportlab.pdfbase.pdfmetrics import registerFont
    from reportlab.pdfbase.ttfonts import TTFont

    code = ord(letter)
    path = next((path for path, codes in installed_letters().items() if code in codes), None)
    if path is None:
        raise InputError(
            f"no installed font contains the character {letter} (U+{code:04X}), which is used on "
            "the sheet: install one that does (Noto Sans CJK contains Chinese, Japanese and "
            "Korean), or write the text in Latin, Greek or Cyrillic letters"
        )
    outline = TTGlyphPen(None)
    with FontFile(path, fontNumber=0) as source:
        glyph = source.getGlyphSet()[source.getBestCmap()[code]]
        units, wide = int(source["head"].unitsPerEm), glyph.width
        glyph.draw(Cu2QuPen(outline, 0.001 * units, reverse_direction="glyf" not in source))
    builder = FontBuilder(units, isTTF=True)
    builder.setupGlyphOrder([".notdef", "letter"])
    builder.setupCharacterMap({code: "letter"})
    builder.setupGlyf({".notdef": TTGlyphPen(None).glyph(), "letter": outline.glyph()})
    builder.setupHorizontalMetrics({".notdef": (units, 0), "letter": (wide, 0)})
    builder.setupHorizontalHeader(ascent=units, descent=-units // 4)
    name = f"Letter-{code:04X}"
    builder.setupNameTable({"familyName": name, "styleName": "Regular", "psName": name})
    builder.setupOS2()
    builder.setupPost()
    content = BytesIO()
    builder.font.save(content)
    content.seek(0)
    registerFont(TTFont(name, content))
    return name


@lru_cache(maxsize=1)
def installed_letters() -> dict[str, frozenset[int]]:
    """Return the code points of each system font file; of a collection, only the first font's."""
    from fontTools.ttLib import TTFont, TTLibError
    from matplotlib.font_manager import findSystemFonts

    found = {}
    for path in sorted(findSystemFonts()):
        try:
            with TTFont(path, fontNumber=0, lazy=True) as font:
                found[path] = frozenset(font.getBestCmap() or {})
        except (TTLibError, OSError, KeyError, AssertionError):
            continue
    return found
