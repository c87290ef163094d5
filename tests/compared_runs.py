"""Two runs side by side, for the tests of what says in what they differ."""

from __future__ import annotations

from dataclasses import replace

from orthoflow.records.compare import CellFacts, ComparedMetric, Pair, ParameterValue, RunComparison
from tests.report_runs import distance, record


def number(value: float, *, is_cost: bool = False, unit: str = "mm") -> ComparedMetric:
    return ComparedMetric(
        value=value, unit=unit, is_cost=is_cost, is_cached=False, environment="here"
    )


def compared(*metrics: Pair[ComparedMetric], alone: tuple[str, ...] = ()) -> RunComparison:
    """Two runs of the cells of these numbers, some of which only the first has."""
    empty = record([])
    facts = CellFacts(
        status="ok", method="a.b", distribution="d 1", result_version=1, determinism="exact",
        seed=None, code={}, tools={}, error="",
    )  # fmt: skip
    cells = tuple(
        Pair(cell=cell, name="facts", left=facts, right=None if cell in alone else facts)
        for cell in dict.fromkeys(row.cell for row in metrics)
    )
    return RunComparison(
        left=empty,
        right=replace(empty, run_id="r2"),
        workflow=(),
        overrides=Pair(name="overrides", left=(), right=()),
        inputs=(Pair(name="scan", left=(), right=None),),
        cells=cells,
        parameters=(
            Pair(
                cell=metrics[0].cell,
                name="a",
                left=ParameterValue(value=1, is_set=True),
                right=ParameterValue(value=2, is_set=True),
            ),
            Pair(
                cell=metrics[0].cell,
                name="b",
                left=ParameterValue(value=1, is_set=True),
                right=ParameterValue(value=1, is_set=True),
            ),
        ),
        environment=(),
        metrics=metrics,
        products=(
            distance("planes", "different"),
            distance("walls", "not measured"),
            distance("cloud", "identical"),
        ),
    )
