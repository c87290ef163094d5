"""Lines and letters on paper: as wide, as high and where they are asked for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from reportlab.pdfbase.pdfmetrics import stringWidth

from orthoflow.files.drawings import pens
from tests.drawn_pages import MM, Page, page


@pytest.fixture
def drawn() -> Iterator[Page]:
    with page() as one:
        yield one


def test_a_line_is_a_tenth_of_a_millimetre_wide_and_open_unless_asked_for(drawn: Page) -> None:
    points = np.array([[10.0, 20.0], [30.0, 20.0], [30.0, 5.0]])
    pens.line(drawn, points)  # type: ignore[arg-type]
    pens.line(drawn, points.tolist(), width_mm=0.7, is_closed=True)  # type: ignore[arg-type]
    plain, closed = drawn.lines
    for line in (plain, closed):
        np.testing.assert_allclose(line.points, points)
    assert (plain.width_mm, plain.is_closed) == (pytest.approx(0.1), False)
    assert (closed.width_mm, closed.is_closed) == (pytest.approx(0.7), True)


def test_letters_are_as_high_as_asked_for_and_two_millimetres_else(drawn: Page) -> None:
    pens.write_text(drawn, "wall 1\x07", (12.0, 34.0))  # type: ignore[arg-type]
    pens.write_text(drawn, "ab", (50.0, 60.0), high_mm=3.5, is_bold=True, is_centred=True)  # type: ignore[arg-type]
    pens.write_text(drawn, "up", (1.0, 2.0), turned_deg=90.0)  # type: ignore[arg-type]
    plain, bold, up = drawn.texts
    # What a terminal would obey is written out.
    assert plain.text == "wall 1\\x07"
    assert (plain.left, plain.bottom) == pytest.approx((12.0, 34.0))
    assert (plain.high, bold.high) == pytest.approx((2.0, 3.5), rel=1e-3)
    assert [text.is_bold for text in drawn.texts] == [False, True, False]
    assert [text.is_centred for text in drawn.texts] == [False, True, False]
    assert [text.is_upright for text in drawn.texts] == [False, False, True]
    assert (bold.middle, bold.bottom) == pytest.approx((50.0, 60.0))
    assert (up.left, up.bottom) == pytest.approx((1.0, 2.0))


@pytest.mark.parametrize("turned_deg", [0.0, 30.0, 90.0, -60.0])
def test_a_number_is_cut_out_of_what_lies_below_it(drawn: Page, turned_deg: float) -> None:
    middle, high = np.array([40.0, 50.0]), 2.5
    pens.write_on_white(drawn, "12.5", (40.0, 50.0), high_mm=high, turned_deg=turned_deg)  # type: ignore[arg-type]
    (white,), (text,) = drawn.lines, drawn.texts
    angle = np.radians(turned_deg)
    along, up = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    # Two fifths of its height more at either end, and three tenths above and below.
    half = 0.5 * pens.text_width_mm("12.5", high) + 0.4 * high
    np.testing.assert_allclose(white.points, [middle - half * along, middle + half * along])
    assert white.width_mm == pytest.approx(1.6 * high)
    assert white.colour == (1.0, 1.0, 1.0)
    # The middle of its base line lies half its height below.
    foot = middle - 0.5 * high * up
    assert (text.middle, text.bottom) == pytest.approx(tuple(foot))
    assert text.is_centred
    assert text.colour == (0.0, 0.0, 0.0)


def test_a_number_on_white_is_two_millimetres_high_and_lies(drawn: Page) -> None:
    pens.write_on_white(drawn, "7", (10.0, 10.0))  # type: ignore[arg-type]
    (white,), (text,) = drawn.lines, drawn.texts
    assert text.high == pytest.approx(2.0, rel=1e-3)
    assert np.ptp(white.points[:, 1]) == 0.0


def test_texts_are_measured_as_wide_as_bold_letters_are(drawn: Page) -> None:
    size = 2.0 / MM / 0.729
    for is_bold, font in ((True, "DejaVuSans-Bold"), (False, "DejaVuSans")):
        wide = stringWidth("sheet 3", font, size) * MM
        assert pens.text_width_mm("sheet 3", 2.0, is_bold=is_bold) == pytest.approx(wide)
    assert pens.text_width_mm("sheet 3", 2.0) > pens.text_width_mm("sheet 3", 2.0, is_bold=False)
    assert drawn.texts == []
