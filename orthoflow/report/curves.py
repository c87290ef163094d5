"""What a parameter does: metrics over the values that it was given, as drawings for the page."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final, NamedTuple

import numpy as np

from orthoflow.records import RecordedCell
from orthoflow.records.runs import MetricRow, Run, parts_of
from orthoflow.report.charts import ChartFormat, ChartPoint, as_image, line_chart
from orthoflow.report.combinations import Combination, combinations_of
from orthoflow.report.comparisons import comparison_columns
from orthoflow.report.paired import middle_of, spread_of
from orthoflow.report.pictures import Picture
from orthoflow.report.rankings import BETTER, is_flag
from orthoflow.workflow.expand import variants_text
from orthoflow.workflow.model import DATA

_MOST_CURVES: Final = 12
_LONGEST_NAME: Final = 120
_MOST_LINES: Final = 6
# An untrusted record may have any number; differences of larger ones are meaningless.
_LARGEST: Final = 1e100
_FEWEST_VALUES: Final = 2


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One metric over one parameter.

    Attributes:
        name: the metric and the parameter by the names of their steps and themselves.
        title: the metric, its step and the parameter, in words.
        caption: what the points and bars are, in words.
        lines: name -> points.
        below: label of the axis of the parameter.
        beside: label of the axis of the metric, with its unit.
        bounds: that the metric cannot lie beyond.
    """

    name: str
    title: str
    caption: str
    lines: Mapping[str, Sequence[ChartPoint]]
    below: str
    beside: str
    bounds: tuple[float, float] = (-math.inf, math.inf)

    @property
    def picture(self) -> Picture:
        """The drawing as a picture of a page."""
        return Picture(uri=as_image(self.file("svg")), title=self.title, caption=self.caption)

    def file(self, suffix: ChartFormat) -> bytes:
        """The drawing as a file."""
        return line_chart(
            self.lines, below=self.below, beside=self.beside, bounds=self.bounds, suffix=suffix
        )


def curve_files(run: Run, suffix: ChartFormat = "svg") -> dict[str, bytes]:
    """Return the drawings of a run, over its datasets where it has several, as files by name."""
    parts = parts_of(run)
    drawn = curves([*parts.values()] if len(parts) > 1 else [run])
    # What a record calls its steps and metrics may be no name of a file.
    names = (re.sub(r"[^\w.-]", "_", curve.name)[:_LONGEST_NAME] for curve in drawn)
    return {
        f"{index:02d}_{name}.{suffix}": curve.file(suffix)
        for index, (name, curve) in enumerate(zip(names, drawn, strict=True), start=1)
    }


