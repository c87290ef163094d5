"""Parts of pictures that are compared."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.inspect.patches import GreyImage

ROWS, COLUMNS = 9, 12


def picture() -> GreyImage:
    rng = np.random.default_rng(2)
    valid = rng.random((ROWS, COLUMNS)) < 0.7
    return GreyImage(grey=rng.uniform(1.0, 255.0, valid.shape), valid=valid, region=valid)


@pytest.mark.parametrize("corner", [(3, 2), (-2, -3), (9, 6), (-1, 7), (20, 20)], ids=str)
def test_a_square_is_cut_and_is_not_valid_beyond_the_border(corner: tuple[int, int]) -> None:
    whole, side = picture(), 5
    part = whole.square(np.array(corner), side)
    for row in range(side):
        for column in range(side):
            v, u = corner[1] + row, corner[0] + column
            inside = 0 <= v < ROWS and 0 <= u < COLUMNS
            assert part.grey[row, column] == (whole.grey[v, u] if inside else 0.0)
            assert part.valid[row, column] == (inside and whole.valid[v, u])
    np.testing.assert_array_equal(part.region, part.valid)
