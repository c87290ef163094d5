"""`orthoflow report`: write the HTML report of one or more runs."""

from __future__ import annotations

from pathlib import Path

import click

from orthoflow.cli.commands import RecordCommand, code_for, store_option
from orthoflow.cli.tables import echo
from orthoflow.errors import ArgumentError


@click.command(cls=RecordCommand)
@click.argument("runs", metavar="RUN [RUN ...]", nargs=-1, required=True, type=click.Path())
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Output file; for a single run, its report.html by default.",
)
@store_option
def report(runs: tuple[str, ...], output: Path | None, store: Path) -> int:
    """Write the HTML report of one or more runs, each a run folder or its run.h5.

    Without -o, the report is written to the run folder, and the figures are written to figures/
    next to it, as PNG or SVG files; if there are variants, only the figures of the baseline are
    written (`orthoflow export RUN --to figures` writes all). For two runs, the report also compares
    products; products that the records reference but do not contain are loaded from the store. If
    the seal of a record is broken, the page shows a warning, and the exit code is 3.
    """
    from orthoflow.engine.store import stores_at
    from orthoflow.records.open import open_run
    from orthoflow.records.runs import REPORT_FILE
    from orthoflow.records.verify import broken_seal
    from orthoflow.report import write_page, write_report

    opened = [open_run(run) for run in runs]
    if output is None and len(opened) > 1:
        raise ArgumentError(
            f"{len(opened)} runs were given: pass -o FILE, the path of the combined report"
        )
    target = output if output is not None else opened[0].home_folder / REPORT_FILE
    if not target.parent.is_dir():
        raise ArgumentError(f"{target.parent} does not exist: create the folder or choose another")
    broken_seals = {run.path: broken for run in opened if (broken := broken_seal(run))}
    if output is None:
        write_page(opened[0], target, broken_seals=broken_seals)
    else:
        write_report(opened, target, broken_seals=broken_seals, stores=stores_at(store))
    echo(f"report: {target}")
    return code_for(broken_seals.values(), "the page shows a warning")
