"""`orthoflow plugins`: list, show and check methods, and write a plugin."""

from __future__ import annotations

from typing import Final

import click

from orthoflow.cli.lazy_groups import LazyCommand, LazyGroup

_SUMMARIES: Final = {
    "list": "List every method, and what is wrong with plugins that do not load.",
    "show": "Show a method's parameters, ports, origin and citations.",
    "new": "Write a plugin of your own that works and passes its tests at once.",
    "check": "Run the conformance suite on a method.",
}


def _nothing_before_the_command() -> None:
    """Satisfy click, which wants a callback on a group."""


plugins: Final[click.Command] = LazyGroup(
    name="plugins",
    callback=_nothing_before_the_command,
    help="List, show and check methods, and write a plugin of your own.",
    lazy={
        name: LazyCommand(target=f"orthoflow.cli.plugins_{name}:plugins_{name}", summary=summary)
        for name, summary in _SUMMARIES.items()
    },
)
