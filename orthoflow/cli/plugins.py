"""`orthoflow plugins`: list the methods that are installed, or show one."""

from __future__ import annotations

from typing import Final

import click

from orthoflow.cli.lazy_groups import LazyCommand, LazyGroup

_SUMMARIES: Final = {
    "list": "List every method, and what is wrong with plugins that do not load.",
    "show": "Show a method's parameters, ports, origin and citations.",
}


def _nothing_before_the_command() -> None:
    """Satisfy click, which wants a callback on a group."""


plugins: Final[click.Command] = LazyGroup(
    name="plugins",
    callback=_nothing_before_the_command,
    help="List the methods that are installed, or show one.",
    lazy={
        name: LazyCommand(target=f"orthoflow.cli.plugins_{name}:plugins_{name}", summary=summary)
        for name, summary in _SUMMARIES.items()
    },
)
