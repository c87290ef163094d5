"""Methods compared over datasets: medians, and differences dataset by dataset with a rank test."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.robust import median_deviation
from orthoflow.records import RecordedCell
from orthoflow.records.runs import MetricRow, Run, is_rounding
from orthoflow.report.combinations import Combination, Measured, combinations_of
from orthoflow.report.comparisons import comparison_columns
from orthoflow.report.environments import EnvironmentGroups, group_environments
from orthoflow.report.rankings import BETTER, badness, is_flag
from orthoflow.untrusted_text import first_few
from orthoflow.workflow.expand import variants_text
from orthoflow.workflow.model import DATA

# The datasets that decide make up at least this share of all differences.
_DECIDING_SHARE: Final = 0.5
_MOST_DECIDING: Final = 3
# Of four differences that all agree p is 0.125: a test of so few can show nothing.
_FEWEST_TESTED: Final = 5
# For two methods signed ranks are more powerful.
_FEWEST_RANKED: Final = 3
# Of six that all agree p is 0.031, of five 0.0625.
_FEWEST_SHOWN: Final = 6
_SHOWN_P: Final = 0.05
_NAMED: Final = 6
_TEST: Final = f"p below {_SHOWN_P:g} after Holm's correction"


@dataclass(frozen=True, kw_only=True)
class Paired:
    """How a method does against another one on the datasets that both have a value of.

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
        deciding: the largest differences, by dataset, which make up half of all; at most three.
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
    deciding: Mapping[str, float]
    interval: tuple[float, float] = (math.nan, math.nan)
    p_holm: float = math.nan


