"""A command works the same where a standard stream is closed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("closed", [">&-", "<&- >&- 2>&-"])
def test_a_command_works_with_closed_streams(closed: str, tmp_path: Path) -> None:
    # What is opened later must not get the number of a closed stream, and its output.
    target = tmp_path / "found.txt"
    program = (
        "import sys\n"
        "from orthoflow.cli.program import take_up_streams\n"
        "take_up_streams()\n"
        f"file = open({str(target)!r}, 'w')\n"
        "print('out'); print('err', file=sys.stderr)\n"
        "sys.stdout.flush(); sys.stderr.flush()\n"
        "file.write(str(file.fileno() > 2))\n"
    )
    command = f'"{sys.executable}" -c "$0" {closed}'
    done = subprocess.run(["bash", "-c", command, program], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert target.read_text() == "True"


def test_the_program_ends_well_with_closed_streams() -> None:
    command = f'"{sys.executable}" -m orthoflow --version >&- 2>&-'
    assert subprocess.run(["bash", "-c", command], check=False).returncode == 0
