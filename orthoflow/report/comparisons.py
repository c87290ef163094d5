"""Two tables on the report page: combinations with their metrics, and datasets."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from string import ascii_uppercase
from typing import Final, TypeAlias

from orthoflow.records import COSTS, RunRecord
from orthoflow.records.runs import MetricRow, Run, cell_metrics, is_rounding
from orthoflow.report.combinations import (
    Combination,
    EnvironmentGroups,
    Measured,
    baseline_cells,
    baseline_metrics,
    baseline_of,
    combinations_of,
    group_environments,
    is_missing,
    wanted_metrics,
)
from orthoflow.report.pictures import thumbnail
from orthoflow.report.rankings import (
    BETTER,
    Mark,
    Value,
    cost_share,
    number,
    number_with_spread,
    rank,
)
from orthoflow.report.summaries import headline_keys, limits
from orthoflow.untrusted_text import first_few
from orthoflow.workflow.expand import variants_text
from orthoflow.workflow.model import DATA

_NOTHING: Final = "-"
_MAX_DESCRIBED: Final = 12  # metrics shown if no quality metric differs
_MAX_NAMED: Final = 3  # metrics listed in which a combination is best
# Costs that are summed over the steps in which combinations differ. Unlike elapsed time, processor
# time hardly depends on the load of the machine.
_SUMMED: Final = tuple(
    MetricRow(cell="", step="", method="", name=name, value=0.0, unit=unit, label=label,
              better="lower", headline=True)
    for name, unit, label in (
        ("cpu_s", "s", "processor time"),
        ("peak_rss_mib", "MiB", "memory"),
    )
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row of the comparison table, which shows one combination.

    Attributes:
        run: label of the combination's run, which contains the name of the workflow and the run id.
        variants: variant for each step with variants; a dash for a step that the combination lacks.
        name: variants as text, preceded by the run if the table compares several runs.
        is_baseline: whether the combination is the workflow's baseline.
        failure: first failed cell and its error; empty if no cell failed.
        missing: addresses of cells that had not run when the run was interrupted.
        values: one value per column.
        remark: sentence on failed repeats; empty if there are none.
    """

    run: str
    variants: tuple[str, ...]
    name: str
    is_baseline: bool
    failure: str
    missing: tuple[str, ...]
    values: tuple[Value, ...]
    remark: str

    @property
    def groups(self) -> tuple[str, ...]:
        """Letters for the environments and data of the row's values, without duplicates."""
        return tuple(dict.fromkeys(value.group for value in self.values if value.group))

    @property
    def shortfall(self) -> str:
        """Reason why time and memory are missing; empty if the row is complete."""
        return "failed" if self.failure else "not computed" if self.missing else ""

    def count(self, mark: Mark) -> int:
        """Return the number of values with this mark."""
        return sum(value.mark is mark for value in self.values)


@dataclass(frozen=True, kw_only=True)
class ComparisonTable:
    """Table of combinations and their metrics.

    Attributes:
        steps: steps with variants.
        columns: metrics, with processor time and memory last.
        rows: rows in the order of the runs and their graphs.
        shows_runs: whether the rows come from more than one run.
        groups: letter -> environment and data; empty if they are the same for all values.
    """

    steps: tuple[str, ...]
    columns: tuple[MetricRow, ...]
    rows: tuple[Row, ...]
    shows_runs: bool
    groups: Mapping[str, str]

    @property
    def baseline(self) -> str:
        """Name of the baseline; empty if there is no baseline or more than one."""
        found = [row.name for row in self.rows if row.is_baseline]
        return found[0] if len(found) == 1 else ""

    @property
    def glance(self) -> tuple[Row, ...]:
        """The rows, beginning with those that have the most best values.

        Among equals, rows with more values near the best come first. Rows with a shortfall come
        last.
        """

        def place(row: Row) -> tuple[bool, int, int]:
            return bool(row.shortfall), -row.count(Mark.BEST), -row.count(Mark.NEAR)

        return tuple(sorted(self.rows, key=place))

    @property
    def n_ranked(self) -> int:
        """Number of columns in which the scatter of all values is known."""
        return sum(
            column.better in BETTER
            and not any(value.text and math.isnan(value.spread) for value in values)
            for column, *values in zip(
                self.columns, *(row.values for row in self.rows), strict=True
            )
        )

    def best_in(self, row: Row) -> str:
        """Return the names of up to three metrics in which a row is clearly the best."""
        found = [
            ": ".join(filter(None, (column.step, column.titled)))
            for column, value in zip(self.columns, row.values, strict=True)
            if value.mark is Mark.BEST
        ]
        return first_few(found, most=_MAX_NAMED)


