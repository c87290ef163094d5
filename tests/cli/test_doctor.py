"""`orthoflow doctor`: what is missing is named with what it costs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from orthoflow.cli.doctor import required_libraries
from tests.studios import asked

GIB = 1 << 30


@pytest.fixture
def libraries(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The libraries that are looked at: one that is here."""
    looked_at = ["click"]
    monkeypatch.setattr("orthoflow.cli.doctor.required_libraries", lambda: looked_at)
    return looked_at


@pytest.fixture(autouse=True)
def _here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A machine with nothing to find fault with."""
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=8 * GIB))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=99 * GIB))
    monkeypatch.chdir(tmp_path)


def findings(*options: str, code: int = 0) -> dict[str, dict[str, Any]]:
    answer = json.loads(asked("doctor", "--json", *options, code=code).stdout)
    assert answer["ok"] is (code == 0)
    return {item["name"]: item for item in answer["findings"]}


@pytest.mark.usefixtures("libraries")
def test_where_all_is_there_nothing_is_restricted() -> None:
    lines = asked("doctor", "--store", "new/er", code=0).stdout.splitlines()
    assert lines[-1] == "orthoflow works with 0 restrictions"
    assert [line.split()[0] for line in lines if "  ok  " in line] == [
        *("platform", "cores", "memory", "disk", "store", "click", "plugins"),
    ]
    assert not Path("new").exists()


LOST = "methods that need it do not work "


@pytest.mark.parametrize(
    ("name", "code", "described", "exit_code"),
    [
        ("no-such-library", None, ("missing", "not installed", "(pip install no-such-library)"), 0),
        (
            "fragile",
            "raise ImportError('libGL.so.1: lost')",
            (
                "missing",
                "1.0, but importing it fails: ImportError: libGL.so.1: lost",
                "(apt-get install libgl1)",
            ),
            0,
        ),
        (
            "h5py",  # nothing works without it
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            ("missing", "1.0, but importing it crashes (signal 11)", "(reinstall it)"),
            4,
        ),
        ("fragile", "", ("ok", "1.0", ""), 0),
    ],
)
def test_a_library_that_does_not_import_is_named_with_the_way_out(
    libraries: list[str],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    code: str | None,
    described: tuple[str, str, str],
    exit_code: int,
) -> None:
    libraries.append(name)
    if code is not None:
        info = Path("packages", f"{name}-1.0.dist-info")
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info.parent / f"{name}.py").write_text(code)
        monkeypatch.syspath_prepend(info.parent)
        monkeypatch.setenv("PYTHONPATH", str(info.parent.absolute()))
    entry = findings(code=exit_code)[name]
    verdict, found, remedy = described
    assert (entry["verdict"], entry["found"]) == (verdict, found)
    assert entry["cost"] == (f"{LOST}{remedy}" if remedy else "")
    assert entry["core"] is (exit_code == 4)


def test_what_an_installation_brings_is_looked_at() -> None:
    assert {"numpy", "open3d-cpu", "pye57", "ruamel-yaml"} <= {*required_libraries()}


@pytest.mark.usefixtures("libraries")
def test_a_store_where_nothing_can_be_written_is_named() -> None:
    # /proc takes no files, not even from root.
    store = findings("--store", "/proc/none", code=4)["store"]
    assert store["found"].startswith("cannot write to /proc: ")
    assert store["cost"] == "no run can start here (choose another folder with --store DIR)"


@pytest.mark.usefixtures("libraries")
def test_broken_and_disabled_plugins_cost_their_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    packages = Path("packages")
    info = packages / "odd-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: odd\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[orthoflow.plugins]\nodd = odd_hooks\n")
    monkeypatch.syspath_prepend(packages)
    (packages / "odd_hooks.py").write_text("raise NameError('no such name')")
    assert findings()["plugin odd"]["found"] == "odd 1.0 cannot be loaded"
    result = asked("doctor")
    assert "- plugin odd: its methods are missing: NameError: no such name" in result.output
    assert result.output.splitlines()[-1] == "orthoflow works with 1 restriction"
    monkeypatch.setenv("ORTHOFLOW_DISABLED_PLUGINS", "odd")
    assert findings()["plugin odd"]["found"] == "disabled"
    unknown = asked("plugins", "show", "plane.odd", code=2)
    assert "ORTHOFLOW_DISABLED_PLUGINS disables odd" in unknown.output
    monkeypatch.delenv("ORTHOFLOW_DISABLED_PLUGINS")
    announced = (
        "hookimpl(lambda: [MethodSpec(id='plane.odd', target='odd_hooks:Odd', summary='-')])"
    )
    lines = ("from orthoflow.sdk import MethodSpec, hookimpl", f"orthoflow_methods = {announced}")
    (packages / "odd_hooks.py").write_text("\n".join(lines))
    assert "has no attribute 'Odd'" in findings()["plugins"]["cost"]

    def fail() -> None:
        raise ImportError("no pluggy")

    monkeypatch.setattr("orthoflow.catalog.discovery.discover_catalog", fail)
    assert findings()["plugins"]["found"] == "no pluggy"
