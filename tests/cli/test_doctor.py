"""`orthoflow doctor`: what is missing is named with what it costs."""

from __future__ import annotations

import dataclasses
import json
import platform
import re
import subprocess
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from orthoflow.cli import diagnosis, doctor, program
from orthoflow.cli.diagnosis import Library, diagnose_library, diagnose_machine
from orthoflow.engine import measuring
from orthoflow.version import __version__

GIB = 1 << 30
CLICK = Library(distribution="click", module="click", use="everything", is_core=True)


def module_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> str:
    (tmp_path / "fragile_library.py").write_text(code, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "fragile_library"


def library(module: str, *, distribution: str = "click", is_core: bool = False) -> Library:
    return Library(
        distribution=distribution, module=module, use="E57 files: read.scan", is_core=is_core
    )


def test_a_library_that_imports_is_ok() -> None:
    found = diagnose_library(CLICK)
    assert (found.verdict, found.cost) == ("ok", "")
    assert found.found[0].isdigit()


def test_a_missing_library_costs_what_it_is_used_for() -> None:
    found = diagnose_library(library("not_there_at_all", distribution="not-there-at-all"))
    assert found.verdict == "missing"
    assert found.found == "not installed"
    assert found.cost == "not to be had: E57 files: read.scan (pip install not-there-at-all)"


def test_a_missing_extra_is_a_restriction_only() -> None:
    extra = Library(
        distribution="no-such", module="no_such", use="signatures", extra="no-such[ssh]"
    )
    found = diagnose_library(extra)
    assert (found.verdict, found.found, found.use) == ("limited", "not installed", "signatures")
    assert found.cost == "not to be had: signatures (pip install 'no-such[ssh]')"


def test_every_library_that_an_installation_brings_is_looked_at_and_said_what_it_is_for() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))
    extras = project["project"]["optional-dependencies"]
    brought = {
        re.match(r"[\w.-]+", text).group()  # type: ignore[union-attr]
        for text in (*project["project"]["dependencies"], *extras["sign"], *extras["dask"])
    }
    looked_at = {library.distribution: library for library in diagnosis.LIBRARIES}
    # The wheel of open3d has another name on Linux; laspy[lazrs] brings lazrs.
    assert looked_at.keys() - {"lazrs"} == brought - {"open3d"}
    assert all(library.use for library in looked_at.values())
    assert {name for name, library in looked_at.items() if library.extra} == {
        *("cryptography", "distributed")
    }


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
    assert diagnosed.cost.startswith("not to be had: E57 files: read.scan (")
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


