"""Two runs side by side: what differs, equal differences in one row, and how far apart."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Generic, TypeVar

from orthoflow.records import RecordedFile
from orthoflow.records.compare import (
    CellFacts,
    ComparedMetric,
    Pair,
    ParameterValue,
    ProductDistance,
    RunComparison,
)
from orthoflow.records.compare import Difference as DifferenceCounts
from orthoflow.report.numbers import number, number_with_unit

Side = TypeVar("Side")
_DIGEST_LETTERS: Final = 12
_NOTHING: Final = "-"


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A value that differs between the two runs."""

    cell: str
    name: str
    left: str
    right: str
    change: str = ""


@dataclass(frozen=True, kw_only=True)
class DifferenceTable:
    """What differs of one kind.

    Attributes:
        title: what kind.
        n_compared: how many things both runs have.
        n_different: number of those that differ.
        rows: those that differ, and those that only one run has; equal ones are grouped.
        n_alone: how many things only one run has.
        n_rounded: how many things differ by rounding only; they have no row.
        whose: of which steps they are, if not of all.
    """

    title: str
    n_compared: int
    n_different: int
    rows: tuple[Difference, ...]
    n_alone: int = 0
    n_rounded: int = 0
    whose: str = ""


@dataclass(frozen=True, kw_only=True)
class ProductRow:
    """How far one product of the two runs lies apart."""

    cell: str
    name: str
    verdict: str
    words: str


@dataclass(frozen=True, kw_only=True)
class Differences:
    """All differences of two runs.

    Attributes:
        left: id of the first run.
        right: id of the second.
        workflow: unified diff of the workflow files; empty when equal.
        tables: a table per kind of thing.
        products: a row per product, those that differ first.
    """

    left: str
    right: str
    workflow: str
    tables: tuple[DifferenceTable, ...]
    products: tuple[ProductRow, ...]


def differences(comparison: RunComparison) -> Differences:
    """Put a comparison of two runs into tables of what differs."""
    step_of, of_shared = comparison.step_of, comparison.of_shared_steps
    parameters = comparison.shared(comparison.parameters)
    return Differences(
        left=comparison.left.run_id,
        right=comparison.right.run_id,
        workflow="\n".join(comparison.workflow[2:]),
        tables=(
            _table("Inputs", comparison.inputs, _files_text),
            _table("Options", [comparison.overrides], " ".join),
            _table("Steps", without_seeds(comparison.cells), str, step_of),
            replace(_table("Parameters", parameters, _parameter_text, step_of), whose=of_shared),
            _table("Environment", comparison.environment, str),
            replace(_metric_table(comparison.measured, step_of), whose=of_shared),
        ),
        products=tuple(
            sorted(
                (_product_row(distance) for distance in comparison.products),
                key=lambda row: row.verdict == "identical",
            )
        ),
    )


def _table(
    title: str,
    pairs: Sequence[Pair[Side]],
    text: Callable[[Side], str],
    step_of: Mapping[str, str] | None = None,
) -> DifferenceTable:
    """Return what differs between things, with equal differences of a step grouped."""
    steps = step_of or {}
    counts = DifferenceCounts.of(pairs)
    rows = []
    for one in grouped_texts([pair for pair in pairs if not pair.is_same], text, steps):
        pair = one.pair
        rows.append(
            Difference(
                cell=pair.cell if one.n == 1 else "",
                name=pair.name if one.n == 1 else one.label(steps),
                left=_NOTHING if pair.left is None else text(pair.left),
                right=_NOTHING if pair.right is None else text(pair.right),
            )
        )
    return DifferenceTable(
        title=title,
        n_compared=counts.n_shared,
        n_different=counts.n_different,
        n_alone=counts.n_left + counts.n_right,
        rows=tuple(rows),
    )


