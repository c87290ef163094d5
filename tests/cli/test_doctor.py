"""`orthoflow doctor`: what is missing is named with what it costs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from orthoflow.cli import diagnosis, program
from orthoflow.cli.diagnosis import Library, diagnose_library, diagnose_machine

CLICK = Library(distribution="click", module="click", loss="nothing works", is_core=True)


def module_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> str:
    (tmp_path / "fragile_library.py").write_text(code, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "fragile_library"


def library(module: str, *, distribution: str = "click", is_core: bool = False) -> Library:
    return Library(
        distribution=distribution, module=module, loss="no E57 files: read.scan", is_core=is_core
    )


def test_a_library_that_imports_is_ok() -> None:
    found = diagnose_library(CLICK)
    assert (found.verdict, found.cost) == ("ok", "")
    assert found.found[0].isdigit()


def test_a_missing_library_costs_what_it_is_used_for() -> None:
    found = diagnose_library(library("not_there_at_all", distribution="not-there-at-all"))
    assert found.verdict == "missing"
    assert found.found == "not installed"
    assert found.cost == "no E57 files: read.scan (pip install not-there-at-all)"


@pytest.mark.parametrize(
    ("code", "found", "way_out"),
    [
        (
            "raise ImportError('libGL.so.1: cannot open shared object file')",
            "its import fails: ImportError: libGL.so.1: cannot open shared object file",
            "apt-get install libgl1",
        ),
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            "its import crashes (signal 11)",
            "reinstall it",
        ),
    ],
    ids=["system library missing", "crash"],
)
def test_an_installed_library_that_does_not_import_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, found: str, way_out: str
) -> None:
    diagnosed = diagnose_library(library(module_that(tmp_path, monkeypatch, code)))
    assert diagnosed.verdict == "missing"
    assert diagnosed.found.endswith(f", but {found}")
    assert diagnosed.cost.startswith("no E57 files: read.scan (")
    assert way_out in diagnosed.cost


def test_doctor_is_content_when_all_libraries_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnosis, "LIBRARIES", (CLICK,))
    result = CliRunner().invoke(program, ["doctor", "--store", str(tmp_path / "new")])
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.stdout.splitlines() if "  ok  " in line][:2] == [
        "platform",
        "cores",
    ]


@pytest.mark.parametrize(("is_core", "code"), [(True, 4), (False, 0)], ids=["core", "method"])
def test_only_a_missing_core_library_ends_with_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_core: bool, code: int
) -> None:
    missing = library("not_there_at_all", distribution="not-there-at-all", is_core=is_core)
    monkeypatch.setattr(diagnosis, "LIBRARIES", (CLICK, missing))
    result = CliRunner().invoke(program, ["doctor", "--store", str(tmp_path), "--json"])
    assert result.exit_code == code
    answer = json.loads(result.stdout)
    assert answer["ok"] is (code == 0)
    entry = next(item for item in answer["findings"] if item["name"] == "not-there-at-all")
    assert entry["verdict"] == "missing"
    assert entry["core"] is is_core


def test_a_store_where_nothing_can_be_written_is_named() -> None:
    # /proc takes no files, not even from root.
    findings = {item.name: item for item in diagnose_machine(Path("/proc/none"))}
    store = findings["store and numba cache"]
    assert (store.verdict, store.is_core) == ("missing", True)
    assert store.found.startswith("/proc cannot be written: ")
    assert store.cost == "no run can start here (choose another folder with --store DIR)"
