"""A patch with a focus shows where its middle is, not where the texture about it is."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.inspect.patches import PATCH_CELLS, GreyImage, refine_shifts, unrefined
from scipy.ndimage import gaussian_filter, map_coordinates

SIDE = 3 * PATCH_CELLS
MIDDLE = SIDE / 2


def texture() -> np.ndarray:
    noise = np.random.default_rng(4).normal(size=(SIDE, SIDE))
    smooth = gaussian_filter(noise, 2.0, mode="wrap")
    return np.asarray(128.0 + 40.0 * smooth / smooth.std())


def image(grey: np.ndarray) -> GreyImage:
    known = np.ones(grey.shape, dtype=np.bool_)
    return GreyImage(grey=grey, valid=known, region=known)


def displaced(right: float, down: float, radius_cells: float) -> np.ndarray:
    """The texture, displaced within a circle about the middle only."""
    rows, columns = np.indices((SIDE, SIDE)).astype(np.float64)
    moved = map_coordinates(texture(), [rows - down, columns - right], order=3, mode="grid-wrap")
    near = np.hypot(rows + 0.5 - MIDDLE, columns + 0.5 - MIDDLE) <= radius_cells
    return np.where(near, moved, texture())


@pytest.mark.parametrize("shift", [(0.4, -0.25), (-0.3, 0.5)])
def test_the_middle_counts_where_there_is_a_focus(shift: tuple[float, float]) -> None:
    start = unrefined(np.full((1, 2), MIDDLE), np.zeros((1, 2)))
    shown, true = image(displaced(*shift, radius_cells=12.0)), image(texture())
    focused = refine_shifts(shown, true, start, sigma_most_cells=1.0, focus_cells=4.0)
    # Hundredths of a cell: what lies three standard deviations off has a weight of a hundredth.
    np.testing.assert_allclose(focused.shift, [shift], atol=0.03)
    np.testing.assert_allclose(focused.centre, [[MIDDLE, MIDDLE]])


@pytest.mark.parametrize("shift", [(0.4, -0.25), (-0.3, 0.5)])
def test_without_one_all_cells_count_alike(shift: tuple[float, float]) -> None:
    start = unrefined(np.full((1, 2), MIDDLE), np.zeros((1, 2)))
    shown = image(displaced(*shift, radius_cells=SIDE))
    whole = refine_shifts(shown, image(texture()), start, sigma_most_cells=0.15)
    np.testing.assert_allclose(whole.shift, [shift], atol=0.01)
    assert whole.correlation[0] > 0.999
