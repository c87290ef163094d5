"""Gaps that may be filled, against loops, and the picture of where most was filled."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.filling import fillable_gaps, filling_preview, void_counts

from orthoflow.products import Layer, LayerMask
from tests import samples

VOID = (255, 0, 255)


@pytest.mark.parametrize("window", [3, 5, 7])
def test_void_cells_are_counted_in_a_window_and_outside_all_are_void(window: int) -> None:
    is_void = np.random.default_rng(1).random((9, 12)) < 0.3
    padded = np.pad(is_void, 3, constant_values=True)
    reach = window // 2
    for row, column in np.ndindex(is_void.shape):
        around = padded[row + 3 - reach : row + 4 + reach, column + 3 - reach : column + 4 + reach]
        assert void_counts(is_void, window)[row, column] == np.count_nonzero(around)


def test_a_gap_is_fillable_where_no_window_has_too_many_void_cells() -> None:
    is_void = np.random.default_rng(2).random((30, 40)) < 0.35
    limits = (4, 10, 19)
    counts = [void_counts(is_void, window) for window in (3, 5, 7)]
    wanted = is_void & np.logical_and.reduce(
        [count <= limit for count, limit in zip(counts, limits, strict=True)]
    )
    found = fillable_gaps(is_void, limits)
    np.testing.assert_array_equal(found, wanted)
    assert 0 < found.sum() < is_void.sum()
    # Each of the three limits counts.
    for place in range(3):
        tight = [9, 25, 49]
        tight[place] = 1
        assert fillable_gaps(is_void, (tight[0], tight[1], tight[2])).sum() < is_void.sum()
    assert fillable_gaps(is_void, (9, 25, 49)).sum() == is_void.sum()


def layer(shape: tuple[int, int], filled: NDArray[np.uint8] | None) -> Layer:
    mask = np.full(shape, LayerMask.PAINTED, dtype=np.uint8)
    mask[:, -5:] = LayerMask.OCCLUDED
    rgb = np.where((mask == LayerMask.PAINTED)[..., None], (10, 20, 30), 0).astype(np.uint8)
    return samples.layer(mask, rgb=rgb, filled=filled)


def shown(of: Layer) -> NDArray[np.uint8]:
    encoded = np.frombuffer(filling_preview(of), np.uint8)
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB))


def test_a_small_layer_is_shown_before_and_after_it_was_filled() -> None:
    filled = np.zeros((20, 30), dtype=np.uint8)
    filled[4, 7] = filled[10, 11] = 1
    picture = shown(layer((20, 30), filled))
    zoom = picture.shape[0] // 20
    assert zoom >= 2
    assert picture.shape[0] == 20 * zoom
    before, after = picture[:, : 30 * zoom], picture[:, -30 * zoom :]
    # White between.
    between = picture[:, 30 * zoom : -30 * zoom]
    assert between.shape[1] > 0
    assert (between == 255).all()
    for part, is_before in ((before, True), (after, False)):
        cells = part[::zoom, ::zoom]
        np.testing.assert_array_equal(np.repeat(np.repeat(cells, zoom, 0), zoom, 1), part)
        is_void = (cells == VOID).all(axis=2)
        wanted = np.zeros((20, 30), dtype=bool)
        wanted[:, -5:] = True
        if is_before:
            wanted |= filled > 0
        np.testing.assert_array_equal(is_void, wanted)
        assert (cells[~is_void] == (10, 20, 30)).all()
    # Without anything filled both are the same.
    plain = shown(layer((20, 30), None))
    np.testing.assert_array_equal(plain[:, : 30 * zoom], plain[:, -30 * zoom :])
