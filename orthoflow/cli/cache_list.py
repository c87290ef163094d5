"""`orthoflow cache list`: the stored results."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from orthoflow.cli.failures import EXIT_GOOD
from orthoflow.cli.options import Command, json_option, store_option
from orthoflow.cli.tables import counted, echo_json, echo_table, size


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
