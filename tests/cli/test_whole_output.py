"""What commands print, to the last letter: tables, numbers, comparisons, methods, refusals."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from orthoflow_provenance.document import RecordedFile, RunRecord

from orthoflow.cli import plugins as plugins_commands
from orthoflow.cli.compare import _print, comparison_json
from orthoflow.cli.export import _refuse_filled
from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.formats import check_choices
from orthoflow.cli.exports.products import make_empty
from orthoflow.cli.program import program
from orthoflow.errors import ArgumentError
from orthoflow.records.comparison import CellFacts, Distance, Pair, ParameterValue, RunComparison
from tests.laboratories import laboratory_catalog
from tests.report_runs import cell, distance, metric, record


def printed(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().out.splitlines()


# --- comparisons ---


def part(field: str, unit: str, largest: float | None) -> Distance:
    return Distance(unit=unit, largest=largest, limit=0.1, field=field, n_values=3)


PRODUCTS = (
    distance("one", "identical"),
    distance("two", "different", "other names", part("x", "m", 0.25), part("n", "1", None)),
    distance("three", "within tolerance", "", part("rgb", "grey", 3.0), part("k", "1", 0.5)),
    distance("four", "different"),
)
FILES = tuple(
    RecordedFile(name=f"{name}.jpg", size_bytes=3, sha256=f"{index}123456789abcdef" * 4)
    for index, name in enumerate("abcde")
)


def facts(**more: Any) -> CellFacts:
    plain: dict[str, Any] = {
        "status": "ok",
        "method": "plane.a",
        "distribution": "toys 1.0",
        "result_version": 1,
        "determinism": "exact",
        "seed": None,
        "code": {},
        "tools": {},
        "error": "",
    }
    return CellFacts(**(plain | more))


def runs() -> tuple[RunRecord, RunRecord]:
    return record([cell("a")], name="room"), record([], run_id="r2", seed=9, name="room")


def same_runs() -> RunComparison:
    left, right = runs()
    return RunComparison(
        left=left,
        right=right,
        workflow=(),
        overrides=Pair(name="options", left=("a=1",), right=("a=1",)),
        inputs=(),
        cells=(Pair(name="a", left=facts(), right=facts()),),
        parameters=(),
        environment=(),
        metrics=(),
        products=(),
    )


def different_runs() -> RunComparison:
    left, right = runs()
    other = facts(
        status="failed",
        seed=0,
        code={"toys": "abcdef0123456789", "more": "1" * 64},
        tools={"colmap": "4.2"},
        error="no plane",
    )
    return RunComparison(
        left=left,
        right=right,
        workflow=("--- a", "+++ b", "@@ -1 +1 @@", "-x", "+y"),
        overrides=Pair(name="", left=("a=1", "b=2"), right=()),
        inputs=(
            Pair(name="scan", left=FILES[:3], right=FILES[:4]),
            Pair(name="photos", left=FILES[:1], right=()),
            Pair(name="same", left=FILES[:1], right=FILES[:1]),
        ),
        cells=(Pair(name="a", left=facts(), right=other), Pair(name="b", left=None, right=facts())),
        parameters=(
            Pair(
                cell="a",
                name="cell_m",
                left=ParameterValue(value=0.123456789, is_set=True),
                right=ParameterValue(value="ä", is_set=False),
            ),
        ),
        environment=(Pair(name="python", left="3.11", right=None),),
        metrics=(
            Pair(cell="a", name="wall_s", left=metric(1.0, is_cost=True), right=metric(2.0)),
            Pair(cell="a", name="rms_mm", left=metric(1.5), right=metric(1.25)),
            Pair(cell="a", name="max_mm", left=None, right=metric(2.0)),
            Pair(cell="a", name="same_mm", left=metric(2.0), right=metric(2.0)),
        ),
        products=PRODUCTS,
    )


def test_a_short_comparison_counts_rounding_and_says_once_what_is_said_alike(
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = ("plane@data=a", "plane@data=a#1", "plane@data=b")
    left = record([cell(name) for name in names])
    numbers = [
        Pair(cell=name, name="tiny_mm", left=metric(1e-13), right=metric(3e-13)) for name in names
    ]
    numbers += [
        Pair(cell=name, name="rms_mm", left=metric(1.5), right=metric(1.25)) for name in names
    ]
    values = [ParameterValue(value=value, is_set=True) for value in (10, 14)]
    comparison = dataclasses.replace(
        same_runs(),
        left=left,
        cells=tuple(Pair(cell=name, name="plane", left=facts(), right=facts()) for name in names),
        parameters=tuple(
            Pair(cell=name, name="angle_deg", left=values[0], right=values[1]) for name in names
        ),
        metrics=tuple(numbers),
    )
    _print(comparison, most=20)
    lines = printed(capsys)
    start = lines.index("parameters (* set, others are defaults): 3 of 3 differ")
    assert lines[start + 2 : start + 4] == ["plane.angle_deg, 3 steps  10*  14*", ""]
    start = lines.index("metrics: 3 of 6 differ, another 3 differ by less than a millionth")
    assert lines[start + 1 : start + 5] == [
        "metric                          A    B     B - A  unit",
        "plane@data=a.rms_mm, 2 repeats  1.5  1.25  -0.25  mm",
        "plane@data=b.rms_mm             1.5  1.25  -0.25  mm",
        "",
    ]
    _print(comparison)
    assert sum("tiny_mm" in line for line in printed(capsys)) == 3


def test_a_comparison_in_json_says_of_each_row_whether_it_is_the_same() -> None:
    found = json.loads(json.dumps(comparison_json(different_runs())))
    assert [run["run_id"] for run in found["runs"]] == ["r1", "r2"]
    assert found["runs"][1] == {
        "run_id": "r2",
        "name": "room",
        "created_by": "orthoflow 0.1.0",
        "status": "ok",
        "started": "2026-01-02T03:04:05Z",
        "ended": "2026-01-02T03:05:05Z",
        "seed": 9,
    }
    assert found["workflow"] == ["--- a", "+++ b", "@@ -1 +1 @@", "-x", "+y"]
    assert found["overrides"] == {
        "cell": "",
        "name": "",
        "left": ["a=1", "b=2"],
        "right": [],
        "same": False,
    }
    rows = ("inputs", "cells", "parameters", "environment", "metrics")
    assert [[row["same"] for row in found[name]] for name in rows] == [
        [False, False, True],
        [False, False],
        [False],
        [False],
        [False, False, False, True],
    ]
    assert [item["verdict"] for item in found["products"]] == [item.verdict for item in PRODUCTS]


# --- methods ---


@pytest.fixture
def laboratory(monkeypatch: pytest.MonkeyPatch) -> None:
    catalog = laboratory_catalog(monkeypatch)
    monkeypatch.setattr(plugins_commands, "discover_catalog", lambda: catalog)


def answer(*arguments: str, code: int = 0) -> str:
    result = CliRunner().invoke(program, ["plugins", *arguments])
    assert result.exit_code == code, result.output
    return result.output


@pytest.mark.usefixtures("laboratory")
def test_a_method_is_shown_with_ports_and_parameters() -> None:
    assert answer("show", "plane.ransac") == (
        "plane.ransac: plane.ransac of the tests\n"
        "\n"
        "distribution  laboratory 1.0\n"
        "state         fine\n"
        "class         laboratory.methods:Ransac\n"
        "determinism   seeded, result version 1\n"
        "\n"
        "port  name    product\n"
        "in    cloud   cloud\n"
        "out   planes  planes\n"
        "out   labels  labels\n"
        "\n"
        "parameter    type                default  unit  description\n"
        "tolerance_m  number > 0 or auto  0.05     m     Distance that counts as on the plane.\n"
        "iterations   integer >= 1        2000           Trials.\n"
    )
    told = json.loads(answer("show", "plane.ransac", "--json"))
    assert told == {
        "id": "plane.ransac",
        "summary": "plane.ransac of the tests",
        "description": "",
        "state": "fine",
        "distribution": "laboratory",
        "version": "1.0",
        "target": "laboratory.methods:Ransac",
        "result_version": 1,
        "determinism": "seeded",
        "citations": [],
        "params": [
            {
                "name": "tolerance_m",
                "type": "number > 0 or auto",
                "default": 0.05,
                "unit": "m",
                "description": "Distance that counts as on the plane.",
            },
            {
                "name": "iterations",
                "type": "integer >= 1",
                "default": 2000,
                "unit": "",
                "description": "Trials.",
            },
        ],
        "in": [{"port": "cloud", "product": "cloud", "required": True}],
        "out": [
            {"port": "planes", "product": "planes"},
            {"port": "labels", "product": "labels"},
        ],
        "metrics": [],
    }
    photos = answer("show", "read.photos")
    assert "in    calibration  files    optional\n" in photos
    assert photos.endswith("out   photos       photos\n\nno parameters\n")


@pytest.mark.usefixtures("laboratory")
def test_methods_kinds_and_products_are_listed() -> None:
    blocks = [block.splitlines() for block in answer("list").split("\n\n")]
    assert [block[0].split() for block in blocks] == [
        ["method", "state", "distribution", "summary"],
        ["kind", "takes", "gives", "distribution", "summary"],
        ["product", "distribution", "summary"],
    ]
    assert "plane.ransac    fine   laboratory 1.0  plane.ransac of the tests" in blocks[0]
    rows = {line.split()[0]: line for line in blocks[1]}
    assert "planes, labels" in rows["plane"]
    assert rows["read"].count("its methods' own") == 2
    told = json.loads(answer("list", "--json"))
    assert set(told) == {"methods", "kinds", "products", "broken"}
    assert told["broken"] == []
    assert next(item for item in told["methods"] if item["id"] == "plane.ransac") == {
        "id": "plane.ransac",
        "kind": "plane",
        "state": "fine",
        "problem": "",
        "distribution": "laboratory",
        "version": "1.0",
        "summary": "plane.ransac of the tests",
    }
    kinds = {item["name"]: item for item in told["kinds"]}
    assert kinds["plane"]["in"] == {"cloud": "cloud"}
    assert kinds["plane"]["out"] == {"planes": "planes", "labels": "labels"}
    assert (kinds["plane"]["is_source"], kinds["read"]["is_source"]) == (False, True)
    assert {item["state"] for item in [*told["kinds"], *told["products"]]} == {"fine"}


# --- options of exports ---


def test_whoever_splits_is_told_where_to_export_then() -> None:
    with pytest.raises(ArgumentError, match=r"as orthoflow export RUN/datasets/NAME --to csv$"):
        check_choices(Choices(split=True), "csv")


def test_only_an_empty_folder_is_written_to(tmp_path: Path) -> None:
    make_empty(tmp_path / "deep" / "er")
    make_empty(tmp_path / "deep" / "er")
    assert (tmp_path / "deep" / "er").is_dir()
    (tmp_path / "file").touch()
    for taken in (tmp_path, tmp_path / "file"):
        with pytest.raises(ArgumentError, match="exists already and is not empty: choose another"):
            _refuse_filled(taken)
    _refuse_filled(tmp_path / "deep" / "er")
    _refuse_filled(tmp_path / "not there")
    with pytest.raises(ArgumentError, match="cannot be made: Not a directory"):
        make_empty(tmp_path / "file" / "below")
