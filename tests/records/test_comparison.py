"""Two runs side by side: what differs is named, and how far products lie apart."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from orthoflow.engine.store import Store
from orthoflow.records import comparison as module
from orthoflow.records.comparison import Difference, Pair, ParameterValue, compare_runs
from orthoflow.records.runs import Run
from orthoflow.records.unfinished import open_run
from orthoflow.report.pages import write_report
from tests.compared_runs import compared, number
from tests.report_runs import HeldRun, cell, metrics, record
from tests.studios import Studio, open_studio


@pytest.mark.parametrize(
    ("left", "right", "is_same", "is_shared", "either"),
    [(1, 1, True, True, 1), (1, 2, False, True, 1), (1, None, False, False, 1),
     (None, 2, False, False, 2)],
)  # fmt: skip
def test_a_pair_is_what_both_or_one_of_them_say(
    left: int | None, right: int | None, is_same: bool, is_shared: bool, either: int
) -> None:
    pair = Pair(name="x", left=left, right=right)
    assert (pair.is_same, pair.is_shared, pair.either) == (is_same, is_shared, either)


def test_rows_are_counted_by_who_says_something() -> None:
    sides = [(1, 1), (1, 2), (3, 4), (1, None), (None, 1), (None, 2), (None, 3), (None, None)]
    rows = [Pair(name="x", left=left, right=right) for left, right in sides]
    assert Difference.of(rows) == Difference(n_different=2, n_shared=3, n_left=1, n_right=3)
    values = [(1.0, 1.0), (1.0, 1.0 + 1e-9), (1.0, 1.1)]
    numbers = [Pair(name="x", left=number(one), right=number(two)) for one, two in values]
    assert Difference.of(numbers) == Difference(
        n_different=1, n_shared=3, n_left=0, n_right=0, n_rounded=1
    )


def test_a_number_is_the_same_whatever_machine_measured_it() -> None:
    here = number(1.0)
    assert here == replace(here, is_cost=True, is_cached=True, environment="there")
    assert here != number(2.0)
    assert here != number(1.0, unit="m")


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
        "<RunComparison of 'r1' and 'r2': 1 of 2 parameters, 1 of 2 metrics, 1 (1 more not "
        "measured) of 3 products differ; no inputs in common; 1 steps in one of them only>"
    )
    assert comparison.measured == rows[:2]
    table = comparison.metric_table()
    assert table.difference.tolist()[:3] == [0.5, 0.0, 5.0]
    assert table.isna().to_numpy().sum(axis=1).tolist() == [0, 0, 0, 2]
    assert table.unit.tolist() == ["mm", "1", "mm", "mm"]
    # What differs by rounding is counted apart.
    near = Pair(cell="plane", name="offset_mm", left=number(1.0), right=number(1.0 + 1e-12))
    both = compared(*rows, near, alone=("wall",))
    assert "1 of 3 metrics (1 more by rounding)" in repr(both)
    # Runs of a workflow without inputs have none to share.
    assert "inputs" not in repr(replace(comparison, inputs=()))
    # What shares nothing is not alike.
    apart = compared(rows[3], alone=("wall",))
    assert "; no inputs, parameters, metrics in common; " in repr(apart)


def test_times_and_memory_are_costs_whoever_measured_them() -> None:
    told = cell("plane", metrics=metrics(rms_mm=1.0, search_s=2.0), cached_from="r0")
    found = module._metrics(told)
    assert {name for name, one in found.items() if one.is_cost} == {*found} - {"rms_mm"}
    assert {"search_s", "wall_s"} < {*found}
    assert all(one.is_cached and one.environment == "e1" for one in found.values())
    assert not any(one.is_cached for one in module._metrics(cell("plane")).values())


def test_what_only_one_of_the_runs_has_stands_alone() -> None:
    left, right = (
        HeldRun(path=Path("run.h5"), record=record([cell(name, params={"x": value}, seed=None)]))
        for name, value in (("scan", 1), ("room", 2))
    )
    one, two = (ParameterValue(value=value, is_set=True) for value in (1, 2))
    assert module._per_cell(left, right, {"room": "room"}, module._parameters) == (
        Pair(cell="scan", name="x", left=one, right=None),
        Pair(cell="room", name="x", left=None, right=two),
    )


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A folder with runs that differ in one thing each from `first`."""
    with pytest.MonkeyPatch.context() as patch:
        opened = open_studio(tmp_path_factory.mktemp("studio"), patch)
        opened.run("first")
        opened.run("again", "--store", "other")
        opened.run("near", "--set", "survey.offset_m=2.000004")
        opened.run("grey", "--set", "paint.grey=131")
        opened.run("fine", "--set", "paint.gsd_m=0.25")
        (opened.folder / "n.txt").write_text("2.0")
        opened.run("file", "--input", "number=n.txt")
        text = (opened.folder / "studio.yaml").read_text()
        swept = "{use: paint.plain, params: {grey: {sweep: [100, 128, 140]}},"
        (opened.folder / "swept.yaml").write_text(text.replace("{use: paint.plain,", swept))
        done = opened("run", "swept.yaml", "-o", "swept")
        assert done.exit_code == 0, done.output
        yield opened


