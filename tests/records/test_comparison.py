"""Two runs side by side: what differs is named, and how far products lie apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from orthoflow_provenance.document import PublishedFile, RecordedCell

from orthoflow.engine.store import Store
from orthoflow.records.compare import Pair, compare_runs
from orthoflow.records.open import open_run
from tests.compared_runs import compared, number
from tests.report_runs import HeldRun, cell, record, without_products
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
        done = opened("run", "swept.yaml", "-o", "swept")
        assert done.exit_code == 0, done.output
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


def held(*cells: RecordedCell) -> HeldRun:
    return HeldRun(path=Path("run.h5"), record=record(cells))


def test_what_was_skipped_has_no_versions_to_differ_in() -> None:
    # Its method was loaded only where another dataset needed it.
    skipped = replace(cell("cloud", status="skipped", error_message="no scan"), seed=None)
    loaded = replace(skipped, result_version=1, determinism="exact", distribution="toys")
    (row,) = compare_runs(held(skipped), held(loaded)).cells
    assert row.is_same
    assert str(row.right) == "skipped, cloud.toy, no scan"
    runs = (held(replace(one, status="ok")) for one in (skipped, loaded))
    (row,) = compare_runs(*runs).cells
    assert not row.is_same


def _swept(**values: float) -> HeldRun:
    """A run of a step whose variants have a parameter each."""
    return held(*(cell(f"plane@plane={name}", params={"x": x}) for name, x in values.items()))


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
