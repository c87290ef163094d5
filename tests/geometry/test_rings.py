"""Rings of points: what they go round, and which way."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.geometry.frames import signed_area

_L_SHAPE = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [1.0, 1.0], [1.0, 2.0], [0.0, 2.0]])


def test_an_area_has_the_sign_of_its_turn() -> None:
    assert signed_area(_L_SHAPE) == pytest.approx(4.0)
    assert signed_area(_L_SHAPE[::-1]) == pytest.approx(-4.0)
    assert signed_area(np.roll(_L_SHAPE, 2, axis=0) - np.array([7.0, 3.0])) == pytest.approx(4.0)
    assert signed_area(_L_SHAPE[:2]) == 0.0
