"""What commands print, to the last letter: tables, numbers, comparisons, methods, refusals."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from orthoflow_provenance.document import RunRecord

from orthoflow.cli import plugins as plugins_commands
from orthoflow.cli.compare import _print
from orthoflow.cli.export import _refuse_filled
from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.formats import check_choices
from orthoflow.cli.exports.products import make_empty
from orthoflow.cli.program import program
from orthoflow.errors import ArgumentError
from orthoflow.records.compare import CellFacts, Pair, ParameterValue, RunComparison
from tests.laboratories import laboratory_catalog
from tests.report_runs import cell, metric, record


def printed(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().out.splitlines()


# --- comparisons ---


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