@dataclass(frozen=True, kw_only=True)
class MethodOverDatasets:
    """One combination of variants on all datasets.

    Attributes:
        name: the variants, `plane=ransac`; empty when nothing varies.
        is_reference: the others are compared with it.
        against: what it is compared with: the reference or, where both sweep a parameter, what the
            reference's method gives at the same value; empty for the reference itself.
        n: datasets with a value.
        failed: datasets on which the combination failed; they have no part in any number.
        n_absent: datasets that have no value though nothing failed, or were left out.
        partly: of datasets with a value of only some repeats, e.g. `r5 1 of 3 repeats`.
        median: over the datasets, of signed errors of their sizes; NaN without any. Of what is yes
            or no the mean, the share of yes.
        spread: 1.4826 times the median absolute deviation from it; NaN without any, and of shares.
        paired: against the reference; None for itself, and where neither more nor less is better.
        n_unlike: datasets on which both have a value, of different environments.
        n_other_photos: datasets on which both have a value, of unequal numbers of photos.
        own: the variants on which the step depends.
    """

    name: str
    is_reference: bool
    against: str
    n: int
    failed: tuple[str, ...]
    n_absent: int
    partly: tuple[str, ...]
    median: float
    spread: float
    paired: Paired | None
    n_unlike: int
    own: str
    n_other_photos: int = 0


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
        methods: the combinations, the reference first where it is the workflow's.
        ranks: of all methods; None of fewer than three, or than five datasets.
    """

    column: MetricRow
    methods: tuple[MethodOverDatasets, ...]
    ranks: MeanRanks | None = None

    @property
    def middle(self) -> str:
        """What the medians are, which are shares where the metric is yes or no."""
        return "share" if is_flag(self.column.unit) else "median"

    @property
    def reference(self) -> str:
        """What the others are compared with unless stated otherwise."""
        return next((one.name for one in self.distinct if one.is_reference), "")

    @property
    def distinct(self) -> tuple[MethodOverDatasets, ...]:
        """The combinations, those of the same cells as one, named by what the step depends on."""
        groups: dict[tuple[str, tuple[str, ...]], MethodOverDatasets] = {}
        for one in self.methods:
            key = one.own, one.failed
            if key not in groups or one.is_reference:
                groups[key] = one
        # If one of them failed in a later step, only the whole name is unique.
        times = Counter(own for own, _ in groups)
        short = {one.name: one.own for one in self.methods if times[one.own] == 1}
        return tuple(
            replace(
                one,
                name=short.get(one.name, one.name),
                against=short.get(one.against, one.against),
            )
            for one in groups.values()
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
    """Compare the combinations of a run over its datasets, metric by metric.

    Values of different environments, or over unequal numbers of photos, are never paired.

    Args:
        parts: dataset -> its part of the run.
    """
    names = tuple(parts)
    found: dict[str, dict[str, Combination]] = {}
    for name, part in parts.items():
        for one in combinations_of(part):
            if one.assignment.get(DATA) == name:
                found.setdefault(_method(one), {})[name] = one
    every = [one for by_name in found.values() for one in by_name.values()]
    if len(names) < 2 or not every:
        return ()
    groups = group_environments(parts.values())
    reference = next((_method(one) for one in every if one.is_baseline), next(iter(found)))
    partners = _partners(
        {method: next(iter(ways.values())) for method, ways in found.items()}, reference
    )
    return _corrected(
        MetricOverDatasets(
            column=column,
            methods=_methods(found, names, partners, column, groups),
            ranks=_mean_ranks(found, names, column, groups),
        )
        for column in comparison_columns(every)
    )


def _corrected(metrics: Iterable[MetricOverDatasets]) -> tuple[MetricOverDatasets, ...]:
    """Correct all p of a run together, by Holm: of many comparisons some are small by chance."""
    metrics = tuple(metrics)
    found = [
        one.paired.p for metric in metrics for one in metric.distinct if one.paired is not None
    ]
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


def _mean_ranks(
    found: Mapping[str, Mapping[str, Combination]],
    names: Sequence[str],
    column: MetricRow,
    groups: EnvironmentGroups,
) -> MeanRanks | None:
    """Rank all methods on the datasets on which each has a value that may be compared."""
    if column.better not in BETTER:
        return None
    # Combinations of the same cells are one method.
    methods = {
        _own(by_name.values(), column.step) or name: by_name for name, by_name in found.items()
    }
    rows = []
    for name in names:
        ways = [by_name[name] for by_name in methods.values() if name in by_name]
        values = [one.measured(column.step, column.metric) for one in ways if one.failure is None]
        known = [value for value in values if value is not None]
        if len(known) < len(methods) or any(
            not groups.are_comparable(known[0].environment, value.environment)
            for value in known[1:]
        ):
            continue
        if any(_other_photos(ways[0], other, column) for other in ways[1:]):
            continue
        rows.append([badness(value.value, column.better) for value in known])
    if len(methods) < _FEWEST_RANKED or len(rows) < _FEWEST_TESTED or not np.isfinite(rows).all():
        return None
    return mean_ranks(tuple(methods), np.array(rows))


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


def _method(one: Combination) -> str:
    return variants_text({k: v for k, v in one.assignment.items() if k != DATA})


def _partners(ways: Mapping[str, Combination], reference: str) -> dict[str, str]:
    """What each combination is compared with; the reference with nothing.

    A method is compared with another at the same value of what both sweep, where there is one.

    Args:
        ways: method -> one of its combinations.
        reference: one of them.
    """
    called: dict[str, dict[str, RecordedCell]] = {}
    for way in ways.values():
        for cell in way.cells:
            if cell.step in cell.assignment and cell.repeat == 0:
                called.setdefault(cell.step, {}).setdefault(cell.assignment[cell.step], cell)
    wanted = {step: one for step, one in ways[reference].assignment.items() if step != DATA}
    partners = {reference: ""}
    for method, way in ways.items():
        if method != reference:
            like = {
                step: _alike(called.get(step, {}), variant, way.assignment.get(step, variant))
                for step, variant in wanted.items()
            }
            name = variants_text(like)
            partners[method] = name if name in ways and name != method else reference
    return partners


def _alike(called: Mapping[str, RecordedCell], reference: str, own: str) -> str:
    """The variant of the reference's method that has the values that another method has, too."""
    if reference not in called or own not in called:
        return reference
    mine, theirs = called[own], called[reference]
    if mine.method == theirs.method:
        return reference
    family = {name: cell.params for name, cell in called.items() if cell.method == theirs.method}
    shared = {
        name
        for name in theirs.params
        if name in mine.params and len({repr(params.get(name)) for params in family.values()}) > 1
    }
    found = [
        variant
        for variant, params in family.items()
        if all(params.get(name) == mine.params[name] for name in shared)
    ]
    return found[0] if len(found) == 1 else reference


