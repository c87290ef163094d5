"""What a parameter does: metrics over the values that it was given, as drawings for the page."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from html import escape
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from orthoflow.alike import first_few
from orthoflow.foreign_text import shown
from orthoflow.records import RecordedCell
from orthoflow.records.datasets import parts_of
from orthoflow.records.runs import Run
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
_SHARES: Final = ("main_found", "label_*", "*completeness*", "*_iou*", "*_share*")
_LOGARITHMIC_RATIO: Final = 20.0
_WIDTH, _HEIGHT = 460.0, 318.0
# Above, the button that enlarges lies over the drawing.
_LEFT, _RIGHT, _TOP, _BOTTOM = 62.0, 14.0, 40.0, 46.0
_APART: Final = 5.0  # of the lines of one drawing, whose bars stand at the same places
_LETTER: Final = 6.2  # width of one, at the size of the drawing's text


# The colours of the light page, for drawings that stand alone.
_STYLE: Final = (
    "svg{font:12px sans-serif;background:#fff;color:#1c2126}.axis,.line,.bar{fill:none}"
    ".axis{stroke:#56606a}.grid{stroke:#d4d9de;stroke-width:.7}.line,.dot{stroke-width:2}"
    ".line-0{stroke:#0b5fa5}.line-1{stroke:#8a4b00;stroke-dasharray:7 3}"
    ".line-2{stroke:#1c6b35;stroke-dasharray:2 3}.line-3{stroke:#a11616;stroke-dasharray:9 3 2 3}"
    ".line-4{stroke:#56606a}.line-5{stroke:#1c2126;stroke-dasharray:1 4}"
    ".dot,.bar{stroke-dasharray:none}.dot{fill:#fff}.base{fill:currentColor}.bar{stroke-width:1.2}"
)


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One metric over one parameter.

    Attributes:
        name: the metric and the parameter by the names of their steps and themselves.
        title: the metric, its step and the parameter, in words.
        svg: an `<svg>` element.
        caption: what the points and bars are, in words.
    """

    name: str
    title: str
    svg: str
    caption: str

    @property
    def file(self) -> bytes:
        """The drawing as an SVG file; on the page its style sheet colours the parts."""
        head, _, drawn = self.svg.removeprefix("<svg").partition(">")
        said = f"<style>{_STYLE}</style><desc>{escape(shown(self.caption))}</desc>"
        alone = f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH:.0f}"{head}>{said}{drawn}'
        return alone.encode("utf-8")


