"""Plans and sections of the box room, whose corners are known exactly."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal

import ezdxf
import numpy as np
import pdfplumber
import pytest

from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.sections import (
    CutLine,
    SectionDrawing,
    plan_cut,
    section_cut,
    section_of,
    section_sheet,
    write_section,
)
from orthoflow.files.drawings.sheet_contents import SheetText, TitleBlock
from orthoflow.files.drawings.sheets import lay_out, write_sheet
from orthoflow.products import PointCloud
from tests.drawing_runs import AXES, CORNER, SIZE_M, box_planes, box_points

DOOR_M = (1.0, 1.9)
POINTS_PER_MM = 72.0 / 25.4


def box_cloud() -> PointCloud:
    """Points every centimetre on the four walls, but for a door in the wall y = 0, and a table."""
    along = np.arange(0.0, 6.0, 0.01)
    places = []
    for axis, level in ((0, 0.0), (0, SIZE_M[0]), (1, 0.0), (1, SIZE_M[1])):
        u, z = np.meshgrid(along[along <= SIZE_M[1 - axis]], np.arange(0.0, SIZE_M[2], 0.01))
        wall = np.empty((u.size, 3))
        wall[:, axis], wall[:, 1 - axis], wall[:, 2] = level, u.ravel(), z.ravel()
        if (axis, level) == (1, 0.0):
            is_door = (wall[:, 0] > DOOR_M[0]) & (wall[:, 0] < DOOR_M[1]) & (wall[:, 2] < 2.0)
            wall = wall[~is_door]
        places.append(wall)
    table = np.random.default_rng(7).uniform([2.0, 1.5, 0.0], [2.6, 1.9, 1.5], (40_000, 3))
    points = box_points(np.concatenate([*places, table]))
    origin = points.mean(axis=0)
    x, y, z = np.ascontiguousarray((points - origin).T, dtype=np.float32)
    return PointCloud(origin=origin, x=x, y=y, z=z, up=np.array([0.0, 0.0, 1.0]))


def test_a_plan_has_the_corners_of_the_room_in_world_coordinates() -> None:
    section = section_of(plan_cut(box_planes(), 1.2), box_planes())
    ends = np.concatenate([line.ends_m for line in section.lines])
    wanted = box_points(np.array([[x, y, 0] for x in (0, SIZE_M[0]) for y in (0, SIZE_M[1])]))
    assert len(section.lines) == 4
    for corner in wanted[:, :2]:
        assert np.sum(np.linalg.norm(ends - corner, axis=1) < 1e-6) == 2
    # What is solid lies outside.
    middle = wanted[:, :2].mean(axis=0)
    assert all((line.ends_m.mean(axis=0) - middle) @ line.behind > 1.0 for line in section.lines)
    assert math.isclose(section.cut.origin_world[2], CORNER[2] + 1.2, abs_tol=1e-6)


def test_a_door_is_a_gap_and_furniture_stays_as_points() -> None:
    section = section_of(plan_cut(box_planes(), 1.2), box_planes(), (), box_cloud())
    (gap,) = section.gaps_m
    in_room = (gap - CORNER[:2]) @ AXES[:2, :2].T
    assert sorted(in_room[:, 0]) == pytest.approx(DOOR_M, abs=0.011)
    assert np.abs(in_room[:, 1]).max() < 1e-6
    table = (section.points_m - CORNER[:2]) @ AXES[:2, :2].T
    assert len(table) > 100
    assert table.min(axis=0) == pytest.approx([2.0, 1.5], abs=0.02)
    assert table.max(axis=0) == pytest.approx([2.6, 1.9], abs=0.02)


def test_a_section_has_heights_and_the_first_place_on_the_left() -> None:
    ends = box_points(np.array([[-0.5, 1.0, 0.0], [SIZE_M[0] + 0.5, 1.0, 0.0]]))[:, :2]
    section = section_of(section_cut(box_planes(), ends.ravel().tolist()), box_planes())
    left, bottom, right, top = section.bounds_m
    assert (bottom, top) == pytest.approx((CORNER[2], CORNER[2] + SIZE_M[2]), abs=1e-6)
    assert (left, right) == pytest.approx((0.5, 0.5 + SIZE_M[0]), abs=1e-6)
    # Beyond the cut are the four edges of the far wall, as long as their points reach.
    lengths_m = np.linalg.norm(section.beyond_m[:, 1] - section.beyond_m[:, 0], axis=1)
    assert sorted(lengths_m) == pytest.approx([SIZE_M[2] - 0.2] * 2 + [SIZE_M[0] - 0.2] * 2)
    # The wall at x = 0 is left of the room: what is behind it lies to the left.
    (wall,) = [line for line in section.lines if abs(line.ends_m[:, 0] - 0.5).max() < 1e-6]
    assert wall.behind == pytest.approx([-1.0, 0.0], abs=1e-9)


def test_two_sides_of_a_wall_give_its_thickness() -> None:
    planes = box_planes()
    inside = int(np.argmax(planes.normal @ AXES[1]))  # the wall y = 0, whose normal is y
    shift = -0.4 * AXES[1]
    arrays = ("normal", "offset", "corners", "covariance", "n_points", "rms_m")
    twice = {name: np.append(v := getattr(planes, name), v[[inside]], axis=0) for name in arrays}
    both = replace(planes, **twice, names=(*planes.names, f"wall {len(planes)}"))
    both.normal[-1] *= -1.0
    both.offset[-1] = 0.4 - planes.offset[inside]
    both.corners[-1] += shift
    section = section_of(plan_cut(both, 1.2), both)
    thickness = {line.plane: line.thickness_m for line in section.lines}
    assert thickness.pop(inside) == pytest.approx(0.4, abs=1e-6)
    assert thickness.pop(len(planes)) == pytest.approx(0.4, abs=1e-6)
    assert all(math.isnan(value) for value in thickness.values())


def test_a_cut_that_meets_nothing_is_refused() -> None:
    with pytest.raises(ArgumentError, match="does not intersect the room"):
        section_of(section_cut(box_planes(), [0.0, 0.0, 1.0, 0.0]), box_planes())
    with pytest.raises(ArgumentError, match="two different points"):
        section_cut(box_planes(), [1.0, 2.0, 1.0, 2.0])


@pytest.mark.parametrize(
    ("kind", "crs", "direction"),
    [
        ("plan", None, "y: axis of the scan; north unknown"),
        ("plan", "site", "y: axis of the scan; north unknown"),
        ("plan", "EPSG:25832", "N: grid north"),
        ("section", "EPSG:25832", "key plan: section line in red, arrow = viewing direction"),
    ],
)
def test_a_sheet_of_it_has_title_block_coordinates_and_lines_in_scale(
    tmp_path: Path, kind: Literal["plan", "section"], crs: str | None, direction: str
) -> None:
    planes = box_planes()
    ends = box_points(np.array([[-0.5, 1.0, 0.0], [SIZE_M[0] + 0.5, 1.0, 0.0]]))[:, :2]
    cut = plan_cut(planes, 1.2)
    if kind == "section":
        cut = section_cut(planes, ends.ravel().tolist())
    section = section_of(cut, planes, (), box_cloud())
    drawing = SectionDrawing(kind=kind, section=section, scale=50, origin="a box")
    text = SheetText(name="", block=TitleBlock(), notes=(), digest="0" * 64, run="run")
    drawn = section_sheet("x", drawing, planes, text, grid=1.0, crs=crs)
    # The arrow of the sheet and that of its key plan have the same label.
    assert drawn.plan is None or drawn.plan.up_label == drawn.up_label
    ((sheet, furniture),) = lay_out(drawn)
    write_sheet(tmp_path / "x.pdf", drawn, sheet, furniture)
    with pdfplumber.open(tmp_path / "x.pdf") as pdf:
        (page,) = pdf.pages
        words = " ".join(page.extract_text().split())
        thick = [
            c
            for c in (*page.lines, *page.curves)
            if c["linewidth"] == pytest.approx(0.5 * POINTS_PER_MM)
        ]
        lengths = [math.hypot(c["x1"] - c["x0"], c["y1"] - c["y0"]) for c in thick]
        longest_mm = 1000 * max(one.length_m for one in section.lines) / 50
        assert min(abs(one / POINTS_PER_MM - longest_mm) for one in lengths) < 0.01
    slab = f"slice {1e3 * section.slab_m:.0f} mm thick"
    for said in ("1:50", kind.title(), slab, "sheet 1 of 1", "record sha256", direction):
        assert said in words, said


def test_a_hatch_too_small_for_a_line_of_its_pattern_is_left_out(tmp_path: Path) -> None:
    planes = box_planes()
    ends_m, behind = np.array([[0.05, 0.0], [0.11, 0.0]]), np.array([0.0, 1.0])
    stub = CutLine(plane=2, ends_m=ends_m, behind=behind, thickness_m=0.04)
    nothing = np.empty((0, 2, 2))
    section = replace(
        section_of(plan_cut(planes, 1.2), planes), lines=(stub,), gaps_m=nothing, beyond_m=nothing
    )
    drawing = SectionDrawing(kind="plan", section=section, scale=100, origin="a box")
    text = SheetText(name="", block=TitleBlock(), notes=(), digest="0" * 64, run="run")
    drawn = section_sheet("x", drawing, planes, text, grid=0.0)
    ((sheet, furniture),) = lay_out(drawn)
    write_sheet(tmp_path / "x.pdf", drawn, sheet, furniture)
    with pdfplumber.open(tmp_path / "x.pdf") as pdf:
        widths_mm = [line["linewidth"] / POINTS_PER_MM for line in pdf.pages[0].lines]
    assert pytest.approx(min(widths_mm, key=lambda width: abs(width - 0.5))) == 0.5


def test_the_files_of_a_plan_show_the_same_lines_in_scale(tmp_path: Path) -> None:
    section = section_of(plan_cut(box_planes(), 1.2), box_planes(), (), box_cloud())
    drawing = SectionDrawing(
        kind="plan", section=section, scale=50, origin="a box", has_dimensions=True, language="pl"
    )
    write_section(tmp_path, "plan_1", drawing)
    document = ezdxf.readfile(tmp_path / "plan_1.dxf")
    assert len(document.audit().errors) == 0
    assert document.units == 6
    drawn = list(document.modelspace().query("LINE[layer=='A-SECT-MCUT']"))
    lengths = sorted(line.dxf.start.distance(line.dxf.end) for line in drawn)
    assert lengths[-1] == pytest.approx(SIZE_M[0], abs=1e-6)
    stated = dict(document.header.custom_vars.properties)
    assert stated == {"Title": section.cut.title, "Origin": "a box"}
    # Dimensions run to the right or upwards, so that none stands on its head, beyond what is cut.
    middle = np.mean([(*line.dxf.start, *line.dxf.end) for line in drawn], axis=0)
    middle = 0.5 * (middle[:3] + middle[3:])
    for dimension in document.modelspace().query("DIMENSION"):
        begin, end = (np.array(dimension.dxf.get(key)) for key in ("defpoint2", "defpoint3"))
        assert tuple(np.round((end - begin)[:2], 6)) > (0.0, 0.0)
        across = np.array([begin[1] - end[1], end[0] - begin[0], 0.0])
        outside = (np.array(dimension.dxf.defpoint) - begin) @ across
        assert outside * ((0.5 * (begin + end) - middle) @ across) > 0.0
    svg = (tmp_path / "plan_1.svg").read_text()
    left, _, right, _ = drawing.bounds_m
    assert f'width="{1000 * (right - left) / 50:.1f}mm"' in svg
