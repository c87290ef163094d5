"""Where edges run, and where a photo of them lies on a wall, against sums done one by one."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match.structures import (
    WallStructure,
    likely_places,
    structure_of,
    wall_structure,
)

from orthoflow.products import Wall
from orthoflow.testing import photographed as ms


def picture(height: int, width: int) -> NDArray[np.float32]:
    """Blocks of 7 pixels in greys of their own."""
    blocks = np.random.default_rng(3).uniform(0.0, 1.0, (height // 7 + 1, width // 7 + 1))
    wide = np.kron(blocks, np.ones((7, 7)))[:height, :width, None]
    return np.ascontiguousarray(wide, dtype=np.float32)


@pytest.fixture(scope="module")
def wall() -> Wall:
    return ms.walls_of(ms.textured_wall(1)).walls[0]


@pytest.fixture(scope="module")
def structure(wall: Wall) -> WallStructure:
    found = wall_structure(wall)
    assert found is not None
    return found


def test_edges_are_the_same_whichever_side_is_brighter_and_turn_with_the_picture() -> None:
    grey, known = picture(120, 120), np.ones((120, 120), dtype=np.bool_)
    upright = structure_of(grey, known).values
    np.testing.assert_allclose(structure_of(1.0 - grey, known).values, upright, atol=1e-4)
    turned = structure_of(np.ascontiguousarray(np.rot90(grey)), known).values
    # A quarter turn is half a turn of doubled angles, and a whole one of fourfold ones.
    signs = np.array([-1.0, -1.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(turned, np.rot90(upright) * signs, atol=1e-4)
    # Each place tells where edges run, not how strong they are: vectors of length one at most.
    lengths = np.linalg.norm(upright, axis=2)
    assert lengths.max() < 1.0
    assert np.median(lengths) == pytest.approx(1.0 / 1.3, abs=0.01)


def test_what_is_not_known_and_its_border_has_no_structure() -> None:
    known = np.ones((80, 90), dtype=np.bool_)
    known[20:40, 30:60] = False
    found = structure_of(picture(80, 90), known)
    void = np.zeros_like(known)
    void[19:41, 29:61] = True
    np.testing.assert_array_equal(found.known == 0.0, void)
    assert not found.values[void].any()
    assert (np.linalg.norm(found.values[~void], axis=1) > 0.0).mean() > 0.99


def test_a_piece_of_the_wall_lies_where_it_was_taken_from(
    wall: Wall, structure: WallStructure
) -> None:
    assert wall.intensity is not None
    rows, columns = wall.frame.shape
    top, left, height, width = rows // 4, columns // 3, rows // 2, columns // 2
    grey = np.rint(255 * np.clip(np.nan_to_num(wall.intensity, nan=0.5), 0.0, 1.0)).astype(np.uint8)
    # Inverted: edges stay where they are.
    cut = 255 - grey[top : top + height, left : left + width]
    places = likely_places(np.repeat(cut[..., None], 3, axis=2), structure, n_most=3)
    assert 1 < len(places) <= 3
    for one, other in itertools.combinations(places, 2):
        apart_m = np.hypot(*(one.centre_m - other.centre_m))
        # The same place at a neighbouring scale is no other one.
        assert apart_m > 0.25 * one.width_m or abs(math.log(one.width_m / other.width_m)) > 0.25
    best = places[0]
    leads = [place.lead for place in places]
    assert leads == sorted(leads, reverse=True)
    cell_m, fine_m = structure.wall.frame.gsd_m, wall.frame.gsd_m
    truth_m = fine_m * np.array([left + 0.5 * width, top + 0.5 * height])
    # Sizes are tried in steps of a tenth, and parts may slip by 3 % of the width.
    slip_m = 0.03 * best.width_m + cell_m
    assert best.width_m == pytest.approx(fine_m * width, rel=0.06)
    assert np.abs(best.centre_m - truth_m).max() < slip_m
    np.testing.assert_allclose(best.parts_photo.mean(axis=0), 0.5, atol=0.01)
    np.testing.assert_allclose(np.ptp(best.parts_photo, axis=0), 0.5, atol=0.02)
    expected_m = fine_m * (np.array([left, top]) + best.parts_photo * [width, height])
    assert np.abs(best.parts_m - expected_m).max() < slip_m
