"""`orthoflow runs`: a table of the runs in and below given folders."""

from __future__ import annotations

import dataclasses
import json
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from orthoflow.cli.commands import EXIT_GOOD, Command, json_option
from orthoflow.cli.tables import counted, echo, echo_json, echo_table
from orthoflow.untrusted_text import csv_text, first_few

if TYPE_CHECKING:
    from orthoflow.cli.browsing import RunSummary

_COLUMNS: Final = ("folder", "started", "workflow", "status")
# Maximum number of metrics, which fit next to the other columns on a wide terminal.
_METRICS_MOST: Final = 4
_LONGEST_FACT: Final = 40
_FACTS_MOST: Final = 4
_CONDITION: Final = re.compile(
    r"\s*(.+?)\s*(<=|>=|!=|=|<|>)\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*"
)
_SIGNS: Final[Mapping[str, Callable[[float, float], bool]]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "=": operator.eq,
    "!=": operator.ne,
}


@click.command(cls=Command)
@click.argument("folders", metavar="[FOLDER ...]", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--where",
    metavar="'METRIC > X'",
    multiple=True,
    help="List only runs that meet a condition (< <= > >= = !=) on a metric, step.metric or "
    "parameter; in runs with variants, datasets or sweeps, at least one value must meet the "
    "condition.",
)
@click.option(
    "--sort",
    metavar="COLUMN",
    default="started",
    show_default=True,
    help="Sort by folder, started, workflow, status, or a metric; -COLUMN for descending order.",
)
@click.option(
    "--table",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write a CSV table of the cells and metrics of the given runs; a cell in several runs "
    "occurs once.",
)
@json_option
def runs(
    folders: tuple[Path, ...],
    where: tuple[str, ...],
    sort: str,
    table: Path | None,
    *,
    as_json: bool,
) -> int:
    """List the runs in and below each FOLDER, by default the working directory.

    A row shows when and with which workflow a run was made, its outcome, the quality of its
    baseline (mean over repeats, median over datasets), and the parameters and inputs in which it
    differs from other runs of the workflow. Results of `export --split` inside a run are listed
    only if their folder is given. For runs without a record, and for unreadable records, the reason
    is shown. --table FILE merges the given runs, or those in the given folders, into one table with
    a row per cell and metric; cells with the same methods, parameters, seeds and data in several
    runs are merged, and `environments` is the number of environments in which they were computed.
    """
    if table is not None:
        return _write_table(folders, table)
    found = list_runs(folders or (Path(),))
    kept = _sorted(_filtered(found, where), sort)
    if as_json:
        echo_json(runs_json(kept, found))
    else:
        print_runs(kept, found)
    return EXIT_GOOD


def _write_table(folders: Sequence[Path], table: Path) -> int:
    from orthoflow.cli.browsing import run_folders
    from orthoflow.engine.durability import write_whole, writing_to
    from orthoflow.engine.journal import RECORD_FILE
    from orthoflow.errors import ArgumentError
    from orthoflow.records.open import open_run
    from orthoflow.records.tables import join_runs

    if not table.absolute().parent.is_dir():
        raise ArgumentError(f"{table.parent} does not exist: create the folder or choose another")
    places: dict[Path, None] = {}
    for folder in folders or (Path(),):
        below = run_folders([folder]) if folder.is_dir() else [folder]
        places |= dict.fromkeys(
            place for place in below if place.is_file() or (place / RECORD_FILE).is_file()
        )
    joined = join_runs([open_run(place) for place in places])
    with writing_to(table):
        write_whole(table, csv_text(joined.rows()).encode("utf-8", "backslashreplace"))
    n_shared = sum(len(one.found) > 1 for one in joined.cells)
    shared = f", {n_shared} of them in several runs" if n_shared else ""
    echo(
        f"{counted(len(joined.runs), 'run')}, {counted(len(joined.cells), 'cell')}{shared}: {table}"
    )
    return EXIT_GOOD


def list_runs(folders: Sequence[Path]) -> list[RunSummary]:
    """Summarise all runs in and below the given folders, oldest first."""
    from orthoflow.cli.progress import working_on

    with working_on("reading the records"):
        from orthoflow.cli.browsing import run_folders, summaries

        return _sorted(list(summaries(run_folders(folders))), "started")


