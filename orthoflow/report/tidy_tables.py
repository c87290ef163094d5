"""Numbers of a run as tables for pages, papers and statistics programs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from orthoflow.records.runs import Run
from orthoflow.report.curves import sweeps
from orthoflow.report.paired import MetricOverDatasets
from orthoflow.report.tables import Column, Table
from orthoflow.untrusted_text import Value
from orthoflow.workflow.model import DATA


@dataclass(frozen=True, kw_only=True)
class Varied:
    """What varies in a run.

    Attributes:
        steps: the steps with variants; `data` for datasets.
        methods: step -> variant -> method, of steps that sweep parameters of several methods.
        swept: (step, parameter) -> variant -> value, of parameters that are swept.
    """

    steps: tuple[str, ...]
    methods: Mapping[str, Mapping[str, str]]
    swept: Mapping[tuple[str, str], Mapping[str, float]]

    @classmethod
    def of(cls, run: Run) -> Varied:
        """Look through the cells of a run."""
        swept: dict[tuple[str, str], dict[str, float]] = {}
        for sweep in sweeps(run.record.cells):
            swept.setdefault((sweep.step, sweep.parameter), {}).update(sweep.values)
        steps = dict.fromkeys(step for cell in run.record.cells for step in cell.assignment)
        methods: dict[str, dict[str, str]] = {}
        for cell in run.record.cells:
            if any(cell.step == step for step, _ in swept) and cell.step in cell.assignment:
                methods.setdefault(cell.step, {})[cell.assignment[cell.step]] = cell.method
        several = {step: named for step, named in methods.items() if len({*named.values()}) > 1}
        return cls(steps=tuple(steps), methods=several, swept=swept)

    @property
    def names(self) -> tuple[str, ...]:
        """Name the columns, those of steps as in tables of several runs."""
        return (
            *("dataset" if step == DATA else f"variant.{step}" for step in self.steps),
            *(f"{step}.use" for step in self.methods),
            *(".".join(parameter) for parameter in self.swept),
        )

    def values(self, assignment: Mapping[str, str]) -> tuple[str | float | None, ...]:
        """Return the columns of a cell or combination; None where it has no part in one."""
        variants = (assignment.get(step) for step in self.steps)
        numbers = (values.get(assignment.get(step, "")) for (step, _), values in self.swept.items())
        methods = (named.get(assignment.get(step, "")) for step, named in self.methods.items())
        return (*variants, *methods, *numbers)


_OVER: Final = (
    Column("step", "step", is_numeric=False),
    Column("metric", "metric", is_numeric=False),
    Column("what", "label", is_numeric=False),
    Column("unit", "unit", is_numeric=False),
    Column("good side", "better", is_numeric=False),
    Column("combination", "combination", is_numeric=False),
    Column("datasets", "datasets"),
    Column("failed", "failed"),
    Column("absent", "absent"),
    Column("some repeats", "partly"),
    Column("median", "median"),
    Column("±", "spread", digits=2),
    Column("compared", "pairs"),
    Column("not compared", "apart"),
    Column("better", "wins"),
    Column("worse", "losses"),
    Column("difference", "median_difference", digits=3),
    Column("95 % from", "interval_low", digits=3),
    Column("to", "interval_high", digits=3),
    Column("p", "p", digits=2),
    Column("p (Holm)", "p_holm", digits=2),
    Column("effect", "effect", digits=2),
)


def over_table(over: Sequence[MetricOverDatasets]) -> Table:
    """Return a row per metric and combination of what holds over all datasets.

    Unknown values, such as p for two datasets, are empty.
    """
    rows = []
    for metric in over:
        column = metric.column
        for one in metric.methods:
            paired = one.paired
            differences: tuple[Value, ...] = (None,) * 8
            if paired is not None:
                differences = (
                    *(paired.wins, paired.losses, _known(paired.median)),
                    *map(_known, (*paired.interval, paired.p, paired.p_holm, paired.effect)),
                )
            rows.append(
                (
                    *(column.step, column.metric, column.titled, column.unit, column.better),
                    *(one.name or "all", one.n, one.n_failed, one.n_absent, one.n_partly),
                    *(_known(one.median), _known(one.spread) if one.n > 1 else None),
                    *(None if paired is None else paired.n, one.n_apart, *differences),
                )
            )
    return Table(
        name="datasets",
        caption="Medians over the datasets, median differences from the reference with their 95 % "
        "confidence intervals, and p of Wilcoxon's signed-rank test after Holm's correction.",
        columns=_OVER,
        rows=tuple(rows),
    )


def _known(value: float) -> float | None:
    # No difference where more is better is -0.0.
    return None if math.isnan(value) else value + 0.0
