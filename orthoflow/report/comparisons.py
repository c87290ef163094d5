"""The comparison table: combinations as rows, metrics as columns, best and worst marked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from string import ascii_uppercase
from typing import Final, TypeAlias

from orthoflow.records import COSTS
from orthoflow.records.runs import MetricRow, Run, cell_metrics, is_rounding
from orthoflow.report.combinations import (
    Combination,
    Measured,
    combinations_of,
    is_missing,
    wanted_metrics,
)
from orthoflow.report.environments import group_environments
from orthoflow.report.numbers import number, number_with_spread
from orthoflow.report.rankings import BETTER, Mark, Value, cost_share, rank
from orthoflow.report.summaries import headline_keys
from orthoflow.workflow.expand import NOT_ASKED_FOR, variants_text
from orthoflow.workflow.model import DATA

_NOTHING: Final = "-"
# Seconds of loading and compiling in which a compiler was at work.
_COMPILING_S: Final = 5.0
# A machine that does nothing else moves the times of short steps by so much.
_TIMED_S: Final = 0.1
_LEADS: Final = (Mark.BEST, Mark.NEAR)
_DESCRIBED_MOST: Final = 12  # metrics that are shown where none of quality differs
_NAMED: Final = 3  # numbers that a combination is best in


@dataclass(frozen=True, kw_only=True)
class Row:
    """One combination.

    Attributes:
        run: the run it belongs to, its workflow and id.
        variants: variant of each varied step; a dash where the step has no part in it.
        is_baseline: the workflow calls it its baseline.
        failure: where and why it failed, empty when it did not.
        missing: addresses that the run was interrupted before.
        values: one per column.
        time: processor seconds of the cells that the variants have a part in: they hardly depend
            on what else the machine does.
        memory: largest memory of these cells.
        has_compiler: the memory is also that of compiling, so that no memory is ranked.
        remark: what was cached and what else to know, in words.
    """

    run: str
    variants: tuple[str, ...]
    is_baseline: bool
    failure: str
    missing: tuple[str, ...]
    values: tuple[Value, ...]
    time: Value
    memory: Value
    remark: str
    has_compiler: bool = False

    @property
    def judged(self) -> tuple[Value, ...]:
        """All its numbers."""
        return *self.values, self.time, self.memory

    @property
    def groups(self) -> tuple[str, ...]:
        """Signs of the environments and data of its numbers, each once."""
        return tuple(
            dict.fromkeys(value.group for value in self.judged if value.text if value.group)
        )

    @property
    def shortfall(self) -> str:
        """Why it has no time and no memory, in a word or two; empty when it is whole."""
        return "failed" if self.failure else "not computed" if self.missing else ""


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How often a combination leads among the others.

    Attributes:
        name: its variants, behind the run where there are several.
        is_baseline: the workflow calls it its baseline.
        shortfall: why it did not come to its end, empty when it did.
        n_best: numbers in which it is clearly best.
        n_near: numbers in which it is among the best, and no difference is shown.
        n_worst: numbers in which it is worst.
        best_in: what it is clearly best in, at most three.
        groups: signs of its environments and data, where there are several.
        is_unranked: nothing of it is ranked, as no other has a sign of it.
        time: processor seconds of the cells that the variants have a part in: they hardly depend
            on what else the machine does.
    """

    name: str
    is_baseline: bool
    shortfall: str
    n_best: int
    n_near: int
    n_worst: int
    best_in: tuple[str, ...]
    groups: tuple[str, ...]
    is_unranked: bool
    time: Value


