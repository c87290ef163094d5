"""Tiles that are cut into quarters, and cells too near to what is hidden."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.ortho import painting
from orthoflow_plugins.ortho.views import TileVisibility


@pytest.mark.parametrize("tile", [(slice(0, 8), slice(4, 12)), (slice(3, 8), slice(5, 6))], ids=str)
def test_quarters_of_a_tile_are_all_of_it_once(tile: tuple[slice, slice]) -> None:
    covered = np.zeros((20, 20), dtype=np.int64)
    quarters = painting._quarters(tile)
    for quarter in quarters:
        covered[quarter] += 1
        assert all(part.start < part.stop for part in quarter)
    expected = np.zeros((20, 20), dtype=np.int64)
    expected[tile] = 1
    np.testing.assert_array_equal(covered, expected)
    # A single column is not cut.
    assert len(quarters) == (4 if tile[1].stop - tile[1].start > 1 else 2)
    sizes = [(q[0].stop - q[0].start, q[1].stop - q[1].start) for q in quarters]
    assert np.ptp(sizes, axis=0).max() <= 1


@pytest.mark.parametrize("reach", [0, 1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_cells_near_hidden_patches_are_those_within_reach_of_two_by_two(
    reach: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    hidden = rng.random((23, 31)) < 0.12
    hidden[5:7, 20:22] = hidden[0:2, 0:2] = hidden[21:23, 29:31] = True
    hidden[12, 3:12] = True  # one row is no patch
    hidden[11, 3:12] = hidden[13, 3:12] = False
    near = np.zeros(hidden.shape, dtype=np.bool_)
    for row in range(22):
        for column in range(30):
            if hidden[row : row + 2, column : column + 2].all():
                top, left = max(0, row - reach), max(0, column - reach)
                near[top : row + 2 + reach, left : column + 2 + reach] = True
    found = painting._near_patches(hidden, reach)
    inner = (slice(reach + 1, -reach - 1),) * 2
    np.testing.assert_array_equal(found[inner] > 0, near[inner])


def test_a_crop_is_as_long_as_the_longer_of_its_sides() -> None:
    nothing = np.zeros((1, 1), dtype=np.float32)
    for summary, side in (((10.0, 50.0, 7.0, 9.0), 40.0), ((10.0, 12.0, 7.0, 99.0), 92.0)):
        visible = TileVisibility(
            u=nothing,
            v=nothing,
            mask=nothing.astype(np.uint8),
            quality=nothing,
            summary=np.array([*summary, 0.0, 0.0, 0.0, 0.0]),
        )
        assert painting._crop_side(visible) == side
