"""`orthoflow check`: report everything that is wrong with a workflow file."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import click

from orthoflow.cli.commands import EXIT_GOOD, Changes, Command, json_option, workflow_arguments
from orthoflow.cli.tables import counted, echo, echo_json
from orthoflow.errors import OrthoflowError

if TYPE_CHECKING:
    from orthoflow.workflow.model import Workflow


@click.command(cls=Command)
@workflow_arguments
@json_option
def check(workflow: str, changes: Changes, *, as_json: bool) -> int:
    """Report everything that is wrong with WORKFLOW, a file or the name of a shipped one.

    Every problem is named in one pass, as file:line:column: path: message; input files are looked
    for as well. Warnings name what is allowed but hardly intended. Ends with 2 when something is
    wrong, with 4 when a plugin is missing.
    """
    if not as_json:
        verdict = _check(workflow, changes)
        echo(verdict.summary, *(f"warning: {text}" for text in verdict.warnings))
        return EXIT_GOOD
    try:
        verdict = _check(workflow, changes)
    except OrthoflowError as error:
        problems = [asdict(problem) for problem in getattr(error, "problems", ())]
        echo_json({"ok": False, "message": str(error), "problems": problems, "warnings": []})
        return error.exit_code
    warnings = list(verdict.warnings)
    echo_json({"ok": True, "message": verdict.summary, "problems": [], "warnings": warnings})
    return EXIT_GOOD


@dataclass(frozen=True, kw_only=True)
class _Verdict:
    """A workflow without mistakes in a sentence, and what is doubtful about it."""

    summary: str
    warnings: tuple[str, ...]


def _check(workflow: str, changes: Changes) -> _Verdict:
    from orthoflow.catalog.discovery import discover_catalog
    from orthoflow.workflow.checks import lint_workflow
    from orthoflow.workflow.expand import expand_cells, is_plain
    from orthoflow.workflow.inputs import resolve_input_files

    catalog = discover_catalog()
    loaded = changes.load(workflow, catalog)
    resolve_input_files(loaded)
    cells = expand_cells(loaded, catalog)
    skipped = sum(bool(cell.skip_reason) for cell in cells)
    without_data = f", {skipped} of them skipped for lack of optional data" if skipped else ""
    n_data = len(loaded.chosen_data)
    datasets = f"{counted(n_data, 'dataset')}, " if n_data else ""
    n_runs = "" if is_plain(cells) else f", {datasets}run {counted(len(cells), 'time')} in all"
    summary = (
        f"{loaded.name} is fine: {counted(len(loaded.steps), 'step')}"
        f"{n_runs}{without_data}{_baseline_text(loaded)}"
    )
    return _Verdict(summary=summary, warnings=lint_workflow(loaded))


def _baseline_text(workflow: Workflow) -> str:
    """Which variants the others are compared with: of a sweep, nobody named it."""
    from orthoflow.workflow.expand import variants_text

    named = variants_text(workflow.baseline)
    return f"; baseline {named}" if named else ""
