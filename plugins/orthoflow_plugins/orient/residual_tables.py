"""Residuals as a table: what surveyors ask of them, per photo, role, coordinate and unit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import JsonValue

# Of a normal distribution 4.55 % lie beyond; of any, at most a quarter can (Chebyshev).
_BEYOND: Final = 2.0
_NMAD: Final = 1.4826
_AXES: Final = ("u", "v")

COLUMNS_SAID: Final[Mapping[str, JsonValue]] = {
    "residual": "observed - computed; u and v of the photo",
    "unit": "px of the photo, cell of the wall's raster, or mm on the wall: px times the median "
    "size of a pixel there",
    "shift_p": "probability of such a mean by chance, Student's t, two-sided",
    "nmad": "1.4826 times the median absolute deviation from the median",
    "p95": "95 % of the residuals are no longer than this",
    "beyond_own": "share beyond twice the coordinate's own RMSE",
    "beyond_cells": "share beyond two cells of the wall's raster, a reference that does not move",
    "beyond_any": "share of ties of which u or v lies beyond twice its own RMSE",
}


def residual_rows(
    place: Mapping[str, JsonValue],
    residuals_px: NDArray[np.float64],
    units: Mapping[str, float],
) -> list[JsonValue]:
    """Give the rows of one photo and role.

    Args:
        place: columns that say which, the first of each row.
        residuals_px: (n, 2), observed - computed.
        units: by name, how many of them a pixel is; `cell` among them if it is known.

    Returns:
        One row per coordinate and unit; none without residuals.
    """
    if not len(residuals_px):
        return []
    is_beyond = np.abs(residuals_px) > _BEYOND * _rmse(residuals_px)
    any_axis = _share(is_beyond[:, 0] | is_beyond[:, 1])
    rows: list[JsonValue] = []
    for axis, values in zip(_AXES, residuals_px.T, strict=True):
        limit = _BEYOND / units["cell"] if "cell" in units else None
        beyond: dict[str, JsonValue] = {
            "beyond_own": _share(np.abs(values) > _BEYOND * _rmse(values)),
            "beyond_cells": None if limit is None else _share(np.abs(values) > limit),
            "beyond_any": any_axis,
        }
        for unit, factor in units.items():
            numbers = _numbers(values * factor)
            rows.append({**place, "axis": axis, "unit": unit, **numbers, **beyond})
    return rows


def _numbers(values: NDArray[np.float64]) -> dict[str, JsonValue]:
    n, median = len(values), float(np.median(values))
    deviation = float(values.std(ddof=1)) if n > 1 else 0.0
    lengths = np.abs(values)
    return {
        "n": n,
        "mean": float(values.mean()),
        "shift_p": _chance_of_mean(values),
        "sd": deviation,
        "median": median,
        "nmad": _NMAD * float(np.median(np.abs(values - median))),
        "skewness": _skewness(values),
        "rmse": float(_rmse(values)),
        "p95": float(np.percentile(lengths, 95.0)),
        "max": float(lengths.max()),
    }


def _chance_of_mean(values: NDArray[np.float64]) -> float | None:
    """Probability of a mean as far from 0 when there is no shift; None for fewer than two."""
    from scipy.special import stdtr  # scipy.stats would take seconds to import

    n = len(values)
    if n < 2:
        return None
    deviation = float(values.std(ddof=1))
    if deviation == 0.0:
        return 1.0 if values[0] == 0.0 else 0.0
    return 2.0 * float(stdtr(n - 1, -abs(float(values.mean())) * math.sqrt(n) / deviation))


def _skewness(values: NDArray[np.float64]) -> float | None:
    """Third standardised moment; None where nothing varies."""
    centred = values - values.mean()
    variance = float(np.mean(centred**2))
    return float(np.mean(centred**3)) / variance**1.5 if variance > 0.0 else None


def _rmse(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square along the first axis."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _share(is_beyond: NDArray[np.bool_]) -> float:
    return float(is_beyond.mean())
