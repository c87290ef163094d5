"""Pairing of photos with walls, and accuracy of ties from key points."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match.key_points import Pair, mapped, rematched, verified
from orthoflow_plugins.match.ties import TiePiece, key_point_ties, ties_of, without_twins

from orthoflow.files.images import encode_png
from orthoflow.geometry.key_points import Matches
from orthoflow.products import TieRole
from orthoflow.testing import photographed as ms
from tests import inspect_scenes
from tests.inspect_scenes import GSD_M
from tests.samples import features
from tests.tied_photos import photo

LOOSE_PX = 20.0
# Transform from wall pixels to photo pixels, which are rotated, reduced and slightly oblique.
TILTED = np.array([[0.8, -0.3, 500.0], [0.25, 0.9, 300.0], [1e-5, -2e-5, 1.0]])


def on_wall(n: int, seed: int = 1) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(0.0, 2000.0, (n, 2))


def judged(wall: NDArray[np.float64], photo: NDArray[np.float64]) -> Pair:
    at = np.arange(len(wall))
    matches = Matches(first=at, second=at, ratio=np.linspace(0.3, 0.8, len(at)))
    return verified(3, matches, (features(photo), features(wall)), LOOSE_PX)


# --- inliers ---


@pytest.mark.parametrize(("n", "is_shown"), [(3, False), (7, False), (8, True), (60, True)])
def test_eight_places_that_agree_show_a_wall(n: int, is_shown: bool) -> None:
    wall = on_wall(n)
    front = mapped(TILTED, wall)
    found = judged(wall, front)
    assert (found.wall, found.is_shown) == (3, is_shown)
    assert found.agreeing.all() == (n >= 4)
    assert (found.homography is not None) == is_shown
    if found.homography is not None:
        np.testing.assert_allclose(mapped(found.homography, wall), front, atol=0.01)
    # A wall seen from behind is not shown.
    assert not judged(wall, front * [-1.0, 1.0] + [3000.0, 0.0]).is_shown


def test_what_lies_loosely_where_it_should_agrees_and_nothing_farther_off() -> None:
    wall = on_wall(200)
    photo = mapped(TILTED, wall)
    off_px = np.zeros(200)
    off_px[[3, 50, 120]] = 0.95 * LOOSE_PX, 1.05 * LOOSE_PX, 400.0
    photo[:, 0] += off_px
    np.testing.assert_array_equal(judged(wall, photo).agreeing, off_px < LOOSE_PX)


@pytest.mark.parametrize("is_photo", [True, False], ids=["in the photo", "on the wall"])
def test_many_key_points_on_one_place_are_one(is_photo: bool) -> None:
    # Nine positions are four pixels apart, or all are within two pixels.
    rows, columns = np.divmod(np.arange(9.0), 3.0)
    lattice = np.column_stack([columns, rows])
    for apart_px, is_shown in ((4.0, True), (0.5, False)):
        near, far = 100.0 + apart_px * lattice, 100.0 + 300.0 * lattice
        assert judged(*((far, near) if is_photo else (near, far))).is_shown == is_shown


# --- guided matching ---


@pytest.mark.parametrize(
    ("size", "turn_deg", "off_px", "is_found"),
    [
        *((1.6, 0.0, 0.0, True), (1.65, 0.0, 0.0, False)),
        *((1.0 / 1.6, 0.0, 0.0, True), (1.0 / 1.65, 0.0, 0.0, False)),
        *((1.0, 29.0, 0.0, True), (1.0, -31.0, 0.0, False)),
        *((1.0, 0.0, 9.5, True), (1.0, 0.0, 10.5, False)),
    ],
)
def test_key_points_are_added_where_place_size_and_direction_are_as_expected(
    size: float, turn_deg: float, off_px: float, is_found: bool
) -> None:
    rng = np.random.default_rng(2)
    pixels = on_wall(12)
    descriptors = rng.integers(0, 200, (12, 128)).astype(np.float32)
    # The photo is half as large as the wall and rotated by 170 degrees; the last key point is
    # tested.
    wall = features(pixels, sizes_px=rng.uniform(3.0, 9.0, 12), descriptors=descriptors)
    sizes, turns, places = 0.5 * wall.sizes_px, np.full(12, 170.0), 0.5 * pixels
    sizes[-1] *= size
    turns[-1] += turn_deg
    places[-1, 1] += off_px
    photo = features(places, sizes_px=sizes, angles_deg=turns % 360.0, descriptors=descriptors)
    first = Matches(first=np.arange(10), second=np.arange(10), ratio=np.full(10, 0.5))
    agreeing = np.arange(10) < 8
    # Outliers do not influence sizes and rotations.
    look = partial(rematched, first, (photo, wall), agreeing=agreeing, radius_px=10.0, ratio=1.0)
    found = look(0.5 * pixels)
    np.testing.assert_array_equal(found.first[:10], first.first)
    np.testing.assert_array_equal(found.ratio[:10], 0.5)
    pairs = list(zip(found.first[10:].tolist(), found.second[10:].tolist(), strict=True))
    assert pairs == [(10, 10), (11, 11)][: 1 + is_found]
    # Key points far from the photo are not considered.
    assert len(look(0.5 * pixels + 5000.0)) == 10


# The type is Any, since the fields of the piece have different types.
def piece(
    pixels: list[tuple[float, float]],
    points: list[tuple[float, float, float]],
    sigma_m: list[float],
    **known: Any,
) -> TiePiece:
    return TiePiece(
        **{"photo": 0, "wall": 0, **known},
        pixels_photo=np.array(pixels),
        points_world=np.array(points),
        sigma_px=np.ones(len(pixels)),
        sigma_m=np.array(sigma_m),
    )


def kept(*pieces: TiePiece) -> list[list[float]]:
    """Return the remaining ties, identified by their `sigma_m`."""
    return [item.sigma_m.tolist() for item in without_twins(pieces)]


def test_of_ties_of_one_key_point_with_one_place_the_most_exact_stays() -> None:
    first = piece([(5.0, 7.0), (9.0, 9.0)], [(0, 0, 0), (1, 1, 1)], [0.002, 0.004])
    second = piece([(5.0, 7.0), (9.0, 9.0)], [(0, 0, 0.005), (1, 1, 1.005)], [0.003, 0.001])
    assert kept(first, second) == [[0.002], [0.001]]
    assert kept(second, first) == [[0.001], [0.002]]
    # A single piece is unchanged.
    assert kept(first) == [[0.002, 0.004]]
    assert without_twins([]) == []
    # Ties are not duplicates if their points differ by more than four times the sum of both sigmas,
    # or if their pixels differ.
    first = piece([(5.0, 7.0)], [(0, 0, 0)], [0.002])
    for du_px, dz_m, is_twin in (
        *((0.0, 0.0199, True), (0.0, 0.0201, False)),
        *((0.0004, 0.0, True), (0.002, 0.0, False)),
    ):
        second = piece([(5.0 + du_px, 7.0)], [(0, 0, dz_m)], [0.003])
        assert kept(first, second) == [[0.002], [] if is_twin else [0.003]]


def test_ties_of_all_pieces_are_joined_without_those_in_masked_pixels() -> None:
    used = np.full((8, 10), 255, dtype=np.uint8)
    used[5:7, 3] = used[:, 0] = used[0] = 0
    # The pixels are in the mask, next to it, on the border of the photo, which is outside, and in
    # the first column and row, which begin at 0.
    pixels = [(3.2, 5.9), (4.01, 5.9), (10.0, 8.0), (0.4, 3.3), (3.3, 0.4), (1.2, 1.2)]
    masked = piece(
        pixels, [(k, k, k) for k in range(6)], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], role=TieRole.CHECK
    )
    whole = piece([(0.4, 3.3)], [(9, 9, 9)], [0.7], photo=1)
    size = {"width": 10, "height": 8}
    photos = ms.photos(photo(name="a", mask=encode_png(used), **size), photo(name="b", **size))
    walls = inspect_scenes.walls()
    ties = ties_of([whole, masked], photos, walls, {"said": 1}, search_radius_px=(4.0, None))
    np.testing.assert_array_equal(ties.sigma_m, [0.7, 0.2, 0.3, 0.6])
    np.testing.assert_array_equal(ties.pixels_photo[1:], [pixels[at] for at in (1, 2, 5)])
    np.testing.assert_array_equal(ties.points_world[:, 0], [9, 1, 2, 5])
    assert (ties.photo_names, ties.photo.tolist()) == (("a", "b"), [1, 0, 0, 0])
    assert ties.role.tolist() == [TieRole.CONTROL, *[TieRole.CHECK] * 3]
    assert np.isnan(ties.residual_px).all()
    assert (ties.search_radius_px, ties.details) == ((4.0, None), {"said": 1})
    assert ties_of([], photos, walls, {}).points_world.shape == (0, 3)


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_large_key_points_are_less_exact_and_those_of_voids_left_out(scale: float) -> None:
    wall = inspect_scenes.walls().walls[0]
    # The second key point is in a void; the last is so large that its standard deviation exceeds
    # three cells.
    pixels = np.array([[50.5, 40.5], [220.5, 110.5], [300.5, 200.5], [60.5, 60.5]])
    on_wall = features(pixels, sizes_px=np.array([2.0, 2.0, 40.0, 1e4]))
    sizes_px = np.array([2.0, 4.0, 100.0, 8.0])
    in_photo = features(np.arange(8.0).reshape(4, 2), sizes_px=sizes_px)
    found = key_point_ties((3, 0), wall, (in_photo, on_wall), scale=scale)
    assert (found.photo, found.wall, found.role) == (3, 0, TieRole.CONTROL)
    np.testing.assert_array_equal(found.pixels_photo, in_photo.pixels[[0, 2]])
    expected = wall.frame.world_from_wall(on_wall.pixels[[0, 2]], 0.0)
    np.testing.assert_allclose(found.points_world, expected, atol=1e-6)
    # Key points of 100 pixels are accurate to 6 pixels, small ones to a third of a pixel.
    assert found.sigma_px * scale == pytest.approx([0.35, 6.0 * scale])
    on_raster = GSD_M * np.array([0.35, 2.4])
    # The standard deviation of the surface is added.
    assert (found.sigma_m >= on_raster).all()
    assert found.sigma_m[0] < found.sigma_m[1] < 3.0 * GSD_M
