"""What a parameter does: metrics over the values that it was given, as drawings for the page."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final, NamedTuple

import numpy as np

from orthoflow.records import RecordedCell
from orthoflow.records.runs import MetricRow, Run, parts_of
from orthoflow.report.charts import ChartFormat, ChartPoint, as_image, line_chart
from orthoflow.report.combinations import (
    Combination,
    combinations_of,
    gives,
    unequal_walls,
)
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
# What measures walls gives one of these.
_OF_WALLS: Final = ("walls", "layers", "orthoimages", "inspection")


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


def _unswept(
    cells: Sequence[RecordedCell], step: str, parameter: str, found: Iterable[Sweep]
) -> list[Sweep]:
    """Return each variant of a step that no sweep has, as one without a value.

    Those that have the parameter all the same, at their default, are named by it.
    """
    swept = {variant for one in found if one.step == step for variant in one.values}
    alone = {
        cell.assignment[step]: cell
        for cell in cells
        if cell.step == step
        and step in cell.assignment
        and cell.assignment[step] not in swept
        and cell.status != "skipped"
    }
    counts = Counter(cell.method for cell in alone.values())
    found_alone = []
    for variant, cell in alone.items():
        others = [variant] if counts[cell.method] > 1 else []
        if parameter in cell.params:
            others.append(f"{parameter}={cell.params[parameter]}")
        found_alone.append(
            Sweep(
                step=step,
                method=cell.method,
                parameter="",
                values={variant: math.nan},
                others={variant: ", ".join(others)},
            )
        )
    return found_alone


class _Value(NamedTuple):
    """What one combination measured, and in how many repeats."""

    value: float
    spread: float
    is_baseline: bool
    dataset: str
    n_repeats: int


# Value of the parameter, None of what was not swept -> what combinations measured there.
_Line = dict[float | None, list[_Value]]


def _curves(parts: Sequence[Run]) -> Iterator[Curve]:
    combinations = [one for part in parts for one in combinations_of(part)]
    columns = comparison_columns(combinations)
    cells = [cell for part in parts for cell in part.record.cells]
    # What several methods sweep is one drawing: axes of their own would hide which is better.
    swept: dict[tuple[str, str], list[Sweep]] = {}
    found = list(sweeps(cells))
    for sweep in found:
        swept.setdefault((sweep.step, sweep.parameter), []).append(sweep)
    of_walls = (
        {cell.step for cell in cells if gives(cell, *_OF_WALLS)}
        if unequal_walls(combinations)
        else set()
    )
    for column in sorted(columns, key=lambda one: not one.headline):
        for (step, parameter), group in swept.items():
            # A parameter over itself is meaningless.
            is_behind = any(cell.step == column.step and step in cell.assignment for cell in cells)
            if (column.step, column.metric) == (step, parameter) or not is_behind:
                continue
            drawn = [*group, *_unswept(cells, step, parameter, found)]
            lines: dict[str, _Line] = {}
            for sweep in drawn:
                method = sweep.method if len(drawn) > 1 else ""
                for name, line in _lines(combinations, sweep, column).items():
                    lines[", ".join(filter(None, [method, name]))] = line
            if any(len(line) >= _FEWEST_VALUES for line in lines.values()):
                first = dict(list(lines.items())[:_MOST_LINES])
                caveats = _unequal_photos(combinations, column)
                if column.step in of_walls:
                    caveats += " Not all are of the same wall."
                yield _curve(f"{step}.{parameter}", column, first, len(parts), caveats)


def _unequal_photos(combinations: Iterable[Combination], column: MetricRow) -> str:
    """Return where combinations sum up unequal numbers of photos of a dataset; else empty."""
    counts: dict[str, set[float]] = {}
    for one in combinations:
        n_photos = one.n_items(column.step, column.counted_by)
        if one.failure is None and n_photos > 0.0:
            counts.setdefault(one.assignment.get(DATA, ""), set()).add(n_photos)
    if all(len(found) < 2 for found in counts.values()):
        return ""
    return " Not all sum up as many photos: without difficult ones errors are smaller."


def _lines(
    combinations: Sequence[Combination], sweep: Sweep, column: MetricRow
) -> dict[str, _Line]:
    """One line per combination of the other variants."""
    lines: dict[str, _Line] = {}
    for one in combinations:
        variant = one.assignment.get(sweep.step, "")
        measured = one.measured(column.step, column.metric)
        if variant not in sweep.values or measured is None or one.failure is not None:
            continue
        if abs(measured.value) < _LARGEST:
            others = {k: v for k, v in one.assignment.items() if k not in (sweep.step, DATA)}
            name = ", ".join(filter(None, [sweep.others[variant], variants_text(others)]))
            x = sweep.values[variant]
            lines.setdefault(name, {}).setdefault(None if math.isnan(x) else x, []).append(
                _Value(
                    measured.value,
                    measured.spread,
                    one.is_baseline,
                    one.assignment.get(DATA, ""),
                    measured.n_repeats,
                )
            )
    return lines


def _curve(
    parameter: str, column: MetricRow, lines: Mapping[str, _Line], n_datasets: int, caveats: str
) -> Curve:
    is_over = n_datasets > 1
    xs = [x for line in lines.values() for x in line if x is not None]
    drawn: dict[str, list[ChartPoint]] = {}
    is_broken = False
    for name, line in lines.items():
        before: list[tuple[str, int]] | None = None
        for x, found in sorted(line.items(), key=lambda one: one[0] or 0.0):
            # The hard datasets are often those that a value fails on: no line between points of
            # unlike datasets or repeats means that one is better.
            origins = sorted((one.dataset, one.n_repeats) for one in found)
            is_joined = before in (None, origins)
            is_broken |= not is_joined
            before = origins
            # What has no value of the parameter is drawn from its least to its largest.
            for place in (min(xs), max(xs)) if x is None else (x,):
                point = _point(place, found, column, is_over=is_over, is_joined=is_joined)
                drawn.setdefault(name, []).append(point)
    every = [point for points in drawn.values() for point in points]
    # Sizes of errors are never below 0, and what is judged by more and lies in 0 to 1 is a share.
    is_size = column.better == "lower" and all(point.y >= 0.0 for point in every)
    is_share = column.better == "higher" and all(0.0 <= point.y <= 1.0 for point in every)
    notes = [_points_text(lines, column.unit, n_datasets)]
    if is_broken:
        notes.append("no line joins points of different datasets or numbers of repeats")
    if column.better in BETTER:
        notes.append(BETTER[column.better])
    if any(None in line for line in lines.values()):
        notes.append("level lines are of what was not swept")
    if any(point.is_filled for point in every):
        notes.append("filled points are the baseline")
    return Curve(
        name=f"{column.step}.{column.metric}_over_{parameter}",
        title=f"{column.titled} ({column.step}) over {parameter}",
        caption=f"Points are {'; '.join(notes)}.{caveats}",
        lines=drawn,
        below=parameter,
        beside=column.titled,
        bounds=(0.0 if is_size or is_share else -math.inf, 1.0 if is_share else math.inf),
    )


def _point(
    x: float, found: Sequence[_Value], column: MetricRow, *, is_over: bool, is_joined: bool
) -> ChartPoint:
    numbers = np.array([one.value for one in found])
    if column.better == "lower":
        # Errors of both signs would make each other small, and the most negative look best.
        numbers = np.abs(numbers)
    spread = spread_of(numbers, column.unit)
    if len(found) == 1:
        # A bar over datasets is how far they lie apart, not how far the repeats of one do.
        spread = math.nan if is_over else found[0].spread
    return ChartPoint(
        x=x,
        y=middle_of(numbers, column.unit) if len(found) > 1 else float(numbers[0]),
        spread=spread,
        is_filled=any(one.is_baseline for one in found),
        is_joined=is_joined,
    )


def _points_text(lines: Mapping[str, _Line], unit: str, n_datasets: int) -> str:
    """What the points are, and over datasets how many these are: what failed has no part in it."""
    found = [values for line in lines.values() for values in line.values()]
    if n_datasets < 2:
        if any(math.isfinite(one.spread) for values in found for one in values):
            return "means of the repeats, bars their standard deviation"
        return "single values without repeats"
    least, most = min(map(len, found)), max(map(len, found))
    counted = f"{least}" if least == most else f"{least} to {most}"
    if is_flag(unit):
        return f"shares of {counted} of {n_datasets} datasets, and of their repeats"
    return (
        f"medians of {counted} of {n_datasets} datasets, of errors with signs of their sizes, "
        "bars 1.4826 times the median absolute deviation"
    )
