"""`orthoflow graph`: draw a workflow as a Mermaid graph."""

from __future__ import annotations

import click

from orthoflow.cli.commands import EXIT_GOOD, Changes, Command, workflow_arguments
from orthoflow.cli.tables import echo


@click.command(cls=Command)
@workflow_arguments
def graph(workflow: str, changes: Changes) -> int:
    """Print WORKFLOW as a Mermaid graph, which GitHub, GitLab and many editors display."""
    from orthoflow.catalog.discovery import discover_catalog
    from orthoflow.workflow.views import mermaid

    catalog = discover_catalog()
    loaded = changes.load(workflow, catalog)
    echo(*mermaid(loaded, catalog).rstrip("\n").split("\n"))
    return EXIT_GOOD