def curves(parts: Sequence[Run]) -> tuple[Curve, ...]:
    """Draw the metrics of a comparison over every parameter in which variants differ alone.

    A sweep is known by what was run, not by how the workflow was written: variants of a step that
    call one method and differ in one number.

    Args:
        parts: the run, or its datasets, of which medians are drawn and how far they lie apart.
    """
    return tuple(islice(_curves(parts), _MOST_CURVES))


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Variants of a step that differ in a number, and perhaps in other parameters.

    Attributes:
        step: name of the step.
        method: what its variants call, `plane.ransac`.
        parameter: name of the parameter.
        values: variant -> value.
        others: variant -> what else is set to differ, in words.
    """

    step: str
    method: str
    parameter: str
    values: Mapping[str, float]
    others: Mapping[str, str]


def sweeps(cells: Sequence[RecordedCell]) -> Iterator[Sweep]:
    """Find the sweeps among cells: some variants differ in one number alone."""
    by_method: dict[tuple[str, str], dict[str, RecordedCell]] = {}
    for cell in cells:
        variant = cell.assignment.get(cell.step)
        if variant is not None and cell.repeat == 0 and cell.status != "skipped":
            by_method.setdefault((cell.step, cell.method), {}).setdefault(variant, cell)
    for (step, method), variants in by_method.items():
        # What nobody set a method may have from what was set: a default that gives way to a value.
        names = sorted({name for cell in variants.values() for name in cell.params_set})
        differ = [
            name
            for name in names
            if len({repr(cell.params.get(name)) for cell in variants.values()}) > 1
        ]
        for parameter in differ:
            values = {variant: cell.params.get(parameter) for variant, cell in variants.items()}
            known = {
                variant: float(value)
                for variant, value in values.items()
                if isinstance(value, int | float)
                and not isinstance(value, bool)
                and abs(value) < _LARGEST
            }
            others = {
                variant: ", ".join(
                    f"{name}={variants[variant].params.get(name)}"
                    for name in differ
                    if name != parameter
                )
                for variant in known
            }
            if max(Counter(others.values()).values(), default=0) >= _FEWEST_VALUES:
                yield Sweep(
                    step=step, method=method, parameter=parameter, values=known, others=others
                )


class _Value(NamedTuple):
    """What one combination measured, and in how many repeats."""

    value: float
    spread: float
    is_baseline: bool
    dataset: str


# Value of the parameter -> what combinations measured there.
_Line = dict[float, list[_Value]]


def _curves(parts: Sequence[Run]) -> Iterator[Curve]:
    combinations = [one for part in parts for one in combinations_of(part)]
    cells = [cell for part in parts for cell in part.record.cells]
    # What several methods sweep is one drawing: axes of their own would hide which is better.
    swept: dict[tuple[str, str], list[Sweep]] = {}
    for sweep in sweeps(cells):
        swept.setdefault((sweep.step, sweep.parameter), []).append(sweep)
    columns = comparison_columns(combinations)
    for column in sorted(columns, key=lambda one: not one.headline):
        for (step, parameter), group in swept.items():
            # A parameter over itself is meaningless.
            is_behind = any(cell.step == column.step and step in cell.assignment for cell in cells)
            if (column.step, column.metric) == (step, parameter) or not is_behind:
                continue
            lines = {
                ", ".join(filter(None, [sweep.method if len(group) > 1 else "", name])): line
                for sweep in group
                for name, line in _lines(combinations, sweep, column).items()
            }
            first = dict([one for one in lines.items() if one[1]][:_MOST_LINES])
            if any(len(line) >= _FEWEST_VALUES for line in first.values()):
                yield _curve(f"{step}.{parameter}", column, first, len(parts))


def _lines(
    combinations: Sequence[Combination], sweep: Sweep, column: MetricRow
) -> dict[str, _Line]:
    """One line per combination of the other variants, over the datasets that all its points have.

    The hard datasets are often those that a value fails on: without them it would look better.
    """
    lines: dict[str, _Line] = {}
    for one in combinations:
        variant = one.assignment.get(sweep.step, "")
        measured = one.measured(column.step, column.metric)
        if variant not in sweep.values or measured is None or one.failure is not None:
            continue
        if abs(measured.value) < _LARGEST:
            others = {k: v for k, v in one.assignment.items() if k not in (sweep.step, DATA)}
            name = ", ".join(filter(None, [sweep.others[variant], variants_text(others)]))
            dataset = one.assignment.get(DATA, "")
            value = _Value(measured.value, measured.spread, one.is_baseline, dataset)
            lines.setdefault(name, {}).setdefault(sweep.values[variant], []).append(value)
    for name, line in lines.items():
        shared = set.intersection(*({one.dataset for one in found} for found in line.values()))
        lines[name] = {
            x: [one for one in line[x] if one.dataset in shared] for x in sorted(line) if shared
        }
    return lines


def _curve(parameter: str, column: MetricRow, lines: Mapping[str, _Line], n_datasets: int) -> Curve:
    drawn = {
        name: [_point(x, found, column, is_over=n_datasets > 1) for x, found in line.items()]
        for name, line in lines.items()
    }
    every = [point for points in drawn.values() for point in points]
    # Sizes of errors are never below 0, and what is judged by more and lies in 0 to 1 is a share.
    is_size = column.better == "lower" and all(point.y >= 0.0 for point in every)
    is_share = column.better == "higher" and all(0.0 <= point.y <= 1.0 for point in every)
    notes = [_points_text(lines, column.unit, n_datasets)]
    if column.better in BETTER:
        notes.append(BETTER[column.better])
    if any(point.is_filled for point in every):
        notes.append("filled points are the baseline")
    return Curve(
        name=f"{column.step}.{column.metric}_over_{parameter}",
        title=f"{column.titled} ({column.step}) over {parameter}",
        caption=f"Points are {'; '.join(notes)}.",
        lines=drawn,
        below=parameter,
        beside=column.titled,
        bounds=(0.0 if is_size or is_share else -math.inf, 1.0 if is_share else math.inf),
    )


def _point(x: float, found: Sequence[_Value], column: MetricRow, *, is_over: bool) -> ChartPoint:
    numbers = np.array([one.value for one in found])
    if column.better == "lower":
        # Errors of both signs would make each other small, and the most negative look best.
        numbers = np.abs(numbers)
    # A bar over datasets is how far they lie apart, not how far the repeats of one do.
    spread = spread_of(numbers, column.unit) if is_over else found[0].spread
    return ChartPoint(
        x=x,
        y=middle_of(numbers, column.unit),
        spread=math.nan if is_over and len(found) == 1 else spread,
        is_filled=any(one.is_baseline for one in found),
    )


def _points_text(lines: Mapping[str, _Line], unit: str, n_datasets: int) -> str:
    """What the points are, and over datasets how many these are: what failed has no part in it."""
    found = [values for line in lines.values() for values in line.values()]
    if n_datasets < 2:
        if any(math.isfinite(one.spread) for values in found for one in values):
            return "means of the repeats, bars their standard deviation"
        return "single values without repeats"
    counts = sorted({len(values) for values in found})
    counted = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    if is_flag(unit):
        return f"shares of {counted} of {n_datasets} datasets, and of their repeats"
    return (
        f"medians of {counted} of {n_datasets} datasets, of errors with signs of their sizes, "
        "bars 1.4826 times the median absolute deviation"
    )
