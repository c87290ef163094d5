"""The program itself: fast start, exit codes, one sentence per error."""

from __future__ import annotations

import errno
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import h5py
import pytest
from click.testing import CliRunner, Result
from syrupy.assertion import SnapshotAssertion

from orthoflow.cli import program
from orthoflow.cli.commands import (
    RecordCommand,
    command_again,
    current_session,
)
from orthoflow.cli.program import Program
from orthoflow.cli.tables import echo
from orthoflow.errors import (
    CancelledStepError,
    GeometryError,
    InputError,
    PluginError,
    ProductError,
    RecordError,
    StoreError,
    WorkflowError,
)
from tests.provenance_records import write_sample

HEAVY = ("numpy", "pydantic", "networkx", "rich", "ruamel", "h5py", "numba", "jinja2")
COMMANDS = [
    *("new", "check", "plan", "graph", "run", "show", "runs", "compare", "report", "verify"),
    *("sign", "replay", "export", "schema", "warm", "doctor"),
    *("plugins", "plugins list", "plugins show", "plugins new", "plugins check"),
    *("cache", "cache list", "cache gc", "cache verify"),
]


def invoke_failing(error: BaseException | Callable[[], int], *arguments: str) -> Result:
    """Run a program whose only command raises the error or calls the function."""

    def fail() -> int:
        if callable(error):
            return error()
        raise error

    broken = Program(name="orthoflow", params=program.params, summaries={}, target="")
    broken.get_command = lambda _ctx, _name: click.Command("fail", callback=fail)  # type: ignore[method-assign]
    return CliRunner().invoke(broken, [*arguments, "fail"])


def modules_loaded_by(arguments: list[str]) -> set[str]:
    """Run a command in an interpreter of its own; gives the names in its `sys.modules`."""
    code = (
        "import sys\n"
        "from orthoflow.cli import program\n"
        "try:\n"
        f"    program.main({arguments!r})\n"
        "except SystemExit as exit:\n"
        "    assert exit.code == 0, exit.code\n"
        "print(*sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.parametrize("arguments", [["--help"], ["plugins", "list"], ["run", "--help"]])
def test_listing_loads_no_heavy_library(arguments: list[str]) -> None:
    loaded = modules_loaded_by(arguments)
    assert loaded.isdisjoint(HEAVY)
    # What half a second allows. Times themselves depend on what else the machine does.
    assert len(loaded) < 320


def test_planning_loads_no_more_than_it_needs() -> None:
    loaded = modules_loaded_by(["plan", "direct.yaml"])
    assert loaded.isdisjoint({"h5py", "numba", "rich", "jinja2"})


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_the_help_of_a_command_is_what_was_reviewed(name: str, snapshot: SnapshotAssertion) -> None:
    result = CliRunner(env={"COLUMNS": "100"}).invoke(program, [*name.split(), "--help"])
    assert result.exit_code == 0
    assert result.output == snapshot


NO_MEMORY = "not enough memory to continue"


@pytest.mark.parametrize(
    ("error", "code", "sentence"),
    [
        (WorkflowError("w"), 2, "w"),
        (RecordError("r"), 3, "r"),
        (PluginError("p"), 4, "p"),
        (StoreError("s"), 1, "s"),
        (OSError(28, "No space left on device", "x/run.h5"), 1, "x/run.h5: no space left on devi"),
        (ZeroDivisionError("0"), 1, "orthoflow itself failed (ZeroDivisionError: 0); repeat the"),
        (MemoryError(), 1, NO_MEMORY),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), 1, NO_MEMORY),
        (ImportError("libhdf5.so: failed to map segment from shared object"), 1, NO_MEMORY),
        (ImportError("libGL.so.1: cannot open"), 4, "a library cannot be imported: libGL.so.1: c"),
    ],
    ids=str,
)
def test_errors_become_one_sentence_and_their_exit_code(
    error: Exception, code: int, sentence: str
) -> None:
    result = invoke_failing(error)
    assert result.exit_code == code
    assert result.stderr.startswith(f"error: {sentence}")
    assert (result.stderr.count("\n"), result.stdout) == (1, "")


def test_debug_shows_the_traceback_as_well() -> None:
    result = invoke_failing(InputError("the scan is empty"), "--debug")
    assert result.exit_code == 2
    assert "Traceback (most recent call last)" in result.stderr
    assert result.stderr.endswith("error: the scan is empty\n")


@pytest.mark.parametrize("error", [KeyboardInterrupt(), CancelledStepError("stopped")])
def test_an_interrupt_ends_with_130_and_says_how_to_go_on(error: BaseException) -> None:
    def interrupted() -> int:
        current_session().resume_hint = "interrupted; repeat the command with -o runs/x"
        raise error

    result = invoke_failing(interrupted)
    assert result.exit_code == 130
    assert result.stderr.strip() == "interrupted; repeat the command with -o runs/x"


# What commands share: the words that repeat one, and closed streams -------------------------------


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