def runs_json(kept: Sequence[RunSummary], found: Sequence[RunSummary]) -> list[dict[str, object]]:
    """Return runs as JSON, including all metrics, facts and differences from other runs."""
    from orthoflow.cli.browsing import differing_facts

    differs = differing_facts(found)
    return [_row_json(run, run.all_facts, differs[run.folder]) for run in kept]


def print_runs(kept: Sequence[RunSummary], found: Sequence[RunSummary]) -> None:
    """Print a table of runs, and their problems."""
    from orthoflow.cli.browsing import differing_facts, key_metrics
    from orthoflow.report.rankings import number

    names = key_metrics(kept, most=_METRICS_MOST)
    facts = differing_facts(found)
    echo_table(
        (*_COLUMNS, *names, "differs in"),
        [
            (
                str(run.folder),
                run.started[:16].replace("T", " "),
                run.workflow,
                run.status + (f", {counted(run.n_errors, 'error')}" if run.n_errors else ""),
                *(number(run.metrics[name]) if name in run.metrics else "" for name in names),
                _facts_text(facts[run.folder]),
            )
            for run in kept
        ],
    )
    for run in kept:
        if run.reason:
            echo(f"{run.folder} {run.status}: {run.reason}")
    n_left_out = len(found) - len(kept)
    others = f", {counted(n_left_out, 'other')} omitted" if n_left_out else ""
    echo(f"{counted(len(kept), 'run')}{others}")


def _condition(text: str) -> tuple[str, Callable[[float], bool]]:
    match = _CONDITION.fullmatch(text)
    if match is None:
        raise click.UsageError(
            f"--where {text!r} is not a condition: expected a name, one of "
            f"{' '.join(_SIGNS)} and a number, e.g. --where 'rmse_u_mm < 2'"
        )
    holds, limit = _SIGNS[match[2]], float(match[3])
    return match[1], lambda value: holds(value, limit)


def _filtered(found: Sequence[RunSummary], where: Sequence[str]) -> list[RunSummary]:
    conditions = [_condition(text) for text in where]
    _require_known([name for name, _ in conditions], found)

    def meets(run: RunSummary, name: str, holds: Callable[[float], bool]) -> bool:
        return any(
            holds(float(value))
            for value in run.values(name)
            if isinstance(value, int | float) and not isinstance(value, bool)
        )

    return [run for run in found if all(meets(run, *condition) for condition in conditions)]


def _sorted(kept: Sequence[RunSummary], key: str) -> list[RunSummary]:
    """Sort runs by a column or metric; runs without the metric come last in both directions."""
    name = key.removeprefix("-")
    if name in _COLUMNS:
        text = operator.attrgetter(name)
        return sorted(kept, key=lambda run: (str(text(run)), str(run.folder)), reverse=key != name)
    _require_known([name], kept)
    sign = -1.0 if key != name else 1.0
    return sorted(
        kept, key=lambda run: (name not in run.metrics, sign * run.metrics.get(name, 0.0))
    )


def _require_known(names: Sequence[str], found: Sequence[RunSummary]) -> None:
    known = {name for run in found for name in run.names}
    if not known:
        return
    for name in names:
        if name not in known:
            from orthoflow.errors import nearest

            # Users often enter only the last part of a name, without the step.
            ends = sorted(one for one in known if one.endswith(f".{name}"))
            near = ends[0] if ends else nearest(name, known)
            hint = f"did you mean {near!r}?" if near else "--json lists all names"
            raise click.UsageError(f"no run has a metric or parameter {name!r}; {hint}")


def _facts_text(facts: Mapping[str, object]) -> str:
    parts = []
    for name, value in facts.items():
        text = json.dumps(value, ensure_ascii=False)
        if isinstance(value, str | list):
            text = value if isinstance(value, str) else ", ".join(map(str, value))
        parts.append(f"{name}={text[:_LONGEST_FACT]}")
    return first_few(parts, most=_FACTS_MOST)


def _row_json(
    run: RunSummary, facts: Mapping[str, object], differs: Mapping[str, object]
) -> dict[str, object]:
    values = dataclasses.asdict(run) | {"folder": str(run.folder)}
    del values["parameters"]
    return values | {"facts": dict(facts), "differs": dict(differs)}
