"""The picture of a wall with its openings: how large, how pale, and where outlines lie in it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.segment.openings import outline_map

from orthoflow.files.images import decode_image

CORNERS = np.array([[40.0, 60.0], [40.0, 150.0], [120.0, 150.0], [120.0, 60.0]])


def drawn(shape: tuple[int, int], grey: float = 0.5, **outlines: NDArray[np.float64]) -> NDArray:
    kinds = {"through": "through", "niche": "niche", "nothing": "no data"}
    given = [(kinds[name], corners) for name, corners in outlines.items()]
    picture = np.full(shape, grey, dtype=np.float32)
    return decode_image(outline_map(picture, given), "a figure")  # type: ignore[arg-type]


@pytest.mark.parametrize("factor", [1, 3])
@pytest.mark.parametrize(
    ("kind", "channel"), [("through", 2), ("niche", 0), ("nothing", 0)], ids=str
)
def test_an_outline_lies_on_its_corners_in_the_colour_of_its_kind(
    kind: str, channel: int, factor: int
) -> None:
    plain = drawn((600 * factor, 700 * factor)).astype(int)
    picture = drawn((600 * factor, 700 * factor), **{kind: CORNERS * factor}).astype(int)
    shrink = min(1.0, 1004 / (700 * factor))
    changed = np.abs(picture - plain).max(axis=2) > 60
    rows, columns = np.nonzero(changed)
    corners = CORNERS * factor * shrink
    low, high = corners.min(axis=0), corners.max(axis=0)
    np.testing.assert_allclose([columns.min(), rows.min()], low, atol=3)
    np.testing.assert_allclose([columns.max(), rows.max()], high, atol=3)
    # All four sides are drawn.
    middles = np.rint(0.5 * (corners + np.roll(corners, -1, axis=0))).astype(int)
    for column, row in middles:
        part = picture[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3)
        assert part[:, channel].max() >= 140
        assert changed[row - 2 : row + 3, column - 2 : column + 3].any()
    # Its number stands inside, at the upper left.
    inside = changed[round(low[1]) + 5 : round(low[1]) + 30, round(low[0]) + 5 : round(low[0]) + 30]
    assert inside.sum() > 20
