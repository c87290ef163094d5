"""Methods compared over datasets: medians, and differences dataset by dataset with a rank test."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.robust import median_deviation
from orthoflow.records.runs import MetricRow, Run, is_rounding
from orthoflow.report.combinations import (
    Combination,
    EnvironmentGroups,
    Measured,
    baseline_of,
    combination_of,
    combinations_of,
    group_environments,
)
from orthoflow.report.comparisons import comparison_columns
from orthoflow.report.rankings import BETTER, badness, is_flag
from orthoflow.report.tables import Column, Table
from orthoflow.untrusted_text import Value, first_few
from orthoflow.workflow.expand import variants_text
from orthoflow.workflow.model import DATA

# Of four differences that all agree p is 0.125: a test of so few can show nothing.
_MIN_TESTED: Final = 5
# For two methods signed ranks are more powerful.
_MIN_RANKED: Final = 3
# Of six that all agree p is 0.031, of five 0.0625.
_MIN_SHOWN: Final = 6
_SHOWN_P: Final = 0.05
_MAX_NAMED: Final = 6
_TEST: Final = f"p below {_SHOWN_P:g} after Holm's correction"


@dataclass(frozen=True, kw_only=True)
class Paired:
    """How a method does against the reference on the datasets that both have a value of.

    What differs by rounding only (`is_rounding`) is level: neither better nor worse, and a
    difference of zero.

    Attributes:
        n: datasets with both values.
        wins: datasets on which the method is better.
        losses: datasets on which it is worse.
        median: median of the differences, in the metric's unit; negative where it has less. For
            signed errors the sizes are compared, where 1 is best the factors to 1, as logarithms.
            Of what is yes or no the mean, the difference of the shares.
        p: Wilcoxon's signed-rank test that the differences lie about zero, two-sided; NaN of
            fewer than five differences.
        effect: matched-pairs rank-biserial correlation, from -1 (worse on every dataset) to 1
            (better on every one); NaN where p is.
        interval: of the median difference, at least 95 % confidence, from order statistics, which
            take no distribution for granted; NaN of fewer than six datasets, and of shares.
        p_holm: p corrected by Holm for all comparisons of the run; NaN where p is.
    """

    n: int
    wins: int
    losses: int
    median: float
    p: float
    effect: float
    interval: tuple[float, float] = (math.nan, math.nan)
    p_holm: float = math.nan


@dataclass(frozen=True, kw_only=True)
class MethodOverDatasets:
    """The variants on which a step depends, on all datasets.

    Attributes:
        variants: step -> variant; empty when nothing varies.
        is_reference: the others are compared with it.
        n: datasets with a value.
        n_failed: datasets on which the step, or one before it, failed; they have no part in any
            number.
        n_absent: datasets that have no value though nothing failed, or were left out.
        n_partly: datasets with a value of only some repeats.
        n_apart: datasets on which both have a value, but of different environments or of unequal
            numbers of photos, so that they are not paired.
        median: over the datasets, of signed errors of their sizes; NaN without any. Of what is yes
            or no the mean, the share of yes.
        spread: 1.4826 times the median absolute deviation from it; NaN without any, and of shares.
        paired: against the reference; None for itself, and where neither more nor less is better.
    """

    variants: Mapping[str, str]
    is_reference: bool
    n: int
    n_failed: int
    n_absent: int
    n_partly: int
    n_apart: int
    median: float
    spread: float
    paired: Paired | None

    @property
    def name(self) -> str:
        """The variants in words, `plane=ransac`."""
        return variants_text(self.variants)


@dataclass(frozen=True, kw_only=True)
class MeanRanks:
    """How methods rank over the datasets that all have a value of (Demsar 2006).

    Attributes:
        n: datasets.
        ranks: method -> mean rank, 1 is best, best first.
        p: Friedman's test that all are equal.
        critical_difference: of two mean ranks, by Nemenyi at 0.05: nearer ones are not shown to
            differ.
    """

    n: int
    ranks: Mapping[str, float]
    p: float
    critical_difference: float

    @property
    def leading(self) -> tuple[str, ...]:
        """The best, and all that are not shown to differ from it; all where p is not below 0.05."""
        best = min(self.ranks.values())
        reach = self.critical_difference if self.p < _SHOWN_P else math.inf
        return tuple(name for name, rank in self.ranks.items() if rank - best < reach)


@dataclass(frozen=True, kw_only=True)
class MetricOverDatasets:
    """One metric of one step over all datasets.

    Attributes:
        column: the metric, as one of its cells has it.
        methods: the variants on which the step depends, in the order of the graph.
        ranks: of all of them; None of fewer than three, or than five datasets.
    """

    column: MetricRow
    methods: tuple[MethodOverDatasets, ...]
    ranks: MeanRanks | None = None

    @property
    def middle(self) -> str:
        """What the medians are, which are shares where the metric is yes or no."""
        return "share" if is_flag(self.column.unit) else "median"

    @property
    def reference(self) -> MethodOverDatasets:
        """What the others are compared with."""
        return next(one for one in self.methods if one.is_reference)

    def method_of(self, assignment: Mapping[str, str]) -> MethodOverDatasets | None:
        """Return the variants that a combination has of the step."""
        return next(
            (one for one in self.methods if one.variants.items() <= assignment.items()), None
        )


def middle_of(values: NDArray[np.float64], unit: str) -> float:
    """What stands for the values of several datasets; NaN without any.

    Their median, but of what is yes or no the mean, the share of yes: the median would hide all
    that is so on fewer than half of them.
    """
    if not values.size:
        return math.nan
    return float(np.mean(values) if is_flag(unit) else np.median(values))


def spread_of(values: NDArray[np.float64], unit: str) -> float:
    """How far the values of several datasets lie apart; NaN without any.

    A share has none, since it determines both counts.
    """
    return math.nan if is_flag(unit) or not values.size else median_deviation(values)


def over_datasets(parts: Mapping[str, Run]) -> tuple[MetricOverDatasets, ...]:
    """Compare the variants of a run over its datasets, metric by metric.

    Values of different environments, or over unequal numbers of photos, are never paired.

    Args:
        parts: dataset -> its part of the run.
    """
    every = [one for part in parts.values() for one in combinations_of(part)]
    every = [one for one in every if DATA in one.assignment]
    if len(parts) < 2 or not every:
        return ()
    environments = group_environments(parts.values())
    # Step -> variants on which it depends -> dataset -> what leads to it.
    ways: dict[str, dict[tuple[tuple[str, str], ...], dict[str, Combination]]] = {}
    for name, part in parts.items():
        baseline = baseline_of(part)
        for cell in part.record.cells:
            if cell.assignment.get(DATA) == name and cell.repeat == 0:
                own = tuple((k, v) for k, v in cell.assignment.items() if k != DATA)
                by_data = ways.setdefault(cell.step, {}).setdefault(own, {})
                by_data[name] = combination_of(part, cell.assignment, baseline)
    return _corrected(
        _over(column, ways[column.step], len(parts), environments)
        for column in comparison_columns(every)
        if column.step in ways
    )


def _over(
    column: MetricRow,
    ways: Mapping[tuple[tuple[str, str], ...], Mapping[str, Combination]],
    n_datasets: int,
    environments: EnvironmentGroups,
) -> MetricOverDatasets:
    step, metric = column.step, column.metric
    measured = {
        own: {
            name: value
            for name, one in by_data.items()
            if one.failure is None and (value := one.measured(step, metric)) is not None
        }
        for own, by_data in ways.items()
    }
    reference = next(
        (own for own, by_data in ways.items() if next(iter(by_data.values())).is_baseline),
        next(iter(ways)),
    )

    def comparable(own: tuple[tuple[str, str], ...]) -> dict[str, tuple[Measured, Measured]]:
        """Dataset -> its value and that of the reference, where they may be compared."""
        found = {}
        for name in measured[own].keys() & measured[reference].keys():
            both = measured[own][name], measured[reference][name]
            # Errors over more photos are no worse ones.
            ours, theirs = (
                ways[key][name].n_items(step, column.counted_by) for key in (own, reference)
            )
            is_like = environments.are_comparable(*(one.environment for one in both))
            if is_like and not abs(ours - theirs) > 0.0:
                found[name] = both
        return {name: found[name] for name in measured[own] if name in found}

    pairs = {own: comparable(own) for own in ways}
    is_judged = column.better in BETTER
    methods = []
    for own, by_data in ways.items():
        values = np.array([value.value for value in measured[own].values()])
        if column.better == "lower":
            # Errors of both signs would make each other small.
            values = np.abs(values)
        n_failed = sum(one.failure is not None for one in by_data.values())
        n_both = len(measured[own].keys() & measured[reference].keys())
        methods.append(
            MethodOverDatasets(
                variants=dict(own),
                is_reference=own == reference,
                n=len(values),
                n_failed=n_failed,
                n_absent=n_datasets - len(values) - n_failed,
                n_partly=sum(value.n_repeats < value.n_all for value in measured[own].values()),
                n_apart=n_both - len(pairs[own]) if is_judged else 0,
                median=middle_of(values, column.unit),
                spread=spread_of(values, column.unit),
                paired=_paired(pairs[own].values(), column)
                if is_judged and own != reference
                else None,
            )
        )
    ranks = None
    if is_judged and len(ways) >= _MIN_RANKED:
        shared = [name for name in pairs[reference] if all(name in own for own in pairs.values())]
        rows = np.array(
            [[badness(pairs[own][name][0].value, column.better) for own in ways] for name in shared]
        )
        if len(shared) >= _MIN_TESTED and np.isfinite(rows).all():
            ranks = mean_ranks([one.name for one in methods], rows)
    return MetricOverDatasets(column=column, methods=tuple(methods), ranks=ranks)


def _corrected(metrics: Iterable[MetricOverDatasets]) -> tuple[MetricOverDatasets, ...]:
    """Correct all p of a run together, by Holm: of many comparisons some are small by chance."""
    metrics = tuple(metrics)
    found = [one.paired.p for metric in metrics for one in metric.methods if one.paired]
    corrected = holm([p for p in found if math.isfinite(p)])
    return tuple(
        replace(
            metric,
            methods=tuple(
                one
                if one.paired is None or one.paired.p not in corrected
                else replace(one, paired=replace(one.paired, p_holm=corrected[one.paired.p]))
                for one in metric.methods
            ),
        )
        for metric in metrics
    )


def holm(values: Sequence[float]) -> dict[float, float]:
    """Correct p-values of several tests by Holm's step-down method: p -> corrected p.

    >>> holm([0.01, 0.04, 0.03])
    {0.01: 0.03, 0.03: 0.06, 0.04: 0.06}
    """
    ordered = np.sort(np.array(values, dtype=np.float64))
    steps = ordered * np.arange(len(ordered), 0, -1)
    corrected = np.minimum(np.maximum.accumulate(steps), 1.0)
    return dict(zip(ordered.tolist(), corrected.tolist(), strict=True))


def mean_ranks(names: Sequence[str], badness_of: NDArray[np.float64]) -> MeanRanks:
    """Rank methods over datasets, and test whether they differ.

    Args:
        names: of the methods, three at least.
        badness_of: (datasets, methods), smaller is better.
    """
    from scipy.stats import (  # noqa: PLC0415 - takes half a second
        friedmanchisquare,
        rankdata,
        studentized_range,
    )

    n, k = badness_of.shape
    means = rankdata(badness_of, axis=1).mean(axis=0)
    is_level = bool((badness_of == badness_of[:, :1]).all())
    quantile = float(studentized_range.ppf(1.0 - _SHOWN_P, k, math.inf)) / math.sqrt(2.0)
    return MeanRanks(
        n=n,
        ranks={names[place]: float(means[place]) for place in np.argsort(means, kind="stable")},
        p=1.0 if is_level else float(friedmanchisquare(*badness_of.T).pvalue),
        critical_difference=quantile * math.sqrt(k * (k + 1) / (6.0 * n)),
    )


def who_leads(over: Sequence[MetricOverDatasets], n_datasets: int) -> str:
    """State in a sentence or two which variants are shown to be better; empty without several.

    Args:
        over: the metrics.
        n_datasets: how many the run has.
    """
    judged = [metric for metric in over if metric.column.better in BETTER]
    rows = [(metric, one) for metric in judged for one in metric.methods if not one.is_reference]
    if not rows:
        return ""
    if not any(one.paired and math.isfinite(one.paired.p) for _, one in rows):
        return (
            f"No difference is shown: it takes {_MIN_SHOWN} of the {n_datasets} datasets that "
            "differ, computed in one environment"
        )
    leads, level = [], []
    for name in dict.fromkeys(one.name for _, one in rows):
        own = [(metric, one.paired) for metric, one in rows if one.name == name]
        shown = [(metric.column.title, pair) for metric, pair in own if pair]
        shown = [(title, pair) for title, pair in shown if pair.p_holm < _SHOWN_P]
        sides = {
            "better": [title for title, pair in shown if pair.effect > 0],
            "worse": [title for title, pair in shown if pair.effect <= 0],
        }
        words = [
            f"{side} in {len(titles)} of {len(own)} numbers ({', '.join(titles)})"
            for side, titles in sides.items()
            if titles
        ]
        if words:
            leads.append(f"{name} {' and '.join(words)}")
        else:
            level.append(name)
    if not leads:
        return f"No difference is shown in any of {len(judged)} numbers ({_TEST})"
    rest = f". No difference is shown of {first_few(level, most=_MAX_NAMED)}" if level else ""
    return (
        f"Shown over the datasets against {judged[0].reference.name} ({_TEST}): "
        f"{first_few(leads, most=_MAX_NAMED)}{rest}"
    )


def _paired(pairs: Iterable[tuple[Measured, Measured]], column: MetricRow) -> Paired | None:
    worse = []
    for both in pairs:
        own, other = (badness(one.value, column.better) for one in both)
        # A rank test would take the last digits of six datasets for a proof.
        if math.isfinite(own - other):
            worse.append(0.0 if is_rounding(own, other) else own - other)
    return paired_differences(np.array(worse), column.better, column.unit) if worse else None


def paired_differences(worse: NDArray[np.float64], better: str, unit: str = "1") -> Paired:
    """Judge differences of pairs.

    Args:
        worse: (n,) how much worse than the reference the method is on each dataset, finite; at
            least one; zero where they are level.
        better: which values are, for the sign of the differences.
        unit: of its values.
    """
    from scipy.stats import quantile_test, rankdata, wilcoxon  # noqa: PLC0415 - half a second

    sign = -1.0 if better == "higher" else 1.0
    moved = worse[worse != 0]
    p = effect = math.nan
    if moved.size >= _MIN_TESTED:
        ranks = rankdata(np.abs(moved))
        effect = float((ranks[moved < 0].sum() - ranks[moved > 0].sum()) / ranks.sum())
        p = float(wilcoxon(moved).pvalue)
    low, high = math.nan, math.nan
    if not is_flag(unit):
        # Any: scipy's types name another class.
        tested: Any = quantile_test(sign * worse)
        low, high = tested.confidence_interval(1.0 - _SHOWN_P)
    return Paired(
        n=len(worse),
        wins=int((worse < 0).sum()),
        losses=int((worse > 0).sum()),
        median=sign * middle_of(worse, unit),
        p=p,
        effect=effect,
        interval=(float(low), float(high)),
    )


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