def who_leads(over: Sequence[MetricOverDatasets], n_datasets: int) -> str:
    """State in a sentence or two which combinations are shown to be better; empty without several.

    Args:
        over: the metrics.
        n_datasets: how many the run has.
    """
    judged = [metric for metric in over if metric.column.better in BETTER]
    rows = [one for metric in judged for one in metric.distinct if one.against]
    if not rows:
        return ""
    tested = [one for one in rows if one.paired is not None and math.isfinite(one.paired.p)]
    if not tested:
        few = (
            f"{n_datasets} datasets are too few for a test"
            if n_datasets < _FEWEST_SHOWN
            else "values of different environments are not compared"
            if any(one.n_unlike for one in rows)
            else "too few of the datasets differ for a test"
        )
        return (
            f"Nobody is shown to lead: {few}; it takes {_FEWEST_SHOWN} that differ to show anything"
        )
    leads = []
    groups: dict[str, list[str]] = {}
    for name, against in dict.fromkeys((one.name, one.against) for one in rows):
        n_both = sum((one.name, one.against) == (name, against) for one in rows)
        shown = [
            (metric.column.title, one.paired.effect)
            for metric in judged
            for one in metric.distinct
            if (one.name, one.against) == (name, against)
            and one.paired is not None
            and one.paired.p_holm < _SHOWN_P
        ]
        sides = (
            ("better", [label for label, effect in shown if effect > 0]),
            ("worse", [label for label, effect in shown if effect <= 0]),
        )
        how = " and ".join(
            f"{word} in {len(labels)} of {n_both} numbers ({', '.join(labels)})"
            for word, labels in sides
            if labels
        )
        if how:
            leads.append(f"{name} against {against}: {how}")
        else:
            groups.setdefault(against, []).append(name)
    if not leads:
        return f"Nobody is shown to lead in any of {len(judged)} numbers ({_TEST})"
    others = f"; and {len(leads) - _NAMED} more" if len(leads) > _NAMED else ""
    named = "; ".join(leads[:_NAMED])
    return f"Shown over the datasets ({_TEST}): {named}{others}{_not_shown(groups)}"


def _not_shown(groups: Mapping[str, Sequence[str]]) -> str:
    """State who is not shown to differ from what it is compared with; empty without any."""
    pairs = [
        f"{first_few(names, most=_NAMED)} against {against}" for against, names in groups.items()
    ]
    return f". No difference is shown of {'; '.join(pairs)}" if pairs else ""


def _methods(
    found: Mapping[str, Mapping[str, Combination]],
    names: Sequence[str],
    partners: Mapping[str, str],
    column: MetricRow,
    groups: EnvironmentGroups,
) -> tuple[MethodOverDatasets, ...]:
    step, is_judged = column.step, column.better in BETTER
    measured = {
        method: {
            name: value
            for name, one in by_name.items()
            if one.failure is None and (value := one.measured(step, column.metric)) is not None
        }
        for method, by_name in found.items()
    }
    rows = []
    for method, by_name in found.items():
        values = measured[method]
        failed = tuple(name for name, one in by_name.items() if one.failure is not None)
        numbers = np.array([value.value for value in values.values()])
        if column.better == "lower":
            # Errors of both signs would make each other small.
            numbers = np.abs(numbers)
        against = partners[method]
        theirs = measured[against] if against and is_judged else {}
        both = {name: value for name, value in values.items() if name in theirs}
        like = {
            name: value
            for name, value in both.items()
            if groups.are_comparable(value.environment, theirs[name].environment)
        }
        ours = {
            name: value
            for name, value in like.items()
            if not _other_photos(by_name[name], found[against][name], column)
        }
        rows.append(
            MethodOverDatasets(
                name=method,
                is_reference=not against,
                against=against,
                n=len(values),
                failed=failed,
                n_absent=len(names) - len(values) - len(failed),
                partly=tuple(
                    f"{name} {value.n_repeats} of {value.n_all} repeats"
                    for name, value in values.items()
                    if value.n_repeats < value.n_all
                ),
                median=middle_of(numbers, column.unit),
                spread=spread_of(numbers, column.unit),
                paired=_paired(ours, theirs, column),
                n_unlike=len(both) - len(like),
                n_other_photos=len(like) - len(ours),
                own=_own(by_name.values(), step),
            )
        )
    return tuple(rows)


