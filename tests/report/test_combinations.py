"""Combinations of variants: which there are, what each measured, and which is the baseline."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.report import combinations
from orthoflow.report.combinations import Combination


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
