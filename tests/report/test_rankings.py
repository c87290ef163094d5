"""The best of a column: among comparable values, by what makes them good, within spreads."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
from orthoflow_plugins.inspect.truth import InspectTruth

from orthoflow.report.rankings import Value, badness, rank

# A value without repeats, or with repeats of a standard deviation.
_Given = float | tuple[float, float]


def of(given: _Given, group: str = "", n_items: float = math.nan) -> Value:
    sort, spread = given if isinstance(given, tuple) else (given, 0.0)
    return Value(text=str(sort), sort=sort, spread=spread, group=group, n_items=n_items)


def marks(values: Sequence[Value], better: str = "lower", unit: str = "1") -> str:
    """The first letter of each mark: best, near the best, over fewer items, none."""
    letters = {"BEST": "b", "NEAR": "n", "FEWER": "f", "NONE": "-"}
    return "".join(letters[value.mark.name] for value in rank(values, better, unit))


@pytest.mark.parametrize(
    ("values", "found", "better"),
    [
        ((3.0, 1.0, 2.0), "-b-", "lower"),
        ((3.0, 1.0, 2.0), "b--", "higher"),
        # Signed errors count by their size, and a ratio is as bad at half as at double.
        ((-3.0, 1.0, -0.5), "--b", "lower"),
        ((0.5, 1.1, 2.0, 0.0), "-b--", "one"),
        ((0.5, 2.0 + 1e-9, 4.0), "nn-", "one"),
        # Level values have no best, and nobody leads in what several share.
        ((1.0,), "-", "lower"),
        ((1.0, -1.0), "--", "lower"),
        ((1.0, 1.0, 2.0), "nn-", "lower"),
        ((1.0, math.inf, 2.0), "b--", "lower"),
        ((1.0, 2.0), "--", ""),
        # A record may contain anything.
        ((1.0, 2.0), "--", "sideways"),
        # Without scatter 1 % is no difference, nor is rounding, whatever its share.
        ((1.238, 1.239, 2.0), "nn-", "lower"),
        ((1.0, 1.011, 2.0), "b--", "lower"),
        ((500.0, 501.0, 900.0), "nn-", "lower"),
        ((1e-13, 4.5e-13, 0.2), "nn-", "lower"),
        (((7.414482203957, 7e-16), (7.414482243713, 7e-16), (9.0, 7e-16)), "nn-", "lower"),
        # Half apart: 0.3 and 0.4 in quadrature.
        (((1.0, 0.3), (1.5, 0.4), 9.0), "nn-", "lower"),
        (((1.0, 0.3), (1.5, 0.39), 9.0), "b--", "lower"),
        (((1.0, 0.0), (1.5, 0.5), 9.0), "nn-", "lower"),
        (((1.0, 0.49), (1.5, 0.0), 9.0), "b--", "lower"),
        # Where one of two scatters, the larger of both: its spread, and a hundredth.
        ((100.0, (100.9, 0.1), (200.0, 0.1)), "nn-", "lower"),
        (((100.0, 3.0), 102.9, 200.0), "nn-", "lower"),
        (((100.0, 3.0), 103.1, 200.0), "b--", "lower"),
        (((-1.0, 0.1), (1.12, 0.1), (-3.0, 0.1)), "nn-", "lower"),
        # Single runs are not ranked.
        (((1.0, 0.1), (3.0, math.nan), (9.0, 0.1)), "---", "lower"),
    ],
)
def test_the_best_is_marked_where_it_is_shown(
    values: tuple[_Given, ...], found: str, better: str
) -> None:
    assert marks([of(value) for value in values], better) == found


@pytest.mark.parametrize(
    ("unit", "values", "found"),
    [("MiB", (10.0, 10.9, 11.1), "nn-"), ("s", (1.0, 1.29, 1.31), "nn-")],
)
def test_costs_that_another_run_could_turn_round_are_level(
    unit: str, values: tuple[float, ...], found: str
) -> None:
    assert marks([of(value) for value in values], unit=unit) == found
    assert marks([of((value, 0.01)) for value in values], unit=unit) == found


def test_a_value_over_fewer_photos_is_not_ranked() -> None:
    assert marks([of(7.0, "", 2), of(9.0, "", 3), of(11.0, "", 3)]) == "fb-"
    assert marks([of(7.0, "", 2), of(9.0, "", 3)]) == "f-"
    # Of other data there are other photos; and what counts none is ranked.
    assert marks([of(7.0, "a", 2), of(9.0, "b", 3), of(8.0, "a", 2)]) == "b--"
    assert marks([of(7.0), of(9.0, "", 3)]) == "b-"


def test_groups_are_ranked_apart_and_what_is_absent_is_not_ranked() -> None:
    assert marks([of(1.0, "a"), of(9.0, "b"), of(2.0, "a"), of(8.0, "b")]) == "b--b"
    assert marks([of(1.0), Value(), of(2.0)]) == "b--"
    single = of((3.0, math.nan), "b")
    assert marks([of((1.0, 0.1), "a"), of((9.0, 0.1), "a"), single]) == "b--"


def test_methods_declare_what_is_good() -> None:
    found = {spec.name: spec.better for spec in InspectTruth.metric_specs()}
    assert found["pose_error_over_sigma"] == "one"
    assert found["label_f1"] == "higher"
    assert found["wall_[0-9]*_rmse_[uv]_mm"] is found["rmse_[uv]_mm"] == "lower"
    assert found["n_photos"] == ""


def test_badness_is_smaller_the_better_a_value_is() -> None:
    assert badness(-2.0, "lower") == 2.0
    assert badness(2.0, "higher") == -2.0
    assert badness(0.5, "one") == badness(2.0, "one")
    assert badness(0.0, "one") == badness(-1.0, "one") == math.inf
    with pytest.raises(ValueError, match="cannot be ranked"):
        badness(1.0, "")
