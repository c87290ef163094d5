"""What commands print, to the last letter: tables, numbers, comparisons, methods, refusals."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import pytest
from click.testing import CliRunner
from orthoflow_provenance.document import RecordedFile, RunRecord
from pydantic import Field

from orthoflow.cli import plugins as plugins_commands
from orthoflow.cli.compare import _print, comparison_json
from orthoflow.cli.export import _refuse_filled
from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.formats import FORMATS, check_choices
from orthoflow.cli.exports.products import make_empty
from orthoflow.cli.program import program
from orthoflow.errors import ArgumentError
from orthoflow.products import PointCloud
from orthoflow.records.comparison import CellFacts, Distance, Pair, ParameterValue, RunComparison
from orthoflow.sdk import MethodParams, Ports
from orthoflow.sdk.units import unit_of
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
PRODUCT_LINES = [
    "product  type    verdict           largest differences",
    "a.one    planes  identical",
    "a.two    planes  different         0.25 m (x), not comparable (n)",
    "a.three  planes  within tolerance  3 grey levels (rgb), 0.5 (k)",
    "a.four   planes  different",
    "a.two different: other names",
    "4 products: 1 identical, 1 within tolerance, 2 different",
]
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


HEADS = [
    "A: room, run r1, orthoflow 0.1.0, 2026-01-02T03:04:05Z, seed 1, 1 step",
    "B: room, run r2, orthoflow 0.1.0, 2026-01-02T03:04:05Z, seed 9, 0 steps",
]


def test_equal_runs_are_said_to_be_equal(capsys: pytest.CaptureFixture[str]) -> None:
    _print(same_runs())
    titles = ["inputs", "workflow", "options", "steps", "parameters (* set, others are defaults)"]
    lines = [f"{title}: same" for title in [*titles, "environment"]]
    lines[:2] = ["inputs: neither has any", "workflow: same text"]
    lines += ["metrics: none", "times and memory: none", "products"]
    spaced = [text for line in lines for text in ("", line)]
    assert printed(capsys) == [*HEADS, *spaced, "0 products"]


def test_all_that_differs_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    _print(different_runs())
    first = "a.jpg 0123456789ab"
    three = f"{first}, b.jpg 1123456789ab, c.jpg 2123456789ab"
    failed = "failed, code of toys abcdef01, code of more 11111111, colmap 4.2, seed 0, no plane"
    assert printed(capsys) == [
        *HEADS,
        "",
        "inputs: 2 of 3 differ",
        f"        {'A'.ljust(len(three))}  B",
        f"scan    {three}  {three} and 1 more",
        f"photos  {first.ljust(len(three))}  not given",
        "",
        "workflow, A (-) against B (+)",
        *("@@ -1 +1 @@", "-x", "+y"),
        "",
        "options: 1 of 1 differ",
        "  A        B",
        "  a=1 b=2",
        "",
        "steps: 1 of 1 differ, 1 only in B",
        "   A   B",
        f"a  ok  {failed}",
        "b  -   ok, plane.a result version 1",
        "",
        "parameters (* set, others are defaults): 1 of 1 differ, of the step that both have",
        "          A          B",
        'a.cell_m  0.123457*  "ä"',
        "",
        "environment: 1 only in A",
        "        A     B",
        "python  3.11  -",
        "",
        "metrics: 1 of 2 differ, 1 only in B, of the step that both have",
        "metric    A    B     B - A  unit",
        "a.rms_mm  1.5  1.25  -0.25  mm",
        "a.max_mm  -    2            mm",
        "",
        "times and memory: 1 of 1 differ",
        "metric    A  B  B - A  unit",
        "a.wall_s  1  2  1      mm",
        "",
        "products",
        *PRODUCT_LINES,
    ]


def test_of_a_long_comparison_what_says_how_good_results_are_is_printed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    few = different_runs()
    numbers = [
        Pair(
            cell="a",
            name=name,
            left=dataclasses.replace(metric(1.0), headline=is_headline),
            right=dataclasses.replace(metric(2.0), headline=is_headline),
        )
        for name, is_headline in {
            **{f"odd_{index}": False for index in range(30)},
            "rmse_u_mm": True,
            "rms_mm": True,
        }.items()
    ]
    _print(dataclasses.replace(few, metrics=tuple(numbers)), most=20)
    lines = printed(capsys)
    start = lines.index("metrics: 32 of 32 differ, of the step that both have")
    assert [line.split()[0] for line in lines[start + 2 : start + 5]] == [
        *("a.rmse_u_mm", "a.rms_mm", "a.odd_0"),
    ]
    assert lines[start + 22] == "and 12 more, which --all prints"


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


class Params(MethodParams):
    """One of each."""

    cell_m: float = Field(0.02, gt=0, le=1, description="Edge of a cell.")
    limit_deg: float | None = Field(None, description="Limit.")
    n_most: int = Field(3, ge=1, lt=10, description="Number.")
    how: Literal["fast", "good"] = Field("fast", description="How.")
    only: Literal["one"] = Field("one", description="One.")
    pair: tuple[float, float] = Field((0.0, 1.0), description="Two.")
    names: list[str] = Field(default=[], description="Names.")
    kept_share: float = Field(0.5, description="Share.")
    memory_mib: int = Field(1, description="Memory.")
    plain: bool = Field(default=True)


class In(Ports):
    cloud: PointCloud
    more: PointCloud | None = None


@pytest.fixture
def laboratory(monkeypatch: pytest.MonkeyPatch) -> None:
    catalog = laboratory_catalog(monkeypatch)
    monkeypatch.setattr(plugins_commands, "discover_catalog", lambda: catalog)


def answer(*arguments: str, code: int = 0) -> str:
    result = CliRunner().invoke(program, ["plugins", *arguments])
    assert result.exit_code == code, result.output
    return result.output


@pytest.mark.usefixtures("laboratory")
def test_parameters_are_shown_with_type_limits_and_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    method = plugins_commands.discover_catalog().method("plane.ransac").load()
    monkeypatch.setattr(method, "Params", Params)
    monkeypatch.setattr(method, "In", In)
    shown = json.loads(answer("show", "plane.ransac", "--json"))
    assert [tuple(one.values()) for one in shown["params"]] == [
        ("cell_m", "number > 0 <= 1", 0.02, "m", "Edge of a cell."),
        ("limit_deg", "number | null", None, "deg", "Limit."),
        ("n_most", "integer >= 1 < 10", 3, "", "Number."),
        ("how", "fast | good", "fast", "", "How."),
        ("only", "one", "one", "", "One."),
        ("pair", "array", [0.0, 1.0], "", "Two."),
        ("names", "array of string", [], "", "Names."),
        ("kept_share", "number", 0.5, "1", "Share."),
        ("memory_mib", "integer", 1, "MiB", "Memory."),
        ("plain", "boolean", True, "", ""),
    ]
    assert [tuple(one.values()) for one in shown["in"]] == [
        ("cloud", "cloud", True),
        ("more", "cloud", False),
    ]
    units = {"a_mm": "mm", "a_px": "px", "a_rad": "rad", "a_s": "s", "a_grey": "grey levels"}
    units |= {"a_cells": "cells", "m": "", "a_b": ""}
    assert {name: unit_of(name) for name in units} == units


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
        "parameter    type               default  unit  description\n"
        "tolerance_m  number > 0 | auto  0.05     m     Distance that counts as on the plane.\n"
        "iterations   integer >= 1       2000           Trials.\n"
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
                "type": "number > 0 | auto",
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


TARGETS = (*FORMATS, None)


@pytest.mark.parametrize(
    ("option", "belongs_to", "says"),
    [
        (
            {"cell": "a"},
            {*FORMATS} - {"csv", "prov", "ro-crate", "stac", "tables"},
            "--step belongs to --to colmap",
        ),
        ({"license_text": ""}, {"ro-crate"}, "--license belongs to --to ro-crate"),
        ({"author": "A"}, {"ro-crate"}, "--author belongs to --to ro-crate"),
        ({"embed": True}, {"ro-crate", None}, "writes no record"),
        ({"inputs": ("a=b",), "embed": True}, {"ro-crate", None}, "writes no record"),
        ({"inputs": ("a=b",)}, set(), "--input belongs to --embed"),
    ],
    ids=["cell", "license", "author", "embed", "embedded inputs", "inputs"],
)
def test_options_belong_to_formats(
    option: dict[str, Any], belongs_to: set[str | None], says: str
) -> None:
    for target in TARGETS:
        chosen = Choices(**option)
        if target in belongs_to:
            check_choices(chosen, target)
            continue
        with pytest.raises(ArgumentError) as caught:
            check_choices(chosen, target)
        is_nothing_said = target is None and not chosen.embed
        assert ("choose what to write" if is_nothing_said else says) in str(caught.value)
    for target in TARGETS[:-1]:
        check_choices(Choices(), target)


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


def test_every_format_has_a_writer_and_stands_in_the_help() -> None:
    said = CliRunner().invoke(program, ["export", "--help"]).output
    for name, entry in FORMATS.items():
        assert callable(entry.load())
        assert f"  {name}: {entry.summary[:20]}" in said
        assert entry.options <= {field.name for field in dataclasses.fields(Choices)}
