"""What one call of the program shares between its commands and the error handler."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import click


@dataclass
class Session:
    """State of one call of the program.

    Attributes:
        debug: show tracebacks.
        resume_hint: sentence that says how to go on after Ctrl-C, empty when there is no way.
    """

    debug: bool = False
    resume_hint: str = ""


def current_session() -> Session:
    """Give the session of the running command; one of its own for a command called alone."""
    context = click.get_current_context(silent=True)
    session = context.find_object(Session) if context is not None else None
    return session if session is not None else Session()


def _keep_debug(ctx: click.Context, _param: click.Parameter, value: bool) -> None:  # noqa: FBT001
    session = ctx.find_object(Session)
    if session is not None and value:
        session.debug = True


DEBUG_HELP: Final = "Show tracebacks of errors."


def debug_parameter() -> click.Option:
    """Give the `--debug` flag, which may stand before or behind the name of a command."""
    return click.Option(
        ["--debug"], is_flag=True, expose_value=False, callback=_keep_debug, help=DEBUG_HELP
    )
