"""Layers of drawings: what is another thing has another colour."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from orthoflow.files.drawings.dxf import LAYERS, _add_polygon, write_wall_dxf
from orthoflow.files.drawings.room_lines import Residuals, room_lines
from tests.drawing_runs import WALL, box_planes, drawn_wall


def test_layers_are_told_apart_by_their_colours() -> None:
    # The index of CAD programs, of which 0 and 256 are no colours.
    assert all(1 <= colour <= 255 for colour in LAYERS.values())
    # Corners are where edges meet, and letters are as black as pictures, whose colour nobody sees.
    alike = [{"CORNERS", "EDGES"}, {"IMAGE", "TEXT"}]
    for one, other in combinations(LAYERS, 2):
        assert (LAYERS[one] == LAYERS[other]) is ({one, other} in alike), (one, other)


@pytest.mark.parametrize("n_axes", [2, 3])
def test_polygons_are_closed_on_paper_and_in_space(n_axes: int) -> None:
    import ezdxf

    space = ezdxf.new().modelspace()
    corners = np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [2.0, 1.0, 3.0]])[:, :n_axes]
    _add_polygon(space, corners, "PARTS")
    (line,) = space
    assert (line.dxf.layer, line.is_closed) == ("PARTS", True)
    points = [
        tuple(point)[:n_axes] for point in (line.vertices() if n_axes == 2 else line.points())
    ]
    np.testing.assert_array_equal(points, corners)


@pytest.mark.parametrize("is_known", [True, False])
def test_a_wall_has_the_lines_of_its_plane_where_that_is_known(
    tmp_path: Path, is_known: bool
) -> None:
    import ezdxf

    planes = box_planes()
    lines = room_lines(planes, None, {})
    wall = drawn_wall(planes, is_known=is_known)
    write_wall_dxf(tmp_path / "a.dxf", wall, lines)
    space = ezdxf.readfile(tmp_path / "a.dxf").modelspace()
    counts = Counter(entity.dxf.layer for entity in space)
    assert counts["FRAME"] == 1
    assert counts["RECTANGLE"] == int(is_known)
    assert counts["PARTS"] == (len(lines.surfaces[WALL].rectangles_world) if is_known else 0)
    # A wall of a box meets four others.
    assert counts["EDGES"] == (4 if is_known else 0)
    assert counts["IMAGE"] == 0
    # Of residuals on other walls there is nothing, not even how much they are enlarged.
    shifts = np.full((2, 2), 0.01)
    elsewhere = Residuals(
        cell="check",
        wall=np.array([WALL + 1, WALL]),
        points_world=np.zeros((2, 3)),
        displacement_m=shifts,
        times=5.0,
    )
    for wall_of, n_lines, n_texts in (([WALL + 1] * 2, 0, 0), ([WALL + 1, WALL], 1, 1)):
        residuals = replace(elsewhere, wall=np.array(wall_of))
        write_wall_dxf(tmp_path / "c.dxf", wall, replace(lines, residuals=(residuals,)))
        drawn = ezdxf.readfile(tmp_path / "c.dxf").modelspace().query('*[layer=="RESIDUALS"]')
        kinds = Counter(entity.dxftype() for entity in drawn)
        assert (kinds["LINE"], kinds["TEXT"]) == (n_lines, n_texts)
        for line in drawn.query("LINE"):
            # Five times as long; v goes down, Y up.
            along = np.subtract(line.dxf.end, line.dxf.start)
            np.testing.assert_allclose(along, [0.05, -0.05, 0.0], atol=1e-9)
    write_wall_dxf(tmp_path / "b.dxf", wall, None)
    alone = ezdxf.readfile(tmp_path / "b.dxf").modelspace()
    assert {entity.dxf.layer for entity in alone} == {"FRAME"}
