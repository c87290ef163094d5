"""`orthoflow doctor`: what is missing is named with what it costs."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from click.testing import CliRunner

from orthoflow.cli import program
from orthoflow.cli.doctor import LIBRARIES

GIB = 1 << 30


@pytest.fixture
def libraries(monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[str, str]]:
    """The libraries that are looked at: one that is here."""
    looked_at = {"click": ("click", "everything")}
    monkeypatch.setattr("orthoflow.cli.doctor.LIBRARIES", looked_at)
    return looked_at


@pytest.fixture(autouse=True)
def _here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A machine with nothing to find fault with."""
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=8 * GIB))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=99 * GIB))
    monkeypatch.chdir(tmp_path)


def findings(*options: str, code: int = 0) -> dict[str, dict[str, Any]]:
    result = CliRunner().invoke(program, ["doctor", "--json", *options])
    assert result.exit_code == code, result.output
    answer = json.loads(result.stdout)
    assert answer["ok"] is (code == 0)
    return {item["name"]: item for item in answer["findings"]}


@pytest.mark.usefixtures("libraries")
def test_where_all_is_there_everything_works() -> None:
    result = CliRunner().invoke(program, ["doctor", "--store", "new/er"])
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert lines[-1] == "everything works"
    assert [line.split()[0] for line in lines if "  ok  " in line] == [
        *("platform", "cores", "memory", "disk", "store", "click", "plugins"),
    ]
    assert not Path("new").exists()


def test_every_library_that_an_installation_brings_is_looked_at() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))
    extras = project["project"]["optional-dependencies"]
    brought = {
        re.match(r"[\w.-]+", text).group()  # type: ignore[union-attr]
        for text in (*project["project"]["dependencies"], *extras["sign"], *extras["dask"])
    }
    # The wheel of open3d has another name on Linux; laspy[lazrs] brings lazrs.
    assert LIBRARIES.keys() - {"lazrs"} == brought - {"open3d"}


LOST = "not available: E57 "


@pytest.mark.parametrize(
    ("name", "code", "described", "exit_code"),
    [
        ("absent", None, ("missing", "not installed", f"{LOST}(pip install absent)"), 0),
        # Of an extra that nobody asked for, and of what nothing works without.
        (
            "cryptography",
            None,
            ("limited", "not installed", f"{LOST}(pip install 'cryptography[ssh]')"),
            0,
        ),
        ("h5py", None, ("missing", "not installed", f"{LOST}(pip install h5py)"), 4),
        (
            "rasterio",
            "raise ImportError('libGL.so.1: lost')",
            (
                "missing",
                "1.0, but importing it fails: ImportError: libGL.so.1: lost",
                f"{LOST}(apt-get install libgl1)",
            ),
            0,
        ),
        (
            "rasterio",
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            ("missing", "1.0, but importing it crashes (signal 11)", f"{LOST}(reinstall it)"),
            0,
        ),
        ("rasterio", "", ("ok", "1.0", ""), 0),
    ],
)
def test_a_library_that_does_not_import_costs_what_it_is_used_for(
    libraries: dict[str, tuple[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    code: str | None,
    described: tuple[str, str, str],
    exit_code: int,
) -> None:
    libraries[name] = ("fragile_library", "E57")
    packages = Path("packages")
    info = packages / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    if code is not None:
        (packages / "fragile_library.py").write_text(code)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        monkeypatch.syspath_prepend(packages)
    else:
        from importlib import metadata

        def version(asked: str) -> str:
            raise metadata.PackageNotFoundError(asked)

        monkeypatch.setattr(metadata, "version", version)
    monkeypatch.setenv("PYTHONPATH", str(packages.absolute()))
    entry = findings(code=exit_code)[name]
    assert (entry["verdict"], entry["found"], entry["cost"]) == described
    assert entry["core"] is (exit_code == 4)


@pytest.mark.usefixtures("libraries")
def test_a_store_where_nothing_can_be_written_is_named() -> None:
    # /proc takes no files, not even from root.
    store = findings("--store", "/proc/none", code=4)["store"]
    assert store["found"].startswith("/proc cannot be written: ")
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
    result = CliRunner().invoke(program, ["doctor"])
    assert "- plugin odd: its methods are missing: NameError: no such name" in result.output
    assert result.output.splitlines()[-1] == "orthoflow works, with 1 restriction"
    monkeypatch.setenv("ORTHOFLOW_DISABLED_PLUGINS", "odd")
    assert findings()["plugin odd"]["found"] == "switched off"
    unknown = CliRunner().invoke(program, ["plugins", "show", "plane.odd"])
    assert unknown.exit_code == 2
    assert "ORTHOFLOW_DISABLED_PLUGINS switches off odd" in unknown.output

    def fail() -> None:
        raise ImportError("no pluggy")

    monkeypatch.setattr("orthoflow.catalog.discovery.discover_catalog", fail)
    assert findings()["plugins"]["found"] == "no pluggy"
