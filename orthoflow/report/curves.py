"""What a parameter does: metrics over the values that it was given, as drawings for the page."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from orthoflow.foreign_text import first_few
from orthoflow.records import RecordedCell
from orthoflow.records.datasets import parts_of
from orthoflow.records.runs import Run
from orthoflow.report.charts import ChartFormat, ChartPoint, as_image, line_chart
from orthoflow.report.combinations import (
    Combination,
    combinations_of,
    gives,
    unequal_walls,
    wanted_metrics,
)
from orthoflow.report.comparisons import Column, comparison_columns
from orthoflow.report.numbers import number
from orthoflow.report.paired import middle_of, spread_of
from orthoflow.report.pictures import Picture
from orthoflow.report.rankings import Sense, cost_share, is_flag
from orthoflow.workflow.model import (
    DATA,
)

_MOST_CURVES: Final = 12
_LONGEST_NAME: Final = 120
_MOST_LINES: Final = 6
# What a record of a stranger says may be any number; differences of larger ones are none.
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
    drawn = curves_over(parts) if len(parts) > 1 else curves(run)
    # What a record calls its steps and metrics may be no name of a file.
    names = (re.sub(r"[^\w.-]", "_", curve.name)[:_LONGEST_NAME] for curve in drawn)
    return {
        f"{index:02d}_{name}.{suffix}": curve.file(suffix)
        for index, (name, curve) in enumerate(zip(names, drawn, strict=True), start=1)
    }


def curves(run: Run) -> tuple[Curve, ...]:
    """Draw the metrics of a comparison over every parameter in which variants differ alone.

    A sweep is known by what was run, not by how the workflow was written: variants of a step that
    call one method and differ in one number.
    """
    return tuple(_curves([run]))[:_MOST_CURVES]


def curves_over(parts: Mapping[str, Run]) -> tuple[Curve, ...]:
    """The same over datasets: medians, and how far the datasets lie apart."""
    return tuple(_curves(list(parts.values())))[:_MOST_CURVES]


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


@dataclass(frozen=True, kw_only=True)
class _Point:
    x: float
    y: float
    spread: float
    found: tuple[_Value, ...]  # what it stands for, one of each dataset
    is_baseline: bool
    is_level: bool = False  # the end of a line of what was not swept

    @property
    def n(self) -> int:
        return len(self.found)

    @property
    def origins(self) -> list[tuple[str, int]]:
        """The datasets, and how many repeats of each have a value."""
        return sorted((one.dataset, one.n_repeats) for one in self.found)

    @property
    def partly(self) -> list[str]:
        """What has a value of only some repeats, in words."""
        at = "" if self.is_level else f" at {number(self.x)}"
        return [
            f"{one.dataset}{at} ({one.n_repeats} of {one.n_all})".lstrip()
            for one in self.found
            if one.n_repeats < one.n_all
        ]


def _curves(parts: Sequence[Run]) -> Iterator[Curve]:
    combinations = [one for part in parts for one in combinations_of(part)]
    columns = comparison_columns(combinations)
    is_asked = any(wanted_metrics(part) for part in parts)
    chosen = [
        one
        for one in columns
        if is_asked or one.is_key or one.is_described or one.sense is not Sense.NEITHER
    ]
    cells = [cell for part in parts for cell in part.record.cells]
    # What several methods sweep is one drawing: axes of their own would hide which is better.
    swept: dict[tuple[str, str], list[Sweep]] = {}
    found = list(sweeps(cells))
    for sweep in found:
        swept.setdefault((sweep.step, sweep.parameter), []).append(sweep)
    behind = {step: {cell.step for cell in cells if step in cell.assignment} for step, _ in swept}
    of_walls = (
        {cell.step: " Not all are of the same wall." for cell in cells if gives(cell, *_OF_WALLS)}
        if unequal_walls(combinations)
        else {}
    )
    unswept = {place: _unswept(cells, *place, found) for place in swept}
    for column in sorted(chosen, key=lambda one: not one.is_key):
        for (step, parameter), alike in swept.items():
            # A parameter over itself says nothing.
            is_itself = (column.step, column.metric) == (step, parameter)
            if is_itself or column.step not in behind[step]:
                continue
            lines: dict[str, list[_Point]] = {}
            are_several = len(alike) + len(unswept[step, parameter]) > 1
            for sweep in (*alike, *unswept[step, parameter]):
                own = _lines(combinations, sweep, column, is_over=len(parts) > 1)
                method = sweep.method if are_several else ""
                lines |= {", ".join(filter(None, [method, name])): own[name] for name in own}
            if any(len(points) >= _FEWEST_VALUES for points in lines.values()):
                shown_lines = _levelled(dict(list(lines.items())[:_MOST_LINES]))
                curve = _curve(alike[0], column, shown_lines, n_datasets=len(parts))
                caveats = _unequal_photos(combinations, column) + of_walls.get(column.step, "")
                yield replace(curve, caption=curve.caption + caveats)


def _unequal_photos(combinations: Iterable[Combination], column: Column) -> str:
    """Return where combinations sum up unequal numbers of photos of a dataset; else empty."""
    counts: dict[str, set[float]] = {}
    for one in combinations:
        n_photos = one.n_items(column.step, column.counted_by)
        if one.failure is None and n_photos > 0.0:
            counts.setdefault(one.assignment.get(DATA, ""), set()).add(n_photos)
    if all(len(found) < 2 for found in counts.values()):
        return ""
    return " Not all sum up as many photos: without difficult ones errors are smaller."


class _Value(NamedTuple):
    """What one combination measured, and of how many of its repeats."""

    value: float
    spread: float
    is_baseline: bool
    dataset: str = ""
    n_repeats: int = 1
    n_all: int = 1


def _lines(
    combinations: Sequence[Combination], sweep: Sweep, column: Column, *, is_over: bool
) -> dict[str, list[_Point]]:
    """One line per combination of the other variants."""
    values: dict[str, dict[float, list[_Value]]] = {}
    for one in combinations:
        variant = one.assignment.get(sweep.step, "")
        measured = one.measured(column.step, column.metric)
        if variant not in sweep.values or measured is None or one.failure is not None:
            continue
        if not abs(measured.value) < _LARGEST:
            continue
        variants = (
            f"{step}={chosen}"
            for step, chosen in one.assignment.items()
            if step not in (sweep.step, DATA)
        )
        others = ", ".join(filter(None, [sweep.others[variant], *variants]))
        at = values.setdefault(others, {}).setdefault(sweep.values[variant], [])
        at.append(
            _Value(
                measured.value,
                measured.spread,
                one.is_baseline,
                one.assignment.get(DATA, ""),
                measured.n_repeats,
                measured.n_all,
            )
        )
    return {
        name: [
            _point(x, found, is_over=is_over, column=column) for x, found in sorted(line.items())
        ]
        for name, line in values.items()
    }


def _levelled(lines: Mapping[str, list[_Point]]) -> dict[str, list[_Point]]:
    """Draw what has no value of the parameter from its least to its largest."""
    xs = [point.x for points in lines.values() for point in points if not math.isnan(point.x)]
    ends = (min(xs), max(xs))
    return {
        name: [replace(points[0], x=x, is_level=True) for x in ends]
        if math.isnan(points[0].x)
        else points
        for name, points in lines.items()
    }


def _point(x: float, found: Sequence[_Value], *, is_over: bool, column: Column) -> _Point:
    is_baseline = any(one.is_baseline for one in found)
    numbers = np.array([one.value for one in found])
    if column.sense is Sense.LESS:
        # Errors of both signs would make each other small, and the most negative look best.
        numbers = np.abs(numbers)
    if len(found) == 1:
        # A bar over datasets is how far they lie apart, not how far the repeats of one do.
        y, spread = float(numbers[0]), math.nan if is_over else found[0].spread
    else:
        y, spread = middle_of(numbers, column.unit), spread_of(numbers, column.unit)
    return _Point(x=x, y=y, spread=spread, found=tuple(found), is_baseline=is_baseline)


def _are_alike(one: _Point, other: _Point) -> bool:
    """Whether both are of the same datasets and as many repeats of each.

    The hard datasets are often those that a value fails on: no line says that it is better.
    """
    return one.origins == other.origins


def _unlike(lines: Mapping[str, Sequence[_Point]], *, is_over: bool) -> str:
    """Return what is missing behind points: datasets and repeats; empty where nothing is."""
    partly = [said for points in lines.values() for point in points for said in point.partly]
    some = f"; of only some repeats: {first_few(partly)}" if partly else ""
    if all(_are_alike(*pair) for points in lines.values() for pair in pairwise(points)):
        return some
    what = "datasets or repeats" if is_over else "numbers of repeats"
    return f", no line between those of unlike {what}{some}"


def _behind(points: Sequence[_Point], n_datasets: int, unit: str) -> str:
    """Return how many datasets points over datasets are of: those that failed have no part."""
    least, most = min(point.n for point in points), max(point.n for point in points)
    if most == 1:
        return f"each of the only one of {n_datasets} datasets that has a value, without bars"
    counted = f"{least}" if least == most else f"{least} to {most}"
    of_all = f" of {n_datasets}" if least < n_datasets else ""
    if is_flag(unit):
        return (
            f"means of {counted}{of_all} datasets: the share of them, and of their repeats, "
            "where it is so (1)"
        )
    where = ", where there is more than one" if least == 1 else ""
    return (
        f"medians of {counted}{of_all} datasets, bars 1.4826 times the median absolute "
        f"deviation{where}"
    )


def _curve(
    sweep: Sweep,
    column: Column,
    lines: Mapping[str, Sequence[_Point]],
    *,
    n_datasets: int,
) -> Curve:
    title = f"{column.label} ({column.step}) over {sweep.step}.{sweep.parameter}"
    has_spread = any(math.isfinite(point.spread) for points in lines.values() for point in points)
    if n_datasets > 1:
        every = [point for points in lines.values() for point in points]
        said = _behind(every, n_datasets, column.unit)
    elif has_spread:
        said = "means of the repeats, bars their standard deviation"
    else:
        said = "one value each: without repeats nobody knows how far they scatter"
    said += _unlike(lines, is_over=n_datasets > 1)
    good = "" if column.sense is Sense.NEITHER else f"; {column.sense.value}"
    if column.sense is Sense.LESS and not cost_share(column.unit):
        good += ", of signed errors their sizes"
    if any(point.is_level for points in lines.values() for point in points):
        good += "; level lines are of what was not swept"
    base = [one for points in lines.values() for one in points if one.is_baseline]
    if base:
        what = "level line with filled points" if base[0].is_level else "filled point"
        good += f"; the {what} is the baseline"
    shape = (
        "A flat stretch is where the parameter does not matter; at a steep end the chosen value "
        "decides the result."
        if max(map(len, lines.values())) > _FEWEST_VALUES
        else "Of two values a line shows the difference alone, and nothing of what lies between."
    )
    every = [point for points in lines.values() for point in points]
    # Sizes of errors are never below 0, and what is judged by more and lies in 0 to 1 is a share.
    is_size = column.sense is Sense.LESS and all(point.y >= 0.0 for point in every)
    is_share = column.sense is Sense.MORE and all(0.0 <= point.y <= 1.0 for point in every)
    return Curve(
        name=f"{column.step}.{column.metric}_over_{sweep.step}.{sweep.parameter}",
        title=title,
        caption=f"Points are {said}{good}. {shape}",
        lines={name: tuple(_chart_points(points)) for name, points in lines.items()},
        below=f"{sweep.step}.{sweep.parameter}",
        beside=column.label,
        bounds=(0.0 if is_size or is_share else -math.inf, 1.0 if is_share else math.inf),
    )


def _chart_points(points: Sequence[_Point]) -> Iterator[ChartPoint]:
    before: _Point | None = None
    for point in points:
        yield ChartPoint(
            x=point.x,
            y=point.y,
            spread=point.spread,
            is_filled=point.is_baseline,
            is_joined=before is None or _are_alike(before, point),
        )
        before = point
