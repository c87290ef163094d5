"""What an export of drawings asks of those who draw: scale, sheets, pictures, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.cli.exports import drawings as module
from orthoflow.cli.exports.choices import Choices
from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.papers import Paper, paper_of
from orthoflow.files.drawings.sheet_contents import Axes, Sheet, WallDrawing
from orthoflow.files.drawings.title_blocks import TitleBlock
from orthoflow.products import Orthoimages
from tests import samples

PAPER = paper_of("A4")


def wall(width_m: float = 3.8, height_m: float = 2.3, *kinds: str, gsd_m: float = 0.01) -> Any:
    """A wall whose pictures nobody opens."""
    shape = (round(width_m / gsd_m), round(height_m / gsd_m))
    return SimpleNamespace(
        number=7,
        plane_index=7,
        name="wall 7",
        frame=samples.facing_east(gsd_m, *shape, (1.0, 2.0, 30.0)),
        rasters={kind: Path(f"{kind}.tif") for kind in kinds or ("ortho", "depth")},
        accuracy=("RMSE 1 mm", "RMS 2 mm"),
        colours="colours untouched",
        intensity_source="laser",
    )


def results(**more: Any) -> Any:
    plain = {"planes": None, "address": "mosaic", "openings_of": lambda _: (), "walls": (wall(),)}
    return SimpleNamespace(**(plain | more))


def drawing(
    one: Any, *, scale: int, grid_m: float = 0.5, kinds: tuple[str, ...] = ()
) -> WallDrawing:
    return WallDrawing(
        number=one.number,
        rasters={kind: one.rasters[kind] for kind in kinds or tuple(one.rasters)},
        axes=Axes(across=(0.0, 1.0), down=(0.0, -1.0), said=""),
        plan=None,
        text=None,  # type: ignore[arg-type] # nobody writes it
        scale=scale,
        grid_m=grid_m,
    )


# --- sheets of a wall ---


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, WallDrawing, Sheet]]:
    """Sheets that would have been written."""
    kept: list[tuple[str, WallDrawing, Sheet]] = []
    monkeypatch.setattr(
        "orthoflow.cli.exports.drawings.write_sheet",
        lambda path, drawn, sheet: kept.append((path.name, drawn, sheet)),
    )
    return kept


def test_a_wall_that_fits_is_one_sheet_without_an_index(
    written: list[tuple[str, WallDrawing, Sheet]],
) -> None:
    one = wall(3.8, 2.3)
    assert module._write_wall(Path(), drawing(one, scale=50), one, PAPER) == 1
    ((name, drawn, sheet),) = written
    assert (name, drawn.scale, drawn.grid_m) == ("wall_7_sheet_1.pdf", 50, 0.5)
    assert (sheet.number, sheet.count, sheet.numbered) == (1, 1, ())
    assert [view.kind for view in sheet.views] == ["ortho", "depth"]


def test_a_wall_that_is_cut_has_an_index_at_the_scale_that_fits(
    written: list[tuple[str, WallDrawing, Sheet]],
) -> None:
    one = wall(6.0, 4.0)
    n_sheets = module._write_wall(Path(), drawing(one, scale=20), one, PAPER)
    *sheets, (name, small, index) = written
    assert n_sheets == len(sheets) > 4
    assert [entry[0] for entry in sheets] == [f"wall_7_sheet_{k + 1}.pdf" for k in range(n_sheets)]
    assert [entry[2].number for entry in sheets] == list(range(1, n_sheets + 1))
    assert {entry[2].count for entry in sheets} == {n_sheets}
    # Half of the sheets show the orthoimage, the others the depth; each has the key of its own.
    kinds = [entry[2].views[0].kind for entry in sheets]
    assert kinds == ["ortho"] * (n_sheets // 2) + ["depth"] * (n_sheets // 2)
    for kind in ("ortho", "depth"):
        own = [entry[2] for entry in sheets if entry[2].views[0].kind == kind]
        parts = tuple((sheet.number, sheet.views[0].part) for sheet in own)
        assert all(sheet.numbered == parts for sheet in own)
    # The index shows the first picture, whole, on one sheet, without a grid.
    assert name == "wall_7_index.pdf"
    assert (index.number, index.count) == (0, n_sheets)
    assert index.numbered == sheets[0][2].numbered
    (view,) = index.views
    assert view.kind == "ortho"
    np.testing.assert_allclose(view.part.size_m, (6.0, 4.0))
    assert small.grid_m == 0.0
    # The largest usual scale at which it fits, of either way that the paper may lie.
    fits = [
        scale
        for scale in (10, 20, 25, 50, 100)
        for way in (PAPER, PAPER.turned)
        if 6000.0 / scale <= way.area_mm[0] and 4000.0 / scale <= way.area_mm[1]
    ]
    assert small.scale == min(fits)


def test_of_what_no_usual_scale_brings_onto_a_sheet_there_is_no_index(
    written: list[tuple[str, WallDrawing, Sheet]],
) -> None:
    one = wall(9000.0, 500.0, "ortho", gsd_m=1.0)
    n_sheets = module._write_wall(Path(), drawing(one, scale=10_000, grid_m=0.0), one, PAPER)
    assert n_sheets > 1
    assert [entry[0] for entry in written] == [f"wall_7_sheet_{k + 1}.pdf" for k in range(n_sheets)]


# --- a drawing ---


def drawn(one: Any, scale: int, **choices: Any) -> WallDrawing:
    return module._drawing(results(), one, Choices(**choices), scale, None)  # type: ignore[arg-type]


def test_crosses_are_two_centimetres_apart_or_a_little_more() -> None:
    one = wall(3.8, 2.3, "ortho")
    for scale in (1, 5, 10, 20, 50, 100, 250, 1000):
        apart_mm = 1e3 * drawn(one, scale).grid_m / scale
        assert 20.0 - 1e-6 <= apart_mm < 50.0
        digits = drawn(one, scale).grid_m / 10.0 ** np.floor(np.log10(drawn(one, scale).grid_m))
        assert min(abs(digits - each) for each in (1, 2, 5)) < 1e-6
    assert drawn(one, 50, grid_m=0.25).grid_m == 0.25
    assert drawn(one, 50, grid_m=0.0).grid_m == 0.0
    assert drawn(one, 50, grid_m=float("inf")).grid_m == 0.0


def test_crosses_closer_than_two_millimetres_are_refused() -> None:
    one = wall(3.8, 2.3, "ortho")
    assert drawn(one, 50, grid_m=0.1).grid_m == 0.1
    with pytest.raises(ArgumentError) as caught:
        drawn(one, 50, grid_m=0.099)
    assert str(caught.value) == (
        "--grid 0.099 puts crosses closer than 2 mm at 1:50: take at least 0.1, or 0 for none"
    )


def test_openings_are_told_from_the_corner_of_the_picture() -> None:
    one = wall(3.8, 2.3, "ortho")
    x, y = one.frame.raster_corner_m
    opening = SimpleNamespace(said="niche", outline_m=np.array([[x + 0.5, y - 0.6], [x + 1.3, y]]))
    told = module._drawing(
        results(openings_of=lambda _: (opening,)),
        one,
        Choices(),
        50,
        None,  # type: ignore[arg-type]
    )
    (area,) = told.areas
    assert area.text == "niche"
    # To the right and down.
    np.testing.assert_allclose(area.outline_m, [[0.5, 0.6], [1.3, 0.0]], atol=1e-9)
    assert (told.number, told.scale, told.interval_m, told.plan) == (7, 50, 0.0, None)
    assert list(told.rasters) == ["ortho"]


@pytest.mark.parametrize(
    ("there", "beside", "kinds"),
    [
        (("depth", "intensity", "ortho"), (), ["ortho"]),
        (("depth", "intensity"), (), ["intensity"]),
        (("depth",), (), ["depth"]),
        (("ortho", "depth"), ("depth", "ortho"), ["ortho", "depth"]),
    ],
)
def test_the_orthoimage_comes_first_and_what_is_asked_beside_it(
    there: tuple[str, ...], beside: tuple[str, ...], kinds: list[str]
) -> None:
    assert module._kinds(wall(1.0, 1.0, *there), Choices(beside=beside)) == kinds


def test_what_the_run_has_not_is_not_drawn_beside() -> None:
    with pytest.raises(ArgumentError) as caught:
        module._kinds(wall(1.0, 1.0, "ortho", "depth"), Choices(beside=("intensity",)))
    assert str(caught.value) == (
        "--beside intensity: the run has no intensity of wall 7, only ortho, depth"
    )


def test_a_wall_is_chosen_by_its_number() -> None:
    walls = [SimpleNamespace(number=number) for number in (2, 5)]
    told = results(walls=walls)
    assert module._chosen_walls(told, Choices()) is walls
    assert module._chosen_walls(told, Choices(wall=5)) == [walls[1]]
    with pytest.raises(ArgumentError, match=r"^--wall 0: mosaic shows no wall 0; it shows 2, 5$"):
        module._chosen_walls(told, Choices(wall=0))


@pytest.mark.parametrize(
    ("change", "notes"),
    [
        ({}, ("accuracy: RMSE 1 mm; RMS 2 mm", "colours untouched", "cells of 10 mm")),
        ({"accuracy": ()}, ("accuracy not checked", "colours untouched", "cells of 10 mm")),
        ({"colours": ""}, ("accuracy: RMSE 1 mm; RMS 2 mm", "cells of 10 mm")),
    ],
)
def test_a_sheet_says_what_is_known_of_its_wall(
    change: dict[str, object], notes: tuple[str, ...]
) -> None:
    run = SimpleNamespace(
        record=SimpleNamespace(run_id="r1", name="hall", created_by="orthoflow 0.2")
    )
    one = wall()
    vars(one).update(change)
    block = TitleBlock(project="Hall")
    text = module._sheet_text(run, one, block, "d" * 64)  # type: ignore[arg-type]
    assert text.notes == notes
    assert (text.name, text.block, text.digest) == ("wall 7", block, "d" * 64)
    assert text.run == "run r1 of hall, orthoflow 0.2"


# --- all walls ---


def test_sheets_are_counted_and_have_one_scale(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    written: list[tuple[str, WallDrawing, Sheet]],
) -> None:
    walls = (wall(3.8, 2.3, "ortho"), wall(9.0, 3.0, "ortho"))
    walls[1].number = 9
    monkeypatch.setattr(
        "orthoflow.cli.exports.drawings.room_results",
        lambda _run, _cell, _wall: results(walls=walls),
    )
    told = SimpleNamespace(run_id="r", name="hall", created_by="o")
    run: Any = SimpleNamespace(record=told, content_sha256="d" * 64)
    # On A3 the longer one fits at 1:50, and the other follows.
    said = module.export_sheets(run, tmp_path / "out", Choices())
    assert said == "2 sheets of 2 walls at 1:50"
    assert {entry[2].paper for entry in written} <= {
        Paper(width_mm=420.0, height_mm=297.0),
        Paper(width_mm=297.0, height_mm=420.0),
    }
    assert (tmp_path / "out").is_dir()
    written.clear()
    more = replace(Choices(), scale=20, wall=7, paper="A4")
    said = module.export_sheets(run, tmp_path / "out", more)
    assert said == f"{len(written) - 1} sheets of 1 wall at 1:20 (on A3 each wall takes one)"
    assert {entry[1].number for entry in written} == {7}


def test_what_a_room_has_is_counted() -> None:
    lines = SimpleNamespace(surfaces=(1, 2), edges=(1,), corners=(), openings=())
    assert module._said(lines) == "2 planes, 1 edge, 0 corners"  # type: ignore[arg-type]
    lines.openings = (1, 2, 3)
    assert module._said(lines) == "2 planes, 1 edge, 0 corners, 3 openings"  # type: ignore[arg-type]


# --- CAD and GIS ---


@pytest.fixture
def drawn_files(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Which writer would have written which file."""
    kept: list[tuple[str, str]] = []
    walls, rooms = (
        ("write_wall_dxf", "write_room_dxf"),
        ("write_wall_geojson", "write_room_geojson"),
    )
    for writer in (*walls, *rooms, "write_seams_geojson"):
        monkeypatch.setattr(
            f"orthoflow.cli.exports.drawings.{writer}",
            lambda path, *_args, writer=writer: kept.append((writer, path.name)),
        )
    monkeypatch.setattr(
        "orthoflow.cli.exports.drawings.write_cad_picture",
        lambda _raster, path: kept.append(("picture", path.name)),
    )
    lines = SimpleNamespace(surfaces=(1, 2), edges=(1,), corners=(1, 2, 3), openings=())
    monkeypatch.setattr("orthoflow.cli.exports.drawings.room_lines", lambda *_args, **_more: lines)
    return kept


