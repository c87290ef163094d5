"""Numbers as pages print them, and the best values of a column."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from orthoflow.records.runs import is_rounding

_DIGITS_MOST: Final = 6  # of a mean beside its spread
_DIGITS_FEW: Final = 4


def number(value: float, *, significant: int = 4) -> str:
    """Print a number with four significant digits, without an exponent where one can.

    >>> number(0.0123456), number(1234567.0), number(12.0), number(0.14151, significant=2)
    ('0.01235', '1234567', '12', '0.14')
    """
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    digits = max(0, significant - 1 - math.floor(math.log10(abs(value))))
    if digits >= 10:
        return f"{value:.3g}"
    printed = f"{value:.{digits}f}"
    # Zeros before the point count.
    return printed.rstrip("0").rstrip(".") if digits else printed


def number_with_unit(value: float, unit: str, *, significant: int = 4) -> str:
    """Print a number and its unit; shares and counts (unit 1) stand alone.

    >>> number_with_unit(2.5, "mm"), number_with_unit(1.0, "yes/no"), number_with_unit(0.4, "1")
    ('2.5 mm', 'yes', '0.4')
    """
    if unit == "yes/no" and value in (0.0, 1.0):
        return "yes" if value else "no"
    printed = number(value, significant=significant)
    return printed if unit == "1" else f"{printed} {unit}"


def number_with_spread(value: float, spread: float) -> str:
    """Print a mean and its standard deviation, to the latter's second digit where that is sane.

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
    """Print a time.

    >>> seconds_in_words(0.042), seconds_in_words(12.34), seconds_in_words(125.0)
    ('0.04 s', '12.3 s', '2 min 05 s')
    """
    if seconds < 10:
        return f"{seconds:.2f} s"
    if seconds < 60:
        return f"{seconds:.1f} s"
    return "{} min {:02d} s".format(*divmod(round(seconds), 60))


# Without repeats of both nobody knows how far values of the same method lie apart, nor where they
# all give one value. What is nearer than this share of the best is no difference then; times and
# memory scatter more, times from run to run by so much (docs/performance.md), whatever their
# repeats in one run suggest.
_LEVEL_SHARE: Final = 0.01
_LEVEL_COST_SHARES: Final = {"s": 0.3, "MiB": 0.1}
FLAG: Final = "yes/no"


class Mark(Enum):
    """How a value stands among those that it may be compared with."""

    NONE = ""
    BEST = "best"
    NEAR = "among the best, no difference shown"
    FEWER = "over fewer items, not ranked"


@dataclass(frozen=True, kw_only=True)
class Value:
    """One place of a comparison table.

    Attributes:
        text: the number as printed, empty where there is none.
        sort: the number that the table is sorted by, NaN where there is none.
        spread: standard deviation over repeats, NaN without repeats.
        mark: how it stands among the values of its group.
        group: letter of its environment and data, empty when the table has one of each.
        note: more in words, e.g. how many repeats.
        n_items: items that it sums up, NaN where nobody counts them.
    """

    text: str = ""
    sort: float = math.nan
    spread: float = math.nan
    mark: Mark = Mark.NONE
    group: str = ""
    note: str = ""
    n_items: float = math.nan


def rank(values: Sequence[Value], better: str, unit: str = "1") -> list[Value]:
    """Mark the best of each group; a group whose values are all level has none.

    Groups with a value of a single run are not ranked: on another machine, or with another seed,
    another may be the best. A value whose distance from the best is not above both their standard
    deviations together (in quadrature), or where one of them has repeats of one value, not above a
    hundredth of the best (a tenth of a memory, three tenths of a time), or just of rounding, is
    marked as near the best; the best is then only among the best, too. What sums up fewer items
    than another of its group is not ranked: a method that refuses difficult photos has smaller
    errors of the rest.

    Args:
        values: a column.
        better: which of its values are, a key of `BETTER`; those of others are not ranked.
        unit: of its values.
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
            # What several share nobody leads in.
            mark = Mark.NEAR if len(leading) > 1 else Mark.BEST
            marked[index] = replace(values[index], mark=mark)
    return marked


def _are_level(one: Value, other: Value, better: str, unit: str) -> bool:
    """Whether nothing shows that a value differs from a better one."""
    if is_rounding(badness(one.sort, better), badness(other.sort, better)):
        return True
    known = [
        value.spread
        for value in (one, other)
        if math.isfinite(value.spread) and not is_rounding(value.sort, value.sort + value.spread)
    ]
    share = max(cost_share(unit), 0.0 if len(known) == 2 else _LEVEL_SHARE)
    # Signed errors count by their size.
    own, leading = (abs(v.sort) if better == "lower" else v.sort for v in (one, other))
    return abs(own - leading) <= max(math.hypot(*known), share * abs(leading))


def cost_share(unit: str) -> float:
    """Return by what share values scatter from run to run: times and memory do, others do not."""
    return _LEVEL_COST_SHARES.get(unit, 0.0)


# What a method declares of a metric (`MetricSpec.better`), in words; others are not judged.
BETTER: Final = {"lower": "less is better", "higher": "more is better", "one": "1 is best"}


def is_flag(unit: str) -> bool:
    """Whether values of a unit are 1 where something is so and 0 where not."""
    return unit == FLAG


def badness(value: float, better: str) -> float:
    """Return a number that is smaller the better the value is; signed errors count by their size.

    Raises:
        ValueError: the metric has no good side.
    """
    if better == "lower":
        return abs(value)
    if better == "higher":
        return -value
    if better == "one":
        return abs(math.log(value)) if value > 0 else math.inf
    raise ValueError("a metric without a good side cannot be ranked")
