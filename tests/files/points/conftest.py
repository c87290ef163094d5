"""What tests of point files share."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray


@pytest.fixture
def points() -> NDArray[np.float64]:
    rng = np.random.default_rng(3)
    return np.round(rng.uniform(-5.0, 5.0, (40, 3)), 4)
