"""What commands share: the words that repeat one, columns and quantities, closed streams."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import click
import h5py
import pytest
from click.testing import CliRunner

from orthoflow.cli.commands import (
    RecordCommand,
    command_again,
)
from orthoflow.cli.tables import echo
from orthoflow.errors import GeometryError, ProductError, RecordError
from tests.provenance_records import write_sample


@click.command()
@click.argument("recipe")
@click.option("--set", "settings", multiple=True)
@click.option("--jobs", type=int, default=2)
@click.option("--force", is_flag=True)
@click.option("-o", "--output")
def bake(**_given: object) -> None:
    echo(command_again(Path("new one")))


def test_a_command_is_repeated_with_what_was_given_and_another_folder() -> None:
    given = ["my cake.yaml", "--set", "a=[1, 2]", "--set", "b=3", "--force", "-o", "old"]
    words = shlex.split(CliRunner().invoke(bake, given).output)
    assert words[0] == "bake"
    assert sorted(words[1:-2]) == sorted(given[:-2])
    assert words[words.index("a=[1, 2]") - 1] == words[words.index("b=3") - 1] == "--set"
    assert words[-2:] == ["-o", "new one"]


# --- what fails on a record ---


def failing(error: Exception, *runs: Path) -> BaseException:
    """Give runs to a command that ends with an error, and take what becomes of it."""

    @click.command(cls=RecordCommand)
    @click.argument("runs", nargs=-1, type=click.Path(path_type=Path))
    def fail(**_given: object) -> None:
        raise error

    with pytest.raises(BaseException) as caught:  # noqa: PT011 - which one is what is asked
        fail.main([str(run) for run in runs], standalone_mode=False)
    return caught.value


def test_a_failure_on_a_changed_record_is_that_records(tmp_path: Path) -> None:
    intact, _, _ = write_sample(tmp_path)
    changed = tmp_path / "changed.h5"
    changed.write_bytes(intact.read_bytes())
    with h5py.File(changed, "r+") as file:
        file.attrs["seed"] = type(file.attrs["seed"])(b"8")
    error = KeyError("wall")
    assert failing(error, intact, intact) is error
    for runs in ((changed,), (intact, intact, changed)):
        raised = failing(error, *runs)
        assert isinstance(raised, RecordError)
        assert str(raised).startswith(f"{changed} has been changed since it was written: ")
        assert raised.__cause__ is error
    # A product that breaks its rules is the record's, too.
    for kind in (GeometryError, ProductError):
        raised = failing(kind("no plane"), intact)
        assert isinstance(raised, RecordError)
        assert str(raised) == "a product of this run is invalid: no plane"


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
