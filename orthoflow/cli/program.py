"""The program `orthoflow`: the table of commands, and the group that runs them."""

from __future__ import annotations

import contextlib
import gc
import io
import os
import sys
import threading
from typing import Any, Final, NoReturn

import click

from orthoflow.cli.commands import (
    EXIT_CELL_FAILED,
    HELP_OPTIONS,
    LazyGroup,
    Session,
    debug_parameter,
    echo_error,
    explain,
    silence_stdout,
)
from orthoflow.cli.tables import echo
from orthoflow.version import __version__

_SUMMARIES: Final = {
    "new": "Write a first workflow for your own files.",
    "check": "Report all mistakes in a workflow file.",
    "plan": "Show which steps would run, which are cached, and why.",
    "graph": "Draw a workflow as a Mermaid graph.",
    "run": "Run a workflow and write orthoimages, report and record.",
    "show": "Summarise a finished run.",
    "runs": "List the runs in a folder with their date, quality and differences.",
    "compare": "Compare two runs and measure their differences.",
    "report": "Write the HTML report of one or more runs.",
    "verify": "Check that a record is complete and unchanged.",
    "sign": "Sign a record with your key, so that others can verify it.",
    "replay": "Repeat a run from its record and show what differs.",
    "export": "Write a run's results for other programs.",
    "plugins": "List, show and check methods, or write your own plugin.",
    "schema": "Print the JSON Schema of workflow files.",
    "warm": "Compile kernels before the first run.",
    "cache": "List, check or clean the store of results.",
    "doctor": "Show which parts are installed or missing, and the consequences.",
}

_HELP: Final = """Make orthoimages of walls from laser scans and hand-held photographs, with methods
that can be compared and repeated.

A first run, on a simulated room: orthoflow run quickstart.yaml

Exit codes: 0 success; 1 a step failed; 2 the workflow, an argument or an input is invalid; 3 a
record is damaged, differs or cannot be replayed; 4 a plugin or a library is missing; 130
interrupted.
"""


class Program(LazyGroup):
    """The group of all commands; it turns errors into a message and an exit code."""

    # The types are those of click.
    def main(self, *args: Any, **extra: Any) -> NoReturn:
        """Run a command line, and exit with its exit code."""
        session = Session()
        extra.update(standalone_mode=False, obj=session)
        code: object
        try:
            code = super().main(*args, **extra)
            sys.stdout.flush()
        except BrokenPipeError:
            silence_stdout()
            code = 0
        except click.ClickException as error:
            shown = io.StringIO()
            error.show(shown)
            echo_error(*shown.getvalue().rstrip("\n").split("\n"))
            code = error.exit_code
        except Exception as error:  # noqa: BLE001 - last handler before the user
            code = explain(error, session)
        # If a command returns no exit code, it has failed.
        sys.exit(code if isinstance(code, int) else EXIT_CELL_FAILED)

    def invoke(self, ctx: click.Context) -> object:
        """Run the chosen command; succeed if the reader of its output closes the pipe."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            # Handle the error here, because click would return the exit code 1, which means that a
            # step failed.
            silence_stdout()
            return 0


def _print_version(ctx: click.Context, _param: click.Parameter, value: bool) -> None:  # noqa: FBT001
    if value:
        echo(f"orthoflow {__version__}")
        ctx.exit()


program: Final = Program(
    name="orthoflow",
    summaries=_SUMMARIES,
    target="orthoflow.cli.{}:{}",
    help=_HELP,
    params=[
        click.Option(
            ["--version"],
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=_print_version,
            help="Print the version and exit.",
        ),
        debug_parameter(),
    ],
    context_settings={**HELP_OPTIONS, "max_content_width": 100},
)


def main() -> NoReturn:
    """Run the `orthoflow` command."""
    take_up_streams()
    # Imports create many permanent objects but little garbage. With the default threshold, garbage
    # collection took 10 % of the time of `orthoflow plan`.
    gc.set_threshold(50_000, *gc.get_threshold()[1:])
    try:
        program.main(prog_name="orthoflow")
    except SystemExit as end:
        _leave_library_threads(end.code)
        raise


def take_up_streams() -> None:
    """Replace closed standard streams by the null device.

    Otherwise, a file that is opened later would get the descriptor of the closed stream, and would
    receive its output.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # The new descriptor is the lowest free one, which is that of the closed stream.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # noqa: FBT003
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", encoding="utf-8"))  # noqa: SIM115, PTH123


def _leave_library_threads(code: object) -> None:
    """Exit immediately if threads of a plugin are still running; Python would wait for them."""
    main_thread = threading.main_thread()
    if all(thread.daemon or thread is main_thread for thread in threading.enumerate()):
        return
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code if isinstance(code, int) else 0)