def changes(studio: Studio, other: str) -> dict[str, list[tuple[object, ...]]]:
    said = studio.json("compare", "first", other)
    return {
        name: [(row["cell"], row["name"]) for row in rows if not row["same"]]
        for name, rows in said.items()
        if name in ("inputs", "cells", "parameters", "environment")
    }


def verdicts(studio: Studio, other: str) -> list[tuple[str, str, list[tuple[str, float]]]]:
    said = studio.json("compare", "first", other)
    return [
        (row["cell"], row["verdict"], [(d["unit"], d["largest"]) for d in row["distances"]])
        for row in said["products"]
    ]


def test_the_same_workflow_computed_twice_is_the_same(studio: Studio) -> None:
    assert not any(changes(studio, "again").values())
    assert verdicts(studio, "again") == [("survey", "identical", []), ("paint", "identical", [])]
    shown = studio("compare", "first", "again").stdout
    for line in ("inputs: same", "workflow: same text", "steps: same", "environment: same"):
        assert line in shown.splitlines()
    assert "metrics: 0 of 2 differ" in shown.splitlines()
    verify = "`orthoflow verify first` and `orthoflow verify again`"
    assert shown.splitlines()[-3:] == [
        "2 products: 2 identical",
        "",
        f"{verify} check that nothing changed since it was written",
    ]


def test_a_set_parameter_is_told_from_a_default(studio: Studio) -> None:
    [row] = [
        row
        for row in studio.json("compare", "first", "grey")["parameters"]
        if row["name"] == "grey"
    ]
    assert row["left"] == {"value": 128, "is_set": False}
    assert row["right"] == {"value": 131, "is_set": True}
    shown = studio("compare", "first", "grey").stdout
    assert "parameters (* set, others are defaults): 1 of 3 differ" in shown
    assert ["paint.grey", "128", "131*"] in [line.split() for line in shown.splitlines()]
    assert "--set paint.grey=131" in shown


def test_a_plain_run_is_compared_with_the_variant_that_does_the_same(studio: Studio) -> None:
    plain, variants = open_run("first"), open_run("swept")
    told = compare_runs(plain, variants)
    assert told.readdressed == {"paint@paint=grey-128": "paint"}
    # Products are read under the name that each run gives them.
    assert [(item.cell, item.verdict) for item in told.products] == [
        ("survey", "identical"),
        ("paint", "identical"),
    ]
    assert {row.cell for row in told.shared(told.parameters)} == {"survey", "paint"}
    assert repr(told).endswith("differ; 2 steps in one of them only>")
    shown = studio("compare", "first", "swept").stdout
    assert "steps: 0 of 2 differ, 2 only in B" in shown
    assert "compared despite different names: paint (A) and paint@paint=grey-128 (B)" in shown
    of_both = re.findall("^(.*): .*, of the 2 steps that both have$", shown, re.MULTILINE)
    assert of_both == ["parameters (* set, others are defaults)", "metrics"]
    assert compare_runs(variants, plain).readdressed == {"paint": "paint@paint=grey-128"}


def test_of_a_changed_method_the_variant_with_the_same_swept_value_is_compared(
    studio: Studio,
) -> None:
    variants, changed = open_run("swept"), open_run("fine")
    told = compare_runs(changed, variants)
    assert told.readdressed == {"paint@paint=grey-128": "paint"}
    moved = {
        row.name: (row.left.value, row.right.value)
        for row in told.shared(told.parameters)
        if row.left and row.right and row.left.value != row.right.value
    }
    assert moved == {"gsd_m": (0.25, 0.5)}
    # 131 is no value of the sweep.
    assert compare_runs(open_run("grey"), variants).readdressed == {}


def test_distances_are_told_in_the_units_of_the_type(studio: Studio) -> None:
    survey, paint = verdicts(studio, "near")
    assert survey[:2] == ("survey", "within tolerance")
    [(unit, largest)] = survey[2]
    assert (unit, largest) == ("m", pytest.approx(4e-6, rel=1e-6))
    assert paint[:2] == ("paint", "within tolerance")
    assert verdicts(studio, "grey")[1] == ("paint", "different", [("grey", 3.0)])
    shown = studio("compare", "first", "grey").stdout
    assert "3 grey levels (images/0/rgb)" in shown
    assert "12 of 12 values differ by more than 2 grey, the largest by 3" in shown


