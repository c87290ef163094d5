"""Two runs side by side: what differs is named, and how far products lie apart."""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from orthoflow_provenance.document import Metric, PublishedFile

from orthoflow.engine.store import Store
from orthoflow.errors import PluginError
from orthoflow.products.product import Payload, Tolerance
from orthoflow.records.compare import (
    Pair,
    ProductDistance,
    RunProducts,
    Verdict,
    compare_runs,
    product_distances,
)
from orthoflow.records.open import open_run
from orthoflow.records.replay import ReplayedMetric, replayed_metrics
from orthoflow.records.runs import Run
from tests.compared_runs import compared, number
from tests.report_runs import HeldRun, cell, given, metrics, record, run_of, without_products
from tests.studios import Studio, open_studio


def test_a_comparison_is_a_sentence_and_a_table_of_what_moved() -> None:
    rows = (
        Pair(cell="plane", name="rms_mm", left=number(1.0), right=number(1.5)),
        Pair(cell="plane", name="n", left=number(4.0, unit="1"), right=number(4.0, unit="1")),
        Pair(
            cell="plane",
            name="wall_s",
            left=number(4.0, is_cost=True),
            right=number(9.0, is_cost=True),
        ),
        Pair(cell="wall", name="rms_mm", left=number(2.0), right=None),
    )
    comparison = compared(*rows, alone=("wall",))
    assert repr(comparison) == (
        "<RunComparison of 'r1' and 'r2': 0 of 0 inputs, 1 of 2 parameters, 1 of 2 metrics, "
        "1 of 3 products differ, 1 products not measured, 1 steps in only one run>"
    )
    assert comparison.measured == rows[:2]
    table = comparison.metric_table()
    assert table.difference.tolist()[:3] == [0.5, 0.0, 5.0]
    assert table.isna().to_numpy().sum(axis=1).tolist() == [0, 0, 0, 2]
    assert comparison.first_walls == ""
    sides = {
        side: record(
            [], published=[PublishedFile(path=path, size_bytes=0, sha256="") for path in paths]
        )
        for side, paths in {
            "left": ["products/wall/wall_11_depth.tif", "products/wall/wall_3_depth.tif"],
            "right": ["products/wall/floor_wall_4_depth.tif", "products/wall/wall_0_ortho.tif"],
        }.items()
    }
    assert replace(comparison, **sides).first_walls == (
        "; the first wall is wall 3 in A and wall 4 in B"
    )
    assert table.unit.tolist() == ["mm", "1", "mm", "mm"]
    # What differs by rounding is not counted.
    near = Pair(cell="plane", name="offset_mm", left=number(1.0), right=number(1.0 + 1e-12))
    assert "1 of 3 metrics" in repr(compared(*rows, near, alone=("wall",)))


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A folder with runs that differ in one thing each from `first`."""
    with pytest.MonkeyPatch.context() as patch:
        opened = open_studio(tmp_path_factory.mktemp("studio"), patch)
        opened.run("first")
        opened.run("again", "--store", "other")
        opened.run("near", "--set", "survey.offset_m=2.000004")
        opened.run("grey", "--set", "paint.grey=131")
        text = (opened.folder / "studio.yaml").read_text()
        swept = "{use: paint.plain, params: {grey: {sweep: [100, 128, 140]}},"
        (opened.folder / "swept.yaml").write_text(text.replace("{use: paint.plain,", swept))
        opened("run", "swept.yaml", "-o", "swept", code=0)
        yield opened


def verdicts(studio: Studio, other: str) -> list[tuple[str, str, list[tuple[str, float]]]]:
    said = studio.json("compare", "first", other)
    return [
        (row["cell"], row["verdict"], [(d["unit"], d["largest"]) for d in row["distances"]])
        for row in said["products"]
    ]


def test_the_same_workflow_computed_twice_is_the_same(studio: Studio) -> None:
    said = studio.json("compare", "first", "again")
    for name in ("inputs", "cells", "parameters", "environment"):
        assert all(row["same"] for row in said[name]), name
    assert verdicts(studio, "again") == [("survey", "identical", []), ("paint", "identical", [])]


def test_a_plain_run_is_compared_with_the_variant_that_does_the_same(studio: Studio) -> None:
    plain, variants = open_run("first"), open_run("swept")
    pairing = compare_runs(plain, variants)
    assert pairing.readdressed == {"paint@paint=grey-128": "paint"}
    # Products are read under the name that each run gives them.
    assert [(item.cell, item.verdict) for item in pairing.products] == [
        ("survey", "identical"),
        ("paint", "identical"),
    ]
    assert {row.cell for row in pairing.shared(pairing.parameters)} == {"survey", "paint"}
    assert repr(pairing).endswith(", 2 steps in only one run>")
    assert compare_runs(variants, plain).readdressed == {"paint": "paint@paint=grey-128"}


def test_distances_are_told_in_the_units_of_the_type(studio: Studio) -> None:
    survey, paint = verdicts(studio, "near")
    assert survey[:2] == ("survey", "within tolerance")
    [(unit, largest)] = survey[2]
    assert (unit, largest) == ("m", pytest.approx(4e-6, rel=1e-6))
    assert paint[:2] == ("paint", "within tolerance")
    assert verdicts(studio, "grey")[1] == ("paint", "different", [("grey", 3.0)])


def test_the_workflow_is_compared_line_by_line(studio: Studio) -> None:
    text = (studio.folder / "studio.yaml").read_text()
    (studio.folder / "failing.yaml").write_text(text.replace("paint.plain", "paint.fail"))
    assert studio("run", "failing.yaml", "-o", "failed").exit_code == 1
    said = studio.json("compare", "first", "failed")
    assert said["workflow"][-2:] == [
        "-  paint: {use: paint.plain, in: {planes: survey.planes}}",
        "+  paint: {use: paint.fail, in: {planes: survey.planes}}",
    ]
    [row] = [row for row in said["cells"] if not row["same"]]
    assert (row["left"]["status"], row["right"]["status"]) == ("ok", "failed")
    assert said["products"][1]["reason"] == "it exists in only one of the runs"
    rates = [row for row in said["metrics"] if row["name"] == "painted_share"]
    assert [row["right"] for row in rates] == [None]


def test_arrays_beside_the_record_are_found_in_a_store_or_not_measured(studio: Studio) -> None:
    left, right = (without_products(open_run(studio.folder / name)) for name in ("first", "near"))
    assert {item.verdict for item in compare_runs(left, right).products} == {"not measured"}
    measured = compare_runs(left, right, stores=[Store(studio.folder / ".orthoflow")]).products
    assert {item.verdict for item in measured} == {"within tolerance"}


def test_what_was_skipped_has_no_versions_to_differ_in() -> None:
    # Its method was loaded only where another dataset needed it.
    skipped = replace(cell("cloud", status="skipped", error_message="no scan"), seed=None)
    loaded = replace(skipped, result_version=1, determinism="exact", distribution="toys")
    (row,) = compare_runs(run_of(skipped), run_of(loaded)).cells
    assert row.is_same
    assert str(row.right) == "skipped, cloud.toy, no scan"
    runs = (run_of(replace(one, status="ok")) for one in (skipped, loaded))
    (row,) = compare_runs(*runs).cells
    assert not row.is_same


def test_other_code_under_the_same_version_is_a_difference() -> None:
    texts = (f'{{"code": {{"plugin": "{letter * 64}"}}}}' for letter in "ab")
    runs = (run_of(replace(cell("plane"), key_preimage=text)) for text in texts)
    (row,) = compare_runs(*runs).cells
    assert not row.is_same
    assert "code of plugin bbbbbbbb" in str(row.right)


def _swept(**values: float) -> HeldRun:
    """A run of a step whose variants have a parameter each."""
    return run_of(*(cell(f"plane@plane={name}", params={"x": x}) for name, x in values.items()))


@pytest.mark.parametrize(
    ("left", "right", "pairs"),
    [
        # Names that changed places are paired by what they stand for.
        ({"a": 1.0, "b": 2.0}, {"a": 2.0, "b": 1.0}, {"a": "b", "b": "a"}),
        ({"a": 1.0, "b": 2.0}, {"a": 0.0, "b": 1.0, "c": 2.0}, {"b": "a", "c": "b"}),
        # A parameter that was changed belongs to the variant of that name.
        ({"a": 1.0, "b": 2.0}, {"a": 3.0, "b": 2.0}, {}),
        ({"a": 1.0, "b": 2.0}, {"a": 2.0, "b": 2.0}, {}),
        ({"a": 1.0, "b": 2.0}, {"c": 1.0, "b": 3.0}, {"c": "a"}),
    ],
)
def test_rows_are_paired_by_parameters_and_not_by_names_of_variants(
    left: dict[str, float], right: dict[str, float], pairs: dict[str, str]
) -> None:
    found = compare_runs(_swept(**left), _swept(**right))
    assert found.readdressed == {f"plane@plane={b}": f"plane@plane={a}" for b, a in pairs.items()}
    # No row of the second run is lost or counted twice.
    assert sum(row.right is not None for row in found.cells) == len(right)
    assert len({row.cell for row in found.cells}) == len(found.cells)


# How far products lie apart -----------------------------------------------------------------------


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


def distance_of(left: Payload, right: Payload | None, *, kind: str = "toy") -> ProductDistance:
    sides = []
    for one in (left, right):
        out = replace(given("", "0", kind), digest=f"{id(one)}", embedded=one is not None)
        held: Any = {("cell", "out"): SimpleNamespace(to_payload=partial(copy, one))}
        run = run_of(cell("cell", outputs={"out": out}), products=held)
        sides.append(RunProducts(run=run))
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
    found = distance_of(before, after)
    assert found.verdict == verdict
    (distance,) = found.distances
    assert (distance.unit, distance.field, distance.n_values) == ("m", "depth_m", n_values)
    assert distance.largest == pytest.approx(apart)
    assert distance.limit == 0.001
    assert (found.reason == "") is (n_values == 0)


def test_a_number_and_no_number_have_no_difference() -> None:
    found = distance_of(payload(depth_m=[np.nan, 1.0]), payload(depth_m=[1.0, 1.5]))
    (distance,) = found.distances
    assert (found.verdict, distance.largest, distance.n_values) == ("different", None, 2)


def test_what_cannot_be_had_is_not_measured() -> None:
    found = distance_of(payload(n=[1]), None)
    assert found.verdict == "not measured"
    assert "no record or available store" in found.reason
    found = distance_of(payload(n=[1]), payload(n=[1]), kind="strange")
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
            (distance,) = distance_of(before, after).distances
            assert distance.limit == allowed


IDENTICAL: tuple[Verdict, Verdict] = ("identical", "identical")


def measured(*numbers: Metric) -> Run:
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
    return run_of(wall, crack)


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
    before, after = (measured(*metrics(rms_mm=value)) for value in (recorded, replayed))
    [found] = reported(before, after, verdicts)
    assert (found.recorded, found.replayed, found.verdict) == (recorded, replayed, expected)
    [found] = reported(before, after, verdicts, before.cells["wall"].method)
    assert found.verdict == behind_changed_code


def test_times_are_left_out_but_for_a_number_that_one_side_calls_a_time() -> None:
    [number] = metrics(n=1.0)
    hidden = replace(number, unit="s")
    assert reported(measured(hidden), measured(replace(hidden, value=2.0)), IDENTICAL) == ()
    [found] = reported(measured(hidden), measured(number), IDENTICAL)
    assert (found.recorded_unit, found.replayed_unit, found.verdict) == ("s", "1", "different")
    [found] = reported(measured(), measured(number), IDENTICAL)
    assert (found.replayed, found.verdict) == (1.0, "not in the record")
