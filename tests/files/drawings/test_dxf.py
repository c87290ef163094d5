"""Layers of drawings: what is another thing has another colour."""

from __future__ import annotations

from itertools import combinations

from orthoflow.files.drawings.dxf import LAYERS


def test_layers_are_told_apart_by_their_colours() -> None:
    # The index of CAD programs, of which 0 and 256 are no colours.
    assert all(1 <= colour <= 255 for colour in LAYERS.values())
    # Corners are where edges meet, and letters are as black as pictures, whose colour nobody sees.
    alike = [{"CORNERS", "EDGES"}, {"IMAGE", "TEXT"}]
    for one, other in combinations(LAYERS, 2):
        assert (LAYERS[one] == LAYERS[other]) is ({one, other} in alike), (one, other)
