"""Summaries on the page: headline metrics, limitations, results and citations."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Final

from orthoflow.diagnostics import DiagnosticGroup, grouped, standing
from orthoflow.products import Cameras, Walls
from orthoflow.records import RecordedCell
from orthoflow.records.runs import Run, cell_metrics
from orthoflow.report.combinations import (
    baseline_cells,
    baseline_metrics,
    combinations_of,
    gives,
    improved_on,
    is_check,
    unequal_walls,
)
from orthoflow.report.rankings import is_flag, number, number_with_unit
from orthoflow.workflow.expand import NOT_ASKED_FOR

_MOST_ANSWERS: Final = 12
_IMAGE: Final = re.compile(r"/wall_(\d+)_ortho\.tif$")
_PLACE: Final = re.compile(r"(.*\S) \(([^()]+)\)")
_PLANE: Final = re.compile(r"\b(?:wall|floor|ceiling) (\d+)")


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A headline metric, with its label, formatted value, cell and remark."""

    what: str
    value: str
    cell: str
    remark: str = ""


@dataclass(frozen=True, kw_only=True)
class Limit:
    """A sentence on a limitation of the results, the cells concerned, and whether they failed."""

    text: str
    cells: tuple[str, ...]
    is_failure: bool = False


def headline_keys(cells: Iterable[RecordedCell]) -> list[tuple[str, str]]:
    """Return step and name of each headline metric that the methods declare.

    Steps that check results come first, followed by the other steps in reverse order. Within a
    step, metrics keep the order in which the method reports them. If several steps report the same
    metric, only the last step is used, because it refines the results of the others; this does not
    apply to steps that check results.
    """
    checks: dict[str, dict[str, None]] = {}
    others: dict[str, dict[str, None]] = {}
    for cell in cells:
        steps = checks if is_check(cell) else others
        for row in cell_metrics(cell):
            if row.headline:
                steps.setdefault(row.step, {})[row.metric] = None
    found = [(step, metric) for step, metrics in checks.items() for metric in metrics]
    taken: set[str] = set()
    for step, metrics in reversed(others.items()):
        found += [(step, metric) for metric in metrics if metric not in taken]
        taken |= metrics.keys()
    return found


def answers(run: Run) -> tuple[Answer, ...]:
    """Return the headline metrics of the baseline."""
    rows = {(row.step, row.metric): row for row in baseline_metrics(run)}
    chosen = [rows[key] for key in headline_keys(baseline_cells(run)) if key in rows]
    repeated = {cell.step for cell in run.record.cells if cell.repeat}
    found = []
    # Yes/no metrics come first if the answer is no; otherwise, they are omitted.
    for row in sorted(chosen, key=lambda row: not is_flag(row.unit)):
        if is_flag(row.unit) and row.value == 1.0:
            continue
        count = rows.get((row.step, row.counted_by))
        counted = f"{count.title}: {number(count.value)}" if count else ""
        mean = "mean over the repeats" if row.step in repeated else ""
        found.append(
            Answer(
                what=row.title,
                value=number_with_unit(row.value, row.unit, significant=3),
                cell=row.cell,
                remark="; ".join(filter(None, (row.description, counted, mean))),
            )
        )
    return tuple(found[:_MOST_ANSWERS])


def has_measured_lengths(run: Run) -> bool:
    """Return whether the baseline contains a check with results in millimetres."""
    return any(
        metric.unit == "mm"
        for cell in baseline_cells(run)
        if is_check(cell)
        for metric in cell.metrics
    )


def limits(run: Run) -> tuple[Limit, ...]:
    """Return the limitations of the results: failures, unequal walls and diagnostics.

    Diagnostics that a later step resolved are omitted. The remaining ones are grouped by code,
    errors first; diagnostics that concern only planes without an orthoimage come last.
    """
    failures: dict[str, list[str]] = {}
    for cell in run.record.cells:
        if cell.status == "failed":
            failures.setdefault(cell.error_message, []).append(cell.address)
    first = {cell.address for cell in baseline_cells(run)}
    by_baseline = sorted(run.record.cells, key=lambda cell: cell.address not in first)
    imaged = {
        found[1] for file in run.record.published if (found := _IMAGE.search(file.path)) is not None
    }
    # A later orientation reports which photos are not oriented, so the diagnostics of earlier
    # orientations are omitted.
    oriented = [
        cell.address
        for cell in by_baseline
        if cell.status == "ok" and gives(cell, Cameras.type_name)
    ]
    settled = improved_on(run, oriented)
    groups = sorted(
        grouped(
            (address, one)
            for address, one in standing(by_baseline)
            if address not in settled and one.severity != "note"
        ),
        key=lambda group: (
            group.worst.severity != "error",
            _is_of_others_than(imaged, group),
        ),
    )
    apart = unequal_walls(combinations_of(run))
    rastered = tuple(one.address for one in by_baseline if gives(one, Walls.type_name))
    return (
        *(Limit(text=why, cells=tuple(where), is_failure=True) for why, where in failures.items()),
        *([Limit(text=apart, cells=rastered)] if apart else []),
        *(Limit(text=group.sentence, cells=group.places) for group in groups),
    )


def _is_of_others_than(numbers: Collection[str], group: DiagnosticGroup) -> bool:
    """Return whether diagnostics concern planes, but none of those with the given numbers.

    The result is False if no numbers are given.
    """
    about = (_PLANE.fullmatch(subject) for subject in (group.worst.subject, *group.subjects))
    named = [plane[1] for plane in about if plane]
    return bool(numbers and named) and not any(number in numbers for number in named)


def results(run: Run) -> dict[str, tuple[str, ...]]:
    """Return result -> cell addresses; the results are ok, failed, skipped and not asked for."""
    found: dict[str, tuple[str, ...]] = {"ok": (), "failed": (), "skipped": (), "not asked for": ()}
    for cell in run.record.cells:
        which = "not asked for" if cell.error_type == NOT_ASKED_FOR else cell.status
        found[which] = (*found[which], cell.address)
    return found


def citations(run: Run) -> dict[str, tuple[str, ...]]:
    """Return citation -> methods that cite it, each with the part of the source that it uses."""
    found: dict[str, dict[str, None]] = {}
    for cell in run.record.cells:
        if cell.status != "skipped":
            for citation in cell.citations:
                # Separate the cited section, as in `..., doi:... (4.4, Table 2)`, so that each
                # publication has one entry.
                placed = _PLACE.fullmatch(citation)
                text, place = placed.groups() if placed else (citation, "")
                method = f"{cell.method}: {place}" if place else cell.method
                found.setdefault(text, {})[method] = None
    return {citation: tuple(methods) for citation, methods in found.items()}
