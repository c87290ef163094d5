"""Key points after they were found: taken, scaled, mirrored, spread over the picture, in tiles."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.match.features import Features, find_features

MAX_FEATURES = 200


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


def blobs() -> np.ndarray:
    """Bright discs on black, 40 px apart."""
    rows, cols = np.mgrid[:120, :160] + 0.5
    away = np.hypot((rows % 40) - 20.0, (cols % 40) - 20.0)
    return np.rint(255.0 * np.exp(-0.5 * (away / 3.0) ** 2)).astype(np.uint8)


@pytest.mark.parametrize("as_opencv", [True, False])
def test_discs_are_found_at_their_centres(*, as_opencv: bool) -> None:
    found = find_features(blobs(), MAX_FEATURES, as_opencv=as_opencv)
    off = found.pixels % 40.0 - 20.0
    # There are others between the discs.
    at_disc = (np.abs(off) < 5.0).all(axis=1)
    assert at_disc.sum() >= 12
    np.testing.assert_allclose(off[at_disc], 0.0, atol=0.1)


def test_key_points_lie_only_where_they_may() -> None:
    usable = np.zeros((120, 160), dtype=np.bool_)
    usable[:, :80] = True
    found = find_features(blobs(), MAX_FEATURES, usable)
    everywhere = find_features(blobs(), MAX_FEATURES)
    assert 0 < len(found) < len(everywhere)
    assert (found.pixels[:, 0] < 80.0).all()


@pytest.mark.parametrize(("side", "n_found"), [(15, 0), (16, 1)])
def test_pictures_of_fifteen_pixels_have_no_key_points(side: int, n_found: int) -> None:
    rows, cols = np.mgrid[:side, :side] + 0.5
    away = np.hypot(rows - 8.0, cols - 8.0)
    disc = np.rint(255.0 * np.exp(-0.5 * (away / 1.5) ** 2)).astype(np.uint8)
    found = find_features(disc, MAX_FEATURES)
    assert (len(found) > 0) == bool(n_found)
    assert found.descriptors.shape == (len(found), 128)


def test_rooted_descriptors_have_one_length_and_plain_ones_are_whole_numbers() -> None:
    rooted = find_features(blobs(), MAX_FEATURES).descriptors
    # Whole numbers of 512 parts, so that their products are exact.
    np.testing.assert_array_equal(rooted, np.rint(rooted))
    plain = find_features(blobs(), MAX_FEATURES, as_opencv=True).descriptors
    np.testing.assert_array_equal(plain, np.rint(plain))
    np.testing.assert_allclose(np.linalg.norm(rooted, axis=1), 512.0, rtol=0.02)
    assert (plain.max(axis=1) > 100.0).all()


def test_undescribed_ones_keep_where_they_are_and_no_bytes_of_descriptors() -> None:
    before = some()
    after = before.undescribed()
    assert after.descriptors.shape == (5, 0)
    assert after.descriptors.base is None
    assert all(a is b for a, b in zip(columns(after)[:3], columns(before)[:3], strict=True))
