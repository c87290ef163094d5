"""What is drawn about a picture: coordinates, crosses, cuts, openings, the frame of the sheet."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pdfplumber
import pytest

from orthoflow.files.drawings import sheets as module
from orthoflow.files.drawings.papers import Paper, Part, View
from orthoflow.files.drawings.sheet_contents import Axes, MarkedArea, Sheet, SheetText, WallDrawing
from orthoflow.files.drawings.sheets import axes_of
from orthoflow.files.drawings.title_blocks import TitleBlock
from tests import samples
from tests.drawn_pages import MM, Page, page

# 6 x 4 m at 1:50 are 120 x 80 mm; the picture begins a metre beside and below the raster's corner.
PART = Part(left_m=1.0, top_m=1.0, right_m=7.0, bottom_m=5.0)
VIEW = View(kind="ortho", part=PART, corner_mm=(30.0, 40.0))
# X counts from 100 m, H falls from 12.25 m.
AXES = Axes(across=(100.0, 1.0), down=(12.25, -1.0), said="")
BLACK, WHITE, RED = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.8, 0.0, 0.0)


def drawing(**more: object) -> WallDrawing:
    text = SheetText(name="wall 7", block=TitleBlock(), notes=(), digest="0" * 64, run="run")
    plain: dict[str, object] = {
        "number": 7,
        "rasters": {},
        "axes": AXES,
        "plan": None,
        "text": text,
        "scale": 50,
        "grid_m": 1.0,
    }
    return WallDrawing(**(plain | more))  # type: ignore[arg-type]


@pytest.fixture
def drawn() -> Iterator[Page]:
    with page() as one:
        yield one


# --- coordinates ---


@pytest.mark.parametrize(
    ("axis", "begin_m", "end_m", "step", "marks"),
    [
        # Places on the wall, and what stands there.
        ((100.0, 1.0), 1.0, 3.0, 1.0, [(1.0, 101.0), (2.0, 102.0), (3.0, 103.0)]),
        ((100.25, 1.0), 1.0, 3.0, 1.0, [(1.75, 102.0), (2.75, 103.0)]),
        ((12.25, -1.0), 1.0, 3.0, 1.0, [(2.25, 10.0), (1.25, 11.0)]),
        ((0.0, 0.5), 0.0, 5.0, 1.0, [(0.0, 0.0), (2.0, 1.0), (4.0, 2.0)]),
        ((0.3, 1.0), 0.0, 0.5, 1.0, []),
        ((100.0, 1.0), 1.0, 2.0, 0.5, [(1.0, 101.0), (1.5, 101.5), (2.0, 102.0)]),
        ((3.0, -2.0), 0.0, 4.0, 4.0, [(3.5, -4.0), (1.5, 0.0)]),
        # Sums of decimals miss their round number by a little.
        ((0.1 + 0.2, 1.0), 0.0, 0.6, 0.3, [(0.0, 0.3), (0.3, 0.6), (0.6, 0.9)]),
    ],
)
def test_marks_stand_at_round_coordinates(
    axis: tuple[float, float],
    begin_m: float,
    end_m: float,
    step: float,
    marks: list[tuple[float, float]],
) -> None:
    found = list(module._marks(axis, begin_m, end_m, step))
    assert len(found) == len(marks)
    if marks:
        np.testing.assert_allclose(found, marks, atol=1e-9)


def test_a_grid_has_crosses_in_the_picture_and_coordinates_beside_it(drawn: Page) -> None:
    module._draw_grid(drawn, drawing(), VIEW)  # type: ignore[arg-type]
    # X = 101 ... 107 m at every 20 mm from the left edge; H = 11 ... 8 m, 1.25 m down and on.
    across = {f"{x}": 30.0 + 20.0 * (x - 101) for x in range(101, 108)}
    heights = {f"{h}": 120.0 - 20.0 * (12.25 - h - 1.0) for h in range(11, 7, -1)}
    lying = {text.text: text for text in drawn.texts if not text.is_upright}
    upright = {text.text: text for text in drawn.texts if text.is_upright}
    assert set(lying) == set(across)
    assert set(upright) == set(heights)
    for name, text in lying.items():
        assert text.middle == pytest.approx(across[name])
        # Below the marks, which stand below the picture.
        assert 40.0 - 9.0 < text.bottom < text.bottom + text.high < 40.0 - 1.5
    for name, text in upright.items():
        # Centred about its height, left of the marks.
        assert text.is_centred
        assert text.bottom == pytest.approx(heights[name])
        assert 30.0 - 9.0 < text.left + 0.5 * text.width < 30.0 - 1.5
    marks = [line.points for line in drawn.lines if not _inside(line.points)]
    ends = {
        (axis, side): sorted(
            float(p[0][1 - axis]) for p in marks if p[0][axis] == pytest.approx(side) != p[1][axis]
        )
        for axis, sides in ((1, (40.0, 120.0)), (0, (30.0, 150.0)))
        for side in sides
    }
    for axis, side, places in (
        *((1, 40.0, across), (1, 120.0, across)),
        *((0, 30.0, heights), (0, 150.0, heights)),
    ):
        assert ends[axis, side] == pytest.approx(sorted(places.values())), (axis, side)
    for points in marks:
        assert np.linalg.norm(points[1] - points[0]) == pytest.approx(1.5)
        # Outwards.
        middle = np.array([90.0, 80.0])
        assert np.linalg.norm(points[1] - middle) > np.linalg.norm(points[0] - middle)
    crosses = [line for line in drawn.lines if _inside(line.points)]
    assert len(crosses) == 2 * 2 * 7 * 4
    for colour, width_mm in ((WHITE, 0.35), (BLACK, 0.1)):
        own = [line for line in crosses if line.colour == colour]
        assert len(own) == 2 * 7 * 4
        assert all(line.width_mm == pytest.approx(width_mm) for line in own)
        middles = {tuple(np.round(line.points.mean(axis=0), 6)) for line in own}
        assert middles == {
            (round(x, 6), round(y, 6)) for x in across.values() for y in heights.values()
        }
    # Black lies over white.
    assert [line.colour for line in crosses] == [WHITE] * 56 + [BLACK] * 56


def _inside(points: np.ndarray) -> bool:
    """Whether a line lies about a cross: neither mark nor frame."""
    low, high = points.min(axis=0), points.max(axis=0)
    return bool(np.linalg.norm(high - low) > 2.0)


@pytest.mark.parametrize(
    ("grid_m", "text"), [(0.5, "1.0"), (0.25, "0.50"), (0.1, "0.2"), (1.0, "1"), (10.0, "10")]
)
def test_coordinates_have_the_decimals_of_the_grid(drawn: Page, grid_m: float, text: str) -> None:
    axes = Axes(across=(0.0, 1.0), down=(0.0, -1.0), said="")
    part = replace(PART, left_m=0.0, right_m=12.0)
    view = replace(VIEW, part=part)
    module._draw_grid(drawn, drawing(grid_m=grid_m, axes=axes), view)  # type: ignore[arg-type]
    assert text in [one.text for one in drawn.texts]


@pytest.mark.parametrize(
    ("up", "words"),
    [
        ((0.0, 0.0, 1.0), "z of the scan"),
        ((math.sin(0.01), 0.0, math.cos(0.01)), "along (0.010, 0.000, 1.000) of the scan"),
    ],
)
def test_a_sheet_has_the_coordinates_of_the_geotiff(
    up: tuple[float, float, float], words: str
) -> None:
    wall = replace(samples.facing_east(0.01, 100, 50, (1.0, 2.0, 30.0)), up=up, left_m=4.0)
    found = axes_of(wall)
    assert (found.across, found.down) == ((4.0, 1.0), (wall.raster_corner_m[1], -1.0))
    assert found.said.endswith(f"H height: {words}, m")
    unknown = axes_of(replace(wall, up=None))
    assert (unknown.across, unknown.down) == ((0.0, 1.0), (0.0, -1.0))


def test_a_raster_in_a_map_has_the_coordinates_of_the_map() -> None:
    frame = replace(samples.facing_east(0.5, 40, 20, (1.0, 2.0, 30.0)), map_crs="EPSG:25832")
    found = axes_of(frame)
    # Three metres to the right and two down, as its GeoTIFF has them.
    (place,) = frame.raster_from_wall(np.array([[6.0, 4.0]]))
    told = [found.across[0] + 3.0 * found.across[1], found.down[0] + 2.0 * found.down[1]]
    np.testing.assert_allclose(told, place)
    assert found.said == "X east, Y north (EPSG:25832), m"


# --- openings ---


@pytest.mark.parametrize("text", ["through, 0.80 x 1.20 m", "door"])
def test_what_an_opening_is_stands_in_it_from_its_top(drawn: Page, text: str) -> None:
    module._write_inside(drawn, text, (50.0, 90.0, 100.0))  # type: ignore[arg-type]
    (ground,) = drawn.boxes
    left, bottom, wide, high = ground.sides
    assert ground.fill == WHITE
    rows = text.split(", ")
    assert [one.text for one in drawn.texts] == rows
    for one in drawn.texts:
        # On white, all of it, and the white in the opening.
        assert left < one.left
        assert one.left + one.width < left + wide
        assert bottom < one.bottom
        assert one.bottom + one.high < bottom + high
        assert one.colour not in (BLACK, WHITE)
    assert left > 50.0
    assert bottom + high < 100.0
    heights = [one.bottom for one in drawn.texts]
    assert heights == sorted(heights, reverse=True)
    assert all(
        upper.bottom > lower.bottom + lower.high
        for upper, lower in zip(drawn.texts, drawn.texts[1:], strict=False)
    )
    assert drawn.state["fill"] == BLACK


def test_an_opening_too_narrow_for_its_text_has_none(drawn: Page) -> None:
    module._write_inside(drawn, "door", (50.0, 90.0, 100.0))  # type: ignore[arg-type]
    wide = drawn.texts[0].width
    for room, n_texts in ((wide + 4.1, 2), (wide + 3.9, 2)):
        module._write_inside(drawn, "door", (50.0, 50.0 + room, 100.0))  # type: ignore[arg-type]
        assert len(drawn.texts) == n_texts


def test_openings_are_lined_with_white_and_cut_off_where_the_picture_ends(drawn: Page) -> None:
    outline = np.array([[2.0, 2.0], [9.0, 2.0], [9.0, 4.0], [2.0, 4.0]])
    areas = (MarkedArea(text="niche", outline_m=outline),)
    module._draw_areas(drawn, drawing(areas=areas), VIEW)  # type: ignore[arg-type]
    np.testing.assert_allclose(drawn.clips, [[[30.0, 40.0], [150.0, 120.0]]], atol=1e-9)
    below, above = drawn.lines
    on_paper = [30.0, 120.0] + 20.0 * (outline - [1.0, 1.0]) * [1.0, -1.0]
    for line in (below, above):
        np.testing.assert_allclose(line.points, on_paper, atol=1e-9)
        assert line.is_closed
    assert below.colour == WHITE
    assert above.colour != WHITE
    assert below.width_mm > 2.0 * above.width_mm
    assert [text.text for text in drawn.texts] == ["niche"]


# --- contours ---


def test_contours_before_the_plane_and_behind_it_have_two_colours(
    drawn: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = [
        (-0.03, np.array([[2.0, 2.0], [3.0, 2.0]])),
        (0.01, np.array([[2.0, 4.0], [2.0, 3.0], [4.0, 3.0]])),
    ]
    monkeypatch.setattr(module, "contours", lambda *_args, **_kwargs: steps)
    depth = replace(VIEW, kind="depth")
    module._draw_contours(drawn, drawing(rasters={"depth": None}), depth)  # type: ignore[arg-type]
    behind, below_first, before, below = drawn.lines
    first, second = drawn.texts
    assert [(text.text, text.colour) for text in (first, second)] == [
        ("-30", behind.colour),
        ("+10", before.colour),
    ]
    assert below_first.colour == below.colour == WHITE
    np.testing.assert_allclose(below_first.points.mean(axis=0), [60.0, 100.0], atol=1e-9)
    # On white, straight along its line.
    np.testing.assert_allclose(below.points.mean(axis=0), [second.middle, 80.0], atol=1e-9)
    assert 50.0 < below.points[:, 0].min() < below.points[:, 0].max() < 90.0
    np.testing.assert_allclose(behind.points, [[50.0, 100.0], [70.0, 100.0]])
    np.testing.assert_allclose(before.points, [[50.0, 60.0], [50.0, 80.0], [90.0, 80.0]])
    assert not behind.is_closed
    # Red before it, blue behind it.
    assert before.colour[0] > before.colour[2] + 0.5
    assert behind.colour[2] > behind.colour[0] + 0.5


# --- sheets ---


@pytest.fixture
def _pictures_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that nobody reads, and contours of nothing."""
    monkeypatch.setattr(module, "write_picture", lambda *_args, **_kwargs: None)
    monkeypatch.setattr(module, "picture_file", lambda path: path.with_suffix(".png"))
    monkeypatch.setattr(
        module, "contours", lambda *_args, **_kwargs: [(0.01, np.array([[2.0, 2.0], [3.0, 2.0]]))]
    )


