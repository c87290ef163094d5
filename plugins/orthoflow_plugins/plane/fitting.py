"""Planes through noisy points: robust fits with a shrinking tolerance on a sample.

All planes here are in the cloud's own offsets (metres from its origin), so that survey coordinates
cost no digits; `world_plane` of `assembling` adds the origin once, at the end.
"""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.plane_fit_kernels import FREE, LEVEL, VERTICAL, refine_robustly

# What a fit may change: everything, or a normal kept exactly horizontal, or kept along up.
Freedom = Literal["free", "vertical", "level"]

_FREEDOMS: Final[dict[Freedom, int]] = {"free": FREE, "vertical": VERTICAL, "level": LEVEL}


def shrinking_tolerances(find_m: float, fit_m: float) -> tuple[float, ...]:
    """Tolerances to fit with, one after the other: 5 cm, 2.7 cm and 1.5 cm for the defaults.

    A fit at 5 cm finds the wall but is pulled by mouldings and the floor's edge; a fit at 1.5 cm is
    exact but would not get there from a rough start.
    """
    if fit_m >= find_m:
        return (find_m,)
    return (find_m, math.sqrt(find_m * fit_m), fit_m)


def refine_plane(
    points: NDArray[np.float64],
    start: Plane,
    tolerance_m: float,
    *,
    freedom: Freedom,
    up: NDArray[np.float64],
) -> Plane | None:
    """Move a plane to the densest layer of points near it: total least squares, reweighted.

    Args:
        points: (m, 3) offsets, metres.
        start: plane to start from.
        tolerance_m: points further away have no weight (Tukey's weights).
        freedom: what may change.
        up: (3,) unit vector.

    Returns:
        The plane, or None where fewer than three points or only a line of points support it.
    """
    row = np.append(start.normal, start.offset_m)
    if not refine_robustly(points, row, tolerance_m, _FREEDOMS[freedom], up):
        return None
    # Twice, because Plane accepts no length that is off by more than rounding.
    normal = row[:3] / np.linalg.norm(row[:3])
    return Plane(normal=normal / np.linalg.norm(normal), offset_m=float(row[3]))
