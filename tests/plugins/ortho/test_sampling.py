"""Bilinear sampling of photos: against the formula in floats, and at the border."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.ortho.painting_kernels import Patch, pack_pixels, sample_bilinear

HALF_PIXEL = (np.float32(0.5), np.float32(0.5))


def sampled(photo: NDArray[np.uint8], places: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours (rows, cols, 3) at places (rows, cols, 2), the first pixel's centre at 0.5."""
    packed = np.empty((photo.shape[0] + 1, photo.shape[1] + 1), dtype=np.uint64)
    pack_pixels(photo, packed)
    colours = np.empty((*places.shape[:2], 3), dtype=np.uint8)
    u, v = (np.ascontiguousarray(places[..., axis]) for axis in range(2))
    sample_bilinear(packed, (u, v), HALF_PIXEL, Patch(0, 0, *u.shape), colours)
    return colours


def in_floats(photo: NDArray[np.uint8], places: NDArray[np.float32]) -> NDArray[np.float64]:
    """The same by the formula; photos go on beyond their border as they end there."""
    limits = np.array(photo.shape[1::-1]) - 1
    u, v = np.moveaxis(np.clip(places.astype(np.float64) - 0.5, 0, limits), -1, 0)
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    right, below = np.minimum(column + 1, limits[0]), np.minimum(row + 1, limits[1])
    across, down = (u - column)[..., None], (v - row)[..., None]
    upper = photo[row, column] * (1 - across) + photo[row, right] * across
    lower = photo[below, column] * (1 - across) + photo[below, right] * across
    return np.asarray(upper * (1 - down) + lower * down)


def test_colours_are_those_of_the_formula() -> None:
    rng = np.random.default_rng(5)
    photo = rng.integers(0, 256, (40, 60, 3), np.uint8)
    places = rng.uniform(-4, 66, (200, 300, 2)).astype(np.float32)
    # Places count in 64ths of a pixel: with noise of full contrast that is four levels at most.
    off = np.abs(sampled(photo, places) - in_floats(photo, places))
    assert off.max() <= 0.5 + 2 * 255 / 128
    exact = np.round(places * 64) / np.float32(64)
    assert np.abs(sampled(photo, exact) - in_floats(photo, exact)).max() <= 0.5


def test_extremes_do_not_run_into_the_next_channel() -> None:
    photo = np.zeros((2, 2, 3), dtype=np.uint8)
    photo[..., 1] = 255
    places = np.random.default_rng(0).uniform(0, 2, (50, 50, 2)).astype(np.float32)
    assert (sampled(photo, places) == [0, 255, 0]).all()


def test_a_photo_of_one_pixel_shows_that_pixel_everywhere() -> None:
    photo = np.array([[[1, 20, 250]]], dtype=np.uint8)
    places = np.array([[[-9, 0], [0.5, 0.5], [70, 3]]], dtype=np.float32)
    assert (sampled(photo, places) == photo).all()
