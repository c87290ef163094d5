"""The column of a sheet as it is drawn: lengths are true, texts fit, nothing lies over another."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from reportlab.pdfbase.pdfmetrics import stringWidth

from orthoflow.files.drawings import sheet_columns as module
from orthoflow.files.drawings.key_plans import KeyPlan
from orthoflow.files.drawings.papers import Paper, Part, View, paper_of
from orthoflow.files.drawings.pens import text_width_mm
from orthoflow.files.drawings.sheet_columns import draw_column
from orthoflow.files.drawings.sheet_contents import Axes, Sheet, SheetText, WallDrawing
from orthoflow.files.drawings.title_blocks import TitleBlock
from tests.drawn_pages import MM, Page, page

DIGEST = "0123456789abcdef" * 4
PART = Part(left_m=0.0, top_m=0.0, right_m=4.0, bottom_m=3.0)
PLAN = KeyPlan(
    walls=np.array([[[0.0, 0.0], [6.0, 0.0]], [[6.0, 0.0], [6.0, 4.0]]]),
    numbers=(3, 5),
    outlines=(np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 0.0]]),),
    marked=np.array([[1.0, 0.0], [5.0, 0.0]]),
    arrow=np.array([[3.0, 2.0], [3.0, 0.2]]),
    up_label="N",
)
RED = (0.8, 0.0, 0.0)


def drawing(**more: object) -> WallDrawing:
    plain: dict[str, object] = {
        "number": 7,
        "rasters": {},
        "axes": Axes(across=(0.0, 1.0), down=(0.0, -1.0), said="X to the right, m"),
        "plan": None,
        "text": SheetText(
            name="wall 7",
            block=TitleBlock(),
            notes=("first note", "second note"),
            digest=DIGEST,
            run="run r1 of hall",
        ),
        "scale": 50,
        "grid_m": 0.0,
    }
    return WallDrawing(**(plain | more))  # type: ignore[arg-type]


def sheet(*kinds: str, **more: object) -> Sheet:
    plain: dict[str, object] = {
        "paper": Paper(width_mm=420.0, height_mm=297.0),
        "views": tuple(View(kind=kind, part=PART, corner_mm=(20.0, 20.0)) for kind in kinds),
    }
    return Sheet(**(plain | more))  # type: ignore[arg-type]


@pytest.fixture
def drawn() -> Iterator[Page]:
    with page() as one:
        yield one


def column(canvas: Page, *, width: float = 94.0, top: float = 280.0) -> module._Column:
    return module._Column(canvas=canvas, left=310.0, width=width, top=top, bottom=13.0, size=1.0)  # type: ignore[arg-type]


def written(canvas: Page) -> list[str]:
    return [text.text for text in canvas.texts]


# --- text ---


def test_rows_are_as_full_as_the_column_is_wide(drawn: Page) -> None:
    words = "the quick brown fox jumps over a lazy dog " * 6
    rows = column(drawn, width=60.0).rows(words, 2.0)
    assert " ".join(rows).split() == words.split()
    size = 2.0 / MM / 0.729
    wide = [stringWidth(row, "DejaVuSans-Bold", size) * MM for row in rows]
    assert max(wide) <= 60.0
    for row, after in itertools.pairwise(rows):
        # The next word had no room: letters are given a fiftieth of it to breathe.
        more = stringWidth(f"{row} {after.split()[0]}", "DejaVuSans-Bold", size) * MM
        assert more > 0.97 * 60.0


def test_a_word_that_is_wider_than_the_column_is_broken(drawn: Page) -> None:
    word = "x" * 61
    rows = column(drawn, width=60.0).rows(f"a {word} b", 2.0)
    assert "".join(rows).replace(" ", "") == f"a{word}b"
    assert len(rows) >= 2
    size = 2.0 / MM / 0.729
    assert all(stringWidth(row, "DejaVuSans-Bold", size) * MM <= 60.0 for row in rows)
    assert column(drawn).rows("", 2.0) == []
    assert column(drawn).rows("   ", 2.0) == []


def test_a_paragraph_lowers_the_top_row_by_row(drawn: Page) -> None:
    one = column(drawn)
    one.write("a word " * 60, high_mm=2.0, is_bold=True)
    assert len(drawn.texts) > 2
    assert {(text.left, text.is_bold) for text in drawn.texts} == {(310.0, True)}
    assert [text.high for text in drawn.texts] == pytest.approx([2.0] * len(drawn.texts), rel=1e-2)
    bottoms = [text.bottom for text in drawn.texts]
    assert bottoms[-1] == pytest.approx(one.top)
    # Below each other, with room for what hangs below a line, and no more than a line between.
    steps = -np.diff([280.0, *bottoms])
    assert np.ptp(steps) < 1e-9
    assert 1.4 * 2.0 < steps[0] < 2.0 * 2.0


def test_what_is_empty_in_the_title_block_is_left_out(drawn: Page) -> None:
    module._write_title(
        column(drawn), drawing(), sheet("ortho", "depth", "depth", number=2, count=3)
    )
    assert written(drawn) == [
        *("wall 7", "orthoimage and depth contours", "scale 1:50", "sheet 2 of 3"),
    ]
    assert drawn.texts[0].is_bold


def test_a_title_stands_before_the_name_and_fields_have_their_names(drawn: Page) -> None:
    block = TitleBlock(project="Hall", title="West", drawing="21-017", checked_by="A B", note="n")
    text = replace(drawing().text, block=block)
    module._write_title(column(drawn), drawing(text=text), sheet("intensity", number=0, count=3))
    assert written(drawn) == [
        *("Hall", "West", "wall 7", "laser intensity", "scale 1:50", "index of 3 sheets"),
        *("checked by: A B", "drawing: 21-017, wall 7, index", "note: n"),
    ]
    high = {one.text: one.high for one in drawn.texts}
    other = Page()
    module._write_title(column(other), drawing(text=text), sheet("intensity", number=2, count=3))
    assert "drawing: 21-017, wall 7, sheet 2" in written(other)
    # The project is the largest text with the scale, its own title the next; fields the smallest.
    assert 4.0 > high["Hall"] == high["scale 1:50"] > high["West"] > high["wall 7"]
    assert high["wall 7"] == high["laser intensity"] == high["index of 3 sheets"]
    assert high["wall 7"] > high["note: n"] == high["checked by: A B"] > 1.9
    is_bold = {one.text for one in drawn.texts if one.is_bold}
    assert is_bold == {"Hall", "West", "scale 1:50"}
    # The scale stands apart.
    bottoms = {one.text: one.bottom for one in drawn.texts}
    apart = bottoms["laser intensity"] - bottoms["scale 1:50"] - 1.7 * high["scale 1:50"]
    assert 1.0 < apart < 2.0


def test_notes_say_what_contours_and_crosses_are() -> None:
    plain = list(module._notes(drawing(), sheet("ortho")))
    assert plain == ["first note", "second note"]
    told = drawing(interval_m=0.02, grid_m=0.5, depth_range_m=(-0.1234, 0.0512))
    assert list(module._notes(told, sheet("ortho", "depth")))[2:] == [
        (
            "depth contours 10, 30 ... mm from the wall's plane: red before it, towards the "
            "viewer, blue behind it"
        ),
        "its grey: black -123 mm and below, white +51 mm and above",
        "grid 0.5 m: X to the right, m",
    ]


# --- the scale bar ---


@pytest.mark.parametrize("scale", [1, 2, 5, 10, 20, 25, 50, 100, 200, 250, 500, 1000, 5000, 10_000])
@pytest.mark.parametrize("width", [56.0, 94.0, 174.0])
def test_a_scale_bar_is_as_long_as_its_numbers_say(drawn: Page, scale: int, width: float) -> None:
    one = column(drawn, width=width)
    module._draw_scale_bar(one, scale)
    lefts = [box.sides[0] for box in drawn.boxes]
    wide = [box.sides[2] for box in drawn.boxes]
    assert np.ptp(wide) < 1e-9
    segment_m = wide[0] * scale / 1000.0
    # The largest round length that fits 25 mm: the next one would not.
    digits = segment_m / 10.0 ** np.floor(np.log10(segment_m) + 1e-9)
    assert min(abs(digits - each) for each in (1.0, 2.0, 5.0)) < 1e-6
    assert wide[0] <= 25.0 + 1e-6
    assert wide[0] * (2.5 if round(digits) == 2 else 2.0) > 25.0 + 1e-6
    # Side by side from left to right, black and white in turns, in the column.
    np.testing.assert_allclose(np.diff(lefts), wide[0], atol=1e-9)
    assert [box.fill for box in drawn.boxes] == [
        (float(k % 2),) * 3 for k in range(len(drawn.boxes))
    ]
    assert lefts[0] >= 310.0
    assert lefts[-1] + wide[0] <= 310.0 + width
    # As many as there is room for, five at most.
    assert len(lefts) == 5 or lefts[0] + (len(lefts) + 1) * wide[0] > 310.0 + width - 8.0
    assert len(lefts) <= 5
    # A number over each end, which says how far it is from the first.
    for place, text in enumerate(drawn.texts):
        number, *unit = text.text.split()
        assert float(number) == pytest.approx(place * segment_m)
        assert unit == (["m"] if place == len(lefts) else [])
        assert text.middle == pytest.approx(lefts[0] + place * wide[0])
        assert drawn.boxes[0].sides[1] + drawn.boxes[0].sides[3] < text.bottom < 280.0
        assert text.colour == (0.0, 0.0, 0.0)
    assert len(drawn.texts) == len(lefts) + 1
    assert max(text.bottom + text.high for text in drawn.texts) <= 280.0
    assert one.top < drawn.boxes[0].sides[1]


# --- plans ---


def similarity(on_paper: NDArray[np.float64], plan: NDArray[np.float64]) -> float:
    """Millimetres per metre of a drawing that keeps directions."""
    per_m = np.linalg.norm(on_paper[-1] - on_paper[0]) / np.linalg.norm(plan[-1] - plan[0])
    np.testing.assert_allclose(on_paper - on_paper[0], per_m * (plan - plan[0]), atol=1e-9)
    return float(per_m)


@pytest.mark.parametrize("room", [40.0, 90.0])
def test_a_key_plan_is_the_room_in_one_scale(drawn: Page, room: float) -> None:
    one = column(drawn)
    module._draw_plan(one, PLAN, room)
    first, second, outline, marked, shaft, barbs, north, _, *below_numbers = drawn.lines
    assert [line.colour for line in below_numbers] == [(1.0, 1.0, 1.0)] * 2
    numbers = {text.text: text for text in drawn.texts if text.text in "35"}
    for number, wall in (("3", first), ("5", second)):
        middle = wall.points.mean(axis=0)
        assert numbers[number].middle == pytest.approx(middle[0])
        assert numbers[number].bottom == pytest.approx(middle[1] - 0.5 * numbers[number].high)
    scales = [
        similarity(first.points, PLAN.walls[0]),
        similarity(second.points, PLAN.walls[1]),
        similarity(outline.points[:-1], PLAN.outlines[0][:-1]),
        similarity(marked.points, PLAN.marked),
    ]
    assert PLAN.arrow is not None
    scales.append(similarity(shaft.points, PLAN.arrow))
    assert np.ptp(scales) < 1e-9
    # As large as there is room for, across or down.
    wide, high = 6.0 * scales[0], 4.0 * scales[0]
    assert (abs(wide - (94.0 - 8.0)) < 1e-6) or (abs(high - (room - 5.0)) < 1e-6)
    assert wide <= 94.0 - 8.0 + 1e-6
    assert high <= room - 5.0 + 1e-6
    # From the column's left edge, below what stands there.
    np.testing.assert_allclose(first.points[0], [310.0, one.top], atol=1e-9)
    assert one.top + high < 280.0
    assert [text.text for text in drawn.texts] == ["N", "3", "5"]
    # The wall of the sheet is red and the widest, and not closed: it is seen from above.
    assert marked.colour == shaft.colour == barbs.colour == RED
    assert marked.width_mm > max(one.width_mm for one in drawn.lines[:8] if one is not marked)
    assert not marked.is_closed
    assert {first.colour, second.colour} == {(0.6, 0.6, 0.6)}
    assert outline.colour == north.colour == (0.0, 0.0, 0.0)
    # Upwards, in the column, beside its right edge, the name over its end.
    assert north.points[0][0] == north.points[1][0] < 310.0 + 94.0
    assert north.points[1][1] > north.points[0][1] > one.top
    label = drawn.texts[0]
    assert label.middle == pytest.approx(north.points[1][0])
    assert label.bottom > north.points[1][1]


def test_the_corners_of_a_floor_are_a_ring_without_an_arrow(drawn: Page) -> None:
    floor = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]])
    module._draw_plan(column(drawn), replace(PLAN, marked=floor, arrow=None), 90.0)
    (ring,) = [one for one in drawn.lines if one.colour == RED]
    assert ring.is_closed


def test_an_arrow_has_its_barbs_at_its_end(drawn: Page) -> None:
    ends = np.array([[10.0, 20.0], [16.0, 28.0]])
    module._draw_arrow(drawn, ends, width_mm=0.4)  # type: ignore[arg-type]
    shaft, barbs = drawn.lines
    np.testing.assert_allclose(shaft.points, ends)
    np.testing.assert_allclose(barbs.points[1], ends[1])
    along = np.array([0.6, 0.8])
    back = (barbs.points[[0, 2]] - ends[1]) @ along
    aside = (barbs.points[[0, 2]] - ends[1]) @ np.array([-along[1], along[0]])
    # Back from the end and to either side of the shaft, alike.
    np.testing.assert_allclose(back, back[0])
    assert -3.0 < back[0] < -1.0
    assert aside[0] == pytest.approx(-aside[1])
    assert 0.25 < aside[0] / -back[0] < 0.6
    assert shaft.width_mm == barbs.width_mm == pytest.approx(0.4)


def test_the_key_of_the_sheets_shows_the_parts_of_the_wall_and_fills_this_one(drawn: Page) -> None:
    # Two above each other on the left, a high one on the right.
    parts = [(0.0, 0.0, 3.0, 1.0), (0.0, 1.0, 3.0, 2.0), (3.0, 0.0, 5.0, 2.0)]
    numbered = tuple(
        (number, Part(left_m=a, top_m=b, right_m=c, bottom_m=d))
        for number, (a, b, c, d) in enumerate(parts, start=1)
    )
    one = column(drawn)
    module._draw_sheet_key(one, sheet(number=2, count=3, numbered=numbered), 60.0)
    outlines = [line.points for line in drawn.lines]
    assert all(line.is_closed for line in drawn.lines)
    every = np.vstack(outlines)
    per_m = float(np.ptp(every[:, 0])) / 5.0
    left, top = every[:, 0].min(), every[:, 1].max()
    for points, (a, b, c, d) in zip(outlines, parts, strict=True):
        wanted = np.array([[a, -b], [c, -b], [c, -d], [a, -d]])
        np.testing.assert_allclose(points, [left, top] + per_m * wanted, atol=1e-9)
    (filled,) = drawn.boxes
    lower, upper = outlines[1].min(axis=0), outlines[1].max(axis=0)
    np.testing.assert_allclose(filled.sides, [*lower, *(upper - lower)], atol=1e-9)
    assert filled.fill != (0.0, 0.0, 0.0)
    for text, points in zip(drawn.texts, outlines, strict=True):
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        assert text.middle == pytest.approx(middle[0])
        assert text.bottom + 0.5 * text.high == pytest.approx(middle[1], abs=0.05)
        assert text.high <= 2.51
        assert text.colour == (0.0, 0.0, 0.0)
    assert written(drawn) == ["1", "2", "3"]
    assert one.top < every[:, 1].min()


def test_numbers_of_small_parts_fit_into_them(drawn: Page) -> None:
    numbered = tuple(
        (k, Part(left_m=0.1 * k, top_m=0.0, right_m=0.1 * k + 0.1, bottom_m=8.0))
        for k in range(1, 30)
    )
    module._draw_sheet_key(column(drawn), sheet(number=3, count=29, numbered=numbered), 30.0)
    for text, line in zip(drawn.texts, drawn.lines, strict=True):
        assert text.width <= np.ptp(line.points[:, 0]) + 1e-6


# --- the seal ---


def test_the_seal_is_read_by_a_phone(drawn: Page) -> None:
    one = column(drawn)
    module._draw_seal(one, drawing())
    dots = np.array([box.sides for box in drawn.boxes])
    side = dots[0, 2]
    np.testing.assert_allclose(dots[:, 2:], side, rtol=1e-9)
    assert side >= 0.4
    # Four dots of quiet about it, within the column, over its bottom.
    low, high = dots[:, :2].min(axis=0), (dots[:, :2] + side).max(axis=0)
    np.testing.assert_allclose(low - [310.0, 13.0], 4.0 * side, rtol=1e-6)
    n_dots = round(float((high - low)[0] / side))
    assert n_dots == round(float((high - low)[1] / side))
    picture = np.full((n_dots + 8, n_dots + 8), 255, np.uint8)
    places = np.rint((dots[:, :2] - low) / side).astype(int)
    picture[n_dots + 3 - places[:, 1], places[:, 0] + 4] = 0
    large = cv2.resize(picture, None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST)
    said, *_ = cv2.QRCodeDetector().detectAndDecode(large)
    assert said == f"sha256:{DIGEST}"
    # Beside it, from its top, the same in letters; what follows in the column stays over it.
    assert written(drawn)[0] == "provenance"
    assert "".join(written(drawn)[-4:]) == DIGEST
    assert "run r1 of hall" in " ".join(written(drawn))
    assert max(text.high for text in drawn.texts) == drawn.texts[0].high < 2.0
    assert [text.is_bold for text in drawn.texts] == [True] + [False] * (len(drawn.texts) - 1)
    quiet = high[0] + 4.0 * side
    assert all(text.left > quiet for text in drawn.texts)
    assert max(text.bottom + text.high for text in drawn.texts) <= high[1] + 4.0 * side
    assert all(text.left + text.width <= 310.0 + 94.0 for text in drawn.texts)
    assert one.bottom > high[1] + 4.0 * side - 1e-9
    assert one.top == 280.0


# --- all of it ---


@pytest.mark.parametrize("paper", [(420.0, 297.0), (297.0, 210.0), (1189.0, 841.0)])
def test_nothing_lies_over_another(drawn: Page, paper: tuple[float, float]) -> None:
    numbered = ((1, PART), (2, replace(PART, left_m=4.0, right_m=8.0)))
    at = sheet("ortho", paper=Paper(width_mm=paper[0], height_mm=paper[1]), numbered=numbered)
    draw_column(drawn, drawing(plan=PLAN, grid_m=0.5), at)  # type: ignore[arg-type]
    # Within the column, which ends at the frame of the sheet.
    right = paper[0] - 10.0
    left = right - at.paper.column_mm
    for text in drawn.texts:
        # A few millimetres from the frame, as people leave them.
        assert left + 2.0 < text.left
        assert text.left + text.width < right - 2.0
        assert 10.0 < text.bottom < text.bottom + text.high < paper[1] - 10.0
    rules = [one for one in drawn.lines if len(one.points) == 2 and np.ptp(one.points[:, 0]) > 50]
    rules = [one for one in rules if abs(np.ptp(one.points[:, 0]) - at.paper.column_mm) < 1e-6]
    assert len(rules) == 3
    for one in rules:
        np.testing.assert_allclose(sorted(one.points[:, 0]), [left, right], atol=1e-6)
    boxes = [(t.left, t.bottom, t.left + t.width, t.bottom + t.high) for t in drawn.texts]
    for one_box, other in itertools.combinations(boxes, 2):
        apart = (
            *(one_box[2] <= other[0], other[2] <= one_box[0]),
            *(one_box[3] <= other[1], other[3] <= one_box[1]),
        )
        assert any(apart), (one_box, other)
    for one in rules:
        y = one.points[0, 1]
        assert all(not bottom < y < top for _, bottom, _, top in boxes)
    words = written(drawn)
    assert "sheets of wall 7" in words
    assert 2.0 < min(text.left for text in drawn.texts) - left < 5.0
    # Notes are the smallest of what is written in sentences, and still read at arm's length.
    high = {text.text: text.high for text in drawn.texts}
    assert 1.5 < high["first note"] < high["sheet 1 of 1"] < high["scale 1:50"]
    # From above to below: title, bar, notes, the key of the sheets, the plan.
    places = [words.index(word) for word in ("scale 1:50", "first note", "sheets of wall 7")]
    assert places == sorted(places)
    heights = [drawn.texts[place].bottom for place in places]
    assert heights == sorted(heights, reverse=True)


@pytest.mark.parametrize(("height", "has_plan"), [(150.0, True), (110.0, False)])
def test_a_plan_needs_room(drawn: Page, height: float, has_plan: bool) -> None:
    at = sheet("ortho", paper=Paper(width_mm=420.0, height_mm=height))
    draw_column(drawn, drawing(plan=PLAN), at)  # type: ignore[arg-type]
    assert ("N" in written(drawn)) is has_plan


def test_the_index_has_no_key_of_its_sheets(drawn: Page) -> None:
    numbered = ((1, PART), (2, PART))
    draw_column(drawn, drawing(), sheet("ortho", number=0, count=2, numbered=numbered))  # type: ignore[arg-type]
    assert "sheets of wall 7" not in written(drawn)
    assert "index of 2 sheets" in written(drawn)


@pytest.mark.parametrize(
    ("paper", "high_mm"), [("A4", 1.7), ("A3", 1.7), ("A2", 2.4), ("A1", 3.0), ("A0", 3.0)]
)
def test_notes_are_as_high_as_large_paper_wants(drawn: Page, paper: str, high_mm: float) -> None:
    draw_column(drawn, drawing(), sheet("ortho", paper=paper_of(paper)))  # type: ignore[arg-type]
    note = next(text for text in drawn.texts if text.text == "first note")
    assert note.high == pytest.approx(high_mm, abs=0.05)
    right = paper_of(paper).width_mm - 10.0
    assert all(text.left + text.width < right for text in drawn.texts)
    assert min(text.bottom for text in drawn.texts) > 10.0
    # The seal ends as far from the frame as the texts begin.
    dots = [box.sides for box in drawn.boxes if box.sides[2] < 1.2]
    quiet = 4.0 * dots[0][2]
    assert min(bottom for _, bottom, *_ in dots) - quiet == pytest.approx(13.0)


def test_walls_that_are_short_or_close_have_no_number(drawn: Page) -> None:
    long = np.array([[0.0, 0.0], [40.0, 0.0]])
    beside, short = long + np.array([0.0, 1.0]), np.array([[0.0, 20.0], [1.0, 20.0]])
    walls = {12: short, 13: long, 14: beside}
    module._number_walls(drawn, walls, high_mm=1.7)  # type: ignore[arg-type]
    assert written(drawn) == ["13"]


@pytest.mark.parametrize(("factor", "has_room"), [(0.98, False), (1.02, True)])
def test_a_number_has_room_where_its_width_and_a_half_and_its_height_fit(
    drawn: Page, factor: float, has_room: bool
) -> None:
    room = 1.5 * text_width_mm("13", 1.7) + 1.7
    wall = np.array([[0.0, 0.0], [factor * room, 0.0]])
    module._number_walls(drawn, {13: wall}, high_mm=1.7)  # type: ignore[arg-type]
    assert written(drawn) == (["13"] if has_room else [])
    # Nor where the middle of another is nearer than that.
    long = np.array([[0.0, 20.0], [40.0, 20.0]])
    beside = long + np.array([0.0, factor * room])
    before = len(drawn.texts)
    module._number_walls(drawn, {13: long, 14: beside}, high_mm=1.7)  # type: ignore[arg-type]
    assert written(drawn)[before:] == (["13", "14"] if has_room else ["13"])


def test_the_wall_of_the_sheet_has_its_number_before_those_beside_it(drawn: Page) -> None:
    walls = np.array([[[0.0, 0.0], [6.0, 0.0]], [[0.0, 0.1], [6.0, 0.1]]])
    plan = replace(PLAN, walls=walls, numbers=(3, 0))
    module._draw_plan(column(drawn), plan, 40.0, number=0)
    assert written(drawn) == ["N", "0"]


@pytest.mark.parametrize("size", [1.0, 1.5])
def test_a_plan_is_no_higher_than_nine_centimetres_on_small_paper(drawn: Page, size: float) -> None:
    # A narrow room, for which a column as high as this has more room.
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 20.0], [0.0, 20.0], [0.0, 0.0]])
    plan = replace(
        PLAN, walls=np.array([corners[:2]]), numbers=(3,), outlines=(corners,), marked=corners[:2]
    )
    paper = Paper(width_mm=size * 420.0, height_mm=1200.0)
    draw_column(drawn, drawing(plan=plan), sheet("ortho", paper=paper))  # type: ignore[arg-type]
    outline = max((line.points for line in drawn.lines), key=lambda points: np.ptp(points[:, 1]))
    assert np.ptp(outline[:, 1]) == pytest.approx(90.0 * size - 5.0, abs=0.01)
