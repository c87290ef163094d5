"""A new author follows `plugins/README.md` to the letter, in a new environment."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from tests.road.conftest import metrics_of

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "plugins" / "README.md").read_text()
COMMANDS = [
    line
    for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    for line in block.replace("\\\n", "").splitlines()
]
# What the test's own environment stands in for: it has this checkout and what that needs.
MADE_ALREADY = ("python -m venv ", ". ../author/", "python -m pip install .")
(METHOD,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def test_the_way_is_at_most_fifteen_commands_long() -> None:
    assert len(COMMANDS) <= 15
    compile(METHOD, "lmeds.py", "exec")


@pytest.mark.long
def test_the_commands_of_the_readme_lead_to_a_comparison(tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", with_pip=True)
    scripts = tmp_path / "venv" / "bin"
    (packages,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    paths = [str(ROOT / part) for part in ("", "plugins", "provenance")]
    paths += [path for path in sys.path if path.endswith("-packages")]
    (packages / "shared.pth").write_text("\n".join(paths))
    program = scripts / "orthoflow"
    program.write_text(f'#!/bin/sh\nexec "{scripts}/python" -m orthoflow "$@"\n')
    program.chmod(0o755)
    variables = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    variables["PATH"] = f"{scripts}:{variables['PATH']}"
    folder = tmp_path / "checkout"
    folder.mkdir()
    for command in COMMANDS:
        if command == MADE_ALREADY[-1] or command.startswith(MADE_ALREADY[:-1]):
            continue
        if command.startswith("cd "):
            folder = (folder / command.removeprefix("cd ")).resolve()
            continue
        if "best_plane" in command:
            (folder / "lmeds_planes" / "lmeds.py").write_text(METHOD)
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=folder,
            env=variables,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, command + done.stdout[-3000:] + done.stderr[-2000:]
    metrics = metrics_of(folder / "compared")
    found = {
        variant
        for variant in ("ransac", "lmeds-planes")
        if (f"plane@plane={variant}", "rms_mm") in metrics
    }
    assert found == {"ransac", "lmeds-planes"}