@dataclass(frozen=True, kw_only=True)
class ComparisonTable:
    """Combinations beside each other.

    Attributes:
        steps: the varied steps.
        columns: metrics.
        rows: in the order of the runs and their graphs.
        shows_runs: rows come from more than one run.
        groups: letter -> what environment or data it stands for; empty when all is of one kind.
    """

    steps: tuple[str, ...]
    columns: tuple[MetricRow, ...]
    rows: tuple[Row, ...]
    shows_runs: bool
    groups: Mapping[str, str]

    @property
    def forced(self) -> str:
        """Options that measure all again in one environment; empty if there is only one."""
        if not any(sign.isupper() for sign in self.groups):
            return ""
        steps = dict.fromkeys((*self.steps, *(column.step for column in self.columns)))
        return " ".join(f"--force {step}" for step in steps if step != DATA)

    @property
    def n_whole(self) -> int:
        """How many combinations came to their end."""
        return sum(not row.shortfall for row in self.rows)

    @property
    def baseline(self) -> str:
        """The combination that the others are compared with; empty where there is none, or two."""
        found = [one for row, one in zip(self.rows, self._names, strict=True) if row.is_baseline]
        return found[0] if len(found) == 1 else ""

    @property
    def _names(self) -> list[str]:
        """What distinguishes each row from the others."""
        variants = (
            variants_text(
                {
                    step: chosen
                    for step, chosen in zip(self.steps, row.variants, strict=True)
                    if chosen != _NOTHING
                }
            )
            for row in self.rows
        )
        return [
            f"{row.run}: {text}" if self.shows_runs else text
            for row, text in zip(self.rows, variants, strict=True)
        ]

    @property
    def n_judged(self) -> int:
        """How many of the columns have a good side, time and memory included."""
        return sum(column.better in BETTER for column in self.columns) + 2

    @property
    def n_undecided(self) -> int:
        """In how many of these no combination leads, so that they count for nobody."""
        places = zip(*(row.judged for row in self.rows), strict=True)
        return self.n_judged - sum(any(one.mark in _LEADS for one in place) for place in places)

    @property
    def glance(self) -> tuple[Standing, ...]:
        """How often each combination leads; who is best, then near the best most often first."""
        labels = [
            *(f"{one.step}: {one.titled}" for one in self.columns),
            "processor time",
            "memory",
        ]
        found = []
        groups = [row.groups for row in self.rows]
        for row, name, own in zip(self.rows, self._names, groups, strict=True):
            marks = [value.mark for value in row.judged]
            best = [label for label, mark in zip(labels, marks, strict=True) if mark is Mark.BEST]
            found.append(
                Standing(
                    name=name,
                    is_baseline=row.is_baseline,
                    shortfall=row.shortfall,
                    n_best=len(best),
                    n_near=marks.count(Mark.NEAR),
                    n_worst=marks.count(Mark.WORST),
                    best_in=(*best[:_NAMED], *(["..."] if len(best) > _NAMED else [])),
                    groups=own,
                    is_unranked=own != () and sum(not set(own).isdisjoint(e) for e in groups) == 1,
                    time=row.time,
                )
            )

        def place(one: Standing) -> tuple[bool, int, int, int]:
            return bool(one.shortfall), -one.n_best, -one.n_near, one.n_worst

        return tuple(sorted(found, key=place))


def comparison_table(runs: Sequence[Run]) -> ComparisonTable | None:
    """Put the combinations of one or more runs beside each other; None when there is but one.

    Values are ranked only among those of one environment and one set of data; with more than one
    of either, letters distinguish them.
    """
    combinations = [one for run in runs for one in combinations_of(run)]
    if len(combinations) < 2:
        return None
    steps = tuple(dict.fromkeys(step for one in combinations for step in one.assignment))
    columns = comparison_columns(combinations)
    origins = Origins.of(runs)
    labels = _run_labels(runs)
    rows = [_row(one, steps, columns, origins, labels[_name(one.run)]) for one in combinations]
    return ComparisonTable(
        steps=steps,
        columns=columns,
        rows=_ranked(rows, columns),
        shows_runs=len(runs) > 1,
        groups=origins.legend,
    )