def curve_files(run: Run) -> dict[str, bytes]:
    """Give the drawings of a run, over its datasets where it has several, as SVG files by name."""
    parts = parts_of(run)
    drawn = curves_over(parts) if len(parts) > 1 else curves(run)
    # What a record calls its steps and metrics may be no name of a file.
    names = (re.sub(r"[^\w.-]", "_", curve.name)[:_LONGEST_NAME] for curve in drawn)
    return {
        f"{index:02d}_{name}.svg": curve.file
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
    """Give each variant of a step that no sweep has, as one without a value.

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
    """Say where combinations sum up unequal numbers of photos of a dataset; else empty."""
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
    """Say what is missing behind points: datasets and repeats; empty where nothing is."""
    partly = [said for points in lines.values() for point in points for said in point.partly]
    some = f"; of only some repeats: {first_few(partly)}" if partly else ""
    if all(_are_alike(*pair) for points in lines.values() for pair in pairwise(points)):
        return some
    what = "datasets or repeats" if is_over else "numbers of repeats"
    return f", no line between those of unlike {what}{some}"


def _behind(points: Sequence[_Point], n_datasets: int, unit: str) -> str:
    """Say how many datasets points over datasets are of: those that failed have no part."""
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
    return Curve(
        name=f"{column.step}.{column.metric}_over_{sweep.step}.{sweep.parameter}",
        title=title,
        svg=_Axes.of(
            [point for points in lines.values() for point in points],
            is_error=column.sense is Sense.LESS,
            is_share=any(fnmatchcase(column.metric, pattern) for pattern in _SHARES),
        ).drawn(
            lines,
            label=title,
            below=f"{sweep.step}.{sweep.parameter}",
            beside=column.label,
        ),
        caption=f"Points are {said}{good}. {shape}",
    )


@dataclass(frozen=True, kw_only=True)
class _Axes:
    """Where numbers lie in the drawing.

    Attributes:
        x: least and largest.
        y: least and largest.
        is_logarithmic: along x.
        floor: no bar reaches below it: sizes of errors are none.
        ceiling: no bar reaches above it: shares are none.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    is_logarithmic: bool
    floor: float
    ceiling: float

    @classmethod
    def of(cls, points: Sequence[_Point], *, is_error: bool, is_share: bool = False) -> _Axes:
        xs = [point.x for point in points]
        spreads = [point.spread if math.isfinite(point.spread) else 0.0 for point in points]
        is_share = is_share and all(0.0 <= point.y <= 1.0 for point in points)
        is_size = is_share or (is_error and all(point.y >= 0.0 for point in points))
        floor, ceiling = 0.0 if is_size else -math.inf, 1.0 if is_share else math.inf
        low = min(point.y - spread for point, spread in zip(points, spreads, strict=True))
        low = max(low, floor)
        high = max(point.y + spread for point, spread in zip(points, spreads, strict=True))
        high = min(high, ceiling)
        margin = 0.08 * (high - low) or 0.1 * abs(high) or 1.0
        # An axis that begins near 0 begins there: half of it would show a difference too large.
        begin = 0.0 if 0.0 <= low < 0.6 * high else low - margin
        is_logarithmic = min(xs) > 0 and max(xs) / min(xs) >= _LOGARITHMIC_RATIO
        return cls(
            x=(min(xs), max(xs)),
            y=(begin, high + margin),
            is_logarithmic=is_logarithmic,
            floor=floor,
            ceiling=ceiling,
        )

    def across(self, x: float) -> float:
        low, high = self.x
        if self.is_logarithmic:
            x, low, high = math.log(x), math.log(low), math.log(high)
        share = (x - low) / (high - low) if high > low else 0.5
        return _LEFT + 12.0 + share * (_WIDTH - _LEFT - _RIGHT - 30.0)

    def down(self, y: float) -> float:
        low, high = self.y
        return _HEIGHT - _BOTTOM - (y - low) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)

    def drawn(
        self, lines: Mapping[str, Sequence[_Point]], *, label: str, below: str, beside: str
    ) -> str:
        floor = _HEIGHT - _BOTTOM
        parts = [
            f'<path class="axis" d="M{_LEFT} {_TOP}V{floor}H{_WIDTH - _RIGHT}"/>',
            (
                f'<text x="{0.5 * (_LEFT + _WIDTH):.0f}" y="{_HEIGHT - 6}" text-anchor="middle">'
                f"{escape(shown(below))}{' (logarithmic)' if self.is_logarithmic else ''}</text>"
            ),
        ]
        ticks = _ticks(*self.y)
        # Numbers that differ in their last digits only: how far they lie above the first.
        base = ticks[0] if len(set(map(number, ticks))) < len(ticks) else 0.0
        beside += f", above {base:.10g}" if base else ""
        for value in ticks:
            y = self.down(value)
            parts.append(
                f'<path class="grid" d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}"/>'
                f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">'
                f"{number(value - base)}</text>"
            )
        taken = -math.inf
        for value in sorted({point.x for points in lines.values() for point in points}):
            text, x = number(value), self.across(value)
            # Values may lie too close for their numbers.
            if x - 0.5 * _LETTER * len(text) > taken:
                parts.append(
                    f'<text x="{x:.1f}" y="{floor + 17}" text-anchor="middle">{text}</text>'
                )
                taken = x + 0.5 * _LETTER * len(text) + 6.0
        # Bars at one place would hide each other.
        apart = _APART if sum(_has_bars(points) for points in lines.values()) > 1 else 0.0
        # The baseline's last: its filled point is looked for.
        drawn = sorted(enumerate(lines.values()), key=lambda one: _has_baseline(one[1]))
        for index, points in drawn:
            aside = apart * (index - 0.5 * (len(lines) - 1))
            line = self._line(index, points)
            parts.append(f'<g transform="translate({aside:g} 0)">{line}</g>' if aside else line)
        # The names stand above the lines, which could be anywhere below.
        named = [(index, name) for index, name in enumerate(lines) if name]
        above = [f'<text class="beside" x="6" y="{_TOP - 14}">{escape(shown(beside))}</text>']
        for row, (index, name) in enumerate(named):
            y = _TOP + 4 + 15 * row
            above.append(
                f'<path class="line line-{index}" d="M{_LEFT} {y - 4}h22"/>'
                f'<text x="{_LEFT + 26}" y="{y}">{escape(shown(name))}</text>'
            )
        down = 15 * len(named)
        return (
            f'<svg class="curve" viewBox="0 0 {_WIDTH:.0f} {_HEIGHT + down:.0f}" role="img" '
            f'aria-label="{escape(shown(label))}">{"".join(above)}'
            f'<g transform="translate(0 {down})">{"".join(parts)}</g></svg>'
        )

    def _line(self, index: int, points: Sequence[_Point]) -> str:
        at = [(self.across(point.x), self.down(point.y)) for point in points]
        joins = ["", *("L" if _are_alike(*pair) else "M" for pair in pairwise(points))]
        way = "".join(f"{join}{x:.1f} {y:.1f}" for join, (x, y) in zip(joins, at, strict=True))
        bars = "".join(
            f"M{x:.1f} {self.down(max(point.y - point.spread, self.floor)):.1f}"
            f"V{self.down(min(point.y + point.spread, self.ceiling)):.1f}"
            for (x, _), point in zip(at, points, strict=True)
            if math.isfinite(point.spread)
        )
        dots = "".join(
            f'<circle class="dot line-{index}{" base" if point.is_baseline else ""}" '
            f'cx="{x:.1f}" cy="{y:.1f}" r="3.6">'
            f"<title>{'' if point.is_level else f'{number(point.x)}: '}{number(point.y)}"
            "</title></circle>"
            for (x, y), point in zip(at, points, strict=True)
        )
        bar = f'<path class="bar line-{index}" d="{bars}"/>' if bars else ""
        return f'<path class="line line-{index}" d="M{way}"/>{bar}{dots}'


def _has_baseline(points: Sequence[_Point]) -> bool:
    return any(point.is_baseline for point in points)


def _has_bars(points: Sequence[_Point]) -> bool:
    return any(math.isfinite(point.spread) and point.spread > 0.0 for point in points)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers between two, about five.

    >>> _ticks(0.0, 1.1)
    [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    """
    rough = (high - low) / 5.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * round_ for round_ in (1, 2, 5, 10) if power * round_ >= 0.8 * rough)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [float(f"{index * step:.12g}") for index in range(first, last + 1)]