def _other_photos(one: Combination, other: Combination, column: MetricRow) -> bool:
    """Whether one sums up more photos than the other, which makes its errors no worse ones."""
    ours, theirs = (each.n_items(column.step, column.counted_by) for each in (one, other))
    return abs(ours - theirs) > 0.0


def _own(ways: Iterable[Combination], step: str) -> str:
    """Name the variants of a combination on which a step depends."""
    cells = (cell for one in ways for cell in one.cells if cell.step == step)
    found = {k: v for cell in cells for k, v in cell.assignment.items() if k != DATA}
    return variants_text(found)


def _paired(
    ours: Mapping[str, Measured], theirs: Mapping[str, Measured], column: MetricRow
) -> Paired | None:
    better = column.better
    pairs = {
        name: (badness(ours[name].value, better), badness(theirs[name].value, better))
        for name in ours
    }
    # A rank test would take the last digits of six datasets for a proof.
    worse = {
        name: 0.0 if is_rounding(own, other) else own - other
        for name, (own, other) in pairs.items()
        if math.isfinite(own - other)
    }
    return paired_differences(worse, better, column.unit) if worse else None


def paired_differences(worse: Mapping[str, float], better: str, unit: str = "1") -> Paired:
    """Judge differences of pairs.

    Args:
        worse: dataset -> how much worse than the reference the method is there, finite; at least
            one; zero where they are level.
        better: which values are, for the sign of the differences.
        unit: of its values.
    """
    sign = -1.0 if better == "higher" else 1.0
    differences = np.array(list(worse.values()))
    largest = sorted(worse, key=lambda name: -abs(worse[name]))
    total = float(np.abs(differences).sum())
    deciding: dict[str, float] = {}
    for name in largest[:_MOST_DECIDING]:
        if sum(map(abs, deciding.values())) >= _DECIDING_SHARE * total:
            break
        deciding[name] = sign * worse[name]
    moved = differences[differences != 0]
    p = effect = math.nan
    if moved.size >= _FEWEST_TESTED:
        from scipy.stats import rankdata, wilcoxon  # noqa: PLC0415 - takes half a second

        ranks = rankdata(np.abs(moved))
        effect = float((ranks[moved < 0].sum() - ranks[moved > 0].sum()) / ranks.sum())
        p = float(wilcoxon(moved).pvalue)
    return Paired(
        n=len(worse),
        wins=int((differences < 0).sum()),
        losses=int((differences > 0).sum()),
        median=sign * middle_of(differences, unit),
        p=p,
        effect=effect,
        deciding=deciding,
        interval=(math.nan, math.nan) if is_flag(unit) else _interval(sign * differences),
    )


def _interval(differences: NDArray[np.float64]) -> tuple[float, float]:
    """Of their median, from order statistics: at least 95 %."""
    from scipy.stats import binom  # noqa: PLC0415 - takes half a second

    ordered = np.sort(differences)
    rank = int(binom.ppf(0.5 * _SHOWN_P, len(ordered), 0.5))
    return (float(ordered[rank - 1]), float(ordered[-rank])) if rank else (math.nan, math.nan)
