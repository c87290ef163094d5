"""`orthoflow cache`: list, check or clean up the store of results."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Final

import click

from orthoflow.cli.commands import (
    EXIT_GOOD,
    EXIT_RECORD_DIFFERS,
    Command,
    LazyGroup,
    echo_error,
    json_option,
    store_option,
)
from orthoflow.cli.tables import counted, echo, echo_json, echo_table, size

_SUMMARIES: Final = {
    "list": "List the stored results with their size and age.",
    "gc": "Remove objects that no stored result needs.",
    "verify": "Check every byte of the store, and remove damaged parts.",
}


cache: Final[click.Command] = LazyGroup(
    name="cache",
    help="List, check or clean the store of results.",
    summaries=_SUMMARIES,
    target="orthoflow.cli.cache:cache_{}",
)


@click.command("list", cls=Command)
@store_option
@json_option
def cache_list(store: Path, *, as_json: bool) -> int:
    """List the stored results, most recently used first.

    A product shared by several results is stored once, but its size is counted for each result.
    """
    from orthoflow.engine.store import Store, list_results

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
    echo(f"{counted(len(results), 'result')} in {store}")
    return EXIT_GOOD


@click.command("gc", cls=Command)
@store_option
@click.option(
    "--older-than",
    type=float,
    metavar="DAYS",
    help="Also remove results that no run has used for this many days; 0 removes all.",
)
@click.option("--dry-run", is_flag=True, help="Only show what would be removed.")
@json_option
def cache_gc(store: Path, older_than: float | None, *, dry_run: bool, as_json: bool) -> int:
    """Remove incomplete results, products that no result needs, and files left by killed runs."""
    from orthoflow.engine.cleaning import collect_garbage
    from orthoflow.engine.store import Store

    found = collect_garbage(Store(store), older_than_days=older_than, dry_run=dry_run)
    if as_json:
        echo_json({"dry_run": dry_run, **asdict(found)})
        return EXIT_GOOD
    verb = "would remove" if dry_run else "removed"
    echo(
        f"{verb} {counted(found.n_results, 'result')} and "
        f"{counted(found.n_objects, 'object')}, "
        f"{size(found.freed_bytes)}"
    )
    return EXIT_GOOD


@click.command("verify", cls=Command)
@store_option
@json_option
def cache_verify(store: Path, *, as_json: bool) -> int:
    """Check every byte of the stored results, products, published files and figures.

    Damaged parts are removed; the next run that needs them recomputes them. The exit code is 3 if
    anything was damaged. Runs may use the store at the same time.
    """
    from orthoflow.engine.cleaning import check_store
    from orthoflow.engine.store import Store

    found = check_store(Store(store))
    code = EXIT_RECORD_DIFFERS if found.damaged else EXIT_GOOD
    if as_json:
        echo_json({"store": str(store), "ok": not found.damaged, **asdict(found)})
        return code
    for item in found.damaged:
        echo(f"{item.name}: {item.what}")
    echo(
        f"{counted(found.n_results, 'result')} and {counted(found.n_objects, 'object')} in {store} "
        "are unchanged"
    )
    if found.damaged:
        echo_error(
            f"error: {counted(len(found.damaged), 'part')} of {store} were damaged and have been "
            "removed (see above); the next run recomputes those it needs"
        )
    return code
