"""Comparison of methods over datasets: medians, paired differences and rank tests."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

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
from orthoflow.report.curves import Varied
from orthoflow.report.rankings import (
    BETTER,
    badness,
    is_flag,
    middle_of,
    number_with_unit,
    spread_of,
)
from orthoflow.report.tables import Column, Table
from orthoflow.untrusted_text import Value, first_few
from orthoflow.workflow.expand import variants_text
from orthoflow.workflow.model import DATA

# With four differences, p is at least 0.125, so none can be significant.
_MIN_TESTED: Final = 5
# Minimum number of methods for mean ranks; for two methods, the signed-rank test is more powerful.
_MIN_RANKED: Final = 3
# If all differences have the same sign, p is 0.031 for six datasets but 0.0625 for five.
_MIN_SHOWN: Final = 6
_SHOWN_P: Final = 0.05
_MAX_NAMED: Final = 6
# Pairs of step and variant, for the steps with variants on which a step depends.
_Variants: TypeAlias = tuple[tuple[str, str], ...]
_Bases: TypeAlias = dict[_Variants, _Variants]
_TEST: Final = f"p below {_SHOWN_P:g} after Holm's correction"


@dataclass(frozen=True, kw_only=True)
class Paired:
    """Comparison of a method with the reference, over the datasets on which both have a value.

    Differences due to rounding (`is_rounding`) count as neither better nor worse.

    Attributes:
        n: number of datasets on which both have a value.
        wins: number of datasets on which the method is better.
        losses: number of datasets on which the method is worse.
        median: median difference in the unit of the metric; negative if the method has smaller
            values. Signed errors are compared by their absolute value. Metrics for which 1 is the
            best value are compared by the absolute value of their logarithm. For yes/no metrics,
            this is the difference between the shares of "yes".
        p: p-value of Wilcoxon's two-sided signed-rank test; NaN for fewer than five differences.
        effect: matched-pairs rank-biserial correlation, from -1 (worse on every dataset) to 1
            (better on every dataset); NaN if p is NaN.
        interval: distribution-free confidence interval of the median difference, based on order
            statistics, with a confidence level of at least 95 %; NaN for fewer than six datasets
            and for shares.
        p_holm: p-value corrected by Holm's method for all comparisons in the run; NaN if p is NaN.
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
    """Values of a metric over all datasets, for one selection of variants.

    Attributes:
        variants: step -> variant; empty if there are no variants.
        compared_with: name of the variants with which these are compared: those of the baseline, or
            variants with the baseline's methods and the same values of swept parameters. Empty for
            the baseline itself, which is the reference.
        n: number of datasets with a value.
        n_failed: number of datasets that are not used because this step or an upstream step failed.
        n_absent: number of datasets without a value, although no step failed.
        n_partly: number of datasets on which only some repeats have a value.
        n_apart: number of datasets that cannot be paired because the environment or the number of
            items, such as photos, differs from that of the reference.
        median: median over the datasets (of absolute values for signed errors), or the share of
            "yes" for yes/no metrics; NaN if there are no values.
        spread: 1.4826 times the median absolute deviation; NaN if there are no values, and for
            shares.
        repeat_spread: standard deviation over repeats, as median over the datasets; NaN without
            repeats.
        paired: comparison with `compared_with`; None for the reference and for unranked metrics.
    """

    variants: Mapping[str, str]
    compared_with: str
    n: int
    n_failed: int
    n_absent: int
    n_partly: int
    n_apart: int
    median: float
    spread: float
    repeat_spread: float
    paired: Paired | None

    @property
    def name(self) -> str:
        """The variants as text, e.g. `plane=ransac`."""
        return variants_text(self.variants)


@dataclass(frozen=True, kw_only=True)
class MeanRanks:
    """Ranks of methods over the datasets on which all of them have a value (Demsar 2006).

    Attributes:
        n: number of datasets on which all methods have a value.
        ranks: method -> mean rank, beginning with the best; the best possible rank is 1.
        p: p-value of Friedman's test; the null hypothesis is that all methods are equal.
        critical_difference: critical difference of mean ranks by Nemenyi's test at the 0.05 level;
            methods whose mean ranks differ by less are not significantly different.
    """

    n: int
    ranks: Mapping[str, float]
    p: float
    critical_difference: float

    @property
    def leading(self) -> tuple[str, ...]:
        """The best method, and the methods that do not differ significantly from it.

        These are all methods if p >= 0.05.
        """
        best = min(self.ranks.values())
        reach = self.critical_difference if self.p < _SHOWN_P else math.inf
        return tuple(name for name, rank in self.ranks.items() if rank - best < reach)


