"""How far rays over a wall have to be followed: what bounds them, as Python runs the kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho import ray_kernels
from orthoflow_plugins.ortho.ray_kernels import Eye
from orthoflow_plugins.ortho.surfaces import _highest_of_four
from orthoflow_plugins.ortho.views import NOTHING_M

from orthoflow.geometry.compiling import interpreted

SIDE = 8
N_BLOCKS = 9
TOLERANCE_M = 0.01


@pytest.fixture
def python(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Callable[..., Any]]:
    """Kernels of the module by name, in Python, with those that they call."""
    for name in ("_first_block", "_top_at", "_is_inside", "_steps_inside"):
        monkeypatch.setattr(ray_kernels, name, interpreted(getattr(ray_kernels, name)))
    return lambda name: interpreted(getattr(ray_kernels, name))


def test_a_block_touches_the_next_one_in_the_direction_it_moves(python: Any) -> None:
    first = ray_kernels._first_block
    for corner in (2.0, 2.25, -0.5):
        inside = [first(corner, direction) for direction in (1.0, -1.0, 0.0)]
        if corner == 2.0:
            # Touching block 2 alone: with 3 on the way down, with 1 on the way up.
            assert inside == [2, 1, 1]
        else:
            assert inside == [int(np.floor(corner))] * 3


def test_what_lies_beside_the_blocks_has_no_height(python: Any) -> None:
    tops = np.arange(12.0, dtype=np.float32).reshape(3, 4)
    for row in range(-3, 5):
        for column in range(-3, 6):
            is_known = 0 <= row + 1 < 3 and 0 <= column + 1 < 4
            expected = tops[row + 1, column + 1] if is_known else NOTHING_M
            assert ray_kernels._top_at(tops, row, column) == expected
            assert ray_kernels._is_inside(tops, row, column) == is_known


@pytest.mark.parametrize("n_beside", [1, 2, 17])
def test_rays_stop_before_they_leave_the_raster_at_a_side(python: Any, n_beside: int) -> None:
    for beside in range(n_beside):
        for aside in (-1.0, -0.37, -0.01, 0.0, 0.02, 0.5, 0.93):
            move = int(aside * ray_kernels._UNIT)
            n_steps = ray_kernels._steps_inside(beside, n_beside, move)
            if move == 0:
                # It never does; other bounds end it.
                assert n_steps >= n_beside
                continue
            places = [(beside << 32) + k * move for k in range(n_steps + 2)]
            end = (n_beside - 1) << 32
            assert all(0 <= place <= end for place in places[:-1])
            assert not 0 <= places[-1] <= end


def swept(eye: Eye, block: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places in blocks (n, k, 2) of rays from a block's cells to the camera, and shares (k,)."""
    cells = np.stack(np.meshgrid(np.linspace(-0.49, 7.49, 5), np.linspace(-0.49, 7.49, 5)), axis=-1)
    starts = cells.reshape(-1, 2) + SIDE * np.array(block)
    shares = np.linspace(0.0, 1.0, 401)
    ends = np.array([eye.row, eye.column])
    at = starts[:, None] + shares[None, :, None] * (ends - starts)[:, None]
    return (at + 0.5) / SIDE, shares


@pytest.mark.parametrize("seed", range(12))
def test_a_bound_holds_all_that_stands_in_the_way_and_nothing_far_from_it(
    python: Any, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    bound = python("highest_in_the_way")
    row, column = rng.uniform(-30.0, SIDE * N_BLOCKS + 30.0, 2)
    if seed == 0:
        # Straight above the block.
        row, column = 35.5, 35.5
    eye = Eye(row, column, rng.uniform(0.3, 1.5), TOLERANCE_M, 1.0)
    block = (4, 4) if seed == 0 else tuple(int(k) for k in rng.integers(0, N_BLOCKS, 2))
    bottom = 0.02
    at, shares = swept(eye, block)  # type: ignore[arg-type]
    height = bottom + shares * (eye.height_m - bottom) + TOLERANCE_M
    way = SIDE * N_BLOCKS
    n_steps = max(1.0, 2.0 * np.abs(np.array([row, column]) / SIDE - block).max())
    rise = (eye.height_m - bottom) / n_steps
    n_bounding = n_ignored = 0
    for there in np.ndindex(N_BLOCKS, N_BLOCKS):
        inside = (np.floor(at) == there).all(axis=2).any(axis=0)
        apart = np.abs(at - (np.array(there) + 0.5)).max(axis=2).min(axis=0)
        for top in rng.uniform(0.0, eye.height_m, 2).astype(np.float32):
            single = np.full((N_BLOCKS, N_BLOCKS), NOTHING_M, dtype=np.float32)
            single[there] = top
            found = bound(eye, _highest_of_four(single), bottom, SIDE, block, way)
            assert found in (top, NOTHING_M)
            if (inside & (height < top)).any():
                # A ray of the block meets it.
                assert found == top
                n_bounding += 1
            # Of two blocks each way and of half a block's step, nothing is nearer.
            if not ((apart < 2.1) & (height - 2.1 * rise < top)).any():
                assert found == NOTHING_M
                n_ignored += 1
    assert n_bounding >= 1
    assert n_ignored > 20


def test_nothing_is_asked_of_a_block_as_high_as_the_camera(python: Any) -> None:
    bound = python("highest_in_the_way")
    eye = Eye(100.0, 4.0, 0.5, TOLERANCE_M, 1.0)
    tops = np.full((N_BLOCKS + 1, N_BLOCKS + 1), 2.0, dtype=np.float32)
    assert bound(eye, tops, 0.5, SIDE, (1, 1), 9.0) == NOTHING_M
    assert bound(eye, tops, np.inf, SIDE, (1, 1), 9.0) == NOTHING_M
    assert bound(eye, tops, 0.4, SIDE, (1, 1), 9.0) == 2.0
    # Where all that counts is lower than the rays begin, none is looked at.
    assert bound(eye, tops, 0.4, SIDE, (1, 1), 0.4 + TOLERANCE_M) == NOTHING_M
    assert bound(eye, tops, 0.4, SIDE, (1, 1), 0.4 + 2.0 * TOLERANCE_M) == 2.0


def test_the_highest_of_all_in_the_way_is_the_bound(python: Any) -> None:
    bound = python("highest_in_the_way")
    eye = Eye(SIDE * N_BLOCKS + 40.0, 12.0, 1.0, TOLERANCE_M, 1.0)
    for heights, expected in (
        ((0.3, 0.5, 0.4), 0.5),
        ((0.5, 0.3, 0.4), 0.5),
        ((0.1, 0.2, 0.05), 0.2),
    ):
        single = np.full((N_BLOCKS, N_BLOCKS), NOTHING_M, dtype=np.float32)
        single[[1, 2, 3], 1] = heights
        found = bound(eye, _highest_of_four(single), 0.0, SIDE, (0, 1), 9.0)
        assert found == np.float32(expected)