def comparison_columns(combinations: Sequence[Combination]) -> tuple[MetricRow, ...]:
    """Metrics that the workflows ask for, else those of quality; the cost has its own places.

    Where none of quality differs, what does is described behind them and not judged.
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
        # A later step of the chain improves on an earlier one: first and final orientation.
        last: dict[tuple[str, str], None] = {}
        for one in combinations:
            steps = {row.metric: row.step for cell in one.cells for row in cell_metrics(cell)}
            last |= dict.fromkeys((step, metric) for metric, step in steps.items())
        wanted = headline_keys(cell for one in combinations for cell in one.cells)
        if not any(_differs(key, combinations) for key in wanted):
            others = [key for key in last if key not in wanted and not cost_share(first[key].unit)]
            described = _described(others, combinations)
    return (
        *(first[key] for key in dict.fromkeys(wanted)),
        *(replace(first[key], better="") for key in described),
    )


def _differs(key: tuple[str, str], combinations: Sequence[Combination]) -> bool:
    """Whether a metric is not the same in all combinations that have it."""
    found = [one.measured(*key) for one in combinations]
    values = [one.value for one in found if one is not None]
    return any(not is_rounding(values[0], value) for value in values[1:])


def _described(
    keys: Iterable[tuple[str, str]], combinations: Sequence[Combination]
) -> list[tuple[str, str]]:
    """Metrics that differ, those of the last step first."""
    by_step: dict[str, list[tuple[str, str]]] = {}
    for key in keys:
        if _differs(key, combinations):
            by_step.setdefault(key[0], []).append(key)
    return [key for own in reversed(by_step.values()) for key in own][:_DESCRIBED_MOST]


def _matching(patterns: Iterable[str], known: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    found: dict[tuple[str, str], None] = {}
    for pattern in patterns:
        for step, metric in known:
            # `*.wall_s` asks for every step's time; the table sums it up in a column of its own.
            is_summed = pattern.startswith("*.") and metric in COSTS
            if not is_summed and fnmatchcase(f"{step}.{metric}", pattern):
                found[step, metric] = None
    return list(found)


def _row(
    one: Combination,
    steps: Sequence[str],
    columns: Sequence[MetricRow],
    origins: Origins,
    label: str,
) -> Row:
    failed = one.failure
    varied = [cell for cell in one.varied_cells if cell.status == "ok"]
    group = origins.letters(one, varied[0].environment if varied else "")
    has_cost = failed is None and not one.missing and bool(varied)
    time_s = sum(cell.cpu_s for cell in varied)
    has_compiler = has_cost and max(cell.compile_s or 0.0 for cell in varied) > _COMPILING_S
    cost_group = "".join(dict.fromkeys(origins.letters(one, cell.environment) for cell in varied))
    return Row(
        run=label,
        variants=tuple(one.assignment.get(step, _NOTHING) for step in steps),
        is_baseline=one.is_baseline,
        failure=f"{failed.address}: {failed.error_message}" if failed else "",
        missing=tuple(cell.address for cell in one.missing),
        values=tuple(
            _value(one.measured(column.step, column.metric), one, origins, column)
            for column in columns
        ),
        time=_time(time_s, cost_group) if has_cost else Value(),
        memory=_memory(max(cell.peak_rss_mib for cell in varied), group) if has_cost else Value(),
        has_compiler=has_compiler,
        remark="; ".join(
            part
            for part in (
                "a step compiled, which takes memory, too: none is ranked" if has_compiler else "",
                _remark(one),
            )
            if part
        ),
    )


def _time(seconds: float, group: str) -> Value:
    text = f"{seconds:.2f}" if seconds < 1.0 else f"{seconds:.1f}"
    return Value(text=text, sort=seconds, spread=_TIMED_S, group=group)


def _memory(mib: float, group: str) -> Value:
    return Value(text=f"{mib:.0f}", sort=mib, group=group)


# Record, id of the run, and name of the dataset.
_Place: TypeAlias = tuple[Path, str, str]


def _name(run: Run) -> tuple[Path, str]:
    return run.path, run.record.run_id


def _run_labels(runs: Sequence[Run]) -> dict[tuple[Path, str], str]:
    """The workflow with the options that not all runs have, the run's folder and its id."""
    shared = frozenset.intersection(*(frozenset(run.record.overrides) for run in runs))
    return {
        _name(run): ", ".join(
            (
                " ".join(
                    (run.record.name, *(one for one in run.record.overrides if one not in shared))
                ),
                run.path.absolute().parent.name,
                run.record.run_id,
            )
        )
        for run in runs
    }


def _value(
    measured: Measured | None, one: Combination, origins: Origins, column: MetricRow
) -> Value:
    if measured is None:
        return _absent(one, origins, column)
    repeated = measured.n_repeats > 1
    text = (
        number_with_spread(measured.value, measured.spread) if repeated else number(measured.value)
    )
    # Of a repeat that missed the wall there is no error of it, and the others look as good as any.
    of_all = (
        f" ({measured.n_repeats} of {measured.n_all} repeats)"
        if measured.n_repeats < measured.n_all
        else ""
    )
    sizes = "the sizes of errors of both signs in " if measured.is_of_sizes else ""
    of_what = f"{sizes}{measured.n_repeats} repeats"
    return Value(
        text=f"{text}{of_all}",
        sort=measured.value,
        spread=measured.spread,
        group=origins.letters(one, measured.environment),
        note=f"mean and standard deviation of {of_what}" if repeated else "",
        n_items=one.n_items(column.step, column.counted_by),
    )


def _absent(one: Combination, origins: Origins, column: MetricRow) -> Value:
    """What stands where there is no number: nothing was found, or nobody asked."""
    own = [cell for cell in one.cells if cell.step == column.step]
    asked = [cell for cell in own if not is_missing(cell) and cell.error_type != NOT_ASKED_FOR]
    if one.failure is not None and (asked or not own):
        # Of another run the step may be, and not of this one.
        asked = [one.failure] if _has_step(one.run, column.step) else []
    if not asked:
        return Value()
    return Value(group=origins.letters(one, asked[0].environment), found_nothing=True)


