"""`orthoflow check`: report all mistakes in a workflow file."""

from __future__ import annotations

from dataclasses import asdict

import click

from orthoflow.cli.commands import EXIT_GOOD, Changes, Command, json_option, workflow_arguments
from orthoflow.cli.tables import counted, echo, echo_json
from orthoflow.errors import OrthoflowError


@click.command(cls=Command)
@workflow_arguments
@json_option
def check(workflow: str, changes: Changes, *, as_json: bool) -> int:
    """Report all mistakes in WORKFLOW, a file or the name of a shipped workflow.

    All problems are reported in one pass, as file:line:column: path: message; input files are
    searched for as well. Warnings mark valid but probably unintended settings. The exit code is 2
    if there are mistakes, and 4 if a plugin is missing.
    """
    try:
        summary, warnings = _check(workflow, changes)
    except OrthoflowError as error:
        if not as_json:
            raise
        problems = [asdict(problem) for problem in getattr(error, "problems", ())]
        echo_json({"ok": False, "message": str(error), "problems": problems, "warnings": []})
        return error.exit_code
    if as_json:
        echo_json({"ok": True, "message": summary, "problems": [], "warnings": list(warnings)})
    else:
        echo(summary, *(f"warning: {text}" for text in warnings))
    return EXIT_GOOD


def _check(workflow: str, changes: Changes) -> tuple[str, tuple[str, ...]]:
    from orthoflow.catalog.discovery import discover_catalog
    from orthoflow.workflow.checks import lint_workflow
    from orthoflow.workflow.expand import expand_cells, is_plain, variants_text
    from orthoflow.workflow.inputs import resolve_input_files

    catalog = discover_catalog()
    loaded = changes.load(workflow, catalog)
    resolve_input_files(loaded)
    cells = expand_cells(loaded, catalog)
    skipped = sum(bool(cell.skip_reason) for cell in cells)
    parts = [counted(len(loaded.steps), "step")]
    if loaded.chosen_data:
        parts.append(counted(len(loaded.chosen_data), "dataset"))
    if not is_plain(cells):
        parts.append(f"{counted(len(cells), 'step run')} in total")
    if skipped:
        parts.append(f"{skipped} skipped because optional inputs are missing")
    # The baseline is empty if no step has variants.
    if named := variants_text(loaded.baseline):
        parts.append(f"baseline {named}")
    return f"{loaded.name} is valid: {', '.join(parts)}", lint_workflow(loaded)
