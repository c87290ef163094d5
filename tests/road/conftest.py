"""The command line as a user calls it, in a folder of its own; each command in a process."""

from __future__ import annotations

import csv
import fcntl
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.forked_commands import run_command

ROOT = Path(__file__).resolve().parents[2]
# A room of which each step takes milliseconds. What ran on it once is in the session's store.
COARSE = ("--set", "room.scan_step_m=0.08", "--set", "wall.gsd_m=0.08")
CHECKOUT = tuple(str(ROOT / part) for part in ("", "plugins", "provenance"))


@dataclass(frozen=True)
class Ended:
    """A finished command."""

    code: int
    out: str
    err: str

    @property
    def said(self) -> str:
        return self.out + self.err


@dataclass(frozen=True)
class Shell:
    """Runs `orthoflow` in a folder.

    Attributes:
        folder: working directory of every command.
        store: used by `run` and `plan` by default; the tests of a session share it,
            because compiling kernels anew takes longer than what they test.
        paths: import path before the installed packages.
    """

    folder: Path
    store: Path
    paths: tuple[str, ...] = CHECKOUT

    def variables(self) -> dict[str, str]:
        return {**os.environ, "PYTHONPATH": os.pathsep.join(self.paths)}

    def command(self, *arguments: object) -> list[str]:
        words = [*map(str, arguments)]
        if words[0] in ("run", "plan") and "--store" not in words:
            words += ["--store", str(self.store)]
        return [sys.executable, "-m", "orthoflow", *words]

    def __call__(self, *arguments: object, code: int | None = 0, timeout_s: float = 300) -> Ended:
        """Run a command, which must end with an exit code unless None is given."""
        words = self.command(*arguments)[3:]
        done = run_command(self.folder, words, self.variables(), timeout_s)
        ended = Ended(done.returncode, done.stdout, done.stderr)
        assert code in (None, ended.code), ended.said
        return ended


def metrics_of(folder: Path) -> dict[tuple[str, str], float]:
    """Metrics of a run's folder by cell and name."""
    with (folder / "products" / "metrics.csv").open() as table:
        return {(row["cell"], row["metric"]): float(row["value"]) for row in csv.DictReader(table)}


def without_variants(text: str, variants: Iterable[str]) -> str:
    """Take variants out of a workflow's text, each of which has a line of its own."""
    starts = tuple(f"      {variant}:" for variant in variants)
    lines = text.splitlines()
    kept = [line for line in lines if not line.startswith(starts)]
    assert len(lines) - len(kept) == len(starts), "a variant was renamed, or has several lines"
    return "\n".join(kept)


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store for all processes of a test run, so that each result is computed by one of them.

    `direct.yaml` ran in it once, which compiles the kernels.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    shell = Shell(folder / "road-store", folder / "road-store" / "store")
    shell.folder.mkdir(exist_ok=True)
    with (shell.folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (shell.folder / "warm").exists():
            how = (*COARSE, "--executor", "inline")
            shell("run", "direct.yaml", *how, "-o", "warm", timeout_s=900)
    return shell.store


@pytest.fixture
def shell(tmp_path: Path, store: Path) -> Shell:
    """The command line with the built-in plugins."""
    return Shell(tmp_path, store)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str], Path]:
    """Write a text file into the working directory."""

    def write_text(name: str, text: str) -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return write_text
