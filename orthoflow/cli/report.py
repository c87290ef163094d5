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
    help="Output file; for a single run by default its own report.html.",
)
@store_option
def report(runs: tuple[str, ...], output: Path | None, store: Path) -> int:
    """Write the HTML report of one or more runs, each a run folder or its run.h5.

    Without -o it lies in the run's folder, with figures/ beside it: the figures as PNG or
    SVG, of a comparison those of the baseline (`orthoflow export RUN --to figures` has all).
    Of two runs it compares products, too, those that records only name from the store.
    Where a record's seal does not hold, the page states it, and this ends with 3.
    """
    from orthoflow.engine.store import stores_at
    from orthoflow.records.open import open_run
    from orthoflow.records.runs import REPORT_FILE
    from orthoflow.records.verify import broken_seal
    from orthoflow.report import write_page, write_report

    opened = [open_run(run) for run in runs]
    if output is None and len(opened) > 1:
        raise ArgumentError(
            f"{len(opened)} runs were given: give -o FILE, where their common report goes"
        )
    target = output if output is not None else opened[0].home_folder / REPORT_FILE
    if not target.parent.is_dir():
        raise ArgumentError(f"{target.parent} does not exist: make the folder, or choose another")
    broken_seals = {run.path: broken for run in opened if (broken := broken_seal(run))}
    if output is None:
        write_page(opened[0], target, broken_seals=broken_seals)
    else:
        write_report(opened, target, broken_seals=broken_seals, stores=stores_at(store))
    echo(f"report: {target}")
    return code_for(broken_seals.values(), "the page states it")
