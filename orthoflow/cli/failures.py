"""How every error becomes one sentence on standard error and an exit code."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

import click

from orthoflow.cli.commands import Session
from orthoflow.cli.tables import counted, echo
from orthoflow.errors import OrthoflowError

if TYPE_CHECKING:
    from orthoflow.workflow.model import (
        Workflow,
    )

EXIT_GOOD: Final = 0
EXIT_CELL_FAILED: Final = 1
EXIT_INVALID: Final = 2
EXIT_RECORD_DIFFERS: Final = 3
EXIT_PLUGIN_MISSING: Final = 4
EXIT_INTERRUPTED: Final = 130


def explain(error: Exception, session: Session) -> int:
    """Tell the user about an error that ended a command.

    Returns:
        The exit code of the process.
    """
    from orthoflow.engine.measuring import is_for_want_of_memory
    from orthoflow.sdk.lines import one_line

    if session.debug:
        import traceback

        say_error(*"".join(traceback.format_exception(error)).rstrip("\n").split("\n"))
    if isinstance(error, click.Abort | KeyboardInterrupt):
        say_error(session.resume_hint or "interrupted")
        return EXIT_INTERRUPTED
    if isinstance(error, OrthoflowError):
        interrupted = error.exit_code == EXIT_INTERRUPTED
        hint = session.resume_hint if interrupted else ""
        say_error(*([hint] if hint else _sentences(error)))
        return error.exit_code
    if is_for_want_of_memory(error):
        say_error("error: not enough memory to go on; free some, or raise the limit on memory")
        return EXIT_CELL_FAILED
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        say_error(f"error: {where}{error.strerror.lower()}")
        return EXIT_CELL_FAILED
    if isinstance(error, ImportError):
        say_error(
            f"error: a library fails to import: {one_line(error)}; `orthoflow doctor` says what is "
            f"missing"
        )
        return EXIT_PLUGIN_MISSING
    say_error(
        f"error: orthoflow itself failed ({type(error).__name__}: {_first_line(str(error))}); "
        "repeat the command with --debug and report what it prints"
    )
    return EXIT_CELL_FAILED


def _sentences(error: OrthoflowError) -> list[str]:
    n_problems = len(getattr(error, "problems", ()))
    if not n_problems:
        return [f"error: {error_text(error)}"]
    # Lines that begin with file:line:column, as editors and other tools expect them.
    return [*str(error).split("\n"), f"error: {counted(n_problems, 'problem')}"]


def error_text(error: Exception) -> str:
    """Give the sentence of an error; `str` of an OSError without arguments would be empty."""
    return str(error) or type(error).__name__


def say_error(*lines: str) -> None:
    """Write lines to standard error; a closed one is no reason to fail."""
    with contextlib.suppress(BrokenPipeError):
        echo(*lines, err=True)


def say_doubts(workflow: Workflow) -> None:
    """Write to standard error what is allowed in a workflow and can hardly be meant."""
    from orthoflow.workflow.checks import doubts_about

    for doubt in doubts_about(workflow):
        say_error(f"workflow: warning: {doubt}")


def code_for(doubts: Iterable[str], consequence: str) -> int:
    """Tell which records are not as they were written and what follows, and give the exit code."""
    told = [f"error: {doubt}; {consequence}" for doubt in doubts if doubt]
    if not told:
        return EXIT_GOOD
    say_error(*told)
    return EXIT_RECORD_DIFFERS


def silence_stdout() -> None:
    """Send what is still to be printed nowhere, so that a closed pipe makes no noise at exit."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _first_line(text: str) -> str:
    return (text.splitlines() or [""])[0]