@pytest.mark.parametrize(
    ("n_bytes", "verdict", "found"),
    [
        (2 * GIB, "ok", "2.0 GiB available"),
        (2 * GIB - 1, "limited", "2.0 GiB available"),
        (GIB // 2, "limited", "0.5 GiB available"),
    ],
)
def test_little_memory_is_told(
    monkeypatch: pytest.MonkeyPatch, n_bytes: int, verdict: str, found: str
) -> None:
    here = measuring.AvailableMemory(available=n_bytes, total=n_bytes)
    monkeypatch.setattr(measuring, "available_memory", lambda: here)
    told = diagnosis._diagnose_memory()
    assert (told.verdict, told.found, bool(told.cost)) == (verdict, found, verdict != "ok")

    def fail() -> None:
        raise KeyError("MemTotal")

    monkeypatch.setattr(measuring, "available_memory", fail)
    unknown = diagnosis._diagnose_memory()
    assert (unknown.verdict, unknown.found, unknown.cost) == (
        "limited",
        "unknown",
        "cannot be measured",
    )


@pytest.mark.parametrize(
    ("n_bytes", "verdict", "found"),
    [
        (5 * GIB, "ok", "5.0 GiB free"),
        (5 * GIB - 1, "limited", "5.0 GiB free"),
        (GIB // 4, "limited", "0.2 GiB free"),
    ],
)
def test_little_room_on_the_disk_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_bytes: int, verdict: str, found: str
) -> None:
    asked = []

    def disk_usage(folder: Path) -> SimpleNamespace:
        asked.append(folder)
        return SimpleNamespace(free=n_bytes)

    monkeypatch.setattr(diagnosis.shutil, "disk_usage", disk_usage)
    disk, store = diagnosis._diagnose_store(tmp_path / "new" / "er")
    # Of what is not there yet the folder that it will lie in counts.
    assert asked == [tmp_path]
    assert (disk.name, disk.is_core) == ("disk of the store", False)
    assert (disk.verdict, disk.found, bool(disk.cost)) == (verdict, found, verdict != "ok")
    assert (store.verdict, store.cost, store.is_core) == ("ok", "", True)
    assert store.found == f"{tmp_path / 'new' / 'er'} is writable"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("system", "machine", "verdict"),
    [
        ("Linux", "x86_64", "ok"),
        ("Linux", "aarch64", "limited"),
        ("Darwin", "x86_64", "limited"),
    ],
)
def test_other_platforms_are_untested(
    monkeypatch: pytest.MonkeyPatch, system: str, machine: str, verdict: str
) -> None:
    monkeypatch.setattr(platform, "system", lambda: system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    told = diagnosis._diagnose_platform()
    assert told.verdict == verdict
    assert told.found.endswith(f", {system} {machine}")
    assert told.cost == ("" if verdict == "ok" else "only Linux on x86-64 is tested")


@pytest.mark.parametrize(
    ("problem", "way_out"),
    [
        ("libGL.so.1: cannot open", "libgl1"),
        ("libX11.so.6: cannot open", "libx11-6"),
        ("libusb-1.0.so.0: no", "libusb-1.0-0"),
        ("libgomp.so.1: no", "libgomp1"),
    ],
)
def test_a_missing_system_library_is_named_by_its_package(problem: str, way_out: str) -> None:
    assert diagnosis._way_out(problem) == (
        f"install the system package {way_out}, e.g. apt-get install {way_out}"
    )
    assert diagnosis._way_out("no module named x") == "reinstall it"


def test_a_library_that_crashes_or_says_nothing_is_told() -> None:
    crash = "os as _o; _o.kill(_o.getpid(), 11)"
    assert diagnosis._import_problem(crash) == "its import crashes (signal 11)"
    assert diagnosis._import_problem("os as _o; _o._exit(3)") == "its import fails: no message"
    assert diagnosis._import_problem("json") == ""
    assert diagnosis._import_problem("no_such_thing") == (
        "its import fails: ModuleNotFoundError: No module named 'no_such_thing'"
    )


def test_a_library_that_takes_too_long_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def waits(command: list[str], *, timeout: float, **_: object) -> None:
        raise subprocess.TimeoutExpired(command, timeout)

    monkeypatch.setattr(diagnosis.subprocess, "run", waits)
    assert re.fullmatch(
        r"its import takes longer than \d+(\.\d)? s", diagnosis._import_problem("x")
    )


def test_every_library_of_the_core_is_one() -> None:
    core = {library.distribution for library in diagnosis.LIBRARIES if library.is_core}
    assert core == {
        *("click", "h5py", "jinja2", "networkx", "numpy", "pluggy", "pydantic", "rich"),
        "ruamel.yaml",
    }


def test_plugins_are_counted_and_broken_ones_cost_their_methods(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken = SimpleNamespace(entry_point="odd", distribution="odd-methods", error="no such name")
    entry = SimpleNamespace(problem="", looked_at=lambda: entry)
    catalog = SimpleNamespace(
        methods={"a.b": entry, "a.c": entry},
        broken=(broken,),
        products={},
        kinds={},
    )
    monkeypatch.setattr("orthoflow.catalog.discovery.discover_catalog", lambda: catalog)
    fine, odd = doctor._diagnose_plugins()
    assert (fine.name, fine.verdict, fine.found, fine.cost) == ("plugins", "ok", "2 methods", "")
    assert (odd.name, odd.verdict, odd.is_core) == ("plugin odd", "missing", False)
    assert (odd.found, odd.cost) == (
        *("odd-methods fails to load", "its methods are missing: no such name"),
    )

    def fail() -> None:
        raise ImportError("no pluggy")

    monkeypatch.setattr("orthoflow.catalog.discovery.discover_catalog", fail)
    (none,) = doctor._diagnose_plugins()
    assert (none.name, none.verdict, none.found) == ("plugins", "missing", "no pluggy")
    assert none.cost == "no method can be found; install what is missing"


@pytest.mark.parametrize(
    ("costs", "broken_core", "last"),
    [
        ([], False, "everything works"),
        (["", "slow"], False, "orthoflow works, with 1 restriction"),
        (["no E57", "slow"], False, "orthoflow works, with 2 restrictions"),
        (["nothing"], True, "something that everything needs is missing"),
    ],
)
def test_the_last_line_says_whether_it_works(
    costs: list[str], broken_core: bool, last: str, capsys: pytest.CaptureFixture[str]
) -> None:
    findings = [
        dataclasses.replace(diagnose_library(CLICK), name=f"part{k}", cost=cost)
        for k, cost in enumerate(costs)
    ]
    doctor._print(findings, broken_core=broken_core)
    said = capsys.readouterr().out.splitlines()
    assert said[0] == f"orthoflow {__version__}"
    assert said[-1] == last
    told = [f"- part{k}: {cost}" for k, cost in enumerate(costs) if cost]
    assert [line for line in said if line.startswith("- ")] == told
    assert ("What that costs:" in said) == bool(told)
