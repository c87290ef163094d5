"""What the workshop compiles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part


@kernel_part
def doubled(value: float) -> float:
    """Twice a value."""
    return 2.0 * value


@compiled
def doubled_sum(values: NDArray[np.float64]) -> float:
    """Twice the sum of values."""
    total = 0.0
    for value in values:
        total += doubled(value)
    return total