def _has_step(run: Run, step: str) -> bool:
    return any(cell.step == step for cell in run.record.cells)


def _remark(one: Combination) -> str:
    cached = [cell for cell in one.varied_cells if cell.cached_from]
    parts = []
    if cached:
        sources = ", ".join(dict.fromkeys(cell.cached_from for cell in cached))
        n_computed = sum(cell.status != "skipped" for cell in one.varied_cells)
        parts.append(
            f"{len(cached)} of {n_computed} steps cached, with their time in run {sources}"
        )
    n_older = sum(cell.status == "ok" and cell.compile_s is None for cell in one.varied_cells)
    if n_older:
        of_all = f"{n_older} of {len(one.varied_cells)} steps"
        parts.append(f"{of_all} with loading and compiling in their time")
    if one.n_failed_repeats:
        parts.append(f"{one.n_failed_repeats} repeats failed")
    return "; ".join(parts)


def _ranked(rows: Sequence[Row], columns: Sequence[MetricRow]) -> tuple[Row, ...]:
    by_column = [
        rank([row.values[index] for row in rows], column.better, column.unit)
        for index, column in enumerate(columns)
    ]
    times = rank([row.time for row in rows], "lower", "s")
    has_compiler = any(row.has_compiler for row in rows)
    memories = rank([row.memory for row in rows], "" if has_compiler else "lower", "MiB")
    return tuple(
        replace(
            row,
            values=tuple(values[index] for values in by_column),
            time=times[index],
            memory=memories[index],
        )
        for index, row in enumerate(rows)
    )


@dataclass(frozen=True, kw_only=True)
class Origins:
    """Capital letters for the environments, small ones for the data of one or more runs.

    Attributes:
        environments: id -> letter, the same for equivalent ones.
        data: run, and its dataset or nothing -> letter.
        legend: what each sign in use stands for; empty when all is of one kind.
    """

    environments: Mapping[str, str]
    data: Mapping[_Place, str]
    legend: Mapping[str, str]

    @staticmethod
    def of(runs: Sequence[Run]) -> Origins:
        """Look through the environments and the data of runs."""
        groups = group_environments(runs)
        signs = {key: _letter(index) for index, key in enumerate(groups.words)}
        # What each run was given, or each of its datasets: digests -> places that have them.
        named: dict[tuple[str, ...], dict[_Place, str]] = {}
        for run in runs:
            datasets = {cell.assignment.get(DATA, "") for cell in run.record.cells} - {""}
            for data in sorted(datasets) if len(runs) > 1 and datasets else ("",):
                text = f"{run.record.run_id}{f', dataset {data}' if data else ''}"
                named.setdefault(_data_of(run, data), {})[(*_name(run), data)] = text
        # No digits: raised behind a number they would look like powers.
        small = {key: _letter(index).lower() for index, key in enumerate(named)}
        legend: dict[str, str] = {}
        if len(signs) > 1:
            legend |= {signs[key]: words for key, words in groups.words.items()}
        if len(named) > 1:
            legend |= {
                small[key]: f"data of run {'; '.join(dict.fromkeys(text.values()))}"
                for key, text in named.items()
            }
        places = {place: small[key] for key, text in named.items() for place in text}
        letters = {key: signs[first] for key, first in groups.first.items()}
        return Origins(environments=letters, data=places, legend=legend)

    def letters(self, one: Combination, environment: str) -> str:
        """Return the sign of a value; empty when all values are of one kind."""
        has_several = len(set(self.environments.values())) > 1
        letter = self.environments.get(environment, "?") if has_several else ""
        if len(set(self.data.values())) < 2:
            return letter
        own = (*_name(one.run), one.assignment.get(DATA, ""))
        return letter + self.data.get(own, "?")


def _letter(index: int) -> str:
    # 27 environments in one report: AA follows Z.
    first, last = divmod(index, len(ascii_uppercase))
    return (ascii_uppercase[first - 1] if first else "") + ascii_uppercase[last]


def _data_of(run: Run, data: str) -> tuple[str, ...]:
    """What the methods were given: digests of input files, and of simulated data."""
    return tuple(sorted(_digests(run, data)))


def _digests(run: Run, data: str) -> Iterator[str]:
    for given in run.record.inputs:
        # `scan@hall` is that of one dataset; the others' have no part in it.
        if not data or given.name.partition("@")[2] in {"", data}:
            yield from (file.sha256 for file in given.files)
    for cell in run.record.cells:
        is_own = not data or cell.assignment.get(DATA, data) == data
        if is_own and cell.status == "ok" and not cell.inputs:
            yield from (product.digest for product in cell.outputs.values())
