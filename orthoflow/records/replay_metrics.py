"""Numbers of a replay beside those that the record states: which differ, and what excuses it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from orthoflow_provenance.document import RecordedCell

from orthoflow.records.comparison import compare_metrics
from orthoflow.records.distances import ProductDistance
from orthoflow.records.runs import Run

MetricVerdict = Literal["same", "excused", "different"]


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
        verdict: `same` bits; else `excused` by rounding, by products of its step that are not the
            same bits either, or by a record that does not state it; else `different`.
    """

    cell: str
    metric: str
    recorded: float | None
    recorded_unit: str
    replayed: float | None
    replayed_unit: str
    verdict: MetricVerdict


def replayed_metrics(
    original: Run, made: Run, distances: Sequence[ProductDistance]
) -> tuple[ReplayedMetric, ...]:
    """Compare the numbers of a record with those of its replay, times and memory left out.

    Args:
        original: the run that was replayed.
        made: the replay.
        distances: of all their products.
    """
    identical = {f"{item.cell}.{item.port}" for item in distances if item.verdict == "identical"}
    found = []
    for pair in compare_metrics(original, made):
        is_excused = (
            pair.left is None
            or pair.left.is_near(pair.right)
            or not _is_of_identical(original.cells[pair.cell], identical)
        )
        verdict: MetricVerdict = (
            "same" if pair.is_same else "excused" if is_excused else "different"
        )
        found.append(
            ReplayedMetric(
                cell=pair.cell,
                metric=pair.name,
                recorded=pair.left.value if pair.left else None,
                recorded_unit=pair.left.unit if pair.left else "",
                replayed=pair.right.value if pair.right else None,
                replayed_unit=pair.right.unit if pair.right else "",
                verdict=verdict,
            )
        )
    return tuple(found)


def _is_of_identical(cell: RecordedCell, identical: set[str]) -> bool:
    """Whether a step took and gave the same bits in both runs; input files always are the same."""
    taken = {given.source for given in cell.inputs.values()}
    given = {f"{cell.address}.{port}" for port in cell.outputs}
    return all(one in identical or one.startswith("inputs.") for one in taken | given)
