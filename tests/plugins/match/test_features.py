"""Key points after they were found: taken, scaled, mirrored, spread over the picture, in tiles."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.match import features
from orthoflow_plugins.match.features import FeatureRule, Features, find_features

RULE = FeatureRule(n_most=200, contrast_threshold=0.02, edge_threshold=10.0)


def some(n: int = 5) -> Features:
    rng = np.random.default_rng(1)
    return Features(
        pixels=rng.uniform(0, 100, (n, 2)),
        sizes_px=rng.uniform(2, 9, n),
        angles_deg=rng.uniform(0, 360, n),
        descriptors=rng.random((n, 128)).astype(np.float32),
    )


def columns(of: Features) -> list[np.ndarray]:
    return [of.pixels, of.sizes_px, of.angles_deg, of.descriptors]


def test_every_column_is_taken_alike() -> None:
    whole = some()
    chosen = np.array([3, 0])
    for one, other in zip(columns(whole.take(chosen)), columns(whole), strict=True):
        np.testing.assert_array_equal(one, other[chosen])
    for one, other in zip(columns(whole.strongest(2)), columns(whole), strict=True):
        np.testing.assert_array_equal(one, other[:2])
    assert (len(whole), len(whole.strongest(99)), len(whole.strongest(0))) == (5, 5, 0)


def test_an_enlarged_image_has_larger_key_points_elsewhere() -> None:
    whole, double = some(), some().scaled(2.0)
    np.testing.assert_allclose(double.pixels, 2.0 * whole.pixels)
    np.testing.assert_allclose(double.sizes_px, 2.0 * whole.sizes_px)
    np.testing.assert_array_equal(double.angles_deg, whole.angles_deg)
    np.testing.assert_array_equal(double.descriptors, whole.descriptors)


def test_mirroring_twice_changes_nothing_and_once_swaps_left_and_right() -> None:
    whole = some()
    once = whole.mirrored(100.0)
    np.testing.assert_allclose(once.pixels[:, 0], 100.0 - whole.pixels[:, 0])
    np.testing.assert_array_equal(once.pixels[:, 1], whole.pixels[:, 1])
    np.testing.assert_allclose(
        np.cos(np.radians(once.angles_deg)), -np.cos(np.radians(whole.angles_deg))
    )
    np.testing.assert_allclose(
        np.sin(np.radians(once.angles_deg)), np.sin(np.radians(whole.angles_deg)), atol=1e-12
    )
    assert (once.descriptors != whole.descriptors).any()
    for one, other in zip(columns(once.mirrored(100.0)), columns(whole), strict=True):
        np.testing.assert_allclose(one, other)


def test_the_strongest_are_taken_in_turns_from_a_grid_of_twelve() -> None:
    # Two cells of 10 px: three strong points in the one, two weak ones in the other.
    pixels = np.array([[1.0, 1], [2, 1], [3, 1], [119, 59], [118, 59]])
    strengths = np.array([7.0, 9.0, 8.0, 1.0, 2.0])
    order = features._spread(pixels, strengths, (60, 120), 4)
    assert order.tolist() == [1, 4, 2, 3]
    # Points at the very rim belong to the last cell.
    rim = np.array([[120.0, 60.0], [119.0, 59.0]])
    assert features._spread(rim, np.array([1.0, 2.0]), (60, 120), 1).tolist() == [1]
    # Cells are a twelfth of the width and a twelfth of the height.
    beside = np.array([[9.9, 1.0], [10.1, 1.0], [1.0, 4.9], [1.0, 5.1]])
    turns = features._spread(beside, np.array([4.0, 3.0, 2.0, 1.0]), (60, 120), 3)
    assert turns.tolist() == [0, 1, 3]


def test_a_pixel_lies_in_its_cell_and_beyond_the_rim_in_the_last_one() -> None:
    rows, cols = features._cell_of(np.array([[0.9, 1.0], [5.0, 3.0], [-1.0, 9.0]]), (3, 5))
    assert rows.tolist() == [1, 2, 2]
    assert cols.tolist() == [0, 4, 0]


def blobs() -> np.ndarray:
    """Bright discs on black, 40 px apart."""
    rows, cols = np.mgrid[:120, :160] + 0.5
    away = np.hypot((rows % 40) - 20.0, (cols % 40) - 20.0)
    return np.rint(255.0 * np.exp(-0.5 * (away / 3.0) ** 2)).astype(np.uint8)


@pytest.mark.parametrize("upscales_precisely", [True, False])
def test_discs_are_found_at_their_centres(*, upscales_precisely: bool) -> None:
    rule = FeatureRule(
        n_most=200,
        contrast_threshold=0.02,
        edge_threshold=10.0,
        upscales_precisely=upscales_precisely,
    )
    found = find_features(blobs(), rule)
    off = found.pixels % 40.0 - 20.0
    # There are others between the discs.
    at_disc = (np.abs(off) < 5.0).all(axis=1)
    assert at_disc.sum() >= 12
    np.testing.assert_allclose(off[at_disc], 0.0, atol=0.1)


def test_key_points_lie_only_where_they_may() -> None:
    usable = np.zeros((120, 160), dtype=np.bool_)
    usable[:, :80] = True
    found = find_features(blobs(), RULE, usable)
    everywhere = find_features(blobs(), RULE)
    assert 0 < len(found) < len(everywhere)
    assert (found.pixels[:, 0] < 80.0).all()


@pytest.mark.parametrize(("side", "n_found"), [(15, 0), (16, 1)])
def test_pictures_of_fifteen_pixels_have_no_key_points(side: int, n_found: int) -> None:
    rows, cols = np.mgrid[:side, :side] + 0.5
    away = np.hypot(rows - 8.0, cols - 8.0)
    disc = np.rint(255.0 * np.exp(-0.5 * (away / 1.5) ** 2)).astype(np.uint8)
    found = find_features(disc, RULE)
    assert (len(found) > 0) == bool(n_found)
    assert found.descriptors.shape == (len(found), 128)


def test_rooted_descriptors_have_one_length_and_plain_ones_are_whole_numbers() -> None:
    rooted = find_features(blobs(), RULE).descriptors
    # Whole numbers of 512 parts, so that their products are exact.
    np.testing.assert_array_equal(rooted, np.rint(rooted))
    plain = find_features(
        blobs(),
        FeatureRule(n_most=200, contrast_threshold=0.02, edge_threshold=10.0, is_rooted=False),
    ).descriptors
    np.testing.assert_array_equal(plain, np.rint(plain))
    shares = plain / plain.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(rooted, 512.0 * np.sqrt(shares), atol=0.51)


def test_tiles_cover_an_image_once() -> None:
    assert features._tiles((2048, 2049)) == [(0, 0), (0, 2048)]
    assert features._tiles((2049, 10)) == [(0, 0), (2048, 0)]


def test_discs_are_found_once_and_in_place_whichever_tile_they_lie_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def at_discs() -> np.ndarray:
        pixels = find_features(blobs(), RULE).pixels
        near = (np.abs(pixels % 40.0 - 20.0) < 5.0).all(axis=1)
        return np.array(sorted(map(tuple, pixels[near].round(6).tolist())))

    whole = at_discs()
    monkeypatch.setattr(features, "_TILE_PX", 80)
    monkeypatch.setattr(features, "_TILE_OVERLAP_PX", 40)
    tiled = at_discs()
    assert tiled.shape == whole.shape
    np.testing.assert_allclose(tiled, whole, atol=0.05)


def test_undescribed_ones_keep_where_they_are_and_no_bytes_of_descriptors() -> None:
    before = some()
    after = before.undescribed()
    assert after.descriptors.shape == (5, 0)
    assert after.descriptors.base is None
    assert all(a is b for a, b in zip(columns(after)[:3], columns(before)[:3], strict=True))