def comparison_table(runs: Sequence[Run]) -> ComparisonTable | None:
    """Return the table of combinations of runs; None if there is only one combination.

    Values are ranked only among those with the same environment and data; if environments or data
    differ, they are distinguished by letters.
    """
    combinations = [one for run in runs for one in combinations_of(run)]
    if len(combinations) < 2:
        return None
    steps = tuple(dict.fromkeys(step for one in combinations for step in one.assignment))
    metrics = comparison_columns(combinations)
    columns = (*metrics, *_SUMMED)
    origins = Origins.of(combinations)
    labels = _run_labels(runs)
    values = [
        (*(_value(one, origins, column) for column in metrics), *_costs(one, origins))
        for one in combinations
    ]
    ranked = [
        rank(of_column, column.better, column.unit)
        for column, of_column in zip(columns, zip(*values, strict=True), strict=True)
    ]
    rows = tuple(
        Row(
            run=labels[one.run.path, one.run.record.run_id],
            variants=tuple(one.assignment.get(step, _NOTHING) for step in steps),
            name=(f"{labels[one.run.path, one.run.record.run_id]}: " if len(runs) > 1 else "")
            + one.name,
            is_baseline=one.is_baseline,
            failure=f"{one.failure.address}: {one.failure.error_message}" if one.failure else "",
            missing=tuple(cell.address for cell in one.missing),
            values=own,
            remark=f"{one.n_failed_repeats} repeats failed" if one.n_failed_repeats else "",
        )
        for one, own in zip(combinations, zip(*ranked, strict=True), strict=True)
    )
    return ComparisonTable(
        steps=steps,
        columns=columns,
        rows=rows,
        shows_runs=len(runs) > 1,
        groups=origins.legend,
    )


def comparison_columns(combinations: Sequence[Combination]) -> tuple[MetricRow, ...]:
    """Return the metrics that the workflows select; by default, the quality metrics.

    If no quality metric differs between combinations, other metrics that differ are appended,
    without being ranked. Costs are not appended.
    """
    first: dict[tuple[str, str], MetricRow] = {}
    for cell in (cell for one in combinations for cell in one.cells):
        for row in cell_metrics(cell):
            first.setdefault((row.step, row.metric), row)
    runs = {one.run.path: one.run for one in combinations}.values()
    patterns = dict.fromkeys(pattern for run in runs for pattern in wanted_metrics(run))
    described: list[tuple[str, str]] = []
    if patterns:
        wanted = _matching(patterns, first)
    else:
        wanted = headline_keys(cell for one in combinations for cell in one.cells)
        if not any(_differs(key, combinations) for key in wanted):
            # If several steps report a metric, the last of them refines the results of the others.
            last = {metric: (step, metric) for step, metric in first}
            order = {step: place for place, (step, _) in enumerate(first)}
            described = [
                key
                for key in sorted(last.values(), key=lambda key: -order[key[0]])
                if key not in wanted
                and not cost_share(first[key].unit)
                and _differs(key, combinations)
            ][:_MAX_DESCRIBED]
    return (
        *(first[key] for key in dict.fromkeys(wanted)),
        *(replace(first[key], better="") for key in described),
    )


def _differs(key: tuple[str, str], combinations: Sequence[Combination]) -> bool:
    values = [value.value for one in combinations if (value := one.measured(*key))]
    return any(not is_rounding(values[0], value) for value in values[1:])


