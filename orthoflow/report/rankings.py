"""Formatting of numbers, and ranking of the values in a column."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.robust import median_deviation
from orthoflow.records.runs import is_rounding

_DIGITS_MOST: Final = 6  # of a mean with its spread
_DIGITS_FEW: Final = 4


def number(value: float, *, significant: int = 4) -> str:
    """Format a number with four significant digits, without an exponent if possible.

    >>> number(0.0123456), number(1234567.0), number(12.0), number(0.14151, significant=2)
    ('0.01235', '1234567', '12', '0.14')
    """
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    digits = max(0, significant - 1 - math.floor(math.log10(abs(value))))
    if digits >= 10:
        return f"{value:.3g}"
    printed = f"{value:.{digits}f}"
    # Remove trailing zeros only after a decimal point.
    return printed.rstrip("0").rstrip(".") if digits else printed


def number_with_unit(value: float, unit: str, *, significant: int = 4) -> str:
    """Format a number with its unit; shares and counts (unit 1) have no unit.

    >>> number_with_unit(2.5, "mm"), number_with_unit(1.0, "yes/no"), number_with_unit(0.4, "1")
    ('2.5 mm', 'yes', '0.4')
    """
    if unit == "yes/no" and value in (0.0, 1.0):
        return "yes" if value else "no"
    printed = number(value, significant=significant)
    return printed if unit == "1" else f"{printed} {unit}"


def number_with_spread(value: float, spread: float) -> str:
    """Format a mean and its standard deviation, rounded to two digits of the latter.

    If the standard deviation is tiny, the mean has four digits.

    >>> number_with_spread(12.3456, 0.0123), number_with_spread(3.0, 0.0)
    ('12.346 ± 0.012', '3')
    >>> number_with_spread(281.999858, 0.000022)
    '282.0 ± 2e-05'
    """
    if spread == 0.0:
        return number(value)
    decimals = 1 - math.floor(math.log10(spread))
    magnitude = math.floor(math.log10(max(abs(value), spread)))
    if decimals + magnitude >= _DIGITS_MOST:
        return f"{value:#.{_DIGITS_FEW}g} ± {spread:.1g}"
    if decimals < 0:
        return f"{number(value)} ± {number(spread)}"
    return f"{value:.{decimals}f} ± {spread:.{decimals}f}"


def seconds_in_words(seconds: float) -> str:
    """Format a duration.

    >>> seconds_in_words(0.042), seconds_in_words(12.34), seconds_in_words(125.0)
    ('0.04 s', '12.3 s', '2 min 05 s')
    """
    if seconds < 10:
        return f"{seconds:.2f} s"
    if seconds < 60:
        return f"{seconds:.1f} s"
    return "{} min {:02d} s".format(*divmod(round(seconds), 60))


# Relative differences from the best value that are smaller than this are ignored if the scatter is
# unknown, i.e. if there are no repeats or all repeats are identical. The limits for times and
# memory are larger, because they vary from run to run (docs/performance.md) even if the repeats of
# one run agree.
_LEVEL_SHARE: Final = 0.01
_LEVEL_COST_SHARES: Final = {"s": 0.3, "MiB": 0.1}
FLAG: Final = "yes/no"


class Mark(Enum):
    """Rank of a value among the values with which it may be compared."""

    NONE = ""
    BEST = "best"
    NEAR = "among the best, no significant difference"
    FEWER = "over fewer items, so not ranked"


@dataclass(frozen=True, kw_only=True)
class Value:
    """A value in a comparison table.

    Attributes:
        text: formatted number; empty if the value is missing.
        sort: number by which the table is sorted; NaN if the value is missing.
        spread: standard deviation over repeats; 0 if the value does not depend on a seed; NaN if
            unknown.
        mark: rank among the values of the group.
        group: letter for the environment and data; empty if they are the same for all values.
        note: remark, such as the number of repeats.
        n_items: number of items that the metric sums over; NaN if they are not counted.
    """

    text: str = ""
    sort: float = math.nan
    spread: float = math.nan
    mark: Mark = Mark.NONE
    group: str = ""
    note: str = ""
    n_items: float = math.nan


def rank(values: Sequence[Value], better: str, unit: str = "1") -> list[Value]:
    """Mark the best value of each group, unless the values of the group cannot be distinguished.

    Groups that contain a value of unknown spread are not ranked, because another value may be the
    best on another machine or with another seed. A value is near the best if their difference does
    not exceed the root of the sum of their squared standard deviations. If repeats are identical or
    missing, the limit is at least 1 % of the best value; for memory, it is always at least 10 %,
    and for times 30 %. If any value is near the best, the best is also marked as near. A value over
    fewer items than another value of its group is not ranked, because a method that rejects
    difficult photos has smaller errors for the remaining photos.

    Args:
        values: values of a column.
        better: which values are better, a key of `BETTER`; metrics with other entries are not
            ranked.
        unit: unit of the values.
    """
    if better not in BETTER:
        return list(values)
    marked = list(values)
    for group in dict.fromkeys(value.group for value in values):
        members = [
            index
            for index, value in enumerate(values)
            if value.group == group and math.isfinite(value.sort)
        ]
        most = max((values[i].n_items for i in members if values[i].n_items > 0), default=0.0)
        for index in [index for index in members if values[index].n_items < most]:
            members.remove(index)
            marked[index] = replace(values[index], mark=Mark.FEWER)
        if not members or any(math.isnan(values[index].spread) for index in members):
            continue
        scores = {index: badness(values[index].sort, better) for index in members}
        best = values[min(members, key=scores.__getitem__)]
        leading = {i for i in members if _are_level(values[i], best, better, unit)}
        if len(leading) == len(members):
            continue
        for index in leading:
            # If several values cannot be distinguished from the best, none is marked as the best.
            mark = Mark.NEAR if len(leading) > 1 else Mark.BEST
            marked[index] = replace(values[index], mark=mark)
    return marked


def _are_level(one: Value, other: Value, better: str, unit: str) -> bool:
    if is_rounding(badness(one.sort, better), badness(other.sort, better)):
        return True
    known = [
        value.spread
        for value in (one, other)
        if math.isfinite(value.spread) and not is_rounding(value.sort, value.sort + value.spread)
    ]
    share = max(cost_share(unit), 0.0 if len(known) == 2 else _LEVEL_SHARE)
    # Signed errors are compared by absolute value.
    own, leading = (abs(v.sort) if better == "lower" else v.sort for v in (one, other))
    return abs(own - leading) <= max(math.hypot(*known), share * abs(leading))


def cost_share(unit: str) -> float:
    """Return the relative scatter of times or memory from run to run; 0 for other units."""
    return _LEVEL_COST_SHARES.get(unit, 0.0)


# Values of `MetricSpec.better` that a method may declare; metrics without one are not ranked.
BETTER: Final = {"lower": "lower is better", "higher": "higher is better", "one": "1 is best"}


def is_flag(unit: str) -> bool:
    """Return whether a unit is that of yes/no metrics, whose values are 1 or 0."""
    return unit == FLAG


def badness(value: float, better: str) -> float:
    """Return a number that is smaller for better values; signed errors count by absolute value.

    Raises:
        ValueError: neither lower nor higher values of the metric are better.
    """
    if better == "lower":
        return abs(value)
    if better == "higher":
        return -value
    if better == "one":
        return abs(math.log(value)) if value > 0 else math.inf
    raise ValueError("a metric without a better direction cannot be ranked")


def middle_of(values: NDArray[np.float64], unit: str) -> float:
    """Return the central value over several datasets; NaN if there are no values.

    This is the median; for yes/no metrics, it is the mean, which is the share of "yes", because the
    median would only be the answer of the majority.
    """
    if not values.size:
        return math.nan
    return float(np.mean(values) if is_flag(unit) else np.median(values))


def spread_of(values: NDArray[np.float64], unit: str) -> float:
    """Return the spread of values over several datasets; NaN if there are no values.

    The spread of yes/no metrics is NaN, because the share of "yes" describes their distribution
    completely.
    """
    return math.nan if is_flag(unit) or not values.size else median_deviation(values)
