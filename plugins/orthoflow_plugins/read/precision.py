"""How fine the coordinates are: rounded in the file, and as offsets in float32."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

# Coordinates rounded more coarsely than this limit what an orthoimage can show.
COARSE_M: Final = 0.005
# Offsets keep half a tenth of a millimetre; beyond, the user is told.
FINE_M: Final = 5e-5
_SAMPLE: Final = 20_000
_LEAST_VALUES: Final = 10
# Decimal rounding, and the powers of two that float32 leaves of large coordinates.
_STEPS: Final = sorted(
    {digit * 10.0**power for digit in (1, 2, 5) for power in range(-4, 3)}
    | {2.0**power for power in range(-10, 4)},
    reverse=True,
)


def rounding_m(points: NDArray[np.float64], unit_m: float) -> float:
    """Step to which a block's coordinates (n, 3) are rounded, in metres, if it is coarse.

    Args:
        points: in the file's unit.
        unit_m: the file's unit in metres.

    Returns:
        The largest step on which all values of an axis lie, the finest of the axes; 0 when that
        is finer than `COARSE_M` or cannot be told.
    """
    sample = points[:: max(1, len(points) // _SAMPLE)]
    found = []
    for axis in range(3):
        values = np.unique(sample[:, axis])
        values = values[np.isfinite(values)]
        if len(values) >= _LEAST_VALUES:
            found.append(_common_step(values, unit_m))
    return min(found, default=0.0) * unit_m


def resolution_m(farthest_m: float) -> float:
    """Distance between neighbouring float32 numbers at an offset."""
    return float(np.spacing(np.float32(farthest_m)))


def _common_step(values: NDArray[np.float64], unit_m: float) -> float:
    finest = float(np.diff(values).min())
    for step in _STEPS:
        if step * unit_m < COARSE_M:
            break
        if step > 1.1 * finest:
            continue
        multiples = (values - values[0]) / step
        if np.abs(multiples - np.rint(multiples)).max() < 0.01:
            return step
    return 0.0
