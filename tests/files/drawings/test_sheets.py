"""Sheets as other programs measure them: scale, text, lines, title blocks, paper and cuts."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import cv2
import ezdxf
import numpy as np
import pdfplumber
import pypdfium2
import pytest
from fontTools.fontBuilder import FontBuilder
from fontTools.pens.t2CharStringPen import T2CharStringPen
from PIL import Image

from orthoflow.cli.exports.sheets import usual_scale
from orthoflow.errors import ArgumentError
from orthoflow.files.drawings import pens
from orthoflow.files.drawings.dxf import write_wall_dxf
from orthoflow.files.drawings.key_plans import DrawnWall, key_plan
from orthoflow.files.drawings.printed_pictures import encode_part, label_place
from orthoflow.files.drawings.sheet_contents import (
    FOOT_M,
    SCALES,
    Drawing,
    Part,
    Picture,
    SheetText,
    TitleBlock,
    axes_of,
    north_of,
    paper_of,
    usual_papers,
)
from orthoflow.files.drawings.sheets import fitting_scale, lay_out
from orthoflow.files.drawings.words import LANGUAGES, all_labels, label
from orthoflow.files.geotiff import GridPlace, write_raster
from orthoflow.geometry.frames import frame_over
from orthoflow.products import OrthoMask
from orthoflow.records.open import open_run
from orthoflow.records.walls import room_results
from tests import samples
from tests.drawing_runs import (
    GAP_M,
    SIZE_M,
    WALL,
    box_image,
    box_planes,
    export,
    wall_frame,
    write_drawing_run,
)
from tests.long_loops import long_only

MM = 25.4 / 72.0
# Height of capital letters of DejaVu Sans over its size.
CAPITALS = 0.729
ISO_MM = (0.13, 0.25, 0.35, 0.5, 0.7, 1.0)
OFFICE = """
logo: logo.png
project: Pałac Stanów, sala zachodnia
title: West elevation
client: Heritage Council
site: Castle Road 1
organisation: Survey Office Ltd.
author: K. Nowak
checked_by: Ελένη Παπαδοπούλου
date: 2026-03-14
drawing: 21-017
note: Heights over the local datum.
fields: {Order: 4711, Phase: Обмер}
revisions:
  - {mark: A, date: 2026-03-14, text: first issue, by: KN}
  - {mark: B, date: 2026-03-20, text: openings added, by: AM}
