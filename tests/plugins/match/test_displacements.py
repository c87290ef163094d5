"""How far two pictures are displaced: which places can be measured, and what comes out."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import displacements
from orthoflow_plugins.match.channels import Channels
from scipy.ndimage import gaussian_filter, shift

measure = partial(displacements.measure, radius_cells=4, min_score=0.5)


def texture(seed: int = 1, *, side: int = 80) -> NDArray[np.float64]:
    noise = np.random.default_rng(seed).normal(size=(side, side))
    smooth = gaussian_filter(noise, 1.5)
    return np.asarray(smooth / smooth.std())


def channels(*layers: NDArray[np.float64]) -> Channels:
    values = np.stack(layers, axis=-1).astype(np.float32)
    return Channels(values=values, known=np.ones(values.shape[:2], dtype=np.float32))


def moved(layer: NDArray[np.float64], right: float, down: float) -> NDArray[np.float64]:
    """The same content so many cells farther right and down."""
    return np.asarray(shift(layer, (down, right), order=3, mode="nearest"))


PLACES = np.array([[column, row] for row in (25, 40, 55) for column in (20, 40, 60)], dtype=np.intp)


def test_noise_is_told_by_the_standard_deviation() -> None:
    first = texture()
    other = moved(first, 1.0, 0.0)
    ratios = []
    for seed in range(2, 8):
        noisy = channels(other + 0.4 * texture(seed=seed))
        found = measure(channels(first), noisy, PLACES)
        ratios.append(np.abs(found.shift_cells - [1.0, 0.0]) / found.sigma_cells[:, None])
    # Of a normal distribution half lies within 0.67 standard deviations.
    assert np.median(np.concatenate(ratios)) == pytest.approx(0.67, abs=0.2)
