"""Differences dataset by dataset: who wins, by how much, and which datasets decide."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import wilcoxon

from orthoflow.records.runs import MetricRow
from orthoflow.report import paired as module
from orthoflow.report.environments import EnvironmentGroups
from orthoflow.report.paired import (
    MethodOverDatasets,
    MetricOverDatasets,
    Paired,
    paired_differences,
)

ALIKE = EnvironmentGroups(first={}, words={})


def worse(*values: float) -> dict[str, float]:
    return dict(zip("abcdefgh", values, strict=False))


@pytest.mark.parametrize(
    ("better", "median", "deciding"),
    [("lower", -1.0, {"c": -4.0, "d": 2.0}), ("higher", 1.0, {"c": 4.0, "d": -2.0})],
)
def test_what_less_or_more_of_a_number_is_worth_is_told_in_its_own_sign(
    better: str, median: float, deciding: dict[str, float]
) -> None:
    # Of eleven in all, four and two make up more than half.
    found = paired_differences(worse(-1.0, -1.0, -4.0, 2.0, -1.5, 1.0, 0.0), better)
    assert (found.n, found.wins, found.losses) == (7, 4, 2)
    assert found.median == median
    assert found.deciding == deciding


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ((1.0, 1.0, 2.0), ["c"]),
        ((1.0, 1.01, 2.0), ["c", "b"]),
        ((1.0, -1.0, 1.0, -1.0, 1.0, -1.0), ["a", "b", "c"]),
        # Three at most, though they make up less than half.
        ((1.0,) * 8, ["a", "b", "c"]),
        ((0.0, 0.0), []),
        ((0.0, -3.0), ["b"]),
    ],
)
def test_the_largest_differences_that_make_up_half_decide(
    values: tuple[float, ...], names: list[str]
) -> None:
    assert list(paired_differences(worse(*values), "lower").deciding) == names


def test_five_differences_are_tested_and_four_are_not() -> None:
    few = paired_differences(worse(-1.0, -2.0, -3.0, -4.0, 0.0, 0.0), "lower")
    assert math.isnan(few.p)
    assert math.isnan(few.effect)
    values = (-1.0, -2.0, -3.0, -4.0, 2.5)
    found = paired_differences(worse(*values, 0.0), "lower")
    # Ranks 1, 2, 4 and 5 for, 3 against: (12 - 3) / 15.
    assert found.effect == pytest.approx(0.6)
    assert found.p == wilcoxon(values).pvalue
    every = paired_differences(worse(1.0, 2.0, 3.0, 4.0, 5.0), "lower")
    assert every.effect == -1.0
    assert every.p == pytest.approx(0.0625)
    assert every.wins == 0


def called(**values: float) -> Any:
    return SimpleNamespace(method=values.pop("method", "a"), params=values)


@pytest.mark.parametrize(
    ("own", "partner"),
    [
        # At the same value of what both sweep, whatever else it sets.
        ({"method": "b", "tolerance_m": 2.0, "extra": 1.0}, "second"),
        ({"method": "b", "tolerance_m": 1.0}, "first"),
        # At a value that the other was not given, or without the parameter.
        ({"method": "b", "tolerance_m": 3.0}, "first"),
        ({"method": "b", "extra": 2.0}, "first"),
        # Variants of one method are all held against the reference.
        ({"tolerance_m": 2.0}, "first"),
    ],
)
def test_methods_are_paired_at_the_value_that_both_sweep(
    own: dict[str, float], partner: str
) -> None:
    known = {
        "first": called(tolerance_m=1.0, seed=5.0),
        "second": called(tolerance_m=2.0, seed=5.0),
        "own": called(**own),
    }
    assert module._alike(known, "first", "own") == partner
    assert module._alike(known, "first", "unheard-of") == "first"
    assert module._alike({"own": known["own"]}, "first", "own") == "first"


def leading(n_methods: int, p: float) -> Any:
    """A number in which every other method is better and the rest is worse than the reference."""
    methods = [
        SimpleNamespace(
            name=f"m{k}",
            against="m0" if k else "",
            n_unlike=0,
            paired=SimpleNamespace(p=p, p_holm=p, effect=0.5 if k % 2 else -0.5),
        )
        for k in range(n_methods + 1)
    ]
    return SimpleNamespace(column=column("lower"), distinct=methods)


def test_who_leads_is_said_of_six_at_most() -> None:
    judged_not = SimpleNamespace(column=column(""), distinct=leading(2, 0.01).distinct)
    assert module.who_leads([judged_not], 9) == ""
    assert module.who_leads([leading(0, 0.01)], 9) == ""
    few = module.who_leads([leading(2, math.nan)], 5)
    assert "5 datasets are too few for a test" in few
    assert "too few of the datasets differ" in module.who_leads([leading(2, math.nan)], 6)
    apart = leading(2, math.nan)
    apart.distinct[1].n_unlike = 6
    assert "values of different environments" in module.who_leads([apart], 6)
    assert module.who_leads([leading(2, 0.051)] * 3, 9) == (
        "Nobody is shown to lead in any of 3 numbers (p below 0.05 after Holm's correction)"
    )
    said = module.who_leads([leading(2, 0.049), leading(2, 0.5)], 9)
    assert "m1 against m0: better in 1 of 2 numbers (error)" in said
    assert "m2 against m0: worse in 1 of 2 numbers (error)" in said
    both = [leading(2, 0.01), leading(3, 0.5)]
    assert module.who_leads(both, 9).endswith(
        "m2 against m0: worse in 1 of 2 numbers (error). No difference is shown of m3 against m0"
    )
    six, seven = (module.who_leads([leading(n, 0.01)], 9) for n in (6, 7))
    assert (six.count(" against "), "more" in six) == (6, False)
    assert (seven.count(" against "), seven.endswith("; and 1 more")) == (6, True)


def measured(value: float, environment: str = "one", n_repeats: int = 3) -> Any:
    return SimpleNamespace(value=value, environment=environment, n_repeats=n_repeats, n_all=3)


def test_values_of_no_size_are_not_paired() -> None:
    ours = {
        "a": measured(2.0),
        "d": measured(math.inf), "e": measured(-1.0),
    }  # fmt: skip
    theirs = {name: measured(1.5) for name in "ade"}
    found = module._paired(ours, theirs, column("lower"))
    assert found is not None
    # Of signed errors the sizes.
    assert (found.n, found.wins, found.losses) == (2, 1, 1)
    assert found.deciding == {"a": 0.5}
    assert module._paired({"d": measured(1.0)}, {"d": measured(math.inf)}, column("lower")) is None


def pairs(better: str, *values: tuple[float, float]) -> Paired:
    ours, theirs = (
        {name: measured(pair[side]) for name, pair in zip("abcdefgh", values, strict=False)}
        for side in (0, 1)
    )
    found = module._paired(ours, theirs, column(better))
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("better", "ours", "theirs"),
    [
        ("lower", 0.84536087, 0.84536104),
        ("higher", 0.84536104, 0.84536087),
        ("lower", 3.2e6 + 0.5, 3.2e6 + 2.5),
        # Angles of next to nothing, in degrees; errors of both signs; factors to 1.
        ("lower", 1e-13, 4.5e-13),
        ("lower", -0.84536087, 0.84536104),
        ("one", 0.5, 2.0000001),
    ],
)
def test_what_differs_by_rounding_is_level_and_tests_nothing(
    better: str, ours: float, theirs: float
) -> None:
    found = pairs(better, *[(ours, theirs)] * 8)
    assert (found.n, found.wins, found.losses, found.median) == (8, 0, 0, 0.0)
    assert math.isnan(found.p)
    assert math.isnan(found.effect)
    assert found.deciding == {}


def test_more_than_rounding_and_every_count_is_a_difference() -> None:
    found = pairs("lower", (1.0, 1.000002), (3e7 + 1.0, 3e7), (0.0, 2e-6))
    assert (found.wins, found.losses) == (2, 1)


def column(better: str, metric: str = "rms_mm", unit: str = "mm") -> MetricRow:
    return MetricRow(
        cell="check",
        step="check",
        method="inspect.truth",
        name=metric,
        value=0.0,
        unit=unit,
        label="error",
        better=better,
    )


def combination(
    value: float | None,
    failure: str | None = None,
    *,
    n_repeats: int = 3,
    n_items: float = math.nan,
) -> Any:
    return SimpleNamespace(
        failure=failure,
        cells=(),
        n_items=lambda *_: n_items,
        measured=lambda *_: None if value is None else measured(value, n_repeats=n_repeats),
    )


def test_a_method_is_summed_up_over_datasets() -> None:
    found = {
        "plane=a": {
            "x": combination(-2.0),
            "y": combination(3.0, n_repeats=1),
            "z": combination(10.0),
        },
        "plane=b": {
            "x": combination(1.0),
            "y": combination(9.0, "no plane"),
            "z": combination(None),
        },
    }
    partners = {"plane=a": "", "plane=b": "plane=a"}
    first, second = module._methods(found, ("x", "y", "z", "w"), partners, column("lower"), ALIKE)
    assert (first.name, first.is_reference, first.n, first.failed, first.n_absent) == (
        "plane=a", True, 3, (), 1,
    )  # fmt: skip
    assert (first.partly, second.partly) == (("y 1 of 3 repeats",), ())
    # Errors of both signs would make each other small.
    assert first.median == 3.0
    assert first.spread == pytest.approx(1.4826 * 1.0)
    assert first.paired is None
    assert (first.against, second.against) == ("", "plane=a")
    assert (second.is_reference, second.n, second.failed, second.n_absent) == (
        False, 1, ("y",), 2,
    )  # fmt: skip
    assert second.paired is not None
    assert (second.paired.n, second.paired.wins) == (1, 1)
    first, second = module._methods(found, ("x", "y", "z"), partners, column(""), ALIKE)
    assert first.median == 3.0
    assert second.paired is None


def test_of_what_is_found_or_not_the_share_of_datasets_is_told() -> None:
    found = {
        "plane=a": dict(zip("xyz", map(combination, (1.0, 1.0, 1.0)), strict=True)),
        "plane=b": dict(zip("xyz", map(combination, (1.0, 0.0, 0.5)), strict=True)),
    }
    partners = {"plane=a": "", "plane=b": "plane=a"}
    told = column("higher", "main_found", "yes/no")
    first, second = module._methods(found, ("x", "y", "z"), partners, told, ALIKE)
    # Their medians would be 1 and 0.5.
    assert (first.median, second.median) == (1.0, 0.5)
    assert math.isnan(second.spread)
    assert second.paired is not None
    assert (second.paired.median, second.paired.losses) == (-0.5, 2)


def test_errors_of_unequal_numbers_of_photos_are_not_paired() -> None:
    found = {
        "orient=a": {"x": combination(2.0, n_items=3), "y": combination(2.0, n_items=3)},
        "orient=b": {"x": combination(1.0, n_items=2), "y": combination(3.0, n_items=3)},
    }
    partners = {"orient=a": "", "orient=b": "orient=a"}
    _, second = module._methods(found, ("x", "y"), partners, column("lower"), ALIKE)
    assert second.paired is not None
    assert (second.paired.n, second.paired.wins, second.paired.losses) == (1, 0, 1)
    assert (second.n_other_photos, second.n_unlike) == (1, 0)


def test_what_does_not_hang_on_a_step_has_one_row_for_all_its_variants() -> None:
    def row(plane: str, corner: str, *, failed: tuple[str, ...] = ()) -> MethodOverDatasets:
        name = f"plane={plane}, corner={corner}"
        return MethodOverDatasets(
            name=name, is_reference=name == "plane=a, corner=x", failed=failed, n=2, n_absent=0,
            against="" if name == "plane=a, corner=x" else "plane=a, corner=x", partly=(),
            n_unlike=0, median=1.0, spread=0.0, paired=None, own=f"plane={plane}",
        )  # fmt: skip

    def told(*rows: MethodOverDatasets) -> list[tuple[str, str]]:
        metric = MetricOverDatasets(column=column("lower"), methods=rows)
        return [(one.name, one.against) for one in metric.distinct]

    every = [row(plane, corner) for plane in "ab" for corner in "yx"]
    assert told(*every) == [("plane=a", ""), ("plane=b", "plane=a")]
    # What failed behind the step is no part of its row: the whole names tell which.
    broken = [*every[:3], row("b", "x", failed=("hall",))]
    assert told(*broken) == [
        ("plane=a", ""),
        ("plane=b, corner=y", "plane=a"),
        ("plane=b, corner=x", "plane=a"),
    ]


def test_mean_ranks_are_those_of_a_worked_example() -> None:
    # Four methods on fourteen sets: Demsar 2006, Table 6 (AUC; more is better, so negative).
    auc = np.array(
        [
            [0.763, 0.768, 0.771, 0.798],
            [0.599, 0.591, 0.590, 0.569],
            [0.954, 0.971, 0.968, 0.967],
            [0.628, 0.661, 0.654, 0.657],
            [0.882, 0.888, 0.886, 0.898],
            [0.936, 0.931, 0.916, 0.931],
            [0.661, 0.668, 0.609, 0.685],
            [0.583, 0.583, 0.563, 0.625],
            [0.775, 0.838, 0.866, 0.875],
            [1.000, 1.000, 1.000, 1.000],
            [0.940, 0.962, 0.965, 0.962],
            [0.619, 0.666, 0.614, 0.669],
            [0.972, 0.981, 0.9751, 0.975],
            [0.957, 0.978, 0.946, 0.970],
        ]
    )
    found = module.mean_ranks(("C4.5", "+m", "+cf", "+m+cf"), -auc)
    assert found.n == 14
    assert found.ranks == {
        "+m+cf": pytest.approx(1.964, abs=0.01),
        "+m": pytest.approx(2.000, abs=0.01),
        "+cf": pytest.approx(2.893, abs=0.01),
        "C4.5": pytest.approx(3.143, abs=0.01),
    }
    assert found.critical_difference == pytest.approx(1.25, abs=0.01)
    assert 0.01 < found.p < 0.05
    assert found.leading == ("+m+cf", "+m", "+cf", "C4.5")


def test_equal_methods_lead_together() -> None:
    found = module.mean_ranks(("a", "b", "c"), np.ones((6, 3)))
    assert (found.p, found.leading) == (1.0, ("a", "b", "c"))


def test_the_interval_of_a_median_covers_it_as_often_as_it_says() -> None:
    rng = np.random.default_rng(5)
    for n, rate in ((6, 0.969), (20, 0.959)):
        covered = 0
        for _ in range(1000):
            drawn = dict(enumerate(rng.standard_normal(n)))
            low, high = module.paired_differences(
                {str(key): value for key, value in drawn.items()}, "lower"
            ).interval
            covered += low <= 0.0 <= high
        assert covered / 1000 == pytest.approx(rate, abs=0.02)
    few = module.paired_differences({str(k): float(k) for k in range(5)}, "lower")
    assert math.isnan(few.interval[0])
