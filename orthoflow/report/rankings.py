"""Best and worst of a column, among values that may be compared, by what makes a metric good."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from orthoflow.records.runs import is_rounding

# Without repeats of both nobody knows how far values of the same method lie apart, nor where they
# all give one value. What is nearer than this share of the best is no difference then; times and
# memory scatter more, times from run to run by so much (docs/performance.md), whatever their
# repeats in one run say.
_ALIKE_SHARE: Final = 0.01
_ALIKE_COST_SHARES: Final = {"s": 0.3, "MiB": 0.1}
FLAG: Final = "yes/no"


class Mark(Enum):
    """How a value stands among its like."""

    NONE = ""
    BEST = "best"
    NEAR = "among the best, no difference shown"
    WORST = "worst"
    FEWER = "over fewer items, not ranked"


@dataclass(frozen=True, kw_only=True)
class Value:
    """One place of a comparison table.

    Attributes:
        text: the number as printed, empty where there is none.
        sort: the number that the table is sorted by, NaN where there is none.
        spread: standard deviation over repeats, NaN without repeats.
        mark: how it stands among the values of its group.
        group: letters of its environment and data, empty when the table has one of each.
        note: more in words, e.g. how many repeats.
        n_items: items that it sums up, NaN where nobody counts them.
        found_nothing: there is no number though its step was asked for one, by a failure or because
            nothing was found.
    """

    text: str = ""
    sort: float = math.nan
    spread: float = math.nan
    mark: Mark = Mark.NONE
    group: str = ""
    note: str = ""
    n_items: float = math.nan
    found_nothing: bool = False


def rank(values: Sequence[Value], sense: Sense, unit: str = "1") -> list[Value]:
    """Mark the best and the worst of each group; a group whose values are all equal has neither.

    Groups with a value of a single run are not ranked: on another machine, or with another seed,
    another may be the best. A value whose distance from the best is not above both their standard
    deviations together (in quadrature), or where one of them has repeats of one value, not above a
    hundredth of the best (a tenth of a memory, three tenths of a time), or just of rounding, is
    marked as near the best and never as worst; the best is then only among the best, too. The worst
    is marked where every other value is as far from it, and where nobody of its group found
    nothing, which is worse; costs, which a method may just not have, are ranked all the same. What
    sums up fewer items than another of its group is not ranked: who refuses the difficult photos
    has smaller errors of the rest.

    Args:
        values: a column.
        sense: what makes its values good.
        unit: of its values.
    """
    if sense is Sense.NEITHER:
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
        scores = {index: badness(values[index].sort, sense) for index in members}
        best = values[min(members, key=scores.__getitem__)]
        leading = {i for i in members if _are_alike(values[i], best, sense, unit)}
        if len(leading) == len(members):
            continue
        worst = max(members, key=scores.__getitem__)
        is_worst = not (_has_found_nothing(values, group) and cost_share(unit) == 0.0) and not any(
            _are_alike(values[worst], values[i], sense, unit) for i in members if i != worst
        )
        for index in members:
            mark = Mark.NONE
            if index in leading:
                # What several share nobody leads in.
                mark = Mark.NEAR if len(leading) > 1 else Mark.BEST
            elif index == worst and is_worst:
                mark = Mark.WORST
            marked[index] = replace(values[index], mark=mark)
    return marked


def _are_alike(one: Value, other: Value, sense: Sense, unit: str) -> bool:
    """Whether nothing shows that a value differs from a better one."""
    if is_rounding(badness(one.sort, sense), badness(other.sort, sense)):
        return True
    known = [
        value.spread
        for value in (one, other)
        if math.isfinite(value.spread) and not is_rounding(value.sort, value.sort + value.spread)
    ]
    share = max(cost_share(unit), 0.0 if len(known) == 2 else _ALIKE_SHARE)
    # Signed errors count by their size.
    own, better = (abs(v.sort) if sense is Sense.LESS else v.sort for v in (one, other))
    return abs(own - better) <= max(math.hypot(*known), share * abs(better))


def cost_share(unit: str) -> float:
    """Return by what share values scatter from run to run: times and memory do, others do not."""
    return _ALIKE_COST_SHARES.get(unit, 0.0)


def _has_found_nothing(values: Sequence[Value], group: str) -> bool:
    return any(value.found_nothing and value.group == group for value in values)


class Sense(Enum):
    """What makes a value of a metric good."""

    LESS = "less is better"
    MORE = "more is better"
    ONE = "1 is best"
    NEITHER = "neither more nor less is better"


_SENSES: Final = {"lower": Sense.LESS, "higher": Sense.MORE, "one": Sense.ONE}


def sense_of(better: str) -> Sense:
    """Return what makes a value good, from what the method of the metric declares.

    >>> sense_of("lower").name, sense_of("").name
    ('LESS', 'NEITHER')
    """
    # A record may hold anything.
    return _SENSES.get(better, Sense.NEITHER)


def is_flag(unit: str) -> bool:
    """Whether values of a unit are 1 where something is so and 0 where not."""
    return unit == FLAG


def badness(value: float, sense: Sense) -> float:
    """Return a number that is smaller the better the value is; signed errors count by their size.

    Raises:
        ValueError: the metric has no good side.
    """
    if sense is Sense.LESS:
        return abs(value)
    if sense is Sense.MORE:
        return -value
    if sense is Sense.ONE:
        return abs(math.log(value)) if value > 0 else math.inf
    raise ValueError("a metric without a good side cannot be ranked")