def _metric_table(
    measured: Sequence[Pair[ComparedMetric]], step_of: Mapping[str, str]
) -> DifferenceTable:
    """Metrics that differ by more than rounding, how good results are first.

    Time and memory always differ, and stand in the comparison table.
    """
    counts = DifferenceCounts.of(measured)
    moved = [pair for pair in measured if pair.is_moved]
    rows = []
    for one in repeats_as_one(moved_first(moved, step_of)):
        left, right = one.pair.left, one.pair.right
        rows.append(
            Difference(
                cell=one.pair.cell,
                name=one.pair.name + (f", {one.n} repeats" if one.n > 1 else ""),
                left=_NOTHING if left is None else number_with_unit(left.value, left.unit),
                right=_NOTHING if right is None else number_with_unit(right.value, right.unit),
                change="" if left is None or right is None else number(right.value - left.value),
            )
        )
    return DifferenceTable(
        title="Metrics, time and memory left aside",
        n_compared=counts.n_shared,
        n_different=counts.n_different,
        n_alone=counts.n_left + counts.n_right,
        n_rounded=counts.n_rounded,
        rows=tuple(rows),
    )


def _product_row(distance: ProductDistance) -> ProductRow:
    apart = [
        f"{number(part.largest)} {part.unit} at most in {part.field}"
        if part.largest is not None
        else f"{part.field} cannot be subtracted"
        for part in distance.distances
    ]
    return ProductRow(
        cell=distance.cell,
        name=f"{distance.port} ({distance.type_name})",
        verdict=distance.verdict,
        words="; ".join([*apart, distance.reason] if distance.reason else apart),
    )


def _files_text(files: Sequence[RecordedFile]) -> str:
    named = [f"{file.name} {file.sha256[:_DIGEST_LETTERS]}" for file in files]
    return ", ".join(named) or "not given"


def _parameter_text(parameter: ParameterValue) -> str:
    text = json.dumps(parameter.value, ensure_ascii=False)
    return f"{text} (set)" if parameter.is_set else text


# --- equal rows as one, headline numbers first ---


@dataclass(frozen=True, kw_only=True)
class RowGroup(Generic[Side]):
    """Equal rows.

    Attributes:
        pair: the first of them.
        n: how many there are.
    """

    pair: Pair[Side]
    n: int

    def label(self, step_of: Mapping[str, str]) -> str:
        """Name what they are of: a cell, or else a step and how many cells of it.

        >>> rows = [Pair(cell=f"wall@{name}", name="cell_m", left=1, right=2) for name in "ab"]
        >>> [row] = grouped_rows(rows, key=lambda pair: pair.name)
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


def grouped_rows(
    pairs: Iterable[Pair[Side]], key: Callable[[Pair[Side]], Hashable]
) -> list[RowGroup[Side]]:
    """Put pairs together whose keys are equal, in the order of the first ones."""
    first: dict[Hashable, Pair[Side]] = {}
    counts: Counter[Hashable] = Counter()
    for pair in pairs:
        text = key(pair)
        first.setdefault(text, pair)
        counts[text] += 1
    return [RowGroup(pair=pair, n=counts[text]) for text, pair in first.items()]


def grouped_texts(
    pairs: Iterable[Pair[Side]], text: Callable[[Side], str], step_of: Mapping[str, str]
) -> list[RowGroup[Side]]:
    """Group pairs with equal texts for one step."""

    def key(pair: Pair[Side]) -> Hashable:
        sides = (None if side is None else text(side) for side in (pair.left, pair.right))
        return (step_of.get(pair.cell, pair.cell), pair.name, *sides)

    return grouped_rows(pairs, key)


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

    First headline numbers, then others with a good side, then the rest, rounding
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
) -> list[RowGroup[ComparedMetric]]:
    """Put repeats of a cell together in which a metric has the same values."""

    def key(pair: Pair[ComparedMetric]) -> Hashable:
        sides = (side and (side.value, side.unit) for side in (pair.left, pair.right))
        return (pair.cell.partition("#")[0], pair.name, *sides)

    return grouped_rows(pairs, key)


def metric_label(row: RowGroup[ComparedMetric]) -> str:
    """Name a metric and its cell, with the number of repeats."""
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
