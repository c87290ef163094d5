"""What is shown of a run that has less than others, or more."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from orthoflow_provenance.document import Metric

from orthoflow.cli import show as module
from tests.report_runs import cell, compared_run


def test_of_a_comparison_a_row_per_combination_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert module._print_comparison(compared_run(tmp_path))
    told = capsys.readouterr().out.splitlines()
    assert told[1].split()[:2] == ["combination", "plane.rms_mm"]
    rows = {line.split("  ")[0]: line for line in told[2:5]}
    assert list(rows) == ["plane=fine", "plane=coarse", "plane=broken"]
    assert "1.10 ± 0.10" in rows["plane=fine"]
    assert rows["plane=broken"].split()[1:] == ["-"] * (len(told[1].split()) - 1)
    assert told[5].startswith("means over repeats ± standard deviation")
    values = [("peak_mib", "MiB"), ("n_points", "1"), ("sigma_mm", "mm"), ("rms_mm", "mm")]
    metrics = [
        Metric(
            name=name,
            value=1.0,
            unit=unit,
            better="" if unit == "1" else "lower",
            headline=name == "rms_mm",
        )
        for name, unit in values
    ]
    plane: Any = SimpleNamespace(
        record=SimpleNamespace(cells=(cell("plane", metrics=tuple(metrics)),))
    )
    module._print_metrics(plane, most=3)
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split()[1] for row in rows] == [
        "rms_mm",
        "sigma_mm",
        "n_points",
        "1",
    ]  # "and 1 more"
    alone: Any = SimpleNamespace(record=SimpleNamespace(cells=(cell("plane"), cell("a@data=b"))))
    assert not module._print_comparison(alone)
