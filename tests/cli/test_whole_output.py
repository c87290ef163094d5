"""What commands print, to the last letter: tables, numbers, comparisons, methods, refusals."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from orthoflow_provenance.document import RunRecord

from orthoflow.cli.compare import _print
from orthoflow.cli.export import _refuse_filled, flags
from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.formats import check_choices
from orthoflow.cli.exports.products import make_empty
from orthoflow.errors import ArgumentError
from orthoflow.records.compare import CellFacts, Pair, ParameterValue, RunComparison
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
    assert lines[start + 1 : start + 4] == [
        "metric                 A    B     B - A  unit",
        "plane.rms_mm, 3 steps  1.5  1.25  -0.25  mm",
        "",
    ]
    _print(comparison)
    assert sum("tiny_mm" in line for line in printed(capsys)) == 3


# --- options of exports ---


def test_whoever_splits_is_told_where_to_export_then() -> None:
    with pytest.raises(ArgumentError, match=r"as orthoflow export RUN/datasets/NAME --to csv$"):
        check_choices(Choices(split=True), "csv", flags())


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
