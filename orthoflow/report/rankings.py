"""Best and worst of a column, among values that may be compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

from orthoflow.report.senses import Sense, badness


class Mark(Enum):
    """How a value stands among its like."""

    NONE = ""
    BEST = "best"
    NEAR = "within the spread of the best"
    WORST = "worst"


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
    """

    text: str = ""
    sort: float = math.nan
    spread: float = math.nan
    mark: Mark = Mark.NONE
    group: str = ""
    note: str = ""


def rank(values: Sequence[Value], sense: Sense) -> list[Value]:
    """Mark the best and the worst of each group; a group whose values are all alike has neither.

    A value whose distance from the best is not above both their standard deviations together (in
    quadrature) is marked as near the best and never as worst.
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
        scores = {index: badness(values[index].sort, sense) for index in members}
        if len(set(scores.values())) < 2:
            continue
        best = min(members, key=scores.__getitem__)
        for index in members:
            mark = Mark.NONE
            if scores[index] == scores[best]:
                mark = Mark.BEST
            elif abs(values[index].sort - values[best].sort) <= _spread(
                values[index], values[best]
            ):
                mark = Mark.NEAR
            elif scores[index] == max(scores.values()):
                mark = Mark.WORST
            marked[index] = replace(values[index], mark=mark)
    return marked


def _spread(one: Value, other: Value) -> float:
    known = [value.spread for value in (one, other) if math.isfinite(value.spread)]
    return math.hypot(*known) if known else 0.0