@dataclass(frozen=True, kw_only=True)
class MetricOverDatasets:
    """One metric of one step over all datasets.

    Attributes:
        column: metadata of the metric.
        methods: results of the variants on which the step depends, in the order of the graph.
        ranks: ranks of all methods; None if there are fewer than three methods or fewer than five
            datasets.
    """

    column: MetricRow
    methods: tuple[MethodOverDatasets, ...]
    ranks: MeanRanks | None = None

    @property
    def reference(self) -> MethodOverDatasets:
        """Results of the reference variants."""
        return next(one for one in self.methods if not one.compared_with)

    @property
    def lead(self) -> str:
        """Sentence on the best and second-best value, and whether they differ significantly.

        It is empty if the metric is not ranked or fewer than two values can be compared.
        """
        better, unit = self.column.better, self.column.unit
        # A median over fewer datasets may be better only because the difficult datasets are
        # missing.
        most = max(one.n for one in self.methods)
        known = [one for one in self.methods if one.n == most and math.isfinite(one.median)]
        if better not in BETTER or len(known) < 2:
            return ""
        best, *others = sorted(known, key=lambda one: badness(one.median, better))
        after = others[0]
        if self.ranks is not None:
            test = "Nemenyi's test"
            is_clear = best.name in self.ranks.leading and after.name not in self.ranks.leading
        else:
            pairs = [one.paired for one in self.methods if one.paired]
            is_pair = len(self.methods) == 2
            test = "Wilcoxon's test" if is_pair else "too few datasets"
            is_clear = is_pair and any(pair.p_holm < _SHOWN_P for pair in pairs)
        unit = "1" if is_flag(unit) else unit
        values = [f"{one.name} ({number_with_unit(one.median, unit)})" for one in (best, after)]
        level = [one.name for one in others if is_rounding(best.median, one.median)]
        if level:
            return f"{values[0]} is level with {first_few(level, most=_MAX_NAMED)}."
        return (
            f"{values[0]} is best, {values[1]} next; the difference is "
            f"{'' if is_clear else 'not '}significant ({test})."
        )


def over_datasets(parts: Mapping[str, Run]) -> tuple[MetricOverDatasets, ...]:
    """Compare the variants of a run over its datasets, for each metric.

    Values from different environments, or over different numbers of items such as photos, are never
    paired.

    Args:
        parts: dataset -> part of the run.
    """
    every = [one for part in parts.values() for one in combinations_of(part)]
    every = [one for one in every if DATA in one.assignment]
    if len(parts) < 2 or not every:
        return ()
    environments = group_environments(parts.values())
    # Step -> variants on which the step depends -> dataset -> combination.
    ways: dict[str, dict[_Variants, dict[str, Combination]]] = {}
    for name, part in parts.items():
        baseline = baseline_of(part)
        for cell in part.record.cells:
            if cell.assignment.get(DATA) == name and cell.repeat == 0:
                own = tuple((k, v) for k, v in cell.assignment.items() if k != DATA)
                by_data = ways.setdefault(cell.step, {}).setdefault(own, {})
                by_data[name] = combination_of(part, cell.assignment, baseline)
    varied = Varied.of(next(iter(parts.values())))
    return _corrected(
        _over(column, ways[column.step], varied, len(parts), environments)
        for column in comparison_columns(every)
        if column.step in ways
    )


def _bases(ways: Sequence[_Variants], varied: Varied, reference: _Variants) -> _Bases:
    """Return variants -> the variants with which they are compared.

    To compare methods at equal settings, these are variants with the methods of the reference and
    the same values of swept parameters. If there are none, the variants are compared with the
    reference.
    """
    used, values = {}, {}
    for own in ways:
        used[own] = [varied.methods.get(step, {}).get(name, name) for step, name in own]
        values[own] = {
            parameter: of_variants[name]
            for parameter, of_variants in varied.swept.items()
            if (name := dict(own).get(parameter[0], "")) in of_variants
        }
    return {
        own: next(
            (
                other
                for other in ways
                if other != own
                and used[other] == used[reference]
                and values[own]
                and values[other] == values[own]
            ),
            reference,
        )
        for own in ways
    }


