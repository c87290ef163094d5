"""Combinations of variants: which there are, what each measured, and which is the baseline."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.report import combinations
from orthoflow.report.combinations import Combination, combinations_of


def cell(
    step: str, *, repeat: int = 0, status: str = "ok", environment: str = "a", **assignment: str
) -> Any:
    return SimpleNamespace(
        step=step, assignment=assignment, repeat=repeat, status=status, environment=environment
    )


def run(*cells: Any, compare: object = None, text: str | None = None) -> Any:
    resolved = json.dumps({} if compare is None else {"compare": compare})
    return SimpleNamespace(
        record=SimpleNamespace(cells=cells, workflow_resolved=resolved if text is None else text)
    )


CELLS = (
    cell("scan"),
    cell("plane", plane="ransac"),
    cell("plane", plane="hough"),
    cell("orient", plane="ransac", orient="pnp"),
    cell("orient", plane="ransac", orient="dlt"),
    cell("orient", plane="ransac", orient="pnp", repeat=1),
)


def test_without_variants_there_is_one_combination_of_everything() -> None:
    [one] = combinations_of(run(cell("scan"), cell("plane")))
    assert (one.name, len(one.cells), len(one.varied_cells)) == ("", 2, 2)
    assert combinations_of(run()) == ()


@pytest.mark.parametrize(
    ("baseline", "marked"),
    [
        ({"plane": "ransac", "orient": "pnp"}, [False, True, False]),
        # A combination that a later step does not reach is part of the baseline's way.
        ({"plane": "hough", "orient": "pnp"}, [True, False, False]),
        ({"plane": "hough"}, [True, False, False]),
        # What the baseline does not name, a dataset say, has a baseline of its own each.
        ({"plane": "ransac"}, [False, True, True]),
        ({}, [False, False, False]),
        (["plane"], [False, False, False]),
    ],
)
def test_the_baseline_is_the_combination_of_its_variants(
    baseline: object, marked: list[bool]
) -> None:
    found = combinations_of(run(*CELLS, compare={"baseline": baseline}))
    assert [one.is_baseline for one in found] == marked


def test_the_cells_of_the_baseline_are_its_first_ones() -> None:
    of = run(*CELLS, compare={"baseline": {"plane": "ransac", "orient": "pnp"}})
    assert [each.step for each in combinations.baseline_cells(of)] == ["scan", "plane", "orient"]
    # Where none is named, the first combination stands in.
    assert combinations.baseline_cells(run(*CELLS)) == (CELLS[0], CELLS[2])
    assert combinations.baseline_cells(run()) == ()


@pytest.mark.parametrize(
    ("text", "patterns"),
    [
        ('{"compare": {"metrics": ["a.b", "*.c"]}}', ("a.b", "*.c")),
        ('{"compare": {"metrics": "a.b"}}', ()),
        ('{"compare": ["a.b"]}', ()),
        ('["a.b"]', ()),
        ("{", ()),
    ],
)
def test_metrics_are_asked_for_by_the_workflow(text: str, patterns: tuple[str, ...]) -> None:
    of = run(text=text)
    assert combinations.wanted_metrics(of) == patterns
    assert combinations.baseline_of(of) == {}


def test_the_first_failure_is_named_and_later_repeats_are_counted() -> None:
    first, second = cell("plane", status="failed"), cell("orient", status="failed")
    one = Combination(
        run=run(),
        assignment={"plane": "a"},
        cells=(
            cell("scan"),
            first,
            cell("plane", repeat=1, status="failed", plane="a"),
            cell("plane", repeat=2, status="failed", plane="a"),
            cell("plane", repeat=3, plane="a"),
            second,
        ),
        is_baseline=False,
    )
    assert one.failure is first
    assert one.n_failed_repeats == 2
    assert one.varied_cells == ()
    fine = Combination(run=run(), assignment={}, cells=(cell("scan"),), is_baseline=False)
    assert (fine.failure, fine.n_failed_repeats) == (None, 0)


def test_errors_of_both_signs_are_averaged_by_their_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(metric: str, *values: float) -> Any:
        def rows(of: Any) -> list[Any]:
            value = values[of.repeat]
            better = "lower" if metric == "plane_offset_mm" else ""
            return [SimpleNamespace(metric=metric, value=value, unit="mm", better=better)]

        monkeypatch.setattr(combinations, "cell_metrics", rows)
        cells = tuple(cell("plane", repeat=repeat) for repeat in range(len(values)))
        one = Combination(run=run(), assignment={}, cells=cells, is_baseline=False)
        return one.measured("plane", metric)

    both = found("plane_offset_mm", -1.0, 3.0)
    assert (both.value, both.spread, both.is_of_sizes) == (2.0, pytest.approx(2**0.5), True)
    # Of one sign the mean has it, too; and what has no good side is no error.
    below = found("plane_offset_mm", -1.0, -3.0)
    assert (below.value, below.is_of_sizes) == (-2.0, False)
    assert (found("omega_deg", -1.0, 3.0).value, found("plane_offset_mm", -1.0).value) == (
        1.0,
        -1.0,
    )


def test_the_photos_behind_a_summary_are_counted_in_its_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def rows(_: Any) -> list[Any]:
        return [SimpleNamespace(metric="n_oriented", value=2.0, unit="1", better="higher")]

    monkeypatch.setattr(combinations, "cell_metrics", rows)
    one = Combination(run=run(), assignment={}, cells=(cell("orient"),), is_baseline=False)
    assert one.n_items("orient", "n_oriented") == 2.0
    assert math.isnan(one.n_items("orient", ""))
    assert math.isnan(one.n_items("match", "n_photos_matched"))


def test_a_metric_is_the_mean_of_its_repeats_and_their_spread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    values = {0: 3.0, 1: 5.0, 2: 10.0}

    def metrics(of: Any) -> list[Any]:
        row = SimpleNamespace(metric="rms_mm", value=values[of.repeat], unit="mm")
        return [SimpleNamespace(metric="other", value=99.0, unit="1"), row]

    monkeypatch.setattr(combinations, "cell_metrics", metrics)
    cells = tuple(cell("plane", repeat=repeat, environment="ab"[repeat > 0]) for repeat in range(3))
    one = Combination(run=run(), assignment={}, cells=(*cells, cell("wall")), is_baseline=False)
    found = one.measured("plane", "rms_mm")
    assert found is not None
    assert (found.value, found.n_repeats, found.unit, found.environment) == (6.0, 3, "mm", "a")
    assert found.spread == pytest.approx(math.sqrt((9 + 1 + 16) / 2))
    assert one.measured("plane", "nothing") is None
    assert one.measured("nothing", "rms_mm") is None
    # Their sum is rounded, and a third of it no longer one of them.
    values |= dict.fromkeys(values, 0.1)
    equal = one.measured("plane", "rms_mm")
    assert equal is not None
    assert equal.spread == 0.0
    values[0] = 3.0
    single = one.measured("wall", "rms_mm")
    assert single is not None
    assert (single.value, single.n_repeats) == (3.0, 1)
    assert math.isnan(single.spread)
