"""How far two products lie apart, and numbers of a replay beside those of the record."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from orthoflow_provenance.document import Metric

from orthoflow.errors import PluginError
from orthoflow.products.product import Payload, Tolerance
from orthoflow.records.compare import ProductDistance, RunProducts, Verdict, product_distances
from orthoflow.records.replay import ReplayedMetric, replayed_metrics
from orthoflow.records.runs import Run
from tests.report_runs import HeldRun, cell, given, metrics, record


def payload(**arrays: Any) -> Payload:
    arrays = {name: np.asarray(value) for name, value in arrays.items()}
    return Payload(type_name="toy", encoding_version=1, metadata={}, arrays=arrays)


class Toy:
    """A product type of which fields may differ."""

    encoding_version: ClassVar[int] = 1
    tolerances: ClassVar[dict[str, Tolerance]] = {
        "depth_m": Tolerance(limit=0.001, unit="m"),
        "rgb": Tolerance(limit=2, unit="grey"),
        "n": Tolerance(limit=0, unit="1"),
    }


class Catalog:
    def product_class(self, name: str) -> Any:
        if name != "toy":
            raise PluginError(f"no product type {name}")
        return Toy


def compared(left: Payload, right: Payload | None, *, kind: str = "toy") -> ProductDistance:
    sides = []
    for one in (left, right):
        out = replace(given("", "0", kind), digest=f"{id(one)}", embedded=one is not None)
        held: Any = {("cell", "out"): SimpleNamespace(to_payload=partial(copy, one))}
        made = record([cell("cell", outputs={"out": out})])
        sides.append(RunProducts(run=HeldRun(path=Path("run.h5"), record=made, products=held)))
    (found,) = product_distances(*sides, ["cell"], Catalog())  # type: ignore[arg-type]
    return found


@pytest.mark.parametrize(
    ("apart", "verdict", "n_values"), [(0.0009, "within tolerance", 0), (0.0011, "different", 2)]
)
def test_values_may_lie_apart_as_their_type_allows(
    apart: float, verdict: str, n_values: int
) -> None:
    before = payload(depth_m=np.array([1.0, 2.0, 3.0]), n=[1, 2])
    after = payload(depth_m=np.array([1.0, 2.0 + apart, 3.0 - apart]), n=[1, 2])
    found = compared(before, after)
    assert found.verdict == verdict
    (distance,) = found.distances
    assert (distance.unit, distance.field, distance.n_values) == ("m", "depth_m", n_values)
    assert distance.largest == pytest.approx(apart)
    assert distance.limit == 0.001
    assert (found.reason == "") is (n_values == 0)


def test_a_number_and_no_number_have_no_difference() -> None:
    found = compared(payload(depth_m=[np.nan, 1.0]), payload(depth_m=[1.0, 1.5]))
    (distance,) = found.distances
    assert (found.verdict, distance.largest, distance.n_values) == ("different", None, 2)


def test_what_cannot_be_had_is_not_measured() -> None:
    found = compared(payload(n=[1]), None)
    assert found.verdict == "not measured"
    assert "no record or available store" in found.reason
    found = compared(payload(n=[1]), payload(n=[1]), kind="strange")
    assert found.verdict == "not measured"
    assert (
        found.reason
        == "the digests differ, but the arrays cannot be compared: no product type strange"
    )


@pytest.mark.parametrize(
    ("dtype", "limit"), [(np.uint8, 2.0), (np.uint16, 2.0 * 257), (np.int32, 2.0)]
)
def test_grey_of_sixteen_bits_counts_in_steps_of_257(dtype: Any, limit: float) -> None:
    for field, allowed in (("rgb", limit), ("n", 0.0)):
        for place in (field, f"walls/0/{field}"):
            before, after = (payload(**{place: np.array([v], dtype=dtype)}) for v in (0, 200))
            (distance,) = compared(before, after).distances
            assert distance.limit == allowed


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
