"""Metrics as rows: one number of one cell, the shape of `metrics.csv`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow_provenance.document import RecordedCell, cost_metrics

from orthoflow.foreign_text import csv_text

# As of fractions in the metadata of products (SPEC 11.3): libraries round their last digits.
_ROUNDING: Final = 1e-6
_UNITLESS: Final = ("1", "yes/no")
_COLUMNS: Final = ("cell", "step", "method", "metric", "value", "unit")


@dataclass(frozen=True, kw_only=True)
class MetricRow:
    """One number of one cell.

    Attributes:
        cell: address of the cell.
        step: name of its step.
        method: method id.
        metric: name, with its unit at the end where it has one.
        value: finite number.
        unit: `mm`, `px`, `s`, ...; `1` for counts and shares.
        label: what its method calls it; empty where it declares nothing.
        better: which values are better, `lower`, `higher` or `one`; empty where none are.
        description: what else to know of it.
        headline: it is one of the numbers that say how good a result is.
        counted_by: metric of the same step that says how many items it sums up.
    """

    cell: str
    step: str
    method: str
    metric: str
    value: float
    unit: str
    label: str = ""
    better: str = ""
    description: str = ""
    headline: bool = False
    counted_by: str = ""

    @property
    def title(self) -> str:
        """Its label; its name where its method declares none."""
        return self.label or self.metric

    @property
    def titled(self) -> str:
        """Its title with the unit; counts, shares and what is yes or no stand alone."""
        return self.title if self.unit in _UNITLESS else f"{self.title} / {self.unit}"


def cell_metrics(cell: RecordedCell) -> tuple[MetricRow, ...]:
    """Give what the method reported and then what the engine measured (time and memory).

    Cells without a result have no rows: their cost is not comparable with that of a result.
    """
    if cell.status != "ok":
        return ()
    return tuple(
        MetricRow(
            cell=cell.address,
            step=cell.step,
            method=cell.method,
            metric=metric.name,
            value=metric.value,
            unit=metric.unit,
            label=metric.label,
            better=metric.better,
            description=metric.description,
            headline=metric.headline,
            counted_by=metric.counted_by,
        )
        for metric in (*cell.metrics, *cost_metrics(cell))
    )


def is_rounding(left: float, right: float) -> bool:
    """Whether two values of a metric are equal or differ by what libraries round.

    By a millionth of the larger one that is, or by a millionth where that is below 1; counts are
    never rounded.

    >>> is_rounding(0.84536087, 0.84536104), is_rounding(1.0, 1.00001), is_rounding(3e7, 3e7 + 1)
    (True, False, False)
    """
    is_counted = all(float(value).is_integer() for value in (left, right))
    return left == right or (
        not is_counted and math.isclose(left, right, rel_tol=_ROUNDING, abs_tol=_ROUNDING)
    )


def write_metrics_csv(path: Path, rows: Iterable[MetricRow]) -> None:
    """Write rows with a header; numbers with every digit that they have."""
    text = csv_text([_COLUMNS, *([getattr(row, name) for name in _COLUMNS] for row in rows)])
    path.write_text(text, encoding="utf-8", newline="")
