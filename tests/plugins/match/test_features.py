"""Key points after they were found: taken, scaled, mirrored, spread over the picture, in tiles."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.geometry.key_points import find_features

MAX_FEATURES = 200


def blobs() -> np.ndarray:
    """Bright discs on black, 40 px apart."""
    rows, cols = np.mgrid[:120, :160] + 0.5
    away = np.hypot((rows % 40) - 20.0, (cols % 40) - 20.0)
    return np.rint(255.0 * np.exp(-0.5 * (away / 3.0) ** 2)).astype(np.uint8)


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
