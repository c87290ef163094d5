"""`orthoflow plan`: show which steps would run, which are cached, and why."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from orthoflow.cli.commands import (
    EXIT_GOOD,
    Changes,
    Command,
    echo_lint,
    json_option,
    selection_options,
    store_option,
    workflow_arguments,
)
from orthoflow.cli.tables import counted, echo, echo_json, echo_table

if TYPE_CHECKING:
    from orthoflow.engine.plan import PlannedCell


@click.command(cls=Command)
@workflow_arguments
@selection_options
@store_option
@json_option
def plan(
    workflow: str,
    changes: Changes,
    store: Path,
    *,
    as_json: bool,
    # These are options that select steps or belong to `RunOptions`; click has checked their types.
    **selection: Any,
) -> int:
    """Show for every step of WORKFLOW whether its result is stored, and if not, why it would run.

    Nothing is computed. "unknown yet" means that the step depends on results that do not exist yet,
    so that it is not known whether one of the stored results of its method will match. If there are
    none, the step "will run".
    """
    from orthoflow.catalog.discovery import discover_catalog
    from orthoflow.engine.plan import RunOptions, plan_run
    from orthoflow.engine.store import Store
    from orthoflow.workflow.expand import expand_cells, swept_indices

    catalog = discover_catalog()
    loaded = changes.load(workflow, catalog)
    cells = expand_cells(loaded, catalog)
    planned = plan_run(cells, loaded, catalog, Store(store), RunOptions(**selection)).cells
    if as_json:
        echo_json([_as_json(item) for item in planned])
        return EXIT_GOOD
    echo_table(
        ("step", "method", "status", "reason"),
        [(item.cell.address, item.cell.method, item.status, item.reason) for item in planned],
    )
    if indices := swept_indices(loaded):
        echo()
        echo_table(("variant", "parameters"), indices)
    echo_lint(loaded)
    echo("", _summary(planned))
    return EXIT_GOOD


def _summary(planned: Sequence[PlannedCell]) -> str:
    states = [item.status for item in planned]
    counts = [
        f"{number} {status}"
        for status in ("cached", "will run", "unknown yet", "skipped")
        if (number := states.count(status))
    ]
    return f"{counted(len(planned), 'step')}: {', '.join(counts)}"


def _as_json(item: PlannedCell) -> dict[str, object]:
    return {
        "cell": item.cell.address,
        "step": item.cell.step,
        "method": item.cell.method,
        "status": item.status,
        "reason": item.reason,
        "key": item.key.key if item.key is not None else None,
        "params": dict(item.cell.params),
    }
