"""`orthoflow cache`: list or clean the store of results."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Final

import click

from orthoflow.cli.commands import Command, LazyCommand, LazyGroup
from orthoflow.cli.failures import EXIT_GOOD
from orthoflow.cli.options import json_option, store_option
from orthoflow.cli.tables import counted, echo_json, echo_table, size

_SUMMARIES: Final = {
    "list": "List the stored results with their size and age.",
    "gc": "Remove what no stored result needs any more.",
}


cache: Final[click.Command] = LazyGroup(
    name="cache",
    help="List or clean the store of results.",
    lazy={
        name: LazyCommand(target=f"orthoflow.cli.cache:cache_{name}", summary=summary)
        for name, summary in _SUMMARIES.items()
    },
)


@click.command("list", cls=Command)
@store_option
@json_option
def cache_list(store: Path, *, as_json: bool) -> int:
    """List the stored results, last used first.

    Equal products of several results are stored once, but count for each.
    """
    from orthoflow.engine import Store, list_results

    results = list_results(Store(store))
    if as_json:
        echo_json([asdict(result) for result in results])
        return EXIT_GOOD
    echo_table(
        ("key", "method", "size", "last used", "run", ""),
        [
            (
                result.key[:12],
                result.method,
                size(result.size_bytes),
                result.last_used,
                result.run_id,
                "" if result.is_complete else "incomplete",
            )
            for result in results
        ],
    )
    click.echo(f"{counted(len(results), 'result')} in {store}")
    return EXIT_GOOD


@click.command("gc", cls=Command)
@store_option
@click.option(
    "--older-than",
    type=float,
    metavar="DAYS",
    help="Also remove results that no run used for so many days; 0 removes all.",
)
@click.option("--dry-run", is_flag=True, help="Only say what would be removed.")
@json_option
def cache_gc(store: Path, older_than: float | None, *, dry_run: bool, as_json: bool) -> int:
    """Remove incomplete results, products that no result needs, and what killed runs left."""
    from orthoflow.engine import Store, collect_garbage

    found = collect_garbage(Store(store), older_than_days=older_than, dry_run=dry_run)
    if as_json:
        echo_json({"dry_run": dry_run, **asdict(found)})
        return EXIT_GOOD
    verb = "would remove" if dry_run else "removed"
    click.echo(
        f"{verb} {counted(found.n_results, 'result')} and "
        f"{counted(found.n_objects, 'object')}, "
        f"{size(found.freed_bytes)}"
    )
    return EXIT_GOOD
