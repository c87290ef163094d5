"""Rows that say in what two runs differ: what is alike is one, how good results are is first."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from orthoflow.records.comparison import CellFacts, ComparedMetric, Pair

Side = TypeVar("Side")


@dataclass(frozen=True, kw_only=True)
class Alike(Generic[Side]):
    """Rows that say the same.

    Attributes:
        pair: the first of them.
        n: how many there are.
    """

    pair: Pair[Side]
    n: int

    def label(self, step_of: Mapping[str, str]) -> str:
        """Name what they are of: a cell, or else a step and how many cells of it.

        >>> rows = [Pair(cell=f"wall@{name}", name="cell_m", left=1, right=2) for name in "ab"]
        >>> [row] = alike_rows(rows, key=lambda pair: pair.name)
        >>> row.label({"wall@a": "wall"})
        'wall.cell_m, 2 steps'
        """
        cell, name = self.pair.cell, self.pair.name
        if self.n == 1:
            return ".".join(part for part in (cell, name) if part)
        step = step_of.get(cell, cell)
        # A row of a step itself has its name.
        what = ".".join(dict.fromkeys(part for part in (step, name) if part))
        return f"{what}, {self.n} steps"


def alike_rows(
    pairs: Iterable[Pair[Side]], key: Callable[[Pair[Side]], Hashable]
) -> list[Alike[Side]]:
    """Put pairs together whose keys are equal, in the order of the first ones."""
    first: dict[Hashable, Pair[Side]] = {}
    counts: Counter[Hashable] = Counter()
    for pair in pairs:
        told = key(pair)
        first.setdefault(told, pair)
        counts[told] += 1
    return [Alike(pair=pair, n=counts[told]) for told, pair in first.items()]


def alike_texts(
    pairs: Iterable[Pair[Side]], text: Callable[[Side], str], step_of: Mapping[str, str]
) -> list[Alike[Side]]:
    """Put pairs together that say the same of one step."""

    def key(pair: Pair[Side]) -> Hashable:
        sides = (None if side is None else text(side) for side in (pair.left, pair.right))
        return (step_of.get(pair.cell, pair.cell), pair.name, *sides)

    return alike_rows(pairs, key)


def without_seeds(cells: Iterable[Pair[CellFacts]]) -> list[Pair[CellFacts]]:
    """Leave out the seeds of steps that one run alone has: nothing is compared with them."""
    return [
        cell
        if cell.is_shared
        else replace(
            cell,
            left=cell.left and replace(cell.left, seed=None),
            right=cell.right and replace(cell.right, seed=None),
        )
        for cell in cells
    ]


def moved_first(
    pairs: Sequence[Pair[ComparedMetric]], step_of: Mapping[str, str]
) -> list[Pair[ComparedMetric]]:
    """Put metrics in the order in which a reader asks for them.

    First those that say how good results are, then others with a good side, then the rest, rounding
    last. Of each metric of a step the largest relative change comes first, and its next one behind
    the first of all others: many rooms do not push a metric out of sight.
    """
    places = {step: place for place, step in enumerate(dict.fromkeys(step_of.values()))}
    turns: Counter[tuple[str, str]] = Counter()
    placed = []
    for pair in sorted(pairs, key=lambda pair: -_relative_change(pair)):
        step = step_of.get(pair.cell, pair.cell)
        facts = pair.right or pair.left
        group = 2 if facts is None else 0 if facts.headline else 1 if facts.better else 2
        turn = turns[step, pair.name]
        turns[step, pair.name] += 1
        # A later step takes further what an earlier one has begun, as orientations do.
        later = -places.get(step, 0) if group == 0 else 0
        placed.append(((pair.is_rounded, group, turn, later), pair))
    return [pair for _, pair in sorted(placed, key=lambda one: one[0])]


def repeats_as_one(
    pairs: Iterable[Pair[ComparedMetric]],
) -> list[Alike[ComparedMetric]]:
    """Put repeats of a cell together in which a metric has the same values."""

    def key(pair: Pair[ComparedMetric]) -> Hashable:
        sides = (side and (side.value, side.unit) for side in (pair.left, pair.right))
        return (pair.cell.partition("#")[0], pair.name, *sides)

    return alike_rows(pairs, key)


def metric_label(row: Alike[ComparedMetric]) -> str:
    """Name a metric and its cell, and say of how many repeats."""
    repeats = f", {row.n} repeats" if row.n > 1 else ""
    return f"{row.pair.cell}.{row.pair.name}{repeats}"


def _relative_change(pair: Pair[ComparedMetric]) -> float:
    """How far a value moved, as a share of the larger one; 0 where there is one only."""
    left, right = pair.left, pair.right
    if left is None or right is None or left.value == right.value:
        return 0.0
    change = abs(right.value - left.value) / max(abs(left.value), abs(right.value))
    # What was a number and is none has moved most.
    return math.inf if math.isnan(change) else change
