"""Ties of key points: how exact they are, and which of them say the same."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match.ties import TiePiece, key_point_ties, ties_of, without_twins

from orthoflow.files.images import encode_png
from orthoflow.geometry.key_points import Features
from orthoflow.products import Photos, TieRole
from orthoflow.testing import photographed as ms
from tests import inspect_scenes
from tests.inspect_scenes import GSD_M
from tests.tied_photos import photo


def piece(
    pixels: list[tuple[float, float]],
    points: list[tuple[float, float, float]],
    sigma_m: list[float],
    **given: Any,
) -> TiePiece:
    return TiePiece(
        photo=given.get("photo", 0),
        wall=given.get("wall", 0),
        pixels_photo=np.array(pixels),
        points_world=np.array(points),
        sigma_px=np.ones(len(pixels)),
        sigma_m=np.array(sigma_m),
        role=given.get("role", TieRole.CONTROL),
    )


def photos_of(*masks: bytes | None) -> Photos:
    """Photos a, b, ... with masks of used pixels or without."""
    named = zip("ab", masks, strict=False)
    return ms.photos(*(photo(name=name, width=10, height=8, mask=mask) for name, mask in named))


def kept(*pieces: TiePiece) -> list[list[float]]:
    """Which ties stay, by their `sigma_m`."""
    return [item.sigma_m.tolist() for item in without_twins(pieces)]


def test_of_ties_of_one_key_point_with_one_place_the_most_exact_stays() -> None:
    first = piece([(5.0, 7.0), (9.0, 9.0)], [(0, 0, 0), (1, 1, 1)], [0.002, 0.004])
    second = piece([(5.0, 7.0), (9.0, 9.0)], [(0, 0, 0.005), (1, 1, 1.005)], [0.003, 0.001])
    assert kept(first, second) == [[0.002], [0.001]]
    assert kept(second, first) == [[0.001], [0.002]]
    # Alone, nothing is looked at.
    assert kept(first) == [[0.002, 0.004]]
    assert without_twins([]) == []


def test_other_places_and_other_pixels_are_no_twins() -> None:
    first = piece([(5.0, 7.0)], [(0, 0, 0)], [0.002])

    def beside(du_px: float, dz_m: float) -> list[list[float]]:
        return kept(first, piece([(5.0 + du_px, 7.0)], [(0, 0, dz_m)], [0.003]))

    # Four times the sum of both deviations: 20 mm.
    assert beside(0.0, 0.0199) == [[0.002], []]
    assert beside(0.0, 0.0201) == [[0.002], [0.003]]
    assert beside(0.0004, 0.0) == [[0.002], []]
    assert beside(0.002, 0.0) == [[0.002], [0.003]]


def test_ties_are_joined_in_the_order_of_their_pieces() -> None:
    first = piece([(1.0, 2.0), (3.0, 4.0)], [(0, 0, 0), (1, 1, 1)], [0.1, 0.2], photo=1)
    second = piece([(5.0, 6.0)], [(2, 2, 2)], [0.3], wall=0, role=TieRole.CHECK)
    walls = inspect_scenes.walls()
    photos = photos_of(None, None)
    ties = ties_of([first, second], photos, walls, {"said": 1}, search_radius_px=(4.0, None))
    assert ties.photo_names == ("a", "b")
    np.testing.assert_array_equal(ties.photo, [1, 1, 0])
    np.testing.assert_array_equal(ties.wall, [0, 0, 0])
    np.testing.assert_array_equal(ties.pixels_photo, [[1, 2], [3, 4], [5, 6]])
    np.testing.assert_array_equal(ties.points_world[:, 0], [0, 1, 2])
    np.testing.assert_array_equal(ties.sigma_m, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(ties.role, [TieRole.CONTROL, TieRole.CONTROL, TieRole.CHECK])
    assert np.isnan(ties.residual_px).all()
    assert ties.residual_px.shape == (3, 2)
    assert (ties.search_radius_px, ties.details) == ((4.0, None), {"said": 1})
    empty = ties_of([], photos, walls, {})
    assert empty.pixels_photo.shape == (0, 2)
    assert empty.points_world.shape == (0, 3)


def test_ties_in_masked_pixels_are_left_out() -> None:
    used = np.full((8, 10), 255, dtype=np.uint8)
    used[5:7, 3] = 0
    # In the mask; right beside it; and on the rim of the photo, which is nowhere.
    pixels = [(3.2, 5.9), (4.01, 5.9), (10.0, 8.0)]
    first = piece(pixels, [(k, k, k) for k in range(3)], [0.1, 0.2, 0.3])
    ties = ties_of([first], photos_of(encode_png(used)), inspect_scenes.walls(), {})
    np.testing.assert_array_equal(ties.sigma_m, [0.2, 0.3])
    np.testing.assert_array_equal(ties.pixels_photo, pixels[1:])
    # The first column and row are those that begin at 0.
    used[:, 0] = used[0] = 0
    rim = replace(first, pixels_photo=np.array([(0.4, 3.3), (3.3, 0.4), (1.2, 1.2)]))
    assert ties_of(
        [rim], photos_of(encode_png(used)), inspect_scenes.walls(), {}
    ).sigma_m.tolist() == [0.3]


def features(pixels: NDArray[np.float64], sizes: list[float]) -> Features:
    return Features(
        pixels=pixels,
        sizes_px=np.array(sizes),
        angles_deg=np.zeros(len(sizes)),
        descriptors=np.zeros((len(sizes), 128), dtype=np.float32),
    )


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_large_key_points_are_less_exact_and_those_of_voids_left_out(scale: float) -> None:
    wall = inspect_scenes.walls().walls[0]
    # The second lies in a void; the last is so large that it is known to no three cells.
    on_wall = features(
        np.array([[50.5, 40.5], [220.5, 110.5], [300.5, 200.5], [60.5, 60.5]]),
        [2.0, 2.0, 40.0, 1e4],
    )
    in_photo = features(np.arange(8.0).reshape(4, 2), [2.0, 4.0, 100.0, 8.0])
    found = key_point_ties((3, 0), wall, (in_photo, on_wall), scale=scale)
    assert (found.photo, found.wall, found.role) == (3, 0, TieRole.CONTROL)
    np.testing.assert_array_equal(found.pixels_photo, in_photo.pixels[[0, 2]])
    expected = wall.frame.world_from_wall(on_wall.pixels[[0, 2]], 0.0)
    np.testing.assert_allclose(found.points_world, expected, atol=1e-6)
    # Key points of a hundred pixels are known to six of them, small ones to a third of one.
    small, large = found.sigma_px * scale
    assert small == pytest.approx(0.35)
    assert large == pytest.approx(6.0 * scale)
    on_raster = GSD_M * np.array([0.35, 2.4])
    # The surface's own deviation comes on top.
    assert (found.sigma_m >= on_raster).all()
    assert found.sigma_m[0] < found.sigma_m[1] < 3.0 * GSD_M