def test_products_of_other_shapes_are_different_without_a_number(studio: Studio) -> None:
    [_, paint] = studio.json("compare", "first", "fine")["products"]
    assert paint["verdict"] == "different"
    assert None in [distance["largest"] for distance in paint["distances"]]


def test_files_are_compared_by_content(studio: Studio) -> None:
    assert changes(studio, "file")["inputs"] == [("", "number")]
    shown = studio("compare", "first", "file").stdout.splitlines()
    assert any(line.startswith("number  not given  n.txt ") for line in shown)


def test_the_workflow_is_compared_line_by_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studio = open_studio(tmp_path, monkeypatch)
    studio.run("a")
    path = tmp_path / "studio.yaml"
    path.write_text(path.read_text().replace("paint.plain", "paint.fail"))
    assert studio("run", "studio.yaml", "-o", "b").exit_code == 1
    said = studio.json("compare", "a", "b")
    assert said["workflow"][-2:] == [
        "-  paint: {use: paint.plain, in: {planes: survey.planes}}",
        "+  paint: {use: paint.fail, in: {planes: survey.planes}}",
    ]
    [row] = [row for row in said["cells"] if not row["same"]]
    assert (row["left"]["status"], row["right"]["status"]) == ("ok", "failed")
    assert said["products"][1]["reason"] == "only one of the runs has it"
    rates = [row for row in said["metrics"] if row["name"] == "painted_share"]
    assert [row["right"] for row in rates] == [None]


def unembedded(run: Run) -> Run:
    cells = tuple(
        replace(
            cell,
            outputs={port: replace(out, embedded=False) for port, out in cell.outputs.items()},
        )
        for cell in run.record.cells
    )
    return replace(run, record=replace(run.record, cells=cells))


def test_arrays_beside_the_record_are_found_in_a_store_or_not_measured(studio: Studio) -> None:
    left, right = (unembedded(open_run(studio.folder / name)) for name in ("first", "near"))
    assert {item.verdict for item in compare_runs(left, right).products} == {"not measured"}
    measured = compare_runs(left, right, stores=[Store(studio.folder / ".orthoflow")]).products
    assert {item.verdict for item in measured} == {"within tolerance"}


def test_a_page_of_two_runs_looks_into_the_store_as_the_command_does(
    studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "orthoflow.records.unfinished.open_run", lambda path: unembedded(open_run(path))
    )
    # Studios write empty pages.
    monkeypatch.setattr("orthoflow.report.write_report", write_report)
    told = "in no record and no store at hand"
    for more, is_told in (((), False), (("--store", "nowhere"), True)):
        done = studio("report", "first", "near", "-o", "both.html", *more)
        assert done.exit_code == 0, done.output
        assert (told in (studio.folder / "both.html").read_text(encoding="utf-8")) is is_told


def test_what_was_skipped_has_no_versions_to_differ_in() -> None:
    # Its method was loaded only where another dataset needed it.
    skipped = replace(cell("cloud", status="skipped", error_message="no scan"), seed=None)
    loaded = replace(skipped, result_version=1, determinism="exact", distribution="toys")
    facts = [module._facts(one) for one in (skipped, loaded)]
    assert facts[0] == facts[1]
    assert str(facts[1]) == "skipped, cloud.toy, no scan"
    assert module._facts(replace(loaded, status="ok")).result_version == 1


@pytest.mark.parametrize("preimage", ["", "[1]", "{", "[" * 50_000, '{"code": 5, "tools": [1]}'])
def test_a_preimage_that_says_nothing_costs_nothing(studio: Studio, preimage: str) -> None:
    first, second = (open_run(studio.folder / name) for name in ("first", "first"))
    for address, recorded in second.cells.items():
        second.cells[address] = replace(recorded, key_preimage=preimage)  # type: ignore[index]
    (pair, *_) = compare_runs(first, second).cells
    assert pair.right is not None
    assert (pair.right.code, pair.right.tools) == ({}, {})


def _swept(**values: float) -> HeldRun:
    """A run of a step whose variants have a parameter each."""
    cells = [
        cell(f"plane@plane={name}", assignment={"plane": name}, params={"x": value}, seed=None)
        for name, value in values.items()
    ]
    return HeldRun(path=Path("run.h5"), record=record(cells))


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
    one, two = _swept(**left), _swept(**right)
    found = module._readdressed(one, two)
    assert found == {f"plane@plane={b}": f"plane@plane={a}" for b, a in pairs.items()}
    own = {module._label(two, address, found): address for address in two.cells}
    assert sorted(own.values()) == sorted(two.cells)
