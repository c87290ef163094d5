"""Two runs side by side: what differs is named, and how far products lie apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from orthoflow.engine.store import Store
from orthoflow.records.comparison import compare_runs
from orthoflow.records.runs import open_run
from tests.studios import Studio, open_studio


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
    assert shown.splitlines()[-1] == "2 products: 2 identical"


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
    text = (studio.folder / "studio.yaml").read_text()
    swept = "{use: paint.plain, params: {grey: {sweep: [100, 128, 140]}},"
    (studio.folder / "swept.yaml").write_text(text.replace("{use: paint.plain,", swept))
    done = studio("run", "swept.yaml", "-o", "swept")
    assert done.exit_code == 0, done.output
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
    assert "the same, though called otherwise: paint (A), paint@paint=grey-128 (B)" in shown
    assert compare_runs(variants, plain).readdressed == {"paint": "paint@paint=grey-128"}


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


def test_arrays_beside_the_record_are_found_in_a_store_or_not_measured(studio: Studio) -> None:
    from dataclasses import replace

    runs = [open_run(studio.folder / name) for name in ("first", "near")]

    def unembedded(run):  # type: ignore[no-untyped-def]
        cells = tuple(
            replace(
                cell,
                outputs={port: replace(out, embedded=False) for port, out in cell.outputs.items()},
            )
            for cell in run.record.cells
        )
        return replace(run, record=replace(run.record, cells=cells))

    left, right = (unembedded(run) for run in runs)
    assert {item.verdict for item in compare_runs(left, right).products} == {"not measured"}
    measured = compare_runs(left, right, stores=[Store(studio.folder / ".orthoflow")]).products
    assert {item.verdict for item in measured} == {"within tolerance"}


@pytest.mark.parametrize("preimage", ["", "[1]", "{", "[" * 50_000, '{"code": 5, "tools": [1]}'])
def test_a_preimage_that_says_nothing_costs_nothing(studio: Studio, preimage: str) -> None:
    first, second = (open_run(studio.folder / name) for name in ("first", "first"))
    for address, cell in second.cells.items():
        second.cells[address] = replace(cell, key_preimage=preimage)  # type: ignore[index]
    (pair, *_) = compare_runs(first, second).cells
    assert pair.right is not None
    assert (pair.right.code, pair.right.tools) == ({}, {})
