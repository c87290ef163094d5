"""Numbers for statistics programs: a column per step that varies, and per parameter of a sweep."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from orthoflow.records import RecordedCell
from orthoflow.records.runs import Run, cell_metrics, parts_of
from orthoflow.report.combinations import Combination, combinations_of
from orthoflow.report.curves import sweeps
from orthoflow.report.paired import over_datasets
from orthoflow.untrusted_text import Value


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

    def names(self, taken: Collection[str]) -> tuple[str, ...]:
        """Name the columns: steps, with a `=` where a column is called so; parameters in full."""
        steps = (f"{step}=" if step in taken else step for step in self.steps)
        methods = (f"{step}.use" for step in self.methods)
        return (*steps, *methods, *(".".join(parameter) for parameter in self.swept))

    def values(self, assignment: Mapping[str, str]) -> tuple[str | float | None, ...]:
        """Return the columns of a cell or combination; None where it has no part in one."""
        variants = (assignment.get(step) for step in self.steps)
        numbers = (values.get(assignment.get(step, "")) for (step, _), values in self.swept.items())
        methods = (named.get(assignment.get(step, "")) for step, named in self.methods.items())
        return (*variants, *methods, *numbers)


def combination_rows(run: Run) -> Iterator[Sequence[Value]]:
    """Return a header, then a row per combination and repeat with every number of its cells.

    What is not repeated stands in the row of the first repeat only.
    """
    varied = Varied.of(run)
    fixed = ("repeat", "status")
    metrics = dict.fromkeys(
        (row.step, row.metric) for cell in run.record.cells for row in cell_metrics(cell)
    )
    yield (*varied.names(fixed), *fixed, *(".".join(metric) for metric in metrics))
    for one in combinations_of(run):
        for repeat in sorted({cell.repeat for cell in one.cells}):
            cells = [cell for cell in one.cells if cell.repeat == repeat]
            found = {
                (row.step, row.metric): row.value for cell in cells for row in cell_metrics(cell)
            }
            status = _status(one, cells)
            values = (found.get(metric) for metric in metrics)
            yield (*varied.values(one.assignment), repeat, status, *values)


def dataset_rows(run: Run) -> Iterator[Sequence[Value]]:
    """Return a header, then a row per metric and combination of what holds over all datasets.

    Unknown values, such as p for two datasets, are empty cells.
    """
    yield (
        *("step", "metric", "combination", "against", "datasets", "failed", "absent"),
        *(
            "partly",
            "median",
            "spread",
            "pairs",
            "better",
            "worse",
            "median_difference",
            "p",
            "p_holm",
            "interval_low",
            "interval_high",
            "effect",
        ),
        "deciding",
    )
    for metric in over_datasets(parts_of(run)):
        for one in metric.methods:
            paired = one.paired
            yield (
                *(metric.column.step, metric.column.metric, one.name, one.against),
                *(one.n, len(one.failed), one.n_absent, ", ".join(one.partly)),
                *map(_known, (one.median, one.spread if one.n > 1 else math.nan)),
                *(
                    ("",) * 10
                    if paired is None
                    else (
                        *(paired.n, paired.wins, paired.losses, _known(paired.median)),
                        *map(_known, (paired.p, paired.p_holm, *paired.interval, paired.effect)),
                        " ".join(paired.deciding),
                    )
                ),
            )


def _known(value: float) -> float | None:
    # No difference where more is better is -0.0.
    return None if math.isnan(value) else value + 0.0


def _status(one: Combination, cells: Sequence[RecordedCell]) -> str:
    if any(cell.status == "failed" for cell in cells):
        return "failed"
    return "not computed" if one.missing else "ok"
