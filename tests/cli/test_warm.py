"""Kernels compiled beforehand: runs of the same user find them, and no store holds any."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from click.testing import CliRunner

from orthoflow.cli import plugins, warm
from orthoflow.cli.program import program
from orthoflow.engine.kernels import VARIABLE
from orthoflow.workflow.source import shipped_workflow
from tests.workshop_runs import WORKSHOP, orthoflow, write_studio


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "kernels"))
    monkeypatch.syspath_prepend(str(WORKSHOP))
    return tmp_path / "kernels"


def compiled(folder: Path) -> set[str]:
    return {path.name for path in folder.rglob("*.nb?")}


def test_what_was_compiled_beforehand_is_not_compiled_by_a_run(
    tmp_path: Path, kernels: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studio = write_studio(tmp_path, "paint.kernel")
    assert all(shipped_workflow(name).is_file() and sets for name, sets in warm.RECIPES.items())
    monkeypatch.setattr(warm, "RECIPES", {str(studio): ("survey.offset_m=2",)})
    called = CliRunner().invoke(program, ["warm", "--json"])
    assert called.exit_code == 0, called.output
    warmed = json.loads(called.stdout)
    assert warmed["methods"] == ["paint.kernel", "survey.offset"]
    assert (warmed["n_compiled"], warmed["n_before"], warmed["failed"]) == (2, 0, {})
    assert warmed["folder"] == str(kernels)
    before = compiled(kernels)
    environment = {VARIABLE: str(kernels)}
    done = orthoflow(tmp_path, "run", "studio.yaml", "-o", "run", environment=environment)
    assert done.returncode == 0, done.stderr
    assert compiled(kernels) == before
    assert compiled(tmp_path / ".orthoflow") == set()


def test_the_conformance_suite_shares_the_kernels_of_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(WORKSHOP))
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with plugins.sharing_kernels("paint.kernel"):
        folder = Path(os.environ[VARIABLE])
    assert folder.is_relative_to(tmp_path / "orthoflow" / "numba")
    assert VARIABLE not in os.environ
