"""`orthoflow run`: run a workflow and write orthoimages, report and record."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from orthoflow.cli.commands import (
    Changes,
    Command,
    command_again,
    current_session,
    echo_error,
    echo_lint,
    execution_options,
    output_option,
    selection_options,
    silence_stdout,
    store_option,
    workflow_arguments,
)
from orthoflow.cli.tables import (
    counted,
    duration,
    echo,
    echo_diagnostics,
    echo_table,
)
from orthoflow.errors import (
    ArgumentError,
    CancelledStepError,
    ClusterError,
    OrthoflowError,
    StoreError,
)
from orthoflow.untrusted_text import shown_json

if TYPE_CHECKING:
    from orthoflow.engine.journal import RunEvent, RunListener
    from orthoflow.engine.plan import RunPlan
    from orthoflow.engine.scheduler import RunOutcome
    from orthoflow.engine.store import Store
    from orthoflow.records import RecordedCell
    from orthoflow.records.runs import Run
    from orthoflow.workflow.model import (
        Workflow,
    )


@click.command(cls=Command)
@workflow_arguments
@output_option("<name>-<run id>")
@selection_options
@execution_options
@store_option
@click.option(
    "--embed",
    is_flag=True,
    help="Store everything in the record, including point clouds, photos and input files.",
)
@click.option(
    "--json-log",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write each diagnostic as a JSON line: code, severity, step, subject, values, text, "
    "remedy.",
)
def run(
    workflow: str,
    changes: Changes,
    output: Path | None,
    store: Path,
    *,
    embed: bool,
    json_log: Path | None,
    # These options belong to `RunOptions`; click has checked their types.
    **choices: Any,
) -> int:
    """Run WORKFLOW, a file or the name of a shipped workflow.

    Stored results are not recomputed. To resume an interrupted run, repeat the command with the
    same -o. The run folder contains run.h5 (the record), report.html, and products/ with files for
    other programs.
    """
    from orthoflow.engine.journal import LOGS, cell_file_name

    began_s = time.monotonic()
    outcome, made = run_workflow(
        workflow, changes, output, store, embed=embed, json_log=json_log, **choices
    )
    for address, failed in outcome.failed.items():
        if failed.is_bug:
            log = made.folder / LOGS / f"{cell_file_name(address)}.log"
            echo_error(f"{address}: traceback: {log}")
    try:
        _print_summary(made, outcome.resumed, time.monotonic() - began_s)
    except BrokenPipeError:
        # The reader of the output has closed the pipe, but the exit code still states the outcome
        # of the run.
        silence_stdout()
    return outcome.exit_code


def run_workflow(
    workflow: str,
    changes: Changes,
    output: Path | None,
    store: Path,
    *,
    embed: bool,
    json_log: Path | None,
    # These are the fields of `RunOptions`.
    **choices: Any,
) -> tuple[RunOutcome, Run]:
    """Plan and execute a workflow, and write its record and report.

    Raises:
        ArgumentError: an option is invalid.
    """
    from orthoflow.cli.progress import working_on

    with working_on("reading the workflow, its inputs and the store"):
        # Import slow modules here, while the activity is displayed.
        from orthoflow.catalog.discovery import discover_catalog
        from orthoflow.engine.journal import new_run_folder, new_run_id, require_run_folder
        from orthoflow.engine.plan import RunOptions, plan_run
        from orthoflow.engine.store import Store
        from orthoflow.records.runs import REPORT_FILE
        from orthoflow.records.write import begin_run
        from orthoflow.report import write_page
        from orthoflow.workflow.expand import expand_cells

        options = RunOptions(**choices)
        catalog = discover_catalog()
        loaded = changes.load(workflow, catalog)
        if output is not None:
            # Check the folder before the inputs are read, which may take long.
            require_run_folder(output.absolute(), loaded.name)
        opened = Store(store)
        cells = expand_cells(loaded, catalog)
        plan = plan_run(cells, loaded, catalog, opened, options)
    run_id = new_run_id()
    folder = output or new_run_folder(loaded.name, run_id)
    # Mark the store as in use until the record is written, so that `cache gc` removes no results.
    with opened.in_use(), _json_log(json_log, plan) as log:
        # Print warnings before the run, which may take long.
        echo_lint(loaded)
        has_begun = False

        def listen(event: RunEvent) -> None:
            nonlocal has_begun
            if not has_begun:
                has_begun = True
                begin_run(plan, loaded, folder, opened, run_id)
            log(event)

        try:
            return executed(
                plan,
                loaded,
                opened,
                folder,
                run_id,
                embed=embed,
                report=lambda made, note: write_page(made, folder / REPORT_FILE, note=note),
                listen=listen,
            )
        except (CancelledStepError, ClusterError, StoreError):
            if has_begun:
                _report_unfinished(folder)
            raise


def _report_unfinished(folder: Path) -> None:
    """Write the report of an interrupted run, with the results so far and how to resume it.

    Errors, for example because the disk is full, are ignored, because the results are already
    stored.
    """
    from orthoflow.records.open import open_unfinished
    from orthoflow.records.runs import REPORT_FILE
    from orthoflow.report import write_page

    report = folder / REPORT_FILE
    with suppress(OrthoflowError, OSError):
        write_page(open_unfinished(folder, publish=True), report, go_on=command_again(folder))
        echo_error(f"report of the finished steps: {report}")


def executed(  # noqa: PLR0913 - parts of a run
    plan: RunPlan,
    workflow: Workflow,
    store: Store,
    folder: Path,
    run_id: str,
    *,
    embed: bool = False,
    report: Callable[[Run, Callable[[str], None]], None],
    listen: RunListener = lambda _: None,
) -> tuple[RunOutcome, Run]:
    """Execute a plan, show the progress, and write the products, record and report."""
    from orthoflow.cli.progress import Progress, working_on
    from orthoflow.engine.scheduler import execute
    from orthoflow.records.write import executed_and_written, write_run

    current_session().resume_hint = (
        f"interrupted; finished steps are kept; to resume, repeat the command with -o {folder}"
    )

    def run() -> RunOutcome:
        with Progress(plan.cells, jobs=plan.options.jobs) as progress:

            def take(event: RunEvent) -> None:
                listen(event)
                progress.take(event)

            return execute(plan, folder, store, take, run_id=run_id)

    def write(outcome: RunOutcome) -> Run:
        current_session().resume_hint = (
            "interrupted while products, report and record were written; all steps are kept: to "
            f"finish, repeat the command with -o {folder}"
        )
        with working_on("writing the products and the record") as note:

            def write_report(made: Run) -> None:
                note("writing the report")
                report(made, note)

            return write_run(
                outcome, plan, workflow, folder, store, embed=embed, before_finish=write_report
            )

    return executed_and_written(run, write)


@contextmanager
def _json_log(path: Path | None, plan: RunPlan) -> Iterator[RunListener]:
    """Yield a listener that writes the diagnostics of finished cells to a file as JSON lines.

    Raises:
        ArgumentError: the file cannot be written.
    """
    from orthoflow.engine.journal import CellFinished
    from orthoflow.records.tables import diagnostics_of

    if path is None:
        yield lambda _: None
        return
    steps = {item.cell.address: item.cell.step for item in plan.cells}
    try:
        file = path.open("w", encoding="utf-8", buffering=1)
    except OSError as error:
        raise ArgumentError(f"--json-log: cannot write {path}: {error.strerror}") from error
    with file:

        def listen(event: RunEvent) -> None:
            if isinstance(event, CellFinished):
                for one in diagnostics_of(event.result, steps[event.address], event.address):
                    file.write(f"{shown_json(json.dumps(one, ensure_ascii=False))}\n")

        yield listen


def _print_summary(run: Run, kept: Collection[str], took_s: float) -> None:
    cells = run.record.cells
    echo()
    echo_table(
        ("step", "method", "status", "time", "remark"),
        [
            (
                cell.address,
                cell.method,
                "cached" if cell.cached_from else "kept" if cell.address in kept else cell.status,
                duration(cell.wall_s) if cell.status != "skipped" and cell.started else "",
                _remark(cell),
            )
            for cell in cells
        ],
    )
    if any(cell.warnings for cell in cells):
        echo()
    echo_diagnostics(cells, run.folder)
    echo("", _cached_text(cells, kept))
    echo(f"total time: {duration(took_s)}, including starting, loading and compiling")
    from orthoflow.records.runs import REPORT_FILE
    from orthoflow.report.combinations import baseline_of
    from orthoflow.workflow.expand import variants_text

    if baseline := variants_text(baseline_of(run)):
        echo(f"baseline: {baseline}; all other combinations are compared with it")
    echo(f"products: {run.products_folder}")
    echo(f"report: {run.folder / REPORT_FILE}")
    echo(f"record: {run.path}")
    for image in run.orthoimages:
        echo(f"orthoimage: {image}")


def _cached_text(cells: Iterable[RecordedCell], kept: Collection[str]) -> str:
    counted_cells = [cell for cell in cells if cell.status != "skipped"]
    n_cells = len(counted_cells)
    n_cached = sum(bool(cell.cached_from) for cell in counted_cells)
    n_kept = sum(cell.address in kept for cell in counted_cells)
    before = f", {n_kept} from before the interruption" if n_kept else ""
    return f"{n_cached} of {counted(n_cells, 'step')} cached{before}"


def _remark(cell: RecordedCell) -> str:
    if cell.status == "skipped":
        return cell.error_message
    if cell.status == "failed":
        return "see above"
    return counted(len(cell.warnings), "warning") if cell.warnings else ""
