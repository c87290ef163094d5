"""A new author follows `plugins/README.md` to the letter, in a new environment."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from tests.author_environments import ROOT, new_environment, succeed
from tests.road.conftest import metrics_of

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
    scripts = new_environment(tmp_path / "venv").parent
    program = scripts / "orthoflow"
    program.write_text(f'#!/bin/sh\nexec "{scripts}/python" -m orthoflow "$@"\n')
    program.chmod(0o755)
    variables = dict(os.environ)
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
        succeed(folder, "bash", "-c", command, variables=variables)
    metrics = metrics_of(folder / "compared")
    for variant in ("ransac", "lmeds-planes"):
        assert (f"plane@plane={variant}", "rms_mm") in metrics
