"""Tables of the differences between two runs; equal differences are grouped into one row."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from orthoflow.records import RecordedFile
from orthoflow.records.compare import (
    ComparedMetric,
    Pair,
    ParameterValue,
    RunComparison,
)
from orthoflow.report.rankings import number, number_with_unit

Side = TypeVar("Side")
_DIGEST_LETTERS: Final = 12
_NOTHING: Final = "-"


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A value that differs between two runs."""

    cell: str
    name: str
    left: str
    right: str
    change: str = ""


@dataclass(frozen=True, kw_only=True)
class DifferenceTable:
    """Table of the differences of one kind, such as parameters.

    Attributes:
        title: name of the kind.
        n_compared: number of values that are present in both runs.
        n_different: number of compared values that differ.
        rows: values that differ or are present in only one run; equal rows are grouped.
        n_alone: number of values that are present in only one run.
        n_rounded: number of values that differ only by rounding and have no row.
        whose: phrase for the steps to which the table is restricted; empty if it contains all
            steps.
    """

    title: str
    n_compared: int
    n_different: int
    rows: tuple[Difference, ...]
    n_alone: int = 0
    n_rounded: int = 0
    whose: str = ""


def differences(comparison: RunComparison) -> tuple[DifferenceTable, ...]:
    """Return a table of differences for each kind of value in a comparison of two runs."""
    step_of, of_shared = comparison.step_of, comparison.of_shared_steps
    parameters = comparison.shared(comparison.parameters)
    moved = moved_first([pair for pair in comparison.measured if pair.is_moved], step_of)
    return (
        _table("Inputs", comparison.inputs, _files_text),
        _table("Options", [comparison.overrides], " ".join),
        _table("Steps", comparison.cells, str, step_of),
        _table("Parameters", parameters, _parameter_text, step_of, whose=of_shared),
        _table("Environment", comparison.environment, str),
        # Time and memory are omitted, because they always differ and are shown in the comparison
        # table.
        _table(
            "Metrics, without time and memory",
            comparison.measured,
            lambda metric: number_with_unit(metric.value, metric.unit),
            step_of,
            different=moved,
            change=_change,
            whose=f"{of_shared}{comparison.first_walls}",
        ),
    )


def _table(
    title: str,
    pairs: Sequence[Pair[Side]],
    text: Callable[[Side], str],
    step_of: Mapping[str, str] | None = None,
    *,
    different: Sequence[Pair[Side]] | None = None,
    change: Callable[[Pair[Side]], str] = lambda _pair: "",
    whose: str = "",
) -> DifferenceTable:
    """Return the table for one kind of difference; equal differences of a step are grouped.

    Args:
        title: name of the kind.
        pairs: all values of both runs.
        text: function that formats the value of one run.
        step_of: address of a cell -> step.
        different: pairs to list, in order; None for all pairs that differ.
        change: function that describes the change between the runs.
        whose: phrase for the steps to which the table is restricted; empty if it contains all
            steps.
    """
    steps = step_of or {}
    shared = [pair for pair in pairs if pair.is_shared]
    if different is None:
        different = [pair for pair in pairs if not pair.is_same]
    return DifferenceTable(
        title=title,
        n_compared=len(shared),
        n_different=sum(pair.is_moved for pair in shared),
        n_alone=sum((pair.left is None) != (pair.right is None) for pair in pairs),
        n_rounded=sum(pair.is_rounded for pair in shared),
        whose=whose,
        rows=tuple(
            Difference(
                cell=one.pair.cell if one.n == 1 else "",
                name=one.pair.name if one.n == 1 else one.label(steps),
                left=_NOTHING if one.pair.left is None else text(one.pair.left),
                right=_NOTHING if one.pair.right is None else text(one.pair.right),
                change=change(one.pair),
            )
            for one in grouped_rows(different, text, steps)
        ),
    )


def _change(pair: Pair[ComparedMetric]) -> str:
    left, right = pair.left, pair.right
    return "" if left is None or right is None else number(right.value - left.value)


def _files_text(files: Sequence[RecordedFile]) -> str:
    named = [f"{file.name} {file.sha256[:_DIGEST_LETTERS]}" for file in files]
    return ", ".join(named) or "not given"


def _parameter_text(parameter: ParameterValue) -> str:
    text = json.dumps(parameter.value, ensure_ascii=False)
    return f"{text} (set)" if parameter.is_set else text


@dataclass(frozen=True, kw_only=True)
class RowGroup(Generic[Side]):
    """Rows that are equal apart from their cells.

    Attributes:
        pair: values of the first row.
        n: number of equal rows.
    """

    pair: Pair[Side]
    n: int

    def label(self, step_of: Mapping[str, str]) -> str:
        """Return the label of the row: the cell, or the step and the number of equal rows.

        >>> steps = {"wall@a": "wall", "wall@b": "wall"}
        >>> rows = [Pair(cell=cell, name="cell_m", left=1, right=2) for cell in steps]
        >>> [row] = grouped_rows(rows, str, steps)
        >>> row.label(steps)
        'wall.cell_m, 2 steps'
        """
        cell, name = self.pair.cell, self.pair.name
        if self.n == 1:
            return ".".join(part for part in (cell, name) if part)
        step = step_of.get(cell, cell)
        # In a row about the whole step, `name` is the name of the step or empty.
        what = ".".join(dict.fromkeys(part for part in (step, name) if part))
        return f"{what}, {self.n} steps"


def grouped_rows(
    pairs: Iterable[Pair[Side]], text: Callable[[Side], str], step_of: Mapping[str, str]
) -> list[RowGroup[Side]]:
    """Group pairs that have the same step, name and texts, in the order of first occurrence."""
    found: dict[Hashable, list[Pair[Side]]] = {}
    for pair in pairs:
        sides = (None if side is None else text(side) for side in (pair.left, pair.right))
        key = (step_of.get(pair.cell, pair.cell), pair.name, *sides)
        found.setdefault(key, []).append(pair)
    return [RowGroup(pair=same[0], n=len(same)) for same in found.values()]


def moved_first(
    pairs: Sequence[Pair[ComparedMetric]], step_of: Mapping[str, str]
) -> list[Pair[ComparedMetric]]:
    """Sort pairs: headline metrics first, then other ranked metrics, then unranked metrics.

    Within each of these groups, the largest relative change comes first. Differences by rounding
    come last.
    """
    places = {step: place for place, step in enumerate(dict.fromkeys(step_of.values()))}

    def key(pair: Pair[ComparedMetric]) -> tuple[bool, int, float, int]:
        facts = pair.right or pair.left
        group = 2 if facts is None else 0 if facts.headline else 1 if facts.better else 2
        # Later steps come first, because they refine the results of earlier steps; an example is a
        # second orientation.
        later = -places.get(step_of.get(pair.cell, pair.cell), 0)
        return pair.is_rounded, group, -_relative_change(pair), later

    return sorted(pairs, key=key)


def _relative_change(pair: Pair[ComparedMetric]) -> float:
    """Return the change relative to the larger absolute value; 0 if only one run has a value."""
    left, right = pair.left, pair.right
    if left is None or right is None or left.value == right.value:
        return 0.0
    change = abs(right.value - left.value) / max(abs(left.value), abs(right.value))
    # A change between a number and NaN counts as the largest.
    return math.inf if math.isnan(change) else change
