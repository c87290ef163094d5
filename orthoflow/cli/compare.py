"""`orthoflow compare`: compare two runs."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from orthoflow.cli.commands import RecordCommand, code_for, json_option, store_option
from orthoflow.cli.tables import (
    ROWS_MOST,
    counted,
    echo,
    echo_distances,
    echo_json,
    echo_left_out,
    echo_table,
)

if TYPE_CHECKING:
    from orthoflow.records.compare import Pair, RunComparison

# The JSON output contains these fields of both records.
_OF_RUNS: Final = ("run_id", "name", "created_by", "status", "started", "ended", "seed")


@click.command(cls=RecordCommand)
@click.argument("first", metavar="A", type=click.Path(path_type=Path))
@click.argument("second", metavar="B", type=click.Path(path_type=Path))
@store_option
@click.option("--all", "is_whole", is_flag=True, help="Print every row of long tables.")
@json_option
def compare(first: Path, second: Path, store: Path, *, is_whole: bool, as_json: bool) -> int:
    """Compare the runs A and B, run folders or their run.h5.

    Shows differences in inputs, workflows, parameters, versions and environments, and how far
    metrics and products differ. Steps are paired by address, or else by the methods and parameters
    of all varied steps upstream. Rounding differences (up to a millionth) are omitted, and
    identical differences of several steps or repeats share a row; --json contains all values,
    including times and memory. The exit code is 3 if the seal of a record is broken; `orthoflow
    verify` also checks large arrays, which are not read here if their digests are the same.
    """
    from orthoflow.engine.store import stores_at
    from orthoflow.records.compare import compare_runs
    from orthoflow.records.open import open_run
    from orthoflow.records.verify import broken_seal

    runs = (open_run(first), open_run(second))
    comparison = compare_runs(*runs, stores=stores_at(store))
    if as_json:
        echo_json(_as_json(comparison))
    else:
        _print(comparison, most=None if is_whole else ROWS_MOST)
    return code_for(map(broken_seal, runs), "do not rely on this output")


def _as_json(comparison: RunComparison) -> dict[str, object]:
    return {
        "runs": [
            {name: getattr(record, name) for name in _OF_RUNS}
            for record in (comparison.left, comparison.right)
        ],
        "workflow": list(comparison.workflow),
        "overrides": _row_json(comparison.overrides),
        **{
            name: [_row_json(row) for row in getattr(comparison, name)]
            for name in ("inputs", "cells", "parameters", "environment", "metrics")
        },
        "readdressed": dict(comparison.readdressed),
        "products": [dataclasses.asdict(distance) for distance in comparison.products],
    }


# The values of rows may have any type.
def _row_json(row: Pair[Any]) -> dict[str, object]:
    return {**dataclasses.asdict(row), "same": row.is_same}


def _print(comparison: RunComparison, *, most: int | None) -> None:
    from orthoflow.report.differences import differences

    for mark, record in (("A", comparison.left), ("B", comparison.right)):
        echo(
            f"{mark}: {record.name}, run {record.run_id}, {record.created_by}, {record.started}, "
            f"seed {record.seed}, {counted(len(record.cells), 'step')}"
        )
    for theirs, ours in comparison.readdressed.items():
        echo(f"paired although the addresses differ: {ours} (A) and {theirs} (B)")
    if comparison.workflow:
        echo("", "workflow, A (-) against B (+)", *comparison.workflow[2:])
    for table in differences(comparison):
        alone = f", {table.n_alone} in only one run" if table.n_alone else ""
        counts = f"{table.n_different} of {table.n_compared} differ{alone}"
        echo("", f"{table.title}: {counts if table.rows else 'the same'}{table.whose}")
        rows = [
            (".".join(filter(None, (row.cell, row.name))), row.left, row.right, row.change)
            for row in table.rows
        ]
        echo_table(("", "A", "B", "B - A"), rows[:most])
        echo_left_out(len(rows), most)
    echo("", "products")
    echo_distances(comparison.products, most)
