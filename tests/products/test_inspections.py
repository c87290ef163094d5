"""Check points have a row each in all of their arrays."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.errors import ProductError
from orthoflow.products import CheckPoints


def points_of(**changes: object) -> CheckPoints:
    given: dict[str, object] = {
        "names": ("a", "b", "c"),
        "points_world": np.zeros((3, 3)),
        "classes": ("", "", ""),
        "wall": np.zeros(3, dtype=np.int32),
        "pixels_wall": np.zeros((3, 2)),
        "places_m": np.zeros((3, 2)),
        "shown_world": np.zeros((3, 3)),
    }
    return CheckPoints(**{**given, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["points_world", "wall", "pixels_wall", "places_m", "shown_world"])
def test_check_points_have_a_row_each(name: str) -> None:
    right = getattr(points_of(), name)
    assert len(points_of().names) == len(right)
    for wrong in (right[:2], np.concatenate([right, right], axis=right.ndim - 1)):
        with pytest.raises(ProductError, match=f"checkpoints.*{name}"):
            points_of(**{name: wrong})
    with pytest.raises(ProductError, match="3 names, but 2 classes"):
        points_of(classes=("", ""))
