"""`orthoflow schema`: print the JSON Schema of workflow files."""

from __future__ import annotations

import json

import click

from orthoflow.cli.commands import EXIT_GOOD, Command, json_option
from orthoflow.cli.tables import echo


@click.command(cls=Command)
@json_option
def schema(*, as_json: bool) -> int:
    """Print the JSON Schema of workflow files, with the parameters of every installed method.

    Save the schema and refer to it in an editor to get completion and checks. The output is JSON
    with or without --json.
    """
    from orthoflow.catalog.discovery import discover_catalog
    from orthoflow.workflow.views import workflow_schema

    del as_json
    # Only programs read the schema; it is half as large without whitespace.
    schema_text = json.dumps(
        workflow_schema(discover_catalog()), separators=(",", ":"), ensure_ascii=False
    )
    echo(schema_text)
    return EXIT_GOOD
