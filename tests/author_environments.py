"""New environments in which authors install their plugins, and plugins installed without pip."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from collections.abc import Mapping
from pathlib import Path

import pytest

from orthoflow.sdk.hooks import ENTRY_POINT_GROUP

ROOT = Path(__file__).resolve().parents[1]


def new_environment(folder: Path) -> Path:
    """The Python of an environment with this checkout and what the tests' own one has."""
    venv.create(folder, with_pip=True)
    (packages,) = (folder / "lib").glob("python*/site-packages")
    paths = [str(ROOT / part) for part in ("", "plugins", "provenance")]
    paths += [path for path in sys.path if path.endswith("-packages")]
    (packages / "shared.pth").write_text("\n".join(paths))
    return folder / "bin" / "python"


def succeed(folder: Path, *command: str | Path, variables: Mapping[str, str] = os.environ) -> str:
    """Run a command in a folder, without the tests' own import path; give what it prints."""
    known = {key: value for key, value in variables.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        command, cwd=folder, env=known, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{command}{done.stdout[-3000:]}{done.stderr[-2000:]}"
    return done.stdout


def install(folder: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lay metadata beside a plugin's package, as pip would, and put both on the path."""
    package = name.replace("-", "_")
    info = folder / f"{package}-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text(
        f"[{ENTRY_POINT_GROUP}]\n{name} = {package}.hooks\n", encoding="utf-8"
    )
    monkeypatch.syspath_prepend(folder)
