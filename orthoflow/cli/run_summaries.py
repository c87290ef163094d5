"""What `orthoflow run` says at its end, and its exit code."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from orthoflow.cli.failures import say_error
from orthoflow.cli.tables import counted, duration, echo_table

if TYPE_CHECKING:
    from orthoflow.records import RecordedCell, Run


def print_failures(cells: Iterable[RecordedCell]) -> None:
    """Write one sentence per failed cell to standard error."""
    for cell in cells:
        if cell.status == "failed":
            say_error(f"{cell.address} failed: {cell.error_message}")


def print_summary(run: Run, report: Path) -> None:
    """Write the table of cells, the warnings, and last the report, the record and the images."""
    cells = run.record.cells
    click.echo()
    echo_table(
        ("cell", "method", "status", "time", "remark"),
        [(cell.address, cell.method, _status(cell), _time(cell), _remark(cell)) for cell in cells],
    )
    warnings = [f"warning, {cell.address}: {text}" for cell in cells for text in cell.warnings]
    if warnings:
        click.echo()
    for warning in warnings:
        click.echo(warning)
    click.echo(f"\n{cached_text(cells)}")
    click.echo(f"products: {run.products_folder}")
    click.echo(f"report: {report}")
    click.echo(f"record: {run.path}")
    for image in run.orthoimages:
        click.echo(f"orthoimage: {image}")


def cached_text(cells: Iterable[RecordedCell]) -> str:
    """Say how many cells came from the store, skipped ones left aside."""
    counted_cells = [cell for cell in cells if cell.status != "skipped"]
    n_cells = len(counted_cells)
    n_cached = sum(bool(cell.cached_from) for cell in counted_cells)
    if n_cells and n_cached == n_cells:
        return (
            f"all {counted(n_cells, 'step')} were cached"
            if n_cells > 1
            else ("the only step was cached")
        )
    return f"{n_cached} of {counted(n_cells, 'step')} cached"


def _status(cell: RecordedCell) -> str:
    return "cached" if cell.cached_from else cell.status


def _time(cell: RecordedCell) -> str:
    return duration(cell.wall_s) if cell.status != "skipped" and cell.started else ""


def _remark(cell: RecordedCell) -> str:
    if cell.status == "skipped":
        return cell.error_message
    if cell.status == "failed":
        return "see above"
    return counted(len(cell.warnings), "warning") if cell.warnings else ""