def _over(
    column: MetricRow,
    ways: Mapping[_Variants, Mapping[str, Combination]],
    varied: Varied,
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
    bases = _bases([*ways], varied, reference)

    def comparable(own: _Variants, base: _Variants) -> dict[str, tuple[Measured, Measured]]:
        """Return dataset -> pair of comparable values of two sets of variants."""
        found = {}
        for name in measured[own].keys() & measured[base].keys():
            both = measured[own][name], measured[base][name]
            # Do not compare errors over different numbers of items: a larger error over more photos
            # is not a worse result.
            ours, theirs = (ways[key][name].n_items(step, column.counted_by) for key in (own, base))
            is_like = environments.are_comparable(*(one.environment for one in both))
            if is_like and not abs(ours - theirs) > 0.0:
                found[name] = both
        return {name: found[name] for name in measured[own] if name in found}

    pairs = {own: comparable(own, bases[own]) for own in ways}
    is_judged = column.better in BETTER
    methods = []
    for own, by_data in ways.items():
        values = np.array([value.value for value in measured[own].values()])
        if column.better == "lower":
            # Errors of both signs would cancel.
            values = np.abs(values)
        n_failed = sum(one.failure is not None for one in by_data.values())
        n_both = len(measured[own].keys() & measured[bases[own]].keys())
        scatter = [one.spread for one in measured[own].values() if math.isfinite(one.spread)]
        methods.append(
            MethodOverDatasets(
                variants=dict(own),
                compared_with="" if own == reference else variants_text(dict(bases[own])),
                n=len(values),
                n_failed=n_failed,
                n_absent=n_datasets - len(values) - n_failed,
                n_partly=sum(value.n_repeats < value.n_all for value in measured[own].values()),
                n_apart=n_both - len(pairs[own]) if is_judged else 0,
                median=middle_of(values, column.unit),
                spread=spread_of(values, column.unit),
                repeat_spread=float(np.median(scatter)) if scatter else math.nan,
                paired=_paired(pairs[own].values(), column)
                if is_judged and own != reference
                else None,
            )
        )
    ranks = None
    if is_judged and len(ways) >= _MIN_RANKED:
        by_method = [comparable(own, reference) for own in ways]
        shared = [name for name in measured[reference] if all(name in own for own in by_method)]
        rows = np.array(
            [[badness(own[name][0].value, column.better) for own in by_method] for name in shared]
        )
        if len(shared) >= _MIN_TESTED and np.isfinite(rows).all():
            ranks = mean_ranks([one.name for one in methods], rows)
    return MetricOverDatasets(column=column, methods=tuple(methods), ranks=ranks)


def _corrected(metrics: Iterable[MetricOverDatasets]) -> tuple[MetricOverDatasets, ...]:
    """Correct all p-values of a run together, because some of many p-values are small by chance."""
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
    """Return p-value -> p-value corrected by Holm's method, for several tests.

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
        names: names of the methods, at least three.
        badness_of: values (datasets, methods); smaller values are better. Values that differ only
            by rounding (`is_rounding`) have the same rank.
    """
    from scipy.stats import (  # noqa: PLC0415 - takes half a second
        friedmanchisquare,
        rankdata,
        studentized_range,
    )

    n, k = badness_of.shape
    # Friedman's test ranks the values itself, so make values equal that differ only by rounding.
    badness_of = np.array([_with_ties(row) for row in badness_of])
    means = rankdata(badness_of, axis=1).mean(axis=0)
    is_level = bool((badness_of == badness_of[:, :1]).all())
    quantile = float(studentized_range.ppf(1.0 - _SHOWN_P, k, math.inf)) / math.sqrt(2.0)
    return MeanRanks(
        n=n,
        ranks={names[place]: float(means[place]) for place in np.argsort(means, kind="stable")},
        p=1.0 if is_level else float(friedmanchisquare(*badness_of.T).pvalue),
        critical_difference=quantile * math.sqrt(k * (k + 1) / (6.0 * n)),
    )


def _with_ties(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace each group of values that differ only by rounding by the smallest of the group."""
    tied = values.copy()
    order = np.argsort(values)
    for before, place in pairwise(order):
        if is_rounding(tied[before], values[place]):
            tied[place] = tied[before]
    return tied


def who_leads(over: Sequence[MetricOverDatasets], n_datasets: int) -> str:
    """Summarise which variants are significantly better; empty for a single combination.

    Args:
        over: the metrics.
        n_datasets: number of datasets of the run.
    """
    judged = [metric for metric in over if metric.column.better in BETTER]
    rows = [(metric, one) for metric in judged for one in metric.methods if one.compared_with]
    if not rows:
        return ""
    tested = [one.paired for _, one in rows if one.paired and math.isfinite(one.paired.p)]
    # If all n differences have the same sign, p is 2 / 2^n. All comparisons are counted, including
    # those that can be tested only with more datasets.
    enough = 2 + math.floor(math.log2(len(rows) / _SHOWN_P))
    needed = f"at least {enough} datasets are needed for all comparisons ({len(rows)})"
    if not tested:
        return (
            f"{n_datasets} datasets are not enough to draw a conclusion: the results must differ "
            f"in at least {enough} datasets for all comparisons ({len(rows)}), or in at least "
            f"{_MIN_SHOWN} for a single comparison, and must be computed in one environment"
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
            f"{side} in {len(titles)} of {len(own)} metrics ({', '.join(titles)})"
            for side, titles in sides.items()
            if titles
        ]
        if words:
            leads.append(f"{name} {' and '.join(words)}")
        else:
            level.append(name)
    sentences = []
    if leads:
        bases = [*dict.fromkeys(one.compared_with for _, one in rows)]
        named = [first_few(names, most=_MAX_NAMED) for names in (bases, leads, level)]
        sentences.append(
            f"Significant over the datasets, compared with {named[0]} ({_TEST}): {named[1]}"
        )
        sentences += [f"No significant difference: {named[2]}"] if level else []
    else:
        sentences.append(f"No difference is significant in any of {len(judged)} metrics ({_TEST})")
        n, n_tests = max(pair.wins + pair.losses for pair in tested), len(tested)
        if (least := n_tests * 2.0 ** (1 - n)) >= _SHOWN_P:
            sentences.append(
                f"None could be significant: with {n} datasets and {n_tests} testable comparisons, "
                f"the smallest possible p is {min(1.0, least):.2g}; {needed}, or fewer metrics "
                "(compare.metrics)"
            )
    ranked = [
        f"{metric.column.title} ({', '.join(metric.ranks.leading)})"
        for metric in judged
        if metric.ranks and len(metric.ranks.leading) < len(metric.ranks.ranks)
    ]
    if ranked:
        sentences.append(
            "Friedman's and Nemenyi's tests of each metric by itself show differences; the best "
            f"method, and the methods not significantly different from it: {'; '.join(ranked)}"
        )
    return ". ".join(sentences)


def _paired(pairs: Iterable[tuple[Measured, Measured]], column: MetricRow) -> Paired | None:
    worse = []
    for both in pairs:
        own, other = (badness(one.value, column.better) for one in both)
        # Otherwise, a rank test could report rounding differences on six datasets as significant.
        if math.isfinite(own - other):
            worse.append(0.0 if is_rounding(own, other) else own - other)
    return paired_differences(np.array(worse), column.better, column.unit) if worse else None


def paired_differences(worse: NDArray[np.float64], better: str, unit: str = "1") -> Paired:
    """Compute the statistics of paired differences.

    Args:
        worse: (n,) finite amounts by which the method is worse than the reference on each dataset,
            with n at least 1; 0 if both are equally good.
        better: which values are better; this determines the sign of the median difference.
        unit: unit of the metric.
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
        # The type is `Any` because scipy's stubs declare another class.
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
    Column("± repeats", "repeat_spread", digits=2),
    Column("compared with", "reference", is_numeric=False),
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
    """Return the statistics over all datasets as a table.

    There is one row for each metric and combination. Unknown values, such as p for two datasets,
    are empty.
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
                    *(_known(one.repeat_spread), one.compared_with or None),
                    *(None if paired is None else paired.n, one.n_apart, *differences),
                )
            )
    return Table(
        name="datasets",
        caption="Medians over the datasets, median differences from the reference with their 95 "
        "% confidence intervals, and p-values of Wilcoxon's signed-rank test after Holm's "
        "correction.",
        columns=_OVER,
        rows=tuple(rows),
    )


def _known(value: float) -> float | None:
    # Adding 0.0 turns -0.0, which occurs for metrics for which higher is better, into 0.0.
    return None if math.isnan(value) else value + 0.0
