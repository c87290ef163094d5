"""`orthoflow cache`: list or clean the store of results."""

from __future__ import annotations

from typing import Final

import click

from orthoflow.cli.lazy_groups import LazyCommand, LazyGroup

_SUMMARIES: Final = {
    "list": "List the stored results with their size and age.",
    "gc": "Remove what no stored result needs any more.",
}


def _nothing_before_the_command() -> None:
    """Satisfy click, which wants a callback on a group."""


cache: Final[click.Command] = LazyGroup(
    name="cache",
    callback=_nothing_before_the_command,
    help="List or clean the store of results.",
    lazy={
        name: LazyCommand(target=f"orthoflow.cli.cache_{name}:cache_{name}", summary=summary)
        for name, summary in _SUMMARIES.items()
    },
)
