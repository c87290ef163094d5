"""Numbers of a replay beside those of the record: what excuses a difference, and what does not."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from orthoflow_provenance.document import Metric

from orthoflow.records.compare import ProductDistance, Verdict
from orthoflow.records.replay import ReplayedMetric, replayed_metrics
from orthoflow.records.runs import Run
from tests.report_runs import cell, given, metrics, record

PATH = Path("run.h5")
IDENTICAL: tuple[Verdict, Verdict] = ("identical", "identical")


def run_of(*numbers: Metric) -> Run:
    """A step whose product the step `crack` takes, which has the numbers."""
    wall = cell("wall", outputs={"walls": given("", "a", "walls")})
    crack = cell(
        "crack",
        inputs={
            "files": given("inputs.scan", "c", "files"),
            "w": given("wall.walls", "a", "walls"),
        },
        outputs={"found": given("", "b", "crack")},
        metrics=numbers,
    )
    return Run(path=PATH, record=record([wall, crack]))


def reported(
    recorded: Run, made: Run, verdicts: tuple[Verdict, Verdict], *changed: str
) -> tuple[ReplayedMetric, ...]:
    ports = (("wall", "walls"), ("crack", "found"))
    distances = [
        ProductDistance(cell=step, port=port, type_name="t", verdict=verdict, left="l", right="r")
        for (step, port), verdict in zip(ports, verdicts, strict=True)
    ]
    return replayed_metrics(recorded, made, distances, changed)


@pytest.mark.parametrize(
    ("recorded", "replayed", "verdicts", "expected", "behind_changed_code"),
    [
        (2.5, 2.5, IDENTICAL, "same", "same"),
        (2.5, 2.5 + 1e-9, IDENTICAL, "rounding", "rounding"),
        (2.5, 2.5001, IDENTICAL, "different", "code changed"),
        (2.5, math.inf, IDENTICAL, "different", "code changed"),
        # Counts are not rounded, however many.
        (3e7, 3e7 + 1, IDENTICAL, "different", "code changed"),
        (2.5, 2.6, ("identical", "within tolerance"), "products", "code changed"),
        (2.5, 2.6, ("within tolerance", "identical"), "products", "code changed"),
        (2.5, 2.6, ("identical", "not measured"), "products", "code changed"),
    ],
)
def test_each_cause_has_a_verdict_of_its_own(
    recorded: float,
    replayed: float,
    verdicts: tuple[Verdict, Verdict],
    expected: str,
    behind_changed_code: str,
) -> None:
    before, after = (run_of(*metrics(rms_mm=value)) for value in (recorded, replayed))
    [found] = reported(before, after, verdicts)
    assert (found.recorded, found.replayed, found.verdict) == (recorded, replayed, expected)
    [found] = reported(before, after, verdicts, before.cells["wall"].method)
    assert found.verdict == behind_changed_code


def test_times_are_left_out_but_for_a_number_that_one_side_calls_a_time() -> None:
    [number] = metrics(n=1.0)
    hidden = replace(number, unit="s")
    assert reported(run_of(hidden), run_of(replace(hidden, value=2.0)), IDENTICAL) == ()
    [found] = reported(run_of(hidden), run_of(number), IDENTICAL)
    assert (found.recorded_unit, found.replayed_unit, found.verdict) == ("s", "1", "different")