"""


@contextmanager
def page_of(path: Path) -> Iterator[pdfplumber.page.Page]:
    with pdfplumber.open(path) as pdf:
        (page,) = pdf.pages
        yield page


def office(folder: Path, **more: str) -> Path:
    Image.new("RGB", (300, 100), (30, 60, 120)).save(folder / "logo.png")
    path = folder / "office.yaml"
    lines = "".join(f"{key}: {value}\n" for key, value in more.items())
    path.write_text(OFFICE + lines, encoding="utf-8")
    return path


def words_of(page: pdfplumber.page.Page) -> str:
    # Reading a page with pdfplumber takes most of the time of a test.
    with pypdfium2.PdfDocument(page.pdf.path) as pdf:
        return " ".join(pdf[0].get_textpage().get_text_range().split())


def boxes_of(page: pdfplumber.page.Page) -> list[tuple[str, tuple[float, float, float, float]]]:
    """Words with the boxes of their capital letters, upright ones and turned ones."""
    found = []
    for is_upright in (True, False):
        part = page.filter(
            lambda item, wanted=is_upright: (
                item["object_type"] != "char" or bool(item["upright"]) is wanted
            )
        )
        for word in part.extract_words(x_tolerance=1.5, y_tolerance=1.0):
            low, high = word["top"], word["bottom"]
            left, right = word["x0"], word["x1"]
            if is_upright:
                low += 0.3 * (high - low)
                high -= 0.15 * (high - low)
            found.append((word["text"], (left, low, right, high)))
    return found


def overlapping(page: pdfplumber.page.Page) -> list[tuple[str, str]]:
    found = []
    for (text, one), (other_text, other) in itertools.combinations(boxes_of(page), 2):
        across = min(one[2], other[2]) - max(one[0], other[0])
        down = min(one[3], other[3]) - max(one[1], other[1])
        if across > 0.3 and down > 0.3:
            found.append((text, other_text))
    # Words that lie on each other in a row are read as one.
    for is_upright, row, begin, end in ((True, "top", "x0", "x1"), (False, "x0", "top", "bottom")):
        letters = [one for one in page.chars if bool(one["upright"]) is is_upright]
        letters.sort(key=lambda one, row=row, begin=begin: (round(one[row], 1), one[begin]))
        found += [
            (one["text"], other["text"])
            for one, other in itertools.pairwise(letters)
            if abs(one[row] - other[row]) < 0.05 and one[end] - other[begin] > 0.3
        ]
    return found


WAYS = [
    ("--scale", 50),
    ("--scale", 20, "--beside", "depth"),
    ("--scale", 50, "--grid", 0.1),
    ("--scale", 20, "--paper", "A4"),
    ("--units", "ft"),
    ("--scale", 500, "--language", "de"),
    ("--language", "pl", "--beside", "intensity"),
]


# Each way in one layout, by turns; None takes less paper.
LAID_OUT = [*zip(itertools.cycle(("column", "strip", None)), WAYS, strict=False)]
ALL = itertools.product(("column", "strip"), WAYS)
OTHERS = [each for each in ALL if each not in LAID_OUT]


@pytest.mark.parametrize(("layout", "more"), [*LAID_OUT, *long_only(*OTHERS)], ids=str)
def test_text_and_lines_have_the_sizes_of_the_standards_and_nothing_overlaps(
    run: Path, tmp_path: Path, more: tuple[object, ...], layout: str | None
) -> None:
    given: tuple[object, ...] = ()
    # The whole title block has no room on A4.
    if layout is not None and "A4" not in more:
        given = ("--title-block", office(tmp_path, layout=layout))
    export(run, "sheet", tmp_path / "out", *more, *given, code=0)
    for path in (tmp_path / "out").iterdir():
        with page_of(path) as page:
            assert page.chars
            # Of letters that stand upright the box lies on its side.
            heights = [
                CAPITALS * MM * (one["size"] if one["upright"] else one["x1"] - one["x0"])
                for one in page.chars
                if min(map(abs, one["matrix"][:2])) < 1e-9
            ]
            assert min(heights) >= 2.5 - 1e-3
            drawn = [*page.lines, *page.rects, *page.curves]
            widths = {round(one["linewidth"] * MM, 3) for one in drawn if one["stroke"]}
            assert widths <= set(ISO_MM)
            assert overlapping(page) == []
            # Everything lies inside the frame.
            for one in (*page.chars, *page.images):
                assert 10.0 < one["x0"] * MM < one["x1"] * MM < page.width * MM - 10.0
                assert 10.0 < one["top"] * MM < one["bottom"] * MM < page.height * MM - 10.0


@pytest.mark.parametrize("layout", ["column", "strip"])
def test_a_title_block_has_what_the_office_and_its_client_want(
    run: Path, tmp_path: Path, layout: str
) -> None:
    block = office(tmp_path, layout=layout)
    more = ("--scale", 50, "--title-block", block, "--paper", "A2")
    export(run, "sheet", tmp_path / "out", *more, code=0)
    with page_of(tmp_path / "out" / f"wall_{WALL}_sheet_1.pdf") as page:
        text = words_of(page)
        for said in (
            *("Pałac Stanów", "West elevation", "Heritage Council", "Castle Road 1"),
            *(
                "Survey Office Ltd.",
                "K. Nowak",
                "Ελένη Παπαδοπούλου",
                "2026-03-14",
                "21-017, wall 2",
            ),
            *("Heights over the local datum.", "Order", "4711", "Phase", "Обмер", "Signature"),
            *("first issue", "openings added", "1:50", "sheet 1 of 1", "Legend", "orthoimage"),
        ):
            assert said in text, said
        # The newest revision is on top, and the one that counts.
        assert text.index("openings added") < text.index("first issue")
        assert re.search(r"Revision.*\bB\b", text)
        logo, picture = sorted(page.images, key=lambda one: one["width"] * one["height"])
        assert logo["width"] / logo["height"] == pytest.approx(3.0, rel=1e-3)
        # A column stands right of the picture, a strip below it.
        (legend,) = (word for word in page.extract_words() if word["text"] == "Legend")
        assert (legend["x0"] > picture["x1"]) is (layout == "column")
        assert (legend["top"] > picture["bottom"]) is (layout == "strip")


def test_what_a_title_block_has_too_much_of_is_refused(run: Path, tmp_path: Path) -> None:
    more = ("--scale", 50, "--paper", "160x160", "--title-block", office(tmp_path))
    done = export(run, "sheet", tmp_path / "out", *more, code=2)
    assert "--paper 160x160 is too small for the title block" in done.output
    assert not (tmp_path / "out").exists()


def test_the_seal_is_read_by_a_phone_and_heights_are_those_of_the_wall(
    run: Path, tmp_path: Path
) -> None:
    done = export(run, "sheet", tmp_path / "out", "--scale", 20)
    # Cells of 10 mm have 150 to the inch from 1:59.06 on.
    assert "but sufficient at 1:100" in done.output
    with page_of(tmp_path / "out" / f"wall_{WALL}_sheet_1.pdf") as page:
        image = np.asarray(page.to_image(resolution=200).original.convert("L"))
        text, _, _ = cv2.QRCodeDetector().detectAndDecode(image)
        assert text == f"sha256:{open_run(run).content_sha256}"
        (picture,) = page.images
        rows = [
            word
            for word in page.extract_words()
            if re.fullmatch(r"[+-]\d+\.\d\d", word["text"]) and word["x0"] > picture["x1"]
        ]
        # Lower and upper edge of the raster; sill and head of the opening.
        heights = sorted(float(row["text"]) for row in rows)
        assert len(heights) == 4
        assert (heights[0], heights[-1]) == (100.10, 102.40)
        # Each stands beside its height, where it has the room.
        for row in rows:
            up_mm = (picture["bottom"] - row["bottom"]) * MM
            assert up_mm == pytest.approx((float(row["text"]) - 100.10) * 50.0, abs=1.5)


def test_feet_are_written_and_measured(run: Path, tmp_path: Path) -> None:
    assert export(run, "sheet", tmp_path / "out", "--units", "ft", "--scale", 24).exit_code == 0
    with page_of(tmp_path / "out" / f"wall_{WALL}_sheet_1.pdf") as page:
        text = words_of(page)
        assert "1:24" in text
        assert '(1/2" =' in text
        assert f"{102.4 / FOOT_M:+.2f}" in text
        bar = [box for box in page.rects if box["height"] * MM == pytest.approx(2.0, abs=1e-3)]
        # A foot is half an inch.
        assert bar[0]["width"] * MM == pytest.approx(12.7, abs=0.01)
        assert "0 5 ft" in text


# --- languages and letters ---


def test_each_text_is_there_in_each_language_with_the_same_values() -> None:
    for key, texts in all_labels().items():
        assert len(texts) == len(LANGUAGES), key
        fields = {tuple(sorted(set(re.findall(r"\{(\w+)\}", text)))) for text in texts}
        assert len(fields) == 1, key


def test_letters_of_no_font_are_refused_and_nothing_is_written(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("matplotlib.font_manager.findSystemFonts", list)
    pens.installed_letters.cache_clear()
    block = tmp_path / "block.yaml"
    block.write_text("project: 松本城\n", encoding="utf-8")
    done = export(run, "sheet", tmp_path / "out", "--title-block", block)
    pens.installed_letters.cache_clear()
    assert done.exit_code == 2
    assert "no installed font contains the character 松 (U+677E), which is used" in done.output
    assert "Noto Sans CJK" in done.output
    assert not (tmp_path / "out").exists()


def test_letters_are_taken_from_an_installed_font(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    font = tmp_path / "postscript.otf"
    write_cff_font(font, "城")
    monkeypatch.setattr("matplotlib.font_manager.findSystemFonts", lambda: [str(font)])
    pens.installed_letters.cache_clear()
    pens.fallback_font.cache_clear()
    block = tmp_path / "block.yaml"
    block.write_text("project: A 城\n", encoding="utf-8")
    done = export(run, "sheet", tmp_path / "out", "--title-block", block)
    pens.installed_letters.cache_clear()
    assert done.exit_code == 0, done.output
    with page_of(tmp_path / "out" / f"wall_{WALL}_sheet_1.pdf") as page:
        letters = [one for one in page.chars if one["text"] == "城"]
        assert letters
        assert {one["size"] for one in letters} <= {one["size"] for one in page.chars}


def write_cff_font(path: Path, letter: str) -> None:
    """A font with one letter, a square, whose outlines are not those of TrueType."""
    pen = T2CharStringPen(1000, None)
    pen.moveTo((100, 0))
    for corner in ((900, 0), (900, 800), (100, 800)):
        pen.lineTo(corner)
    pen.closePath()
    empty = T2CharStringPen(500, None)
    builder = FontBuilder(1000, isTTF=False)
    builder.setupGlyphOrder([".notdef", "square"])
    builder.setupCharacterMap({ord(letter): "square"})
    strings = {".notdef": empty.getCharString(), "square": pen.getCharString()}
    builder.setupCFF("Square", {}, strings, {})
    builder.setupHorizontalMetrics({".notdef": (500, 0), "square": (1000, 100)})
    builder.setupHorizontalHeader(ascent=800, descent=-200)
    builder.setupNameTable({"familyName": "Square", "styleName": "Regular"})
    builder.setupOS2()
    builder.setupPost()
    builder.save(path)


# --- paper and cuts ---


def drawing(scale: int, size_m: tuple[float, float] = (3.8, 2.3), **more: object) -> Drawing:
    """A drawing whose picture nobody draws."""
    frame = replace(samples.facing_east(0.01, 100, 50, (1.0, 2.0, 30.0)), up=(0.0, 0.0, 1.0))
    text = SheetText(name="wall 7", block=TitleBlock(), notes=(), digest="0" * 64, run="run")
    plain = Drawing(
        stem="wall_7",
        size_m=size_m,
        pictures={"orthoimage": Picture(draw=lambda _placed: None)},
        axes=axes_of(frame),
        text=text,
        scale=scale,
        grid=1.0,
    )
    return replace(plain, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("size_m", "scale", "name"),
    [((24.5, 4.7), 50, "A3.2"), ((3.8, 2.3), 50, "A4"), ((7.0, 5.0), 20, "A3.2")],
)
def test_the_paper_fits_the_content(size_m: tuple[float, float], scale: int, name: str) -> None:
    laid = lay_out(drawing(scale, size_m))
    ((sheet, furniture),) = laid
    assert sheet.paper.name == name
    # No smaller paper would do, either way round.
    area_mm2 = sheet.paper.width_mm * sheet.paper.height_mm
    for paper in usual_papers():
        if paper.width_mm * paper.height_mm < area_mm2 - 1.0:
            with suppress(ArgumentError):
                assert len(lay_out(drawing(scale, size_m), [paper])) > 1
    assert furniture.paper == sheet.paper


def test_the_scale_is_the_largest_at_which_all_walls_fit() -> None:
    sizes = [(3.8, 2.3), (9.0, 3.0)]

    def drawn(scale: int) -> list[Drawing]:
        return [drawing(scale, size_m) for size_m in sizes]

    # 360 mm of the 400 inside the frame, with 35 for what stands beside them.
    assert fitting_scale(drawn, SCALES, [paper_of("A3")]) == 25
    assert fitting_scale(lambda n: drawn(n)[:1], SCALES, [paper_of("A3")]) == 20


@pytest.mark.parametrize(
    ("size_m", "scale", "grid"),
    [((30.0, 4.0), 20, 1.0), ((9.7, 13.3), 10, 0.0), ((25.0, 9.0), 20, 0.5), ((5.0, 3.9), 5, 0.3)],
)
def test_sheets_cover_a_wall_once_and_evenly(
    size_m: tuple[float, float], scale: int, grid: float
) -> None:
    laid = lay_out(drawing(scale, size_m, grid=grid), [paper_of("A3")])
    parts = [sheet.views[0].part for sheet, _ in laid]
    assert len(parts) > 1
    area_m2 = sum(part.size_m[0] * part.size_m[1] for part in parts)
    assert area_m2 == pytest.approx(size_m[0] * size_m[1])
    for axis in (0, 1):
        edges = sorted({(part.left_m, part.top_m)[axis] for part in parts})
        sizes = np.diff([*edges, size_m[axis]])
        # Equal, but for the whole steps of the grid at which they are cut.
        assert sizes.max() - sizes.min() <= max(grid * (len(sizes)), 1e-9) + 1e-9
        if grid:
            steps = np.array(edges) / grid
            fits_grid = np.abs(steps - np.round(steps)).max() < 1e-6
            assert fits_grid or np.ptp(sizes) < 1e-9
    for sheet, _ in laid:
        left, bottom = sheet.views[0].corner_mm
        wide, high = (1e3 * edge / scale for edge in sheet.views[0].part.size_m)
        corner, area = sheet.paper.corner_mm, sheet.paper.area_mm
        assert corner[0] < left < left + wide < corner[0] + area[0]
        assert corner[1] < bottom < bottom + high < corner[1] + area[1]


def test_too_many_sheets_are_refused() -> None:
    with pytest.raises(ArgumentError, match="the limit is 200: choose a larger --paper"):
        lay_out(drawing(1, (30.0, 4.0)), [paper_of("A4")])


def test_match_lines_name_the_sheet_on_which_the_wall_goes_on(run: Path, tmp_path: Path) -> None:
    export(run, "sheet", tmp_path / "out", "--scale", 10, "--paper", "A3", code=0)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    n_sheets = len(names)
    seen: dict[int, set[int]] = {}
    for number in range(1, n_sheets + 1):
        with page_of(tmp_path / "out" / f"wall_{WALL}_sheet_{number}.pdf") as page:
            letters = "".join(one["text"] for one in page.chars)
            seen[number] = {int(other) for other in re.findall(r"match line, sheet (\d)", letters)}
            dashed = [one for one in page.lines if one["dash"] and one["dash"][0]]
            # One of them is in the legend.
            assert len(dashed) == len(seen[number]) + 1
    assert n_sheets > 1
    for number, others in seen.items():
        assert others
        assert all(number in seen[other] for other in others)


# --- ceilings ---


def test_a_reflected_ceiling_lies_over_its_floor(tmp_path: Path) -> None:
    up = (0.0, 0.0, 1.0)
    planes = {"floor": (0.0, 0.0, 1.0), "ceiling": (0.0, 0.0, -1.0)}
    corners = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [3.0, 2.0, 0.0], [0.0, 2.0, 0.0]])
    seen = {}
    for name, normal in planes.items():
        # Top left first, counter-clockwise for the viewer; rows of ceilings go north.
        seen_from = corners[[3, 0, 1, 2]] if name == "floor" else corners[[0, 3, 2, 1]]
        frame = replace(frame_over(seen_from, np.array(normal), gsd_m=0.01), up=up)
        # Bright where x is small and y large: a corner that both share.
        place = frame.world_from_wall(cell_centres(frame.shape))
        bright = (place[:, 0] < 1.0) & (place[:, 1] > 1.0)
        values = bright.reshape(frame.shape).astype(np.float32)
        raster = tmp_path / f"{name}.tif"
        write_raster(raster, values, place=GridPlace.of(frame), tags={})
        whole = Part(left_m=0.0, top_m=0.0, right_m=3.0, bottom_m=2.0)
        is_flipped = frame.raster_down > 0.0
        encoded = encode_part(raster, whole, scale=10, is_flipped=is_flipped)
        seen[name] = np.asarray(Image.open(BytesIO(encoded)).convert("L"))
        axes = axes_of(frame)
        # X to the right and Y up the paper, and so the key plan's up.
        assert (axes.across, axes.down) == (
            pytest.approx((0.0, 1.0), abs=1e-9),
            pytest.approx((2.0, -1.0), abs=1e-9),
        )
        assert north_of(frame) == pytest.approx((0.0, 1.0), abs=1e-9)
        wall = DrawnWall(number=0, name=name, plane_index=None, frame=frame, image="a.png")
        write_wall_dxf(tmp_path / "a.dxf", wall, None)
        (image,) = ezdxf.readfile(tmp_path / "a.dxf").modelspace().query("IMAGE")
        top_m = image.dxf.insert.y + frame.height * image.dxf.v_pixel.y
        assert top_m == pytest.approx(frame.raster_corner_m[1], abs=1e-9)
    np.testing.assert_array_equal(seen["floor"], seen["ceiling"])
    assert seen["floor"][5, 5] == 255
    assert seen["floor"][-5, 5] == seen["floor"][5, -5] == 0


def test_a_sheet_of_a_floor_has_a_mark_of_orientation(tmp_path: Path) -> None:
    planes = box_planes()
    frame = frame_over(planes.corners[0], planes.normal[0], gsd_m=0.02)
    frame = replace(frame, up=(0.0, 0.0, 1.0))
    rgb = np.full((*frame.shape, 3), 90, np.uint8)
    floor = samples.orthoimage(frame, name="floor 0", rgb=rgb, plane_index=0)
    run = write_drawing_run(tmp_path / "run", others=(floor,))
    export(run, "sheet", tmp_path / "out", "--wall", 0, code=0)
    with page_of(tmp_path / "out" / "wall_0_sheet_1.pdf") as page:
        assert "axis of the scan; north unknown" in words_of(page)


def test_grey_of_colours_is_not_called_intensity(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = write_drawing_run(tmp_path / "run")
    found = room_results(open_run(run))
    walls = tuple(replace(wall, intensity_source="luminance") for wall in found.walls)
    changed = replace(found, walls=walls)
    monkeypatch.setattr("orthoflow.cli.exports.sheets.room_results", lambda *_: changed)
    export(run, "sheet", tmp_path / "out", "--scale", 50, "--beside", "intensity", code=0)
    with page_of(tmp_path / "out" / f"wall_{WALL}_sheet_1.pdf") as page:
        assert "grey of the scan's colours" in words_of(page)


def cell_centres(shape: tuple[int, int]) -> np.ndarray:
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    return np.column_stack([columns.ravel(), rows.ravel()])


def test_usual_scales_are_those_of_the_list() -> None:
    assert (usual_scale(41.0), usual_scale(20.1), usual_scale(2.1)) == (50, 25, 5)


@pytest.mark.parametrize(
    ("language", "said"),
    [
        ("en", ("reference plane: 4,000 points", "RMSE horizontal 0.7 mm", "niche 0.80 x 1.20 m")),
        ("de", ("Bezugsebene: 4.000 Punkte", "RMSE horizontal 0,7 mm", "Nische 0,80 x 1,20 m")),
        ("fr", ("référence : 4 000 points", "RMSE en largeur 0,7 mm", "niche 0,80 x 1,20 m")),
    ],
)
def test_numbers_have_the_separators_of_the_language(
    tmp_path: Path, language: str, said: tuple[str, ...]
) -> None:
    errors_m = np.full(box_image().frame.shape, 0.002, np.float32)
    image = replace(box_image(), error_m=errors_m, n_check_points=1288)
    run = write_drawing_run(tmp_path / "run", gains="global", differ=True, image=image)
    done = export(run, "sheet", tmp_path / "out", "--scale", 25, "--language", language)
    assert (done.exit_code, done.stderr) == (0, "")
    with page_of(tmp_path / "out" / f"wall_{WALL}_sheet_1.pdf") as page:
        text = words_of(page)
    for part in said:
        assert part in text, part
    # Heights beside the picture: the upper edge of the niche.
    assert ("+101.80" if language == "en" else "+101,80") in text
    if language == "en":
        return
    for key in ("legend", "legend_height", "legend_empty", "legend_opening"):
        assert label(key, language).split(";")[0][:20] in text
    for english in (
        *("Legend ", "height", "accuracy", "wall 2", "colours", "check", "gains", "run r1 of"),
        *("sheet 1 of", "contour "),
    ):
        assert english not in text, english
    if language == "de":
        for part in (
            "erwarteter Fehler eines in diesem Bild gemessenen Punktes: Median 2,0 mm",
            "bezogen auf den Scan und ohne dessen Fehler",
            "zurückgehaltene Verknüpfungspunkte auf dieser Wand: 1.288",
            "Lauf r1 von box",
        ):
            assert part in text, part


def test_a_wall_with_an_empty_image_has_a_sheet_only_where_it_is_asked_for(tmp_path: Path) -> None:
    image = box_image()
    empty = replace(
        image,
        name="wall 1",
        plane_index=1,
        mask=np.zeros_like(image.mask),
        rgb=np.zeros_like(image.rgb),
        source=np.full_like(image.source, -1),
    )
    run = write_drawing_run(tmp_path / "run", others=(empty,))
    for options, number in ((), WALL), (("--wall", 1), 1):
        done = export(run, "sheet", tmp_path / str(number), "--scale", 25, *options, code=0)
        assert ("; left out as empty: wall 1" in done.output) == (not options)
        names = [path.name for path in (tmp_path / str(number)).iterdir()]
        assert names == [f"wall_{number}_sheet_1.pdf"]


@pytest.mark.parametrize(
    ("share", "has_ties", "said", "note"),
    [
        (0.35, True, "only 35% covered", "nur 35 % dieses Bildes sind abgedeckt"),
        (0.60, False, "there is no tie point", "auf dieser Wand liegt kein Verknüpfungspunkt"),
        (0.60, True, "", ""),
    ],
)
def test_a_wall_that_is_not_recommended_says_so_on_its_sheet(
    tmp_path: Path, share: float, said: str, note: str, *, has_ties: bool
) -> None:
    image = box_image()
    mask = np.full(image.frame.shape, OrthoMask.NONE, dtype=np.uint8)
    mask[:, : round(share * mask.shape[1])] = OrthoMask.PAINTED
    errors_m = np.full(mask.shape, 0.002 if has_ties else np.nan, np.float32)
    errors_m[mask == OrthoMask.NONE] = np.nan
    rgb = np.where(mask[:, :, None] == OrthoMask.PAINTED, image.rgb, 0).astype(np.uint8)
    source = np.where(mask == OrthoMask.PAINTED, 0, -1).astype(np.int16)
    image = replace(
        image, mask=mask, rgb=rgb, source=source, error_m=errors_m, n_check_points=12 * has_ties
    )
    run = write_drawing_run(tmp_path / "run", image=image)
    done = export(run, "sheet", tmp_path / "out", "--scale", 25, "--language", "de", code=0)
    assert (f"warning: not recommended for delivery: wall {WALL} (" in done.stderr) == bool(said)
    assert said in done.stderr
    with page_of(tmp_path / "out" / f"wall_{WALL}_sheet_1.pdf") as page:
        text = words_of(page)
    assert ("nicht empfohlen" in text) == bool(said)
    assert note in text


# Parts of a sheet: the key plan and the numbers of contours ---------------------------------------


@pytest.mark.parametrize(
    ("direction_deg", "turned_deg"), [(0, 0), (30, 30), (90, 90), (91, -89), (225, 45), (300, -60)]
)
def test_a_number_lies_along_its_line_and_is_never_upside_down(
    direction_deg: float, turned_deg: float
) -> None:
    angle = math.radians(direction_deg)
    line = np.array([[5.0, 6.0], [5.0 + 40.0 * math.cos(angle), 6.0 + 40.0 * math.sin(angle)]])
    place = label_place(line, 4.0, [])
    assert place is not None
    np.testing.assert_allclose(place[0], line.mean(axis=0))
    assert math.isclose(math.sin(math.radians(place[1] - turned_deg)), 0.0, abs_tol=1e-9)
    assert -90.0 - 1e-9 <= place[1] <= 90.0


def test_numbers_keep_apart_and_short_lines_have_none() -> None:
    line = np.array([[0.0, 0.0], [80.0, 0.0]])
    first = label_place(line, 4.0, [])
    assert first is not None
    second = label_place(line, 4.0, [np.array(first[0])])
    assert second is not None
    assert abs(second[0][0] - first[0][0]) >= 12.0
    everywhere = [np.array([x, 1.0]) for x in np.arange(0.0, 81.0, 10.0)]
    assert label_place(line, 4.0, everywhere) is None
    assert label_place(line[:, :] * 0.24, 4.0, []) is None


def test_a_number_stands_where_its_line_is_straight() -> None:
    # A corner in the middle: there the number would lie beside its line.
    line = np.array([[0.0, 0.0], [30.0, 0.0], [28.0, 1.0], [0.0, 1.0]])
    place = label_place(line, 6.0, [])
    assert place is not None
    assert place[0][1] in (0.0, 1.0)
    assert place[0][0] < 27.0
    zigzag = np.array([[float(k % 2), 0.2 * k] for k in range(60)])
    assert label_place(zigzag, 6.0, []) is None


@pytest.mark.parametrize(("sine", "share"), [(0.89, 0.25), (0.91, 0.5)])
def test_a_corner_below_a_number_is_a_blunt_one(sine: float, share: float) -> None:
    # From the corner both ways: the ends of the number are that sine of its width apart.
    half = 40.0 * np.array([sine, math.sqrt(1.0 - sine**2)])
    line = np.array([half * (-1.0, 1.0), [0.0, 0.0], half])
    place = label_place(line, 5.0, [])
    assert place is not None
    at = line[0] * (1.0 - 2.0 * share)
    below = 2.5 * math.sqrt(1.0 - sine**2) if share == 0.5 else 0.0
    np.testing.assert_allclose(place[0], at + np.array([0.0, below]), atol=1e-9)


def test_the_marked_wall_is_as_long_as_its_points_and_seen_along_its_normal() -> None:
    planes = box_planes()
    plan = key_plan(planes, wall_frame(planes))
    assert len(plan.walls) == 4
    left, right = plan.marked
    wide_m = SIZE_M[0] - 2 * GAP_M
    assert np.linalg.norm(right - left) == pytest.approx(wide_m, abs=1e-6)
    assert plan.arrow is not None
    begin, end = plan.arrow
    across = (right - left) / wide_m
    middle = 0.5 * (left + right)
    # It stands over the middle of the wall, points straight at it, and ends before it.
    for place in (begin, end):
        assert abs(float((place - middle) @ across)) < 1e-6
    assert np.linalg.norm(begin - middle) == pytest.approx(0.25 * wide_m, abs=1e-6)
    assert np.linalg.norm(end - middle) == pytest.approx(0.025 * wide_m, abs=1e-6)
    assert (begin - middle) @ (end - middle) > 0.0
    # In the room: on the same side as the other walls.
    others = plan.walls.reshape(-1, 2).mean(axis=0)
    assert (begin - middle) @ (others - middle) > 0.0


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0, -25.0])
def test_arrows_are_as_long_at_walls_that_lean(tilt_deg: float) -> None:
    angle = np.radians(tilt_deg)
    normal = np.array([0.0, -np.cos(angle), np.sin(angle)])
    down = np.array([0.0, -np.sin(angle), -np.cos(angle)])
    corner = np.array([1.0, 2.0, 3.0])
    sides = np.array([[0, 0], [0, 1], [1, 1], [1, 0]], dtype=np.float64)
    corners = corner + 4.0 * sides[:, :1] * [1.0, 0.0, 0.0] + 2.0 * sides[:, 1:] * down
    planes = samples.planes(
        normal=normal[None],
        offset=np.array([normal @ corner]),
        corners=corners[None],
        names=("wall 0",),
    )
    plan = key_plan(planes, frame_over(corners, normal, gsd_m=0.01))
    assert plan.arrow is not None
    along = plan.arrow[1] - plan.arrow[0]
    # A quarter of the wall before it, but for a tenth of that; towards it, seen from above.
    assert np.linalg.norm(along) == pytest.approx(0.25 * 4.0 * 0.9)
    before = plan.arrow[0] - plan.marked.mean(axis=0)
    np.testing.assert_allclose(before, -along / 0.9, atol=1e-9)