def of_room(monkeypatch: pytest.MonkeyPatch, *, has_planes: bool) -> Any:
    """A run of two walls, one of which has no orthoimage; each with seams."""
    walls = (wall(3.8, 2.3, "ortho"), wall(9.0, 3.0, "depth"))
    walls[1].number = 9
    told = results(
        walls=walls,
        planes=SimpleNamespace() if has_planes else None,
        checkpoints=None,
        inspections={},
        openings=(),
    )
    monkeypatch.setattr(
        "orthoflow.cli.exports.drawings.room_results", lambda _run, _cell, _wall: told
    )
    images = [
        SimpleNamespace(number=7, sources=("a.jpg", "b.jpg")),
        SimpleNamespace(number=9, sources=("a.jpg",)),
    ]
    monkeypatch.setattr(module, "_images", lambda _run, _address: images)
    return SimpleNamespace()


CAD_OF_9 = ("write_wall_dxf", "wall_9.dxf")
CAD = [("picture", "wall_7_ortho.png"), ("write_wall_dxf", "wall_7.dxf"), CAD_OF_9]
GIS_OF_9 = ("write_wall_geojson", "wall_9.geojson")
# Only the first wall is painted by several photos.
SEAMS = ("write_seams_geojson", "wall_7_seams.geojson")
GIS = [("write_wall_geojson", "wall_7.geojson"), GIS_OF_9, SEAMS]


