"""Running the command line on the workshop's methods, in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from tests.forked_commands import run_command

ROOT = Path(__file__).resolve().parents[1]
WORKSHOP = ROOT / "tests" / "workshop"

STUDIO = """\
orthoflow: 1
name: studio
seed: 7
inputs:
  number: {optional: true}
steps:
  survey: {use: survey.offset, in: {files: inputs.number}}
  paint: {use: METHOD, in: {planes: survey.planes}}
"""


def workshop_environment(*more: Path) -> Mapping[str, str]:
    """The environment with the workshop installed, and the distributions in more folders.

    The checkout comes before what is installed, as in tests/road, whose process serves both.
    """
    checkout = (ROOT / part for part in ("", "plugins", "provenance"))
    folders = [WORKSHOP, *more, *checkout, os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders)).rstrip(os.pathsep)}


def write_studio(folder: Path, method: str = "paint.plain") -> Path:
    """Write a workflow of two steps whose second uses the method."""
    path = folder / "studio.yaml"
    path.write_text(STUDIO.replace("METHOD", method), encoding="utf-8")
    return path


def command(*arguments: str) -> list[str]:
    """The command line of `orthoflow`."""
    return [sys.executable, "-m", "orthoflow", *arguments]


def orthoflow(
    folder: Path,
    *arguments: str,
    plugins: Sequence[Path] = (),
    environment: Mapping[str, str] = MappingProxyType({}),
    code: int | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder and wait for its end; `plugins` are installed besides."""
    done = run_command(folder, arguments, {**workshop_environment(*plugins), **environment})
    assert code in (None, done.returncode), done.stderr
    return done
