"""The command line as a user calls it, in a folder of its own; a stranger's plugin beside it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
STRANGER = ROOT / "tests" / "third_party" / "orthoflow-stranger"
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
        paths: import path before the installed packages.
        environment: variables on top of the process's own.
    """

    folder: Path
    paths: tuple[str, ...] = CHECKOUT
    environment: Mapping[str, str] = field(default_factory=dict)

    def variables(self) -> dict[str, str]:
        return {**os.environ, "PYTHONPATH": os.pathsep.join(self.paths), **self.environment}

    def command(self, *arguments: object) -> list[str]:
        return [sys.executable, "-m", "orthoflow", *map(str, arguments)]

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


@pytest.fixture
def shell(tmp_path: Path) -> Shell:
    """The command line with the built-in plugins."""
    return Shell(tmp_path)


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
def with_stranger(tmp_path: Path, stranger_paths: tuple[str, ...]) -> Shell:
    """The command line with the stranger's plugin installed."""
    return Shell(tmp_path, stranger_paths)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str], Path]:
    """Write a text file into the working directory."""

    def write_text(name: str, text: str) -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return write_text
