"""`orthoflow compare`: compare two runs."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

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
    first_rows,
    number,
    verify_hint,
)
from orthoflow.untrusted_text import first_few

if TYPE_CHECKING:
    from orthoflow.records import RecordedFile
    from orthoflow.records.compare import (
        CellFacts,
        ComparedMetric,
        Pair,
        ParameterValue,
        RunComparison,
    )
    from orthoflow.report.differences import RowGroup

Value = TypeVar("Value")
_NOTHING: Final = "-"
_READDRESSED_MOST: Final = 3
# Fields of each run in JSON.
_OF_RUNS: Final = ("run_id", "name", "created_by", "status", "started", "ended", "seed")


@click.command(cls=RecordCommand)
@click.argument("first", metavar="A", type=click.Path(path_type=Path))
@click.argument("second", metavar="B", type=click.Path(path_type=Path))
@store_option
@click.option("--all", "is_whole", is_flag=True, help="Print every difference, including rounding.")
@json_option
def compare(first: Path, second: Path, store: Path, *, is_whole: bool, as_json: bool) -> int:
    """Compare the runs A and B, run folders or their run.h5.

    Shows differences in inputs, workflows, parameters, versions and environments, and how far
    metrics and products differ. An asterisk marks a parameter that was set; the others are
    defaults. Steps are paired by address, or else by the methods and parameters of all varied steps
    before them; steps of one run only are counted separately. Long tables are truncated, and tables
    of metrics show those that measure quality; differences by rounding (a millionth) are omitted,
    and identical differences of several steps or repeats share a row. --json also contains values
    without differences. The exit code is 3 if the seal of a record is broken; `orthoflow verify`
    also checks large arrays, which are not read here if their digests are the same.
    """
    from orthoflow.engine.store import stores_at
    from orthoflow.records.compare import compare_runs
    from orthoflow.records.open import open_run
    from orthoflow.records.verify import broken_seal

    runs = (open_run(first), open_run(second))
    comparison = compare_runs(*runs, stores=stores_at(store))
    if as_json:
        echo_json(comparison_json(comparison))
    else:
        _print(comparison, most=None if is_whole else ROWS_MOST)
        echo("", verify_hint(first, second))
    return code_for(map(broken_seal, runs), "do not rely on this output")


def comparison_json(comparison: RunComparison) -> dict[str, object]:
    """Return a comparison as JSON; every row contains whether both values are the same."""
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


# Any: rows of all kinds.
def _row_json(row: Pair[Any]) -> dict[str, object]:
    return {**dataclasses.asdict(row), "same": row.is_same}


def _print(comparison: RunComparison, *, most: int | None = None) -> None:
    for mark, record in (("A", comparison.left), ("B", comparison.right)):
        echo(
            f"{mark}: {record.name}, run {record.run_id}, {record.created_by}, {record.started}, "
            f"seed {record.seed}, {counted(len(record.cells), 'step')}"
        )
    step_of = comparison.step_of
    if comparison.inputs:
        _print_pairs("inputs", comparison.inputs, _files_text, most)
    else:
        echo("", "inputs: none in either run")
    if comparison.workflow:
        echo("", "workflow, A (-) against B (+)")
        for line in comparison.workflow[2:]:
            echo(line)
    else:
        echo("", "workflow: the texts are the same")
    _print_pairs("options", [comparison.overrides], " ".join, most)
    steps = [_differing_parts(pair) for pair in comparison.cells]
    _print_pairs("steps", steps, str, most, step_of)
    if comparison.readdressed:
        pairs = [f"{ours} (A) and {theirs} (B)" for theirs, ours in comparison.readdressed.items()]
        named = first_few(pairs, len(pairs) if most is None else _READDRESSED_MOST)
        echo(f"paired although the addresses differ: {named}")
    _print_pairs(
        "parameters (* set, others default)",
        comparison.shared(comparison.parameters),
        _parameter_text,
        most,
        step_of,
        comparison.of_shared_steps,
    )
    _print_pairs("environment", comparison.environment, str, most)
    _print_metrics(comparison, most)
    echo("", "products")
    echo_distances(comparison.products, most)


def _print_pairs(
    title: str,
    rows: Sequence[Pair[Value]],
    text: Callable[[Value], str],
    most: int | None,
    step_of: Mapping[str, str] | None = None,
    whose: str = "",
) -> None:
    """Print the rows that differ under a title, or that none differs; rows of both runs first.

    Args:
        title: name of the kind of values.
        rows: all rows.
        text: formats the value of one run.
        most: maximum number of rows to print, with identical differences of a step grouped; None
            for all.
        step_of: step of each cell.
        whose: steps to which the rows are restricted; empty for all.
    """
    from orthoflow.report.differences import RowGroup, grouped_rows

    different = [row for row in rows if not row.is_same]
    if not different:
        echo("", f"{title}: same{whose}")
        return
    echo("", f"{title}: {_counts(rows)}{whose}")
    kept = (
        [RowGroup(pair=row, n=1) for row in different]
        if most is None
        else grouped_rows(different, text, step_of or {})
    )
    echo_table(
        ("", "A", "B"),
        [
            (
                one.label(step_of or {}),
                *(
                    _NOTHING if side is None else text(side)
                    for side in (one.pair.left, one.pair.right)
                ),
            )
            for one in first_rows(kept, most, lambda one: not one.pair.is_shared)
        ],
    )
    echo_left_out(len(kept), most)


# Any: rows of all kinds.
def _counts(rows: Sequence[Pair[Any]]) -> str:
    """Return in how many rows the runs differ, and in how many of these by rounding only."""
    from orthoflow.records.compare import Difference

    found = Difference.of(rows)
    counts = [f"{found.n_different} of {found.n_shared} differ"] if found.n_shared else []
    alone = ((found.n_left, "only in A"), (found.n_right, "only in B"))
    counts += [f"{n} {where}" for n, where in alone if n]
    if found.n_rounded:
        counts.append(f"{found.n_rounded} more differ by less than a millionth")
    return ", ".join(counts) or "none"


def _differing_parts(pair: Pair[CellFacts]) -> Pair[str]:
    """Describe how a step differs; a step of one run only by its status and method."""
    left, right = pair.left, pair.right
    sides: list[str | None] = []
    for ours, theirs in ((left, right), (right, left)):
        if ours is None:
            sides.append(None)
        elif theirs is None:
            sides.append(", ".join(ours.parts[:2]))
        else:
            own = [part for part in ours.parts if part not in theirs.parts]
            is_alone = pair.is_same or ours.determinism != theirs.determinism
            sides.append(", ".join(own or [ours.determinism if is_alone else _NOTHING]))
    return dataclasses.replace(pair, left=sides[0], right=sides[1])  # type: ignore[arg-type,return-value]


def _files_text(files: Sequence[RecordedFile]) -> str:
    return first_few([f"{file.name} {file.sha256[:12]}" for file in files]) or "not given"


def _parameter_text(parameter: ParameterValue) -> str:
    value = parameter.value
    text = number(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)
    return f"{text}*" if parameter.is_set else text


def _print_metrics(comparison: RunComparison, most: int | None) -> None:
    """Print metrics that differ by more than rounding; times and memory separately at the end."""
    from orthoflow.report.differences import RowGroup, grouped_rows, moved_first

    measured, step_of = comparison.measured, comparison.step_of
    echo("", f"metrics: {_counts(measured)}{comparison.of_shared_steps}")
    different = moved_first([row for row in measured if not row.is_same], step_of)
    if most is None:
        _print_numbers([RowGroup(pair=row, n=1) for row in different], step_of)
    else:
        moved = [row for row in different if row.is_moved]
        kept = grouped_rows(moved, lambda side: f"{side.value} {side.unit}", step_of)
        _print_numbers(kept[:most], step_of)
        echo_left_out(len(kept), most)
    costs = [row for row in comparison.shared(comparison.metrics) if row.either.is_cost]
    different = [row for row in costs if not row.is_same]
    echo("", f"times and memory: {_counts(costs)}")
    _print_numbers([RowGroup(pair=row, n=1) for row in different[:most]], step_of)
    echo_left_out(len(different), most)


def _print_numbers(rows: Sequence[RowGroup[ComparedMetric]], step_of: Mapping[str, str]) -> None:
    echo_table(
        ("metric", "A", "B", "B - A", "unit"),
        [
            (
                one.label(step_of),
                *(
                    _NOTHING if side is None else number(side.value)
                    for side in (one.pair.left, one.pair.right)
                ),
                ""
                if one.pair.left is None or one.pair.right is None
                else number(one.pair.right.value - one.pair.left.value),
                one.pair.either.unit,
            )
            for one in rows
        ],
    )
