"""Openings as products: kept whole, refused where they make no sense."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orthoflow.errors import ProductError
from tests.drawing_runs import box_openings


def test_what_it_is_is_said_in_a_line() -> None:
    (opening,) = box_openings().openings
    assert opening.said == "niche 0.250 m deep, 0.80 x 1.20 m"
    assert replace(opening, kind="through", depth_m=0.1).said == "through, 0.80 x 1.20 m"


def test_the_error_of_all_sides_counts_those_that_were_seen() -> None:
    (opening,) = box_openings().openings
    assert opening.edge_sigma_m == pytest.approx(np.sqrt((9 + 2.25 + 9) / 3) * 1e-3)
    assert replace(opening, side_sigma_m=np.full(4, np.nan)).edge_sigma_m is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"outline_world": np.zeros((3, 3))}, "opening.outline_world must have shape"),
        ({"side_source": np.zeros(3, dtype=np.uint8)}, "opening.side_source must have shape"),
        ({"outline_m": np.full((4, 2), np.nan)}, "at least 3 corners with coordinates below"),
        ({"kind": "hole"}, "must be one of through, niche, no data, got 'hole'"),
        ({"side_source": np.full(4, 9, dtype=np.uint8)}, "opening.side_source must be at most 2"),
    ],
    ids=["corners", "sides", "not finite", "kind", "source"],
)
def test_what_does_not_go_together_is_refused(change: dict[str, object], said: str) -> None:
    with pytest.raises(ProductError, match=said):
        replace(box_openings().openings[0], **change)  # type: ignore[arg-type] # wrong on purpose
