"""What is printed of a run, a store and a plan, and of a run that has less than others."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from orthoflow_provenance.document import RecordedCell
from orthoflow_provenance.record import open_record, write_record
from syrupy.assertion import SnapshotAssertion

from orthoflow.cli.tables import echo_diagnostics
from tests.provenance_records import write_sample
from tests.report_runs import cell, compared_run, metrics, record, warned
from tests.studios import said


def test_a_whole_record_is_verified_and_a_changed_one_named(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    with open_record(path) as opened:
        seal = opened.content_sha256
    verified = said("verify", path)
    assert verified.startswith(f"seal: sha256:{seal}\nverified: seal ok, 1 product (1 more by ")
    assert json.loads(said("verify", path, "--json")) == {
        "record": str(path),
        "ok": True,
        "products": 1,
        "inputs": 0,
        "published": 0,
        "pages": 0,
        "others": 0,
        "not_checked": [],
        "findings": [],
        "notes": [],
        "seal": seal,
        "signed_with": "",
    }
    path.write_bytes(path.read_bytes()[:-1])
    assert "has been changed since it was written (see above)\n" in said("verify", path, code=3)
    verified = json.loads(said("verify", path, "--json", code=3))
    assert (verified["ok"], len(verified["findings"])) == (False, 1)


def test_who_shows_a_record_that_was_changed_says_so(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    page = tmp_path / "page.html"
    said("report", path, "-o", page)
    warning = "The record of this run has been changed since it was written"
    assert warning not in page.read_text()
    with h5py.File(path, "r+") as file:
        file.attrs["seed"] = type(file.attrs["seed"])(b"8")
    doubt = f"{path} has been changed since it was written: its seal does not match /; "
    assert doubt in said("show", path, code=3)
    assert doubt in said("report", path, "-o", page, code=3)
    assert warning in page.read_text()
    assert doubt in said("compare", path, path, code=3)
    (row,) = json.loads(said("runs", tmp_path, "--json"))
    assert (row["status"], row["metrics"]) == ("damaged", {})
    assert row["reason"] == doubt.removesuffix("; ")


def shown(folder: Path, cells: Sequence[RecordedCell], workflow_resolved: str = "{}") -> str:
    """What is printed of a run of cells without arrays."""
    made = record(cells, workflow_resolved=workflow_resolved)
    write_record(folder / "run.h5", made, lambda _digest: None)
    return said("show", folder / "run.h5").replace(str(folder), "FOLDER")


def test_of_a_comparison_a_row_per_combination_is_shown(
    tmp_path: Path, snapshot: SnapshotAssertion
) -> None:
    compared = compared_run(tmp_path).record
    cells = [replace(one, outputs={}) for one in compared.cells]
    assert shown(tmp_path, cells, compared.workflow_resolved) == snapshot


def test_quality_comes_before_counts_and_costs(tmp_path: Path, snapshot: SnapshotAssertion) -> None:
    many = {f"rms_{k}_px": 1.0 for k in range(19)}
    plane = cell("plane", metrics=metrics(peak_mib=7.0, n_points=5.0, **many, rms_mm=1.0))
    assert shown(tmp_path, [plane, cell("a@data=b")]) == snapshot


def test_over_datasets_medians_are_shown(tmp_path: Path, snapshot: SnapshotAssertion) -> None:
    cells = [
        cell(f"plane@data=r{k},plane={name}", metrics=metrics(rms_mm=k + better))
        for k in range(3)
        for name, better in (("a", 1.0), ("b", 0.5))
    ]
    assert shown(tmp_path, cells, '{"datasets": {"r0": {}, "r1": {}, "r2": {}}}') == snapshot


def test_five_warnings_are_shown_and_the_others_counted(capsys: pytest.CaptureFixture[str]) -> None:
    echo_diagnostics([cell("wall", **warned(*map(str, range(7))))], Path("run"))
    *shown, last = capsys.readouterr().out.splitlines()
    assert len(shown) == 5
    assert last == "and 2 more warnings: orthoflow show run --all"
