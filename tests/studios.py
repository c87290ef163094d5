"""The command line on the workshop's methods, in this process, with a store per folder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from orthoflow.cli.program import program
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run
from tests.workshop_runs import WORKSHOP, write_studio


def asked(*arguments: object, code: int | None = None) -> Result:
    """Give a command and wait for its end, with this exit code if one is given."""
    result = CliRunner().invoke(program, [str(argument) for argument in arguments])
    assert code in (None, result.exit_code), result.output
    return result


def said(*arguments: object, code: int = 0) -> str:
    """Give a command that ends with a code, and take what it prints."""
    return asked(*arguments, code=code).output


@dataclass(frozen=True)
class Studio:
    """A folder with a workflow of two steps; commands run in it."""

    folder: Path

    def __call__(self, *arguments: object, code: int | None = None) -> Result:
        more = ("--executor", "inline") if arguments[0] in ("run", "replay") else ()
        return asked(*arguments, *more, code=code)

    def run(self, name: str, *arguments: object) -> Run:
        """Run the workflow into a folder of that name."""
        self("run", "studio.yaml", "-o", name, *arguments, code=0)
        return open_run(self.folder / name)

    # Any: JSON.
    def json(self, *arguments: object, code: int = 0) -> Any:
        """Run a command with `--json` and read what it prints."""
        return json.loads(self(*arguments, "--json", code=code).stdout)


def open_studio(folder: Path, patch: pytest.MonkeyPatch) -> Studio:
    """Write the workflow into a folder, make it the working directory, install the workshop."""
    write_studio(folder)
    patch.chdir(folder)
    patch.syspath_prepend(str(WORKSHOP))
    # The page takes half of such a small run, and has tests of its own.
    patch.setattr("orthoflow.report.write_report", _write_empty_report)
    return Studio(folder)


def open_finished_studio(folder: Path, patch: pytest.MonkeyPatch, *settings: str) -> Studio:
    """Open a studio and make a run `first` there, whose plane a file says."""
    studio = open_studio(folder, patch)
    (folder / "n.txt").write_text("1.5")
    studio.run("first", "--input", "number=n.txt", *settings)
    return studio


def open_copy(finished: Studio, folder: Path, patch: pytest.MonkeyPatch) -> Studio:
    """Open another studio with the run `first`, its input and its store."""
    opened = open_studio(folder, patch)
    for name in ("first", ".orthoflow"):
        # Without the memory of where the files of the other studio lie.
        ignored = shutil.ignore_patterns("digests.json")
        shutil.copytree(finished.folder / name, folder / name, ignore=ignored)
    shutil.copyfile(finished.folder / "n.txt", folder / "n.txt")
    return opened


def _write_empty_report(_runs: Sequence[Run], path: Path) -> None:
    path.write_text("<!doctype html>", encoding="utf-8")
