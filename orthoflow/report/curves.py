"""Charts of metrics against the values of a swept parameter."""

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
from orthoflow.report.pictures import Picture
from orthoflow.report.rankings import BETTER, is_flag, middle_of, spread_of
from orthoflow.workflow.expand import variants_text
from orthoflow.workflow.model import DATA

_MOST_CURVES: Final = 12
_LONGEST_NAME: Final = 120
_MOST_LINES: Final = 6
# Larger numbers are ignored: a record is untrusted and may contain any number, and the differences
# between such numbers may overflow.
_LARGEST: Final = 1e100
_FEWEST_VALUES: Final = 2


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A chart of one metric against one parameter.

    Attributes:
        name: file name without suffix, which consists of the metric and the parameter, each with
            its step.
        title: title with metric, step and parameter.
        caption: description of the points and error bars.
        lines: name of the line -> points.
        below: label of the horizontal axis (parameter).
        beside: label of the vertical axis (metric), with the unit.
        bounds: lowest and highest possible value of the metric.
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
        """The chart as a picture on a page."""
        return Picture(uri=as_image(self.file("svg")), title=self.title, caption=self.caption)

    def file(self, suffix: ChartFormat) -> bytes:
        """Return the chart as a file."""
        return line_chart(
            self.lines, below=self.below, beside=self.beside, bounds=self.bounds, suffix=suffix
        )


def curve_files(run: Run, suffix: ChartFormat = "svg") -> dict[str, bytes]:
    """Return file name -> content for the curves of a run over all its datasets."""
    parts = parts_of(run)
    drawn = curves([*parts.values()] if len(parts) > 1 else [run])
    # The names of steps and metrics in a record may be invalid as file names.
    names = (re.sub(r"[^\w.-]", "_", curve.name)[:_LONGEST_NAME] for curve in drawn)
    return {
        f"{index:02d}_{name}.{suffix}": curve.file(suffix)
        for index, (name, curve) in enumerate(zip(names, drawn, strict=True), start=1)
    }


def curves(parts: Sequence[Run]) -> tuple[Curve, ...]:
    """Return the curves of the compared metrics for all swept parameters.

    Sweeps are found from the cells and not from the workflow text: a sweep consists of variants of
    a step that call the same method and differ in one number.

    Args:
        parts: the run, or one part per dataset; medians and spreads are computed over several
            parts.
    """
    return tuple(islice(_curves(parts), _MOST_CURVES))


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Variants of a step that differ in a numeric parameter and possibly in other parameters.

    Attributes:
        step: name of the step.
        method: method of the variants, e.g. `plane.ransac`.
        parameter: name of the parameter.
        values: variant -> value of the parameter.
        others: variant -> other parameters that differ, as text.
    """

    step: str
    method: str
    parameter: str
    values: Mapping[str, float]
    others: Mapping[str, str]


def sweeps(cells: Sequence[RecordedCell]) -> Iterator[Sweep]:
    """Yield the sweeps found in the cells of a run; see `curves`."""
    by_method: dict[tuple[str, str], dict[str, RecordedCell]] = {}
    for cell in cells:
        variant = cell.assignment.get(cell.step)
        if variant is not None and cell.repeat == 0 and cell.status != "skipped":
            by_method.setdefault((cell.step, cell.method), {}).setdefault(variant, cell)
    for (step, method), variants in by_method.items():
        # Only explicitly set parameters are compared, because defaults may depend on other
        # parameters.
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
    """Value of one combination, and its standard deviation over repeats."""

    value: float
    spread: float
    is_baseline: bool
    dataset: str


# Parameter value -> values of the combinations.
_Line = dict[float, list[_Value]]


def _curves(parts: Sequence[Run]) -> Iterator[Curve]:
    combinations = [one for part in parts for one in combinations_of(part)]
    cells = [cell for part in parts for cell in part.record.cells]
    # Sweeps of several methods share a chart so that the methods can be compared.
    swept: dict[tuple[str, str], list[Sweep]] = {}
    for sweep in sweeps(cells):
        swept.setdefault((sweep.step, sweep.parameter), []).append(sweep)
    columns = comparison_columns(combinations)
    for column in sorted(columns, key=lambda one: not one.headline):
        for (step, parameter), group in swept.items():
            # A method may report the swept parameter as a metric; plotting it against itself is
            # meaningless.
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
    """Return one line for each combination of the other variants.

    The points of a line use the same datasets. Otherwise, a parameter value that fails on difficult
    datasets would look better than the others, because only its point would lack these datasets.
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
    # If lower is better and no value is negative, treat the metric as an absolute error. If higher
    # is better and all values are between 0 and 1, treat it as a share.
    is_size = column.better == "lower" and all(point.y >= 0.0 for point in every)
    is_share = column.better == "higher" and all(0.0 <= point.y <= 1.0 for point in every)
    notes = [_points_text(lines, column, n_datasets)]
    if column.better in BETTER:
        notes.append(BETTER[column.better].capitalize())
    if any(point.is_filled for point in every):
        notes.append("Filled points show the baseline")
    return Curve(
        name=f"{column.step}.{column.metric}_over_{parameter}",
        title=f"{column.titled} ({column.step}) against {parameter}",
        caption=f"{'. '.join(notes)}.",
        lines=drawn,
        below=parameter,
        beside=column.titled,
        bounds=(0.0 if is_size or is_share else -math.inf, 1.0 if is_share else math.inf),
    )


