"""`orthoflow show`: summarise a finished run."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from orthoflow.cli.commands import EXIT_GOOD, RecordCommand, code_for, json_option
from orthoflow.cli.runs import list_runs, print_runs, runs_json
from orthoflow.cli.tables import (
    ROWS_MOST,
    counted,
    duration,
    echo,
    echo_diagnostics,
    echo_json,
    echo_left_out,
    echo_table,
    first_rows,
    number,
    size,
)
from orthoflow.workflow.model import DATA

if TYPE_CHECKING:
    from orthoflow.records import RecordedCell
    from orthoflow.records.runs import Run

# Maximum number of columns for metrics, which fit in a wide window.
_COLUMNS_MOST: Final = 5
_NOTHING: Final = "-"
_COST_UNITS: Final = ("s", "MiB")


@click.command(cls=RecordCommand)
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option("--all", "is_whole", is_flag=True, help="Print every metric, warning and note.")
@json_option
def show(run: Path, *, is_whole: bool, as_json: bool) -> int:
    """Summarise RUN, a run folder or its run.h5: inputs, steps, metrics, warnings, environment.

    If there are many metrics, only those that measure quality are printed; --all prints all of
    them. With variants, there is a row per combination; with several datasets, its values are
    medians over the datasets. For a folder that contains runs, the table of `orthoflow runs` is
    printed. The exit code is 3 if the seal of the record is broken; `orthoflow verify` also checks
    large arrays, which are not read here.
    """
    from orthoflow.engine.journal import RECORD_FILE
    from orthoflow.records.open import open_run
    from orthoflow.records.verify import broken_seal

    if run.is_dir() and not (run / RECORD_FILE).exists():
        found = list_runs([run])
        if any(one.folder != run for one in found):
            if as_json:
                echo_json(runs_json(found, found))
            else:
                print_runs(found, found)
            return EXIT_GOOD
    opened = open_run(run)
    if as_json:
        echo_json(_as_json(opened))
    else:
        _print_head(opened)
        _print_cells(opened, is_whole=is_whole)
        most = None if is_whole else ROWS_MOST
        is_compared = _print_comparison(opened, most)
        if is_whole or not is_compared:
            _print_metrics(opened, most=most)
        _print_environments(opened)
        _print_files(opened)
    return code_for([broken_seal(opened)], "do not rely on this output")


def _print_head(run: Run) -> None:
    record = run.record
    counts = Counter(cell.status for cell in record.cells)
    states = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    n_steps = counted(len(record.cells), "step")
    echo(f"{record.name}, run {record.run_id}: {n_steps}, {states}")
    echo(f"{record.started} to {record.ended}, {record.created_by}, seed {record.seed}")
    if record.overrides:
        echo(f"overrides: {' '.join(record.overrides)}")
    for entry in record.inputs:
        if not entry.files:
            echo(f"input {entry.name}: not given")
        for file in entry.files:
            echo(
                f"input {entry.name}: {file.name}, {size(file.size_bytes)}, "
                f"sha256 {file.sha256[:12]}{', in the record' if entry.embedded else ''}"
            )


def _print_cells(run: Run, *, is_whole: bool) -> None:
    echo()
    echo_table(
        ("step", "method", "status", "time", "memory"),
        [
            (
                cell.address,
                f"{cell.method} {cell.distribution_version}".rstrip(),
                f"{cell.status} (cached from {cell.cached_from})"
                if cell.cached_from
                else cell.status,
                duration(cell.wall_s) if cell.started else "",
                f"{cell.peak_rss_mib:.0f} MiB" if cell.started else "",
            )
            for cell in run.record.cells
        ],
    )
    for cell in run.record.cells:
        if cell.error_message:
            echo(f"{cell.address} {cell.status}: {cell.error_message}")
    echo_diagnostics(run.record.cells, run.home_folder, is_whole=is_whole)


def _print_comparison(run: Run, most: int | None) -> bool:
    if all(set(cell.assignment) <= {DATA} for cell in run.record.cells):
        return False
    from orthoflow.records.runs import parts_of
    from orthoflow.report.comparisons import comparison_table
    from orthoflow.report.paired import over_datasets, over_table, who_leads

    parts = parts_of(run)
    if over := over_datasets(parts):
        table = over_table(over)
        texts = [
            {
                column.name: table.text(value, column)
                for column, value in zip(table.columns, row, strict=True)
            }
            for row in table.rows
        ]
        units = {"1": "", "yes/no": "share of yes"}
        rows = [
            (
                f"{text['step']}.{text['metric']}",
                units.get(text["unit"], text["unit"]),
                *(text[name] for name in ("better", "combination", "median", "spread", "datasets")),
            )
            for text in texts
        ]
        echo()
        head = ("metric", "unit", "better", "combination", "median", "±", "datasets")
        echo_table(head, rows[:most])
        echo_left_out(len(rows), most)
        echo("±: 1.4826 times the median absolute deviation over the datasets")
        for metric in over:
            if metric.lead:
                echo(f"{metric.column.step}: {metric.column.titled}: {metric.lead}")
        echo(who_leads(over, len(parts)))
        return True
    compared = comparison_table([run])
    names = [f"{one.step}.{one.metric}" for one in compared.columns if one.step] if compared else []
    if compared is None or not names:
        return False
    width = 1 + _COLUMNS_MOST
    echo()
    echo_table(
        ("combination", *names)[:width],
        [
            (row.name, *(value.text or _NOTHING for value in row.values[: len(names)]))[:width]
            for row in compared.rows
        ],
    )
    has_repeats = any(cell.repeat for cell in run.record.cells)
    means = "means over repeats ± standard deviation; " if has_repeats else ""
    echo(f"{means}--all prints all metrics")
    return True


def _print_metrics(run: Run, *, most: int | None = None) -> None:
    metrics = [(cell, metric) for cell in run.record.cells for metric in cell.metrics]
    steps = list(dict.fromkeys(cell.step for cell in run.record.cells))
    rows = [
        (cell.address, metric.name, number(metric.value), metric.unit if metric.unit != "1" else "")
        for cell, metric in first_rows(
            metrics,
            most,
            # Headline metrics come first, then other ranked metrics, and then the rest; times and
            # memory come last. Later steps come before earlier ones.
            lambda one: (
                one[1].unit in _COST_UNITS,
                not one[1].headline,
                not one[1].better,
                -steps.index(one[0].step),
            ),
        )
    ]
    if rows:
        echo()
        echo_table(("step", "metric", "value", "unit"), rows)
        echo_left_out(len(metrics), most)


def _print_environments(run: Run) -> None:
    for environment in run.record.environments:
        commit = f", commit {environment.git_commit}" if environment.git_commit else ""
        echo(
            "",
            f"environment: Python {environment.python}, {environment.os}, {environment.cpu}, "
            f"{counted(environment.cores, 'core')}, {counted(environment.threads, 'thread')}"
            f"{commit}",
        )
        echo(f"{counted(len(environment.packages), 'package')}, listed by --json")


def _print_files(run: Run) -> None:
    from orthoflow.records.walls import delivered_walls

    if not run.is_finished:
        echo("", f"the run in {run.home_folder} has not ended: its products are not published yet")
        return
    published = run.record.published
    n_files = sum((run.folder / file.path).exists() for file in published)
    where = f"{run.products_folder}, {n_files} of {counted(len(published), 'published file')}"
    echo("", f"products: {where}")
    about = {wall.orthoimage: wall.sentence for wall in delivered_walls(run.products_folder)}
    for image in run.orthoimages:
        sentence = about.get(image.relative_to(run.products_folder).as_posix())
        echo(f"orthoimage: {image}" + (f" ({sentence})" if sentence else ""))


def _as_json(run: Run) -> dict[str, object]:
    from orthoflow.records.tables import diagnostics_of

    record = run.record
    values = dataclasses.asdict(dataclasses.replace(record, cells=()))
    values["diagnostics"] = [
        one for cell in record.cells for one in diagnostics_of(cell, cell.step, cell.address)
    ]
    values["cells"] = [_cell_json(cell) for cell in record.cells]
    values["files"] = [str(file) for group in run.files.values() for file in group]
    return values


def _cell_json(cell: RecordedCell) -> dict[str, object]:
    values = dataclasses.asdict(dataclasses.replace(cell, figures=()))
    # Omit the content of figures, which is in the record and the report.
    values["figures"] = [
        {"name": figure.name, "caption": figure.caption, "media_type": figure.media_type}
        for figure in cell.figures
    ]
    return values