@pytest.mark.parametrize("has_planes", [False, True])
@pytest.mark.parametrize(
    ("name", "of_all", "of_9"),
    [("dxf", CAD, CAD_OF_9), ("geojson", GIS, GIS_OF_9)],
    ids=["CAD", "GIS"],
)
def test_files_are_of_each_wall_and_of_the_room_where_it_is_known(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    drawn_files: list[tuple[str, str]],
    *,
    name: str,
    of_all: list[tuple[str, str]],
    of_9: tuple[str, str],
    has_planes: bool,
) -> None:
    run, export = of_room(monkeypatch, has_planes=has_planes), getattr(module, f"export_{name}")
    said = export(run, tmp_path / "out", Choices())
    room = [(f"write_room_{name}", f"room.{name}")] if has_planes else []
    assert drawn_files == [*of_all, *room]
    beside = ", and the room: 2 planes, 1 edge, 3 corners" if has_planes else ""
    assert said == f"2 walls{beside}"
    drawn_files.clear()
    assert export(run, tmp_path / "out", Choices(wall=9)) == f"1 wall{beside}"
    assert drawn_files == [of_9, *room]


def test_a_wall_is_drawn_with_its_picture_and_its_openings() -> None:
    one = wall(3.8, 2.3, "ortho")
    told = module._drawn(results(openings_of=lambda _: ("door",)), one, "a.png")
    assert (told.number, told.name, told.plane_index) == (7, "wall 7", 7)
    assert (told.frame, told.image, told.openings) == (one.frame, "a.png", ("door",))


@pytest.mark.parametrize("embedded", [True, False])
def test_seams_are_those_of_the_orthoimages_that_a_cell_gave_and_kept(embedded: bool) -> None:
    frame = samples.facing_east(0.1, 3, 4, (0.0, 0.0, 0.0))
    rgb = np.zeros((*frame.shape, 3), dtype=np.uint8)
    images = Orthoimages(images=(samples.orthoimage(frame, wall=7, rgb=rgb),))
    outputs = {
        "walls": SimpleNamespace(type_name="walls", embedded=True),
        "images": SimpleNamespace(type_name="orthoimages", embedded=embedded),
    }
    run: Any = SimpleNamespace(
        cell=lambda address: SimpleNamespace(outputs=outputs if address == "mosaic" else {}),
        payload=lambda _, port: images.to_payload() if port == "images" else None,
    )
    found = module._images(run, "mosaic")
    assert [one.number for one in found] == (
        [one.number for one in images.images] if embedded else []
    )
    assert module._images(run, "walls") == ()
