"""Patches, seams and steps of colour against loops over cells."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic import agreement as module
from orthoflow_plugins.mosaic.agreement import (
    count_seams,
    is_seam,
    overlaps_of,
    seam_steps,
)
from orthoflow_plugins.mosaic.blocks import depth_edges

from orthoflow.products import Layer, LayerMask
from tests import samples
from tests.long_loops import seeds

SHAPE = (150, 210)


def layer(
    quality: NDArray[np.float64] | float = 1.0,
    *,
    rgb: NDArray[np.uint8] | None = None,
    mask: NDArray[np.uint8] | None = None,
    shape: tuple[int, int] = SHAPE,
) -> Layer:
    plain = samples.layer(shape if mask is None else mask)
    values = np.where(plain.mask == LayerMask.PAINTED, quality, 0.0).astype(np.float32)
    return replace(plain, rgb=plain.rgb if rgb is None else rgb, quality=values)


# --- patches ---


def test_the_two_best_layers_of_a_patch_are_those_that_paint_all_of_it() -> None:
    rng = np.random.default_rng(1)
    layers = []
    for _ in range(4):
        mask = np.full(SHAPE, LayerMask.PAINTED, dtype=np.uint8)
        # A single cell of some patches is missing.
        for row, column in rng.integers(0, (128, 192), (3, 2)):
            mask[row, column] = LayerMask.OCCLUDED
        layers.append(layer(rng.uniform(0.5, 1.0, SHAPE), mask=mask))
    # Patches of 64 cells, as many as there is room for.
    wanted = []
    for row in (0, 64):
        for column in (0, 64, 128):
            part = np.s_[row : row + 64, column : column + 64]
            means = {
                k: float(one.quality[part].mean(dtype=np.float64))
                for k, one in enumerate(layers)
                if (one.mask[part] == LayerMask.PAINTED).all()
            }
            best = sorted(means, key=lambda k: -means[k])
            if len(best) >= 2:
                wanted.append((row, column, best[0], best[1]))
    assert 2 < len(wanted) <= 6
    assert module._pairs(layers, of_all_pairs=False) == wanted
    assert module._pairs(layers[:1], of_all_pairs=False) == []
    small = [layer(shape=(63, 300)), layer(shape=(63, 300))]
    assert module._pairs(small, of_all_pairs=False) == []
    three = [layer(shape=(64, 64))] * 3
    assert len(module._pairs(three, of_all_pairs=False)) == 1
    assert len(module._pairs(three, of_all_pairs=True)) == 3


def texture(spread_grey: float) -> NDArray[np.float64]:
    """Blurred noise of 64 x 64 cells whose standard deviation is given, and some cells beside."""
    noise = np.random.default_rng(2).normal(size=(64, 70))
    blurred = cv2.GaussianBlur(noise, (0, 0), 1.0)
    part = blurred[:, :64]
    return 120.0 + spread_grey * (blurred - part.mean()) / part.std()


@pytest.mark.parametrize(("spread_grey", "n_found"), [(2.5, 0), (4.0, 1), (30.0, 1)])
def test_flat_patches_tell_no_displacement(spread_grey: float, n_found: int) -> None:
    whole = np.rint(texture(spread_grey)).astype(np.uint8)
    pair = [layer(rgb=np.dstack([whole[:, k : k + 64]] * 3), shape=(64, 64)) for k in (0, 2)]
    found = overlaps_of(pair).shifts_cells
    assert len(found) == n_found
    if n_found:
        np.testing.assert_allclose(found, [[-2.0, 0.0]], atol=0.4)


def peak(pair: list[NDArray[np.uint8]]) -> float:
    window = cv2.createHanningWindow((64, 64), cv2.CV_32F)
    first, second = (part.astype(np.float32) for part in pair)
    return float(cv2.phaseCorrelate(first, second, window)[1])


def test_a_peak_of_a_fifth_tells_and_one_of_a_tenth_does_not() -> None:
    rng = np.random.default_rng(4)
    one = rng.integers(0, 256, (64, 64)).astype(np.uint8)
    told: dict[str, int] = {}
    # The same patch with more and more of others mixed in.
    for weight in np.linspace(0.5, 1.0, 41):
        other = rng.integers(0, 256, one.shape)
        pair = [one, np.rint((1.0 - weight) * one + weight * other).astype(np.uint8)]
        layers = [layer(rgb=np.dstack([part] * 3), shape=(64, 64)) for part in pair]
        if 0.16 < peak(pair) < 0.28:
            told["fifth"] = len(overlaps_of(layers).photos)
        elif 0.07 < peak(pair) < 0.14:
            told["tenth"] = len(overlaps_of(layers).photos)
    assert told == {"fifth": 1, "tenth": 0}


def test_two_hundred_patches_are_enough() -> None:
    shape = (64, 64 * 240)
    row = np.rint(texture(30.0)[:, :64]).astype(np.uint8)
    same = layer(rgb=np.dstack([np.tile(row, (1, 240))] * 3), shape=shape)
    found = overlaps_of([same, same]).shifts_cells
    assert len(found) == 200
    np.testing.assert_allclose(found, 0.0, atol=0.05)


# --- seams ---


def sources(seed: int, shape: tuple[int, int] = (11, 9)) -> NDArray[np.int16]:
    return np.random.default_rng(seed).integers(-1, 3, shape).astype(np.int16)


@pytest.mark.parametrize("at_once", [1, 3, 11, 1024])
@pytest.mark.parametrize("seed", seeds(2))
def test_seams_are_where_the_right_or_lower_neighbour_is_of_another(
    monkeypatch: pytest.MonkeyPatch, seed: int, at_once: int
) -> None:
    monkeypatch.setattr(module, "_ROWS_AT_ONCE", at_once)
    source = sources(seed)
    rows, columns = source.shape
    before: dict[int, list[tuple[int, int]]] = {0: [], 1: []}
    for row, column in np.ndindex(source.shape):
        for axis, (r, c) in enumerate(((row + 1, column), (row, column + 1))):
            is_there = r < rows and c < columns
            pair = {int(source[row, column]), int(source[r, c])} if is_there else set()
            if len(pair) == 2 and -1 not in pair:
                before[axis].append((row, column))
    seam = np.zeros(source.shape, dtype=np.bool_)
    for axis in (0, 1):
        found = module._before_seams(source, axis)
        assert sorted(zip(*(part.tolist() for part in found), strict=True)) == before[axis]
        seam[tuple(np.array(before[axis]).T)] = True
    np.testing.assert_array_equal(is_seam(source), seam)
    depth_m = np.random.default_rng(seed).uniform(0.0, 0.06, source.shape).astype(np.float32)
    n_edges = np.count_nonzero(seam & depth_edges(depth_m))
    assert count_seams(source, depth_m) == (seam.sum(), n_edges)
    assert count_seams(source, None) == (seam.sum(), 0)


def test_black_and_white_are_a_hundred_apart() -> None:
    source = np.array([[0, 1]], dtype=np.int16)
    pair = [layer(rgb=np.full((1, 2, 3), value, np.uint8), shape=(1, 2)) for value in (0, 255)]
    grey, delta_e = seam_steps(source, pair)
    assert grey.tolist() == pytest.approx([-255.0])
    assert delta_e.tolist() == pytest.approx([100.0], abs=1e-3)