@pytest.mark.usefixtures("_pictures_are_named")
@pytest.mark.parametrize(("kind", "grid_m"), [("ortho", 0.0), ("ortho", 0.5), ("depth", 0.0)])
def test_a_picture_lies_in_its_frame(drawn: Page, kind: str, grid_m: float) -> None:
    view = replace(VIEW, kind=kind)
    told = drawing(rasters={kind: Path("a.tif")}, grid_m=grid_m, interval_m=0.02)
    module._draw_view(drawn, told, view, Path("picture_0"))  # type: ignore[arg-type]
    # 6 x 4 m at 1:50.
    assert list(drawn.images) == ["picture_0.png"]
    np.testing.assert_allclose(drawn.images["picture_0.png"], (30.0, 40.0, 120.0, 80.0))
    frame = drawn.lines[-1]
    np.testing.assert_allclose(frame.points, [(30, 40), (150, 40), (150, 120), (30, 120)])
    assert frame.is_closed
    assert frame.colour == BLACK
    assert (len(drawn.texts) > 0) is (grid_m > 0.0)
    # Besides the frame: one contour of a depth, none of anything else.
    assert (len(drawn.lines) == 2) is (kind == "depth")


@pytest.mark.usefixtures("_pictures_are_named")
@pytest.mark.parametrize("number", [0, 1])
def test_only_an_index_shows_how_the_wall_is_cut(
    tmp_path: Path, drawn: Page, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    @contextmanager
    def canvas(_path: Path, _paper: Paper) -> Iterator[Page]:
        yield drawn

    monkeypatch.setattr(module, "sheet_canvas", canvas)
    paper = Paper(width_mm=420.0, height_mm=297.0)
    numbered = ((1, PART), (2, replace(PART, right_m=4.0)))
    sheet = Sheet(paper=paper, views=(VIEW,), number=number, count=2, numbered=numbered)
    block = TitleBlock(project="Hall", author="A B")
    told = drawing(rasters={"ortho": Path("a.tif")}, grid_m=0.0)
    told = replace(told, text=replace(told.text, block=block))
    module.write_sheet(tmp_path / "sheet.pdf", told, sheet)
    cuts = [line for line in drawn.lines if line.colour == RED]
    assert len(cuts) == (2 if number == 0 else 0)
    assert drawn.said == {
        "title": "Hall wall 7",
        "author": "A B",
        "subject": f"1:50; record sha256:{'0' * 64}",
    }
    assert (drawn.n_pages, drawn.is_saved) == (1, True)
    # Frame and column are there.
    assert any(np.allclose(line.points.min(axis=0), 10.0) for line in drawn.lines)
    assert "provenance" in [text.text for text in drawn.texts]
    assert list(tmp_path.iterdir()) == []


def test_a_page_is_as_large_as_its_paper_and_the_same_on_another_day(tmp_path: Path) -> None:
    sheet = Sheet(paper=Paper(width_mm=400.0, height_mm=250.0), views=())
    for name in ("a.pdf", "b.pdf"):
        with module.sheet_canvas(tmp_path / name, sheet.paper) as canvas:
            canvas.showPage()
            canvas.save()
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()
    with pdfplumber.open(tmp_path / "a.pdf") as pdf:
        (page,) = pdf.pages
        assert (page.width * MM, page.height * MM) == pytest.approx((400.0, 250.0), abs=1e-3)


def test_an_index_shows_what_is_on_which_sheet(drawn: Page) -> None:
    parts = [replace(PART, right_m=4.0), replace(PART, left_m=4.0, bottom_m=1.2)]
    numbered = tuple(enumerate(parts, start=1))
    index = Sheet(
        paper=Paper(width_mm=420.0, height_mm=297.0), views=(VIEW,), number=0, numbered=numbered
    )
    module._draw_cuts(drawn, drawing(), index)  # type: ignore[arg-type]
    wanted = [
        ((30.0, 40.0), (90.0, 120.0)),
        ((90.0, 116.0), (150.0, 120.0)),
    ]
    for line, text, (low, high) in zip(drawn.lines, drawn.texts, wanted, strict=True):
        np.testing.assert_allclose(
            line.points,
            [(low[0], high[1]), high, (high[0], low[1]), low],
            atol=1e-9,
        )
        assert line.is_closed
        assert line.colour == text.colour == RED
        # Its number in the middle, inside.
        assert text.middle == pytest.approx(0.5 * (low[0] + high[0]))
        assert text.bottom + 0.5 * text.high == pytest.approx(0.5 * (low[1] + high[1]), abs=0.1)
        assert text.bottom > low[1]
        assert text.bottom + text.high < high[1]
        assert text.is_bold
    assert [text.text for text in drawn.texts] == ["1", "2"]
    assert (drawn.state["stroke"], drawn.state["fill"]) == (BLACK, BLACK)


def test_the_frame_is_a_centimetre_from_the_edge_and_parts_the_column(drawn: Page) -> None:
    paper = Paper(width_mm=420.0, height_mm=297.0)
    module._draw_border(drawn, paper)  # type: ignore[arg-type]
    frame, split = drawn.lines
    assert frame.is_closed
    np.testing.assert_allclose(
        frame.points, [(10.0, 10.0), (410.0, 10.0), (410.0, 287.0), (10.0, 287.0)]
    )
    at = 410.0 - paper.column_mm
    np.testing.assert_allclose(split.points, [(at, 10.0), (at, 287.0)])
    assert not split.is_closed
    assert frame.width_mm > split.width_mm
    assert (frame.colour, split.colour) == (BLACK, BLACK)
