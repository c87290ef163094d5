"""The command line as a user calls it, in a folder of its own; a stranger's plugin beside it."""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
STRANGER = ROOT / "tests" / "third_party" / "orthoflow-stranger"
# More of the same, or what needs the machine for itself: `.ci/run --long`.
IS_LONG = os.environ.get("ORTHOFLOW_LONG_TESTS") == "1"
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
        store: what `run` and `plan` use unless told otherwise; the tests of a session share it,
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

    def compiled_store(self, name: str) -> str:
        """A new store in the folder that has nothing but the session's compiled kernels."""
        shutil.copytree(self.store / "numba", self.folder / name / "numba")
        return name

    def __call__(self, *arguments: object, timeout_s: float = 300) -> Ended:
        completed = subprocess.run(
            self.command(*arguments),
            cwd=self.folder,
            env=self.variables(),
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            stdin=subprocess.DEVNULL,
        )
        return Ended(completed.returncode, completed.stdout, completed.stderr)


def metrics_of(folder: Path) -> dict[tuple[str, str], float]:
    """Metrics of a run's folder by cell and name."""
    with (folder / "products" / "metrics.csv").open() as table:
        return {(row["cell"], row["metric"]): float(row["value"]) for row in csv.DictReader(table)}


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store in which `direct.yaml` ran once, so that its kernels are compiled."""
    folder = tmp_path_factory.mktemp("store")
    shell = Shell(folder, folder / "store")
    coarse = ("--set", "room.scan_step_m=0.08", "--set", "wall.gsd_m=0.08")
    ended = shell("run", "direct.yaml", *coarse, "-o", "warm", timeout_s=900)
    assert ended.code == 0, ended.said
    return folder / "store"


@pytest.fixture
def shell(tmp_path: Path, store: Path) -> Shell:
    """The command line with the built-in plugins."""
    return Shell(tmp_path, store)


@pytest.fixture(scope="session")
def stranger_paths(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Import path with the stranger's plugin installed as a distribution of its own."""
    target = tmp_path_factory.mktemp("stranger")
    completed = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation"),
            *("--target", str(target), str(STRANGER)),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    if completed.returncode != 0:
        pytest.skip(f"the stranger's plugin cannot be installed here: {completed.stderr[-200:]}")
    return (*CHECKOUT, str(target))


@pytest.fixture
def with_stranger(tmp_path: Path, store: Path, stranger_paths: tuple[str, ...]) -> Shell:
    """The command line with the stranger's plugin installed."""
    return Shell(tmp_path, store, stranger_paths)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str], Path]:
    """Write a text file into the working directory."""

    def write_text(name: str, text: str) -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return write_text
