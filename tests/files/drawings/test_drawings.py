"""Sheets, CAD files and vectors of a run, measured as other programs see them."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
import pdfplumber
import pytest
from click import BadParameter
from orthoflow_provenance.document import PublishedFile
from PIL import Image

from orthoflow.cli.export import export as command
from orthoflow.errors import RecordError
from orthoflow.files.drawings import geojson
from orthoflow.files.drawings.dxf import LAYERS, regular_opening
from orthoflow.records.open import open_run
from orthoflow.records.walls import room_results
from tests import samples
from tests.drawing_runs import (
    GAP_M,
    GSD_M,
    SIZE_M,
    WALL,
    box_image,
    box_openings,
    box_planes,
    box_points,
    export,
    wall_frame,
    write_drawing_run,
)
from tests.long_loops import seeds
from tests.report_runs import cell, given, metrics

# Height of the top edge of the wall's raster.
TOP_M = 102.4
MM = 25.4 / 72.0
WIDE_M, HIGH_M = SIZE_M[0] - 2 * GAP_M, SIZE_M[2] - 2 * GAP_M


@pytest.fixture(scope="module")
def sheet(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[pdfplumber.page.Page]:
    """The only sheet of the wall at 1:50, with its depth beside it."""
    folder = tmp_path_factory.mktemp("sheet")
    block = folder / "block.yaml"
    block.write_text("project: Sala Łukowa\ndrawing: 21-017\n", encoding="utf-8")
    more = ("--scale", 50, "--beside", "depth", "--title-block", block, "--grid", 0.5)
    export(run, "sheet", folder / "out", *more, code=0)
    assert [path.name for path in (folder / "out").iterdir()] == [f"wall_{WALL}_sheet_1.pdf"]
    with pdfplumber.open(folder / "out" / f"wall_{WALL}_sheet_1.pdf") as pdf:
        (page,) = pdf.pages
        yield page


def test_pictures_bars_and_marks_are_to_scale(sheet: pdfplumber.page.Page) -> None:
    bar = [box for box in sheet.rects if box["height"] * MM == pytest.approx(2.0, abs=1e-3)]
    assert len(bar) >= 3
    for segment in bar:
        assert segment["width"] * MM == pytest.approx(20.00, abs=0.005)
    ortho, depth = sheet.images
    for picture in (ortho, depth):
        assert (picture["x1"] - picture["x0"]) * MM == pytest.approx(WIDE_M * 20, abs=0.01)
        assert (picture["bottom"] - picture["top"]) * MM == pytest.approx(HIGH_M * 20, abs=0.01)
    assert ortho["srcsize"] == (380, 230)
    # The mark of X = 2 m below the picture, and that of height 101 m beside it.
    upright = [line for line in sheet.lines if abs(line["x1"] - line["x0"]) < 1e-6]
    below = [m for m in upright if m["top"] == pytest.approx(ortho["bottom"], abs=0.01)]
    places = sorted((mark["x0"] - ortho["x0"]) * MM for mark in below)[:8]
    np.testing.assert_allclose(places, np.arange(8) * 10.0, atol=0.01)
    level = [line for line in sheet.lines if abs(line["top"] - line["bottom"]) < 1e-6]
    beside = [m for m in level if m["x1"] == pytest.approx(ortho["x0"], abs=0.01)]
    heights = sorted((ortho["bottom"] - mark["top"]) * MM for mark in beside)
    # The lowest cell of the wall is 0.1 m over the floor, at 100.1 m.
    np.testing.assert_allclose(heights, (np.arange(100.5, 102.5, 0.5) - 100.1) * 20, atol=0.01)
    # Crosses of the grid.
    within = [m for m in level if ortho["x0"] < m["x0"] < m["x1"] < ortho["x1"]]
    arms = [(m["x1"] - m["x0"]) * MM for m in within if ortho["top"] < m["top"] < ortho["bottom"]]
    assert len(arms) > 10
    np.testing.assert_allclose(arms, 3.0, atol=1e-3)


def test_a_sheet_says_what_the_record_says(run: Path, sheet: pdfplumber.page.Page) -> None:
    text = " ".join(sheet.extract_text().split())
    for said in (
        *("Sala Łukowa", "1:50", "21-017", "wall 2", "sheet 1 of 1"),
        "measured: RMSE horizontal 0.7 mm, vertical 1.4 mm",
        "reference plane: 4,000 points, RMS distance 2.0 mm (including relief)",
        "colours as scanned",
        "grid 0.5 m",
        # Letters that stand upright come from below.
        *("0.101", "3.5"),
    ):
        assert said in text, said
    digest = open_run(run).content_sha256
    letters = "".join(character["text"] for character in sheet.chars)
    assert all(digest[k : k + 16] in letters for k in (0, 16, 32, 48))


def test_the_step_of_the_wall_is_a_contour(sheet: pdfplumber.page.Page) -> None:
    # 40 mm over the plane on the right half.
    _, depth = sheet.images
    middle = 0.5 * (depth["x0"] + depth["x1"])
    drawn = [
        line
        for line in (*sheet.curves, *sheet.lines)
        if line["stroke"]
        and line["stroking_color"] == pytest.approx((0.8, 0.25, 0.05))
        # The legend has one, too.
        and depth["top"] <= line["top"] <= depth["bottom"]
    ]
    assert drawn
    # A sample of the contours is half a millimetre of paper.
    assert all(abs(line["x0"] - middle) * MM < 0.5 for line in drawn)
    assert max(line["height"] for line in drawn) * MM > 0.95 * HIGH_M * 20


def test_a_wall_that_does_not_fit_takes_several_sheets(run: Path, tmp_path: Path) -> None:
    export(run, "sheet", tmp_path / "out", "--scale", 10, "--paper", "A3", code=0)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == [f"wall_{WALL}_sheet_{number}.pdf" for number in range(1, len(names) + 1)]
    areas = 0.0
    for name in names:
        with pdfplumber.open(tmp_path / "out" / name) as pdf:
            (picture,) = pdf.pages[0].images
            areas += picture["width"] * picture["height"] * MM * MM
            assert f"of {len(names)}" in pdf.pages[0].extract_text()
    assert areas == pytest.approx(WIDE_M * HIGH_M * 1e4, rel=1e-5)


@pytest.mark.parametrize("has_ties", [True, False])
def test_the_accuracy_of_a_wall_is_by_evidence_on_that_wall(
    tmp_path: Path, *, has_ties: bool
) -> None:
    errors_m = np.full(box_image().frame.shape, 0.002 if has_ties else np.nan, np.float32)
    image = replace(box_image(), error_m=errors_m, n_check_points=12 if has_ties else 0)
    run = open_run(write_drawing_run(tmp_path / "run", image=image))
    # An orientation of photos behind its orthoimages.
    numbers = metrics(sigma_wall_mm_worst=4.0, check_rmse_mm_worst=2.5)
    orient = cell("orient", inputs={"photos": given("inputs.photos", "a", "photos")})
    cameras = given("orient.cameras", "b", "cameras")
    cells = [
        replace(one, inputs={**one.inputs, "cameras": cameras}) if one.step == "mosaic" else one
        for one in run.record.cells
    ]
    cells.insert(0, replace(orient, metrics=numbers))
    (wall,) = room_results(replace(run, record=replace(run.record, cells=tuple(cells)))).walls
    texts = [said.text() for said in wall.accuracy]
    assert texts[0].startswith("expected error of a point" if has_ties else "accuracy not checked")
    # What is stated is not said to be unknown; numbers of the photos are of all walls together.
    assert sum("not checked" in text for text in texts) == int(not has_ties)
    assert not any("worst photo" in text for text in texts)


@pytest.mark.parametrize("text", ["50", "1:50", "1 : 50"])
def test_a_scale_may_be_written_whole(text: str) -> None:
    (option,) = (one for one in command.params if one.name == "scale")
    assert option.type.convert(text, option, None) == 50
    with pytest.raises(BadParameter):
        option.type.convert("2:50", option, None)


def test_a_record_alone_is_drawn_as_its_run_is(run: Path, tmp_path: Path) -> None:
    alone = tmp_path / "court.h5"
    alone.write_bytes((run / "run.h5").read_bytes())
    made = []
    for source in (run, alone):
        done = export(source, "geojson", tmp_path / source.stem, code=0)
        made.append({path.name: path.read_bytes() for path in (tmp_path / source.stem).iterdir()})
    assert f"note: {alone} has no files next to it: its rasters are recreated" in done.output
    assert made[0] == made[1] != {}


def test_one_wall_is_drawn_without_the_files_of_another(run: Path) -> None:
    whole = open_run(run)
    gone = PublishedFile(
        path=f"products/mosaic/wall_{WALL + 1}_ortho.tif", size_bytes=9, sha256="0" * 64
    )
    published = (*whole.record.published, gone)
    partly = replace(whole, record=replace(whole.record, published=published))
    with pytest.raises(RecordError, match=f"wall_{WALL + 1}_ortho.tif is missing from"):
        room_results(partly)
    (wall,) = room_results(partly, wall=WALL).walls
    assert wall.number == WALL
    assert wall.accuracy == room_results(whole).walls[0].accuracy


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--wall", 0), "--wall 0: mosaic shows no wall 0; it shows 2"),
        (("--paper", "B7"), "--paper must be A0"),
        (("--grid", "0.01"), "--grid 0.01 puts crosses closer together than 2 mm at 1:"),
        (
            ("--step", "plane"),
            "the step plane has no orthoimages or walls; steps of this run that have them:",
        ),
        (("--step", "none"), "has no step 'none'"),
        (("--title-block", "missing.yaml"), "cannot read missing.yaml"),
    ],
    ids=["wall", "paper", "grid", "cell", "no-cell", "title-block"],
)
def test_what_cannot_be_drawn_is_refused_and_nothing_is_written(
    run: Path, tmp_path: Path, more: tuple[object, ...], said: str
) -> None:
    done = export(run, "sheet", tmp_path / "out", *more, code=2)
    assert said in done.output
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def drawn(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dxf") / "out"
    done = export(run, "dxf", folder, code=0)
    assert "1 wall, and the room: 6 planes, 12 edges, 8 corners, 1 opening" in done.output
    return folder


@pytest.mark.parametrize("name", [f"wall_{WALL}.dxf", "room.dxf"])
def test_cad_files_have_no_errors_and_no_text_lies_on_another(drawn: Path, name: str) -> None:
    document = ezdxf.readfile(drawn / name)
    audit = document.audit()
    assert (audit.errors, audit.fixes) == ([], [])
    assert document.units == ezdxf.units.M
    (definition,) = document.objects.query("IMAGEDEF")
    assert definition.dxf.filename == f"wall_{WALL}_ortho.png"
    # From above a floor and its ceiling have one middle.
    texts = sorted(document.modelspace().query("TEXT"), key=lambda text: text.dxf.insert.x)
    assert len(texts) > 5
    for first, second in itertools.combinations(texts, 2):
        end = first.dxf.insert.x + 0.8 * first.dxf.height * len(first.dxf.text)
        apart = abs(first.dxf.insert.y - second.dxf.insert.y)
        assert end < second.dxf.insert.x or apart > first.dxf.height, (first, second)
    # Names from a record are harmless.
    assert b"\x1b" not in (drawn / name).read_bytes()
    if name == "room.dxf":
        marks = document.modelspace().query("INSERT")
        assert "P2\\x1b]0;" in [mark.get_attrib_text("NAME") for mark in marks]
        leaders = document.modelspace().query('LINE[layer=="A-ANNO-TEXT"]')
        assert {line.dxf.end for line in leaders} & {text.dxf.insert for text in texts}


def test_the_picture_lies_on_its_wall_to_scale(drawn: Path) -> None:
    space = ezdxf.readfile(drawn / f"wall_{WALL}.dxf").modelspace()
    (image,) = space.query("IMAGE")
    assert tuple(image.dxf.insert)[:2] == pytest.approx((0.0, TOP_M - HIGH_M), abs=1e-9)
    assert tuple(image.dxf.u_pixel) == pytest.approx((GSD_M, 0.0, 0.0), abs=1e-12)
    assert tuple(image.dxf.v_pixel) == pytest.approx((0.0, GSD_M, 0.0), abs=1e-12)
    picture = np.asarray(Image.open(drawn / f"wall_{WALL}_ortho.png"))
    assert picture.shape == (230, 380, 4)
    # The ten rightmost columns show nothing; red grows to the right, green downwards.
    assert (picture[:, -10:, 3] == 0).all()
    assert (picture[:, :-10, 3] == 255).all()
    np.testing.assert_array_equal(picture[7, :370, 0], np.arange(370) // 2)
    np.testing.assert_array_equal(picture[:, 9, 1], np.arange(230))


def test_a_wall_has_its_edges_points_grid_and_heights_in_metres(drawn: Path) -> None:
    document = ezdxf.readfile(drawn / f"wall_{WALL}.dxf")
    layers = [
        (one.dxf.name, one.description, one.color, one.dxf.lineweight) for one in document.layers
    ]
    assert {(name, *stated) for name, stated in LAYERS.items()} <= {*layers}
    space = document.modelspace()
    edges = [
        np.array([line.dxf.start, line.dxf.end])[:, :2]
        for line in space.query('LINE[layer=="A-ELEV-EDGE"]')
    ]
    # 10 cm outside the rectangle of points on all four sides.
    sides = sorted(
        round(float(value), 6)
        for edge in edges
        for value in (edge[0] if np.ptp(edge[:, 0]) < 1e-6 else edge[0][::-1])[:1]
    )
    beside = [-GAP_M, WIDE_M + GAP_M, TOP_M + GAP_M, TOP_M - HIGH_M - GAP_M]
    assert sides == pytest.approx(sorted(beside))
    marks = space.query('INSERT[name=="SURVEY-POINT"]')
    points = [tuple(mark.dxf.insert)[:2] for mark in marks]
    assert points == [pytest.approx((1.0, TOP_M - 1.0)), pytest.approx((2.0, TOP_M - 1.0))]
    heights = [
        (tuple(mark.dxf.insert)[1], mark.get_attrib_text("HEIGHT"))
        for mark in space.query('INSERT[name=="LEVEL"]')
    ]
    for height, text in heights:
        assert text == f"{height:+.3f}"
    assert [height for height, _ in heights] == pytest.approx([TOP_M - HIGH_M, TOP_M])
    level = [
        line.dxf.start.y
        for line in space.query('LINE[layer=="A-ANNO-GRID"]')
        if line.dxf.start.y == line.dxf.end.y
    ]
    assert level == pytest.approx([100.5, 101.0, 101.5, 102.0])
    measured = sorted(
        dimension.get_measurement() for dimension in space.query('DIMENSION[layer=="A-ANNO-DIMS"]')
    )
    assert measured == pytest.approx([0.8, 1.2, HIGH_M, WIDE_M], abs=1e-6)


def test_the_room_has_each_wall_in_its_place(drawn: Path) -> None:
    document = ezdxf.readfile(drawn / "room.dxf")
    space = document.modelspace()
    frame = wall_frame(box_planes())
    (image,) = space.query("IMAGE")
    corner = np.array(image.dxf.insert)
    right = corner + 380 * np.array(image.dxf.u_pixel)
    top = corner + 230 * np.array(image.dxf.v_pixel)
    top_left, bottom_left, bottom_right, _ = frame.corners_world()
    for found, expected in ((corner, bottom_left), (right, bottom_right), (top, top_left)):
        np.testing.assert_allclose(found, expected, atol=1e-6)
    ucs = document.ucs.get(f"wall_{WALL}").ucs()
    place = np.array(tuple(ucs.to_wcs((1.0, -0.5, 0.25))))
    expected = frame.world_from_wall(np.array([[100.0, 50.0]]), 0.25)[0]
    np.testing.assert_allclose(place, expected, atol=1e-6)
    faces = space.query("3DFACE")
    assert len(faces) == 4
    (outline,) = space.query("LWPOLYLINE")
    assert outline.closed
    assert outline.dxf.elevation == pytest.approx(100.0)
    x, y, _ = SIZE_M
    corners = box_points(np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]], dtype=float))
    drawn_at = np.array([point[:2] for point in outline.get_points()])
    for point in corners:
        assert np.linalg.norm(drawn_at - point[:2], axis=1).min() < 1e-6
    assert len(space.query('LINE[layer=="A-WALL-EDGE"]')) == 12


def test_openings_are_drawn_on_a_layer_of_the_wall_and_of_the_room(drawn: Path) -> None:
    (opening,) = box_openings().openings
    places = {
        f"wall_{WALL}.dxf": ("A-ELEV-OPNG", opening.outline_m),
        "room.dxf": ("A-WALL-OPNG", opening.outline_world),
    }
    for name, (layer, expected) in places.items():
        space = ezdxf.readfile(drawn / name).modelspace()
        (outline,) = space.query(f'LWPOLYLINE[layer=="{layer}"]') or space.query(
            f'POLYLINE[layer=="{layer}"]'
        )
        points = outline.get_points() if name.startswith("wall") else outline.points()
        corners = np.array([tuple(point)[: expected.shape[1]] for point in points])
        for corner in expected:
            assert np.linalg.norm(corners - corner, axis=1).min() < 1e-6
    texts = ezdxf.readfile(drawn / f"wall_{WALL}.dxf").modelspace().query("TEXT")
    found = [text.dxf.text for text in texts]
    assert {"niche 0.250 m deep", "0.80 x 1.20 m", "rectangle", "deviation 0 mm"} <= {
        part for text in found for part in (text, *text.split(", "))
    }


def test_openings_are_outlined_on_sheets_in_scale(sheet: pdfplumber.page.Page) -> None:
    (opening,) = box_openings().openings
    ortho = sheet.images[0]
    outlines = [
        box
        for box in (*sheet.rects, *sheet.curves)
        if box["stroking_color"] == pytest.approx((0.0, 0.4, 0.45))
        and box["x1"] < max(picture["x1"] for picture in sheet.images)
    ]
    # Beside the orthoimage its depth, with the same.
    assert len(outlines) == 2
    first = min(outlines, key=lambda box: float(box["x0"]))
    left, top = (opening.outline_m[0] - [0.0, TOP_M]) * [20.0, -20.0]
    assert (first["x0"] - ortho["x0"]) * MM == pytest.approx(left, abs=0.01)
    assert (first["top"] - ortho["top"]) * MM == pytest.approx(top, abs=0.01)
    assert first["width"] * MM == pytest.approx(20 * opening.width_m, abs=0.01)
    assert first["height"] * MM == pytest.approx(20 * opening.height_m, abs=0.01)


def test_vectors_are_geojson_of_rings_and_lines(run: Path, tmp_path: Path) -> None:
    export(run, "geojson", tmp_path / "out", code=0)
    room = json.loads((tmp_path / "out" / "room.geojson").read_text())
    kinds = [feature["properties"]["kind"] for feature in room["features"]]
    counts = {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)}
    expected_counts = {"rectangle": 6, "edge": 12, "corner": 8, "outline": 1, "check point": 2}
    assert counts == expected_counts | {"opening": 1}
    (outline,) = [f for f in room["features"] if f["properties"]["kind"] == "outline"]
    ring = np.array(outline["geometry"]["coordinates"][0])
    assert len(ring) == 5
    np.testing.assert_array_equal(ring[0], ring[-1])
    x, y = ring[:-1, 0], ring[:-1, 1]
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    # Coordinates of 5e6 m multiplied: to a part in 1e9 of 2e13.
    assert area == pytest.approx(SIZE_M[0] * SIZE_M[1], abs=0.02)
    wall = json.loads((tmp_path / "out" / f"wall_{WALL}.geojson").read_text())
    (frame,) = [f for f in wall["features"] if f["properties"]["kind"] == "frame"]
    corners = np.array(frame["geometry"]["coordinates"][0])
    expected = np.array([[0, 0], [0, -HIGH_M], [WIDE_M, -HIGH_M], [WIDE_M, 0], [0, 0]])
    np.testing.assert_allclose(corners, expected + np.array([0.0, TOP_M]), atol=1e-6)
    edges = [f for f in wall["features"] if f["properties"]["kind"] == "edge"]
    assert sorted(f["properties"]["planes"] for f in edges) == [[0, 2], [1, 2], [2, 3], [2, 5]]


# GeoJSON of seams, and regular openings -----------------------------------------------------------


def features(path: Path) -> list[Any]:
    found: list[Any] = json.loads(path.read_text())["features"]
    return found


@pytest.mark.parametrize("most_cells", [24, 6])
def test_seams_lie_in_the_metres_of_the_wall_however_coarse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most_cells: int
) -> None:
    monkeypatch.setattr(geojson, "SEAM_CELLS", most_cells)
    frame = samples.facing_south(0.5, 6, 4, (100.0, 200.0, 3.0))
    source = np.zeros(frame.shape, dtype=np.int16)
    source[:, 4:] = 1
    image = samples.orthoimage(
        frame,
        source=source,
        sources=("a.jpg", "b.jpg"),
        rgb=np.zeros((*frame.shape, 3), dtype=np.uint8),
    )
    geojson.write_seams_geojson(tmp_path / "a.geojson", image)
    left, right = frame.raster_corner_m[0], frame.raster_corner_m[0] + 3.0
    high = frame.raster_corner_m[1]
    drawn = features(tmp_path / "a.geojson")
    assert [one["properties"] for one in drawn] == [
        {"photo": "a.jpg", "wall": image.number},
        {"photo": "b.jpg", "wall": image.number},
    ]
    for one, begin, end in zip(drawn, (left, left + 2.0), (left + 2.0, right), strict=True):
        (ring,) = one["geometry"]["coordinates"]
        assert ring[0] == ring[-1]
        corners = [[begin, high - 2.0], [begin, high], [end, high - 2.0], [end, high]]
        assert sorted(map(list, set(map(tuple, ring)))) == corners


def wobbled(outline: np.ndarray, seed: int, sd_m: float) -> np.ndarray:
    """An outline with a vertex every 5 cm, each moved at random."""
    points = []
    for begin, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        count = max(1, int(np.linalg.norm(end - begin) / 0.05))
        points += [begin + k / count * (end - begin) for k in range(count)]
    return np.array(points) + np.random.default_rng(seed).normal(0.0, sd_m, (len(points), 2))


@pytest.mark.parametrize("seed", seeds(5))
def test_a_window_with_uneven_sides_is_a_rectangle(seed: int) -> None:
    box = np.array([[1.0, 0.5], [2.2, 0.5], [2.2, 2.0], [1.0, 2.0]])
    found = regular_opening(wobbled(box, seed, 0.005), 0.005)
    assert found.kind == "rectangle"
    assert np.abs(found.outline_m - box).max() < 0.005
    assert 0.004 < found.deviation_m < 0.03


@pytest.mark.parametrize(("seed", "rise_m"), [(0, 0.6), (1, 0.3), (2, 0.15)])
def test_a_door_under_an_arch_is_one(seed: int, rise_m: float) -> None:
    half, spring = 0.6, 2.0
    radius = (half**2 + rise_m**2) / (2 * rise_m)
    angle = np.arcsin(half / radius)
    turns = np.linspace(angle, -angle, 40)
    arc = np.column_stack([np.sin(turns), np.cos(turns)]) * radius
    arc += [0.0, spring + rise_m - radius]
    door = np.vstack([[-half, 0.0], [half, 0.0], arc])
    found = regular_opening(wobbled(door, seed, 0.003), 0.003)
    assert found.kind == "arch"
    assert found.outline_m[:, 1].max() == pytest.approx(spring + rise_m, abs=0.012)
    assert found.deviation_m < 0.03


def test_what_is_neither_keeps_its_outline() -> None:
    star = np.array([[0.0, 0.0], [1.0, 0.3], [2.0, 0.0], [1.4, 0.8], [1.0, 2.0], [0.6, 0.8]])
    found = regular_opening(star, None)
    assert (found.kind, found.deviation_m) == ("outline", 0.0)
    np.testing.assert_array_equal(found.outline_m, star)
