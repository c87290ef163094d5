"""Two runs side by side, for the page: what differs, and how far products lie apart."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

from orthoflow.records import RecordedFile
from orthoflow.records.comparison import (
    ComparedMetric,
    Pair,
    ParameterValue,
    ProductDistance,
    RunComparison,
)
from orthoflow.records.comparison import Difference as DifferenceCounts
from orthoflow.report.moved import alike_texts, moved_first, repeats_as_one, without_seeds
from orthoflow.report.numbers import number, number_with_unit

Side = TypeVar("Side")
_DIGEST_LETTERS: Final = 12
_NOTHING: Final = "-"


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One thing that the two runs say differently."""

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
        n_different: of how many of them they say something else.
        rows: those that differ, and those that only one run has; what is said alike is one.
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
    """Everything the page says of two runs.

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
    """State what differs between things, of those of a step once what is said alike."""
    steps = step_of or {}
    counts = DifferenceCounts.of(pairs)
    rows = []
    for one in alike_texts([pair for pair in pairs if not pair.is_same], text, steps):
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