def _point(x: float, found: Sequence[_Value], column: MetricRow, *, is_over: bool) -> ChartPoint:
    numbers = np.array([one.value for one in found])
    if column.better == "lower":
        # Errors of both signs would cancel, and the most negative error would look best.
        numbers = np.abs(numbers)
    # With several datasets, the error bar shows the spread between datasets, not between repeats.
    spread = spread_of(numbers, column.unit) if is_over else found[0].spread
    return ChartPoint(
        x=x,
        y=middle_of(numbers, column.unit),
        spread=math.nan if is_over and len(found) == 1 else spread,
        is_filled=any(one.is_baseline for one in found),
    )


def _points_text(lines: Mapping[str, _Line], column: MetricRow, n_datasets: int) -> str:
    found = [values for line in lines.values() for values in line.values()]
    if n_datasets < 2:
        if any(math.isfinite(one.spread) for values in found for one in values):
            return "Points are means of the repeats. Bars are their standard deviations"
        return "Points are single values without repeats"
    counts = sorted({len(values) for values in found})
    counted = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    if is_flag(column.unit):
        return (
            f"Points are the share of yes over {counted} of {n_datasets} datasets and their repeats"
        )
    absolute = ". Absolute values of errors are used" if column.better == "lower" else ""
    bars = ". Bars are 1.4826 times the median absolute deviation" if counts[-1] > 1 else ""
    return f"Points are medians of {counted} of {n_datasets} datasets{absolute}{bars}"


@dataclass(frozen=True, kw_only=True)
class Varied:
    """Steps and parameters that vary in a run.

    Attributes:
        steps: names of the steps with variants; `data` for datasets.
        methods: step -> variant -> method, for steps with swept parameters.
        swept: (step, parameter) -> variant -> value, for each swept parameter.
    """

    steps: tuple[str, ...]
    methods: Mapping[str, Mapping[str, str]]
    swept: Mapping[tuple[str, str], Mapping[str, float]]

    @classmethod
    def of(cls, run: Run) -> Varied:
        """Determine which steps and parameters vary in a run."""
        swept: dict[tuple[str, str], dict[str, float]] = {}
        for sweep in sweeps(run.record.cells):
            swept.setdefault((sweep.step, sweep.parameter), {}).update(sweep.values)
        steps = dict.fromkeys(step for cell in run.record.cells for step in cell.assignment)
        methods: dict[str, dict[str, str]] = {}
        for cell in run.record.cells:
            if any(cell.step == step for step, _ in swept) and cell.step in cell.assignment:
                methods.setdefault(cell.step, {})[cell.assignment[cell.step]] = cell.method
        return cls(steps=tuple(steps), methods=methods, swept=swept)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns; those for steps are the same as in tables of several runs."""
        return (
            *("dataset" if step == DATA else f"variant.{step}" for step in self.steps),
            *(f"{step}.use" for step in self.methods),
            *(".".join(parameter) for parameter in self.swept),
        )

    def values(self, assignment: Mapping[str, str]) -> tuple[str | float | None, ...]:
        """Return the column values of a cell or combination; None in columns that do not apply."""
        variants = (assignment.get(step) for step in self.steps)
        numbers = (values.get(assignment.get(step, "")) for (step, _), values in self.swept.items())
        methods = (named.get(assignment.get(step, "")) for step, named in self.methods.items())
        return (*variants, *methods, *numbers)
