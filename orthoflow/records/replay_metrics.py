"""Numbers of a replay beside those that the record states: which differ, and why."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from orthoflow_provenance.document import RecordedCell

from orthoflow.records.comparison import ComparedMetric, Pair, compare_metrics
from orthoflow.records.distances import ProductDistance
from orthoflow.records.runs import Run

MetricVerdict = Literal[
    "same", "rounding", "products", "not in the record", "code changed", "different"
]
# Verdicts that make a replay differ.
DIFFERING: Final = frozenset({"code changed", "different"})


@dataclass(frozen=True, kw_only=True)
class ReplayedMetric:
    """One number that a record states or a replay computed.

    Attributes:
        cell: address of its cell.
        metric: its name.
        recorded: what the record states, None when nothing.
        recorded_unit: in which unit.
        replayed: what the replay computed, None when nothing.
        replayed_unit: in which unit.
        verdict: `same` bits; within `rounding`; moved with `products` of its step that are not the
            same bits, though within their tolerance or not measured; `not in the record`; of a
            step behind which a method's `code changed`; else `different`.
    """

    cell: str
    metric: str
    recorded: float | None
    recorded_unit: str
    replayed: float | None
    replayed_unit: str
    verdict: MetricVerdict


def replayed_metrics(
    original: Run,
    made: Run,
    distances: Sequence[ProductDistance],
    changed_methods: Collection[str] = (),
) -> tuple[ReplayedMetric, ...]:
    """Compare the numbers of a record with those of its replay, times and memory left out.

    Args:
        original: the run that was replayed.
        made: the replay.
        distances: of all their products.
        changed_methods: ids of the methods whose code is not that of the record.
    """
    identical = {f"{item.cell}.{item.port}" for item in distances if item.verdict == "identical"}
    is_changed = {
        address: any(cell.method in changed_methods for cell in original.upstream(address))
        for address in original.cells
    }

    def verdict(pair: Pair[ComparedMetric]) -> MetricVerdict:
        if pair.is_same:
            return "same"
        if pair.left is None:
            return "not in the record"
        if pair.left.is_near(pair.right):
            return "rounding"
        if is_changed[pair.cell]:
            return "code changed"
        return "different" if _is_of_identical(original.cells[pair.cell], identical) else "products"

    return tuple(
        ReplayedMetric(
            cell=pair.cell,
            metric=pair.name,
            recorded=pair.left.value if pair.left else None,
            recorded_unit=pair.left.unit if pair.left else "",
            replayed=pair.right.value if pair.right else None,
            replayed_unit=pair.right.unit if pair.right else "",
            verdict=verdict(pair),
        )
        for pair in compare_metrics(original, made)
    )


def _is_of_identical(cell: RecordedCell, identical: set[str]) -> bool:
    """Whether a step took and gave the same bits in both runs; input files always are the same."""
    taken = {given.source for given in cell.inputs.values()}
    given = {f"{cell.address}.{port}" for port in cell.outputs}
    return all(one in identical or one.startswith("inputs.") for one in taken | given)
