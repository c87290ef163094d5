"""`orthoflow cache gc`: remove what no stored result needs any more."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from orthoflow.cli.failures import EXIT_GOOD
from orthoflow.cli.options import Command, json_option, store_option
from orthoflow.cli.tables import counted, echo_json, size


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
