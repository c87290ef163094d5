"""Layers of drawings: what is another thing has another colour."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from orthoflow.files.drawings.dxf import LAYERS, _add_polygon


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