def _matching(patterns: Iterable[str], known: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    found: dict[tuple[str, str], None] = {}
    for pattern in patterns:
        for step, metric in known:
            # A pattern such as `*.cpu_s` selects a cost of every step, for which the table has its
            # own column.
            is_summed = pattern.startswith("*.") and metric in COSTS
            if not is_summed and fnmatchcase(f"{step}.{metric}", pattern):
                found[step, metric] = None
    return list(found)


def _costs(one: Combination, origins: Origins) -> tuple[Value, Value]:
    varied = [cell for cell in one.varied_cells if cell.status == "ok"]
    if one.failure or one.missing or not varied:
        return Value(), Value()
    time_s, memory_mib = sum(cell.cpu_s for cell in varied), max(c.peak_rss_mib for c in varied)
    group = "".join(dict.fromkeys(origins.letter(one, cell.environment) for cell in varied))
    text = f"{time_s:.2f}" if time_s < 1.0 else f"{time_s:.1f}"
    return (
        Value(text=text, sort=time_s, group=group),
        Value(text=f"{memory_mib:.0f}", sort=memory_mib, group=group),
    )


def _run_labels(runs: Sequence[Run]) -> dict[tuple[Path, str], str]:
    shared = frozenset.intersection(*(frozenset(run.record.overrides) for run in runs))
    labels = {}
    for run in runs:
        own = [option for option in run.record.overrides if option not in shared]
        words = (" ".join([run.record.name, *own]), run.path.absolute().parent.name)
        labels[run.path, run.record.run_id] = ", ".join((*words, run.record.run_id))
    return labels


def measured_text(measured: Measured) -> str:
    """Format a value, followed by its standard deviation if there are repeats."""
    if measured.n_repeats > 1:
        return number_with_spread(measured.value, measured.spread)
    return number(measured.value)


def _value(one: Combination, origins: Origins, column: MetricRow) -> Value:
    measured = one.measured(column.step, column.metric)
    if measured is None:
        return Value()
    # State the number of repeats with a value, because repeats without one, such as those that
    # missed the wall, may have been the worst.
    of_all = (
        f" ({measured.n_repeats} of {measured.n_all} repeats)"
        if measured.n_repeats < measured.n_all
        else ""
    )
    sizes = "absolute errors in " if measured.is_of_sizes else ""
    of_what = f"mean and standard deviation of {sizes}{measured.n_repeats} repeats"
    return Value(
        text=f"{measured_text(measured)}{of_all}",
        sort=measured.value,
        spread=measured.scatter,
        group=origins.letter(one, measured.environment),
        note=of_what if measured.n_repeats > 1 else "",
        n_items=one.n_items(column.step, column.counted_by),
    )


# Id of the first equivalent environment, and digests of the input data.
_Origin: TypeAlias = tuple[str, tuple[str, ...]]
# Path of the record, run id and dataset.
_Place: TypeAlias = tuple[Path, str, str]


@dataclass(frozen=True, kw_only=True)
class Origins:
    """Letters that identify the environment and the input data of each value.

    Attributes:
        environments: groups of equivalent environments.
        data: record, run and dataset -> digests of the input data.
        letters: environment and data -> letter; empty if all values have the same origin.
        legend: letter -> description.
    """

    environments: EnvironmentGroups
    data: Mapping[_Place, tuple[str, ...]]
    letters: Mapping[_Origin, str]
    legend: Mapping[str, str]

    @staticmethod
    def of(combinations: Sequence[Combination]) -> Origins:
        """Determine the origins of all values of the combinations."""
        groups = group_environments({_place(one)[:2]: one.run for one in combinations}.values())
        data: dict[_Place, tuple[str, ...]] = {}
        places: dict[_Origin, dict[str, None]] = {}
        for one in combinations:
            name = one.assignment.get(DATA, "")
            if _place(one) not in data:
                data[_place(one)] = _data_of(one.run.record, name)
            text = f"{one.run.record.run_id}{f', dataset {name}' if name else ''}"
            for cell in (cell for cell in one.cells if cell.status == "ok"):
                first = groups.first.get(cell.environment, cell.environment)
                places.setdefault((first, data[_place(one)]), {})[text] = None
        if len(places) < 2:
            return Origins(environments=groups, data=data, letters={}, legend={})
        letters = {origin: _letter(index) for index, origin in enumerate(places)}
        n_environments, n_data = (len(set(parts)) for parts in zip(*places, strict=True))
        legend = {
            letters[origin]: "; ".join(
                [groups.words.get(origin[0], origin[0])] * (n_environments > 1)
                + [f"data of run {'; '.join(texts)}"] * (n_data > 1)
            )
            for origin, texts in places.items()
        }
        return Origins(environments=groups, data=data, letters=letters, legend=legend)

    def letter(self, one: Combination, environment: str) -> str:
        """Return the letter for the origin of a value; empty if all values have the same origin."""
        first = self.environments.first.get(environment, environment)
        return self.letters.get((first, self.data[_place(one)]), "")


def _place(one: Combination) -> _Place:
    return one.run.path, one.run.record.run_id, one.assignment.get(DATA, "")


def _data_of(record: RunRecord, data: str) -> tuple[str, ...]:
    digests = [
        file.sha256
        for given in record.inputs
        # An input such as `scan@hall` belongs only to the dataset hall.
        if given.name.partition("@")[2] in {"", data}
        for file in given.files
    ]
    digests += [
        product.digest
        for cell in record.cells
        if cell.status == "ok" and not cell.inputs and cell.assignment.get(DATA, data) == data
        for product in cell.outputs.values()
    ]
    return tuple(sorted(digests))


def _letter(index: int) -> str:
    # The letter after Z is AA.
    first, last = divmod(index, len(ascii_uppercase))
    return (ascii_uppercase[first - 1] if first else "") + ascii_uppercase[last]


_MOST_COLUMNS: Final = 6
# Total number of pixels in the pictures of all datasets.
_PICTURES_PX: Final = 2_000_000
_LARGEST_PX: Final = 220
_SMALLEST_PX: Final = 64


@dataclass(frozen=True, kw_only=True)
class DatasetRow:
    """Results of the baseline on one dataset.

    Attributes:
        name: name of the dataset.
        page: path of the dataset's own page, relative to this page; empty if the dataset has none.
        picture: data URI of the dataset's first orthoimage; empty if there is no orthoimage.
        failed: failed cells with their errors, without the cells that were skipped as a
            consequence.
        missing: cells that had not run when the run was interrupted.
        values: one value per column.
        limit: text of the most important diagnostic, followed by the number of further ones.
    """

    name: str
    page: str
    picture: str
    failed: tuple[str, ...]
    missing: tuple[str, ...]
    values: tuple[Value, ...]
    limit: str


@dataclass(frozen=True, kw_only=True)
class DatasetTable:
    """The datasets of a run.

    Attributes:
        columns: step, and title of the metric with its unit, for each column.
        rows: rows in the order of the run.
        baseline: variants to which the values belong; empty if there are no variants.
    """

    columns: tuple[tuple[str, str], ...]
    rows: tuple[DatasetRow, ...]
    baseline: str = ""


def dataset_table(parts: Mapping[str, Run], pages: Mapping[str, str]) -> DatasetTable:
    """Return the table of the datasets of a run.

    Args:
        parts: dataset -> part of the run.
        pages: dataset -> path of its own page, relative to the page being written.
    """
    own = {
        name: {cell.address for cell in part.record.cells if DATA in cell.assignment}
        for name, part in parts.items()
    }
    measured = {name: _measured(part, own[name]) for name, part in parts.items()}
    units = {key: row for values in measured.values() for key, row in values.items()}
    # Use the columns of the comparison, because the workflow may select them.
    columns = comparison_columns([one for part in parts.values() for one in combinations_of(part)])
    wanted = [(column.step, column.metric) for column in columns]
    chosen = [key for key in wanted if key in units][:_MOST_COLUMNS]
    return DatasetTable(
        columns=tuple((row.step, row.titled) for row in (units[key] for key in chosen)),
        rows=tuple(
            DatasetRow(
                name=name,
                page=pages.get(name, ""),
                picture=_picture(part, own[name], len(parts)),
                failed=tuple(
                    f"{cell.address}: {cell.error_message}"
                    for cell in part.record.cells
                    if cell.status == "failed"
                ),
                missing=tuple(cell.address for cell in part.record.cells if is_missing(cell)),
                values=tuple(_dataset_value(measured[name].get(key)) for key in chosen),
                limit=_limit(part, own[name]),
            )
            for name, part in parts.items()
        ),
        baseline=variants_text(baseline_of(next(iter(parts.values())))) if parts else "",
    )


_Measured = Mapping[tuple[str, str], MetricRow]


def _measured(part: Run, own: AbstractSet[str]) -> _Measured:
    return {(row.step, row.metric): row for row in baseline_metrics(part) if row.cell in own}


def _picture(part: Run, own: AbstractSet[str], n_rows: int) -> str:
    addresses = [cell.address for cell in baseline_cells(part) if cell.address in own]
    side_px = math.isqrt(_PICTURES_PX // n_rows)
    return thumbnail(part, addresses, longest_side_px=min(_LARGEST_PX, max(_SMALLEST_PX, side_px)))


def _dataset_value(measured: MetricRow | None) -> Value:
    return Value(text=number(measured.value), sort=measured.value) if measured else Value()


def _limit(part: Run, own: AbstractSet[str]) -> str:
    baseline = {cell.address for cell in baseline_cells(part)} & own
    texts = [
        limit.text
        for limit in limits(part)
        if not baseline.isdisjoint(limit.cells) and not limit.is_failure
    ]
    return f"{texts[0]} (and {len(texts) - 1} more)" if len(texts) > 1 else "".join(texts)
