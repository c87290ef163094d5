"""The picture of a wall with its openings: how large, how pale, and where outlines lie in it."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.segment.openings import outline_map

from orthoflow.files.images import decode_image
from orthoflow.products import OpeningKind


@pytest.mark.parametrize("factor", [1, 3])
@pytest.mark.parametrize(("kind", "channel"), [("through", 2), ("niche", 0), ("no data", 0)])
def test_an_outline_lies_on_its_corners_in_the_colour_of_its_kind(
    kind: OpeningKind, channel: int, factor: int
) -> None:
    corners = factor * np.array([[40.0, 60.0], [40.0, 150.0], [120.0, 150.0], [120.0, 60.0]])
    grey = np.full((600 * factor, 700 * factor), 0.5, dtype=np.float32)
    plain, picture = (
        decode_image(outline_map(grey, outlines), "a figure").astype(int)
        for outlines in ([], [(kind, corners)])
    )
    changed = np.abs(picture - plain).max(axis=2) > 60
    rows, columns = np.nonzero(changed)
    corners *= min(1.0, 1004 / (700 * factor))
    low, high = corners.min(axis=0), corners.max(axis=0)
    np.testing.assert_allclose([columns.min(), rows.min()], low, atol=3)
    np.testing.assert_allclose([columns.max(), rows.max()], high, atol=3)
    # All four sides are drawn.
    middles = np.rint(0.5 * (corners + np.roll(corners, -1, axis=0))).astype(int)
    for column, row in middles:
        part = np.s_[row - 2 : row + 3, column - 2 : column + 3]
        assert picture[part][..., channel].max() >= 140
        assert changed[part].any()
    # Its number stands inside, at the upper left.
    left, top = np.rint(low).astype(int)
    assert changed[top + 5 : top + 30, left + 5 : left + 30].sum() > 20
