"""The best of a column: among comparable values, by what makes them good, within spreads."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from orthoflow_plugins.inspect.truth import InspectTruth

from orthoflow.report.rankings import Value, badness, rank


def marks(*values: Value, better: str = "lower") -> list[str]:
    return [value.mark.name for value in rank(values, better)]


def of(sort: float, spread: float = 0.0, group: str = "") -> Value:
    return Value(text=str(sort), sort=sort, spread=spread, group=group)


def test_the_smallest_or_the_largest_is_best() -> None:
    assert marks(of(3.0), of(1.0), of(2.0)) == ["NONE", "BEST", "NONE"]
    assert marks(of(3.0), of(1.0), of(2.0), better="higher") == ["BEST", "NONE", "NONE"]
    # Signed errors count by their size.
    assert marks(of(-3.0), of(1.0), of(-0.5)) == ["NONE", "NONE", "BEST"]


def test_who_sums_up_fewer_photos_is_not_ranked() -> None:
    def over(sort: float, n_items: float, group: str = "") -> Value:
        return Value(text="x", sort=sort, spread=0.0, n_items=n_items, group=group)

    assert marks(over(7.0, 2), over(9.0, 3), over(11.0, 3)) == ["FEWER", "BEST", "NONE"]
    assert marks(over(7.0, 2), over(9.0, 3)) == ["FEWER", "NONE"]
    # Of other data there are other photos; and who does not count them is ranked.
    assert marks(over(7.0, 2, "a"), over(9.0, 3, "b"), over(8.0, 2, "a")) == [
        "BEST",
        "NONE",
        "NONE",
    ]
    assert marks(of(7.0), over(9.0, 3)) == ["BEST", "NONE"]


def test_single_runs_are_not_ranked() -> None:
    single = of(3.0, math.nan)
    assert marks(of(1.0, 0.1), single, of(9.0, 0.1)) == ["NONE", "NONE", "NONE"]
    # Those of other data have repeats.
    assert marks(of(1.0, 0.1, "a"), of(9.0, 0.1, "a"), replace(single, group="b")) == [
        "BEST",
        "NONE",
        "NONE",
    ]


def test_a_ratio_is_best_at_one_and_as_bad_at_half_as_at_double() -> None:
    found = marks(of(0.5), of(1.1), of(2.0), of(0.0), better="one")
    assert found == ["NONE", "BEST", "NONE", "NONE"]


def test_what_is_alike_has_neither_and_nobody_leads_in_what_several_share() -> None:
    assert marks(of(1.0), of(1.0)) == ["NONE", "NONE"]
    assert marks(of(1.0), of(-1.0)) == ["NONE", "NONE"]
    assert marks(of(1.0), of(1.0), of(2.0)) == ["NEAR", "NEAR", "NONE"]
    assert marks(of(1.0)) == ["NONE"]
    assert marks(of(1.0), of(2.0), better="") == ["NONE", "NONE"]


@pytest.mark.parametrize(
    ("best_spread", "spread", "found"),
    [
        (0.3, 0.4, ["NEAR", "NEAR"]),
        (0.3, 0.39, ["BEST", "NONE"]),
        (0.0, 0.5, ["NEAR", "NEAR"]),
        (0.5, 0.0, ["NEAR", "NEAR"]),
        (0.0, 0.49, ["BEST", "NONE"]),
        (0.0, 0.0, ["BEST", "NONE"]),
    ],
)
def test_a_value_within_both_spreads_of_the_best_is_near_it(
    best_spread: float, spread: float, found: list[str]
) -> None:
    # Half apart: 0.3 and 0.4 in quadrature.
    assert marks(of(1.0, best_spread), of(1.5, spread), of(9.0)) == [*found, "NONE"]


def test_without_repeats_a_hundredth_is_no_difference_and_a_tenth_of_a_cost() -> None:
    assert marks(of(1.238), of(1.239)) == ["NONE", "NONE"]
    assert marks(of(1.238), of(1.239), of(2.0)) == ["NEAR", "NEAR", "NONE"]
    assert marks(of(1.0), of(1.011), of(2.0)) == ["BEST", "NONE", "NONE"]
    costs = rank([of(10.0), of(10.9), of(11.1)], "lower", "MiB")
    assert [value.mark.name for value in costs] == ["NEAR", "NEAR", "NONE"]


@pytest.mark.parametrize("spread", [0.0, 7e-16])
def test_repeats_of_one_value_say_nothing_of_scatter(spread: float) -> None:
    exact = of(7.414482203957, spread), of(7.414482243713, spread)
    assert marks(*exact) == ["NONE", "NONE"]
    assert marks(*exact, of(9.0, spread)) == ["NEAR", "NEAR", "NONE"]
    assert marks(of(100.0, spread), of(100.9, spread), of(200.0, spread)) == [
        "NEAR",
        "NEAR",
        "NONE",
    ]
    assert marks(of(100.0, spread), of(101.1, spread), of(200.0, spread)) == [
        "BEST",
        "NONE",
        "NONE",
    ]
    # Where one of two scatters, the larger of both: its spread, and a hundredth.
    assert marks(of(100.0, spread), of(100.9, 0.1), of(200.0, 0.1)) == ["NEAR", "NEAR", "NONE"]
    assert marks(of(100.0, 3.0), of(102.9, spread), of(200.0, 0.1)) == ["NEAR", "NEAR", "NONE"]
    assert marks(of(100.0, 3.0), of(103.1, spread), of(200.0, 0.1)) == ["BEST", "NONE", "NONE"]
    # Counts, too.
    assert marks(of(500.0, spread), of(501.0, spread), of(900.0, spread)) == [
        "NEAR",
        "NEAR",
        "NONE",
    ]


def test_rounding_is_no_difference_whatever_the_share() -> None:
    # Errors of next to nothing: in degrees, 3.5e-13 apart.
    assert marks(of(1e-13), of(4.5e-13)) == ["NONE", "NONE"]
    assert marks(of(1e-13), of(4.5e-13), of(0.2)) == ["NEAR", "NEAR", "NONE"]
    assert marks(of(0.1), of(0.2), of(0.2 + 1e-9)) == ["BEST", "NONE", "NONE"]
    halves = marks(of(0.5), of(2.0 + 1e-9), of(4.0), better="one")
    assert halves == ["NEAR", "NEAR", "NONE"]


def test_errors_of_both_signs_are_as_far_apart_as_their_sizes() -> None:
    assert marks(of(-1.0), of(1.005)) == ["NONE", "NONE"]
    assert marks(of(-1.0, 0.1), of(1.12, 0.1), of(-3.0, 0.1)) == ["NEAR", "NEAR", "NONE"]
    assert marks(of(0.1), of(3.0), of(-3.01)) == ["BEST", "NONE", "NONE"]


def test_times_that_another_run_could_turn_round_are_not_told_apart() -> None:
    for spread in (0.0, 0.01):
        times = [of(1.0, spread), of(1.29, spread), of(1.31, spread), of(2.0, spread)]
        found = rank(times, "lower", "s")
        assert [value.mark.name for value in found] == ["NEAR", "NEAR", "NONE", "NONE"]


def test_groups_are_ranked_apart_and_what_is_absent_is_not_ranked() -> None:
    values = [of(1.0, group="a"), of(9.0, group="b"), of(2.0, group="a"), of(8.0, group="b")]
    assert marks(*values) == ["BEST", "NONE", "NONE", "BEST"]
    assert marks(of(1.0), Value(), of(math.inf), of(2.0)) == ["BEST", "NONE", "NONE", "NONE"]


def test_methods_declare_what_is_good() -> None:
    found = {spec.name: spec.better for spec in InspectTruth.metric_specs()}
    assert found["pose_error_over_sigma"] == "one"
    assert found["label_f1"] == "higher"
    assert found["wall_[0-9]*_rmse_[uv]_mm"] is found["rmse_[uv]_mm"] == "lower"
    assert found["n_photos"] == ""
    # A record may hold anything.
    assert marks(of(1.0), of(2.0), better="sideways") == ["NONE", "NONE"]


def test_badness_is_smaller_the_better_a_value_is() -> None:
    assert badness(-2.0, "lower") == 2.0
    assert badness(2.0, "higher") == -2.0
    assert badness(2.0, "one") == badness(0.5, "one") == pytest.approx(math.log(2.0))
    assert badness(0.0, "one") == badness(-1.0, "one") == math.inf
    with pytest.raises(ValueError, match="cannot be ranked"):
        badness(1.0, "")
