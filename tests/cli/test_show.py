"""What is shown of a run that has less than others, or more."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from orthoflow_provenance.record import write_record

from tests.report_runs import cell, compared_run, metrics, record
from tests.studios import said


def show(folder: Path, *cells: object, **more: object) -> list[str]:
    """The lines about a run of cells without arrays."""
    made = record(cells, **more)  # type: ignore[arg-type]
    write_record(folder / "run.h5", made, lambda _digest: None)
    return said("show", folder / "run.h5").splitlines()


def test_of_a_comparison_a_row_per_combination_is_shown(tmp_path: Path) -> None:
    compared = compared_run(tmp_path).record
    cells = [replace(one, outputs={}) for one in compared.cells]
    printed = show(tmp_path, *cells, workflow_resolved=compared.workflow_resolved)
    begin = next(k for k, line in enumerate(printed) if line.startswith("combination"))
    assert printed[begin].split()[1] == "plane.rms_mm"
    rows = {line.split("  ")[0]: line for line in printed[begin + 1 : begin + 4]}
    assert list(rows) == ["plane=fine", "plane=coarse", "plane=broken"]
    assert "1.10 ± 0.10" in rows["plane=fine"]
    assert {*rows["plane=broken"].split()[1:]} == {"-"}
    assert printed[begin + 4].startswith("means over repeats ± standard deviation")


def test_quality_comes_before_counts_and_costs(tmp_path: Path) -> None:
    many = {f"rms_{k}_px": 1.0 for k in range(19)}
    plane = cell("plane", metrics=metrics(peak_mib=7.0, n_points=5.0, **many, rms_mm=1.0))
    printed = show(tmp_path, plane, cell("a@data=b"))
    begin = next(k for k, line in enumerate(printed) if line.startswith("step   metric"))
    assert printed[begin + 1].split()[1] == "rms_mm"
    assert not [line for line in printed if "peak_mib" in line]
    assert "and 2 more, shown by --all" in printed


def test_over_datasets_medians_are_shown(tmp_path: Path) -> None:
    cells = [
        cell(f"plane@data=r{k},plane={name}", metrics=metrics(rms_mm=k + better))
        for k in range(3)
        for name, better in (("a", 1.0), ("b", 0.5))
    ]
    printed = show(
        tmp_path, *cells, workflow_resolved='{"datasets": {"r0": {}, "r1": {}, "r2": {}}}'
    )
    rows = [line.split() for line in printed if line.startswith("plane.rms_mm")]
    assert [row[1:5] for row in rows] == [
        ["mm", "lower", "plane=a", "2"],
        ["mm", "lower", "plane=b", "1.5"],
    ]
    assert [row[-1] for row in rows] == ["3", "3"]
