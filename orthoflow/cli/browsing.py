"""Summaries of the runs in and below given folders."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np

from orthoflow.diagnostics import grouped, standing
from orthoflow.engine.journal import JOURNAL, RECORD_FILE, is_running
from orthoflow.errors import ArgumentError, OrthoflowError
from orthoflow.products import JsonValue
from orthoflow.records import RecordedCell
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run, parts_of
from orthoflow.records.verify import broken_seal
from orthoflow.report.combinations import baseline_cells, baseline_metrics
from orthoflow.report.rankings import FLAG, is_flag, middle_of
from orthoflow.report.summaries import headline_keys
from orthoflow.untrusted_text import open_file, parse_json

RunState: TypeAlias = Literal["ok", "failed", "running", "unfinished", "damaged"]

# Folders deeper than this are not searched, because run folders are in `runs/` or a few levels
# below it.
_DEEPEST: Final = 6
# These folders contain no runs, and searching them would take time.
_NO_RUNS: Final = frozenset({"products", "logs", "pages", "node_modules", "__pycache__"})
# These subfolders of a run folder contain exports of the same run.
_OF_A_RUN: Final = frozenset({"datasets", "export"})
_FIRST_LINE_BYTES: Final = 1 << 16


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """Summary of a run: a row in a table of runs.

    Attributes:
        folder: path of the run folder; relative if the user gave a relative path.
        status: `ok`; `failed` if a cell failed; `running` if the run is in progress; `unfinished`
            if it was interrupted; `damaged` if the record cannot be read or its seal is broken.
        reason: first failure, or the reason why there is no readable record; empty if there is
            none.
        n_errors: number of different error codes in the diagnostics that steps reported.
        workflow: name of the workflow.
        run_id: id of the run.
        started: start of the run, ISO 8601, UTC; empty if unknown.
        metrics: `step.metric` -> value for the baseline, and `metric` -> value for the last step
            that reports the metric, averaged over repeats. For several datasets, the value is the
            median, or the share of "yes" for yes/no metrics.
        n_datasets: number of datasets; 0 if the workflow lists none.
        headlines: names of the headline metrics, most important first.
        facts: name -> property, other than parameters, that may differ between runs: `seed`,
            `orthoflow` (version), `datasets` (number), `step.use` (method of the baseline) and
            `input <name>` (files).
        parameters: `step.parameter` -> values; there are several if variants or datasets differ.
    """

    folder: Path
    status: RunState
    reason: str = ""
    n_errors: int = 0
    workflow: str = ""
    run_id: str = ""
    started: str = ""
    metrics: Mapping[str, float] = field(default_factory=dict)
    n_datasets: int = 0
    headlines: tuple[str, ...] = ()
    facts: Mapping[str, JsonValue] = field(default_factory=dict)
    parameters: Mapping[str, tuple[JsonValue, ...]] = field(default_factory=dict)

    @property
    def names(self) -> frozenset[str]:
        """Names accepted by `values`."""
        return frozenset((*self.metrics, *self.facts, *self.parameters))

    def values(self, name: str) -> tuple[JsonValue, ...]:
        """Return all values of a metric, fact or parameter."""
        for known in (self.metrics, self.facts):
            if name in known:
                return (known[name],)
        return self.parameters.get(name, ())

    @property
    def all_facts(self) -> dict[str, JsonValue]:
        """Facts and parameters; several values of a parameter become text such as `0.02|0.05`."""
        return dict(self.facts) | {
            name: values[0] if len(values) == 1 else "|".join(map(_sorted_json, values))
            for name, values in self.parameters.items()
        }


def run_folders(folders: Sequence[Path]) -> list[Path]:
    """Return the run folders in and below the given folders; links are not followed.

    Raises:
        ArgumentError: a path is not a folder.
    """
    found: dict[Path, None] = {}
    for folder in folders:
        if not folder.is_dir():
            raise ArgumentError(f"{folder} is not a folder: pass folders that contain runs")
        found.update(dict.fromkeys(_below(folder)))
    return list(found)


def summaries(folders: Iterable[Path]) -> Iterator[RunSummary]:
    """Yield a summary of each run folder; its status is `damaged` if it cannot be read."""
    for folder in folders:
        yield _summary(folder)


def differing_facts(runs: Sequence[RunSummary]) -> dict[Path, dict[str, JsonValue]]:
    """Return run folder -> facts that distinguish the run from other runs of its workflow.

    A fact that some runs lack is included only if two of the other runs have different values.
    """
    facts = {run.folder: run.all_facts for run in runs}
    values: dict[tuple[str, str], set[str]] = {}
    for run in runs:
        for name, value in facts[run.folder].items():
            values.setdefault((run.workflow, name), set()).add(_sorted_json(value))
    return {
        run.folder: {
            name: value
            for name, value in facts[run.folder].items()
            if len(values[run.workflow, name]) > 1
        }
        for run in runs
    }


def _sorted_json(value: JsonValue) -> str:
    return json.dumps(value, sort_keys=True)


def key_metrics(runs: Iterable[RunSummary], *, most: int) -> list[str]:
    """Return the names of the most frequent headline metrics of the runs."""
    counts = Counter(name for run in runs for name in run.headlines)
    chosen = sorted(counts, key=lambda name: -counts[name])[:most]
    return [name for name in counts if name in chosen]


def _below(folder: Path) -> Iterator[Path]:
    for place, folders, files in os.walk(folder):
        if RECORD_FILE in files or JOURNAL in files:
            yield Path(place)
            # Search below a run folder only if the user gave this folder, because replays may be
            # there.
            if Path(place) != folder:
                folders.clear()
                continue
            folders[:] = [name for name in folders if name not in _OF_A_RUN]
        depth = len(Path(place).relative_to(folder).parts)
        folders[:] = sorted(
            name
            for name in folders
            if depth < _DEEPEST and name not in _NO_RUNS and not name.startswith(".")
        )


def _summary(folder: Path) -> RunSummary:
    if not (folder / RECORD_FILE).exists():
        return _unfinished(folder)
    try:
        run = open_run(folder)
        if doubt := broken_seal(run):
            return RunSummary(folder=folder, status="damaged", reason=doubt)
        return _of_run(folder, run)
    except Exception as error:  # noqa: BLE001 - a record may contain anything
        unforeseen = f"the record has invalid content: {type(error).__name__}: "
        reason = f"{'' if isinstance(error, OrthoflowError) else unforeseen}{error}"
        return RunSummary(folder=folder, status="damaged", reason=reason)


def _of_run(folder: Path, run: Run) -> RunSummary:
    record = run.record
    failed = next((cell for cell in record.cells if cell.status == "failed"), None)
    facts: dict[str, JsonValue] = {"seed": record.seed, "orthoflow": record.created_by}
    parts = parts_of(run)
    if parts:
        facts["datasets"] = len(parts)
    for given in record.inputs:
        facts[f"input {given.name}"] = [f"{file.name} {file.sha256[:8]}" for file in given.files]
    values: dict[str, list[float]] = {}
    flags: set[str] = set()
    of_parts = [baseline_cells(part) for part in parts.values() or (run,)]
    for part, cells in zip(parts.values() or (run,), of_parts, strict=True):
        facts |= {f"{cell.step}.use": cell.method for cell in cells if cell.status != "skipped"}
        own: dict[str, float] = {}
        for row in baseline_metrics(part):
            # For several datasets, use absolute values, because errors of both signs would cancel.
            is_size = len(parts) > 1 and row.better == "lower"
            for name in (f"{row.step}.{row.metric}", row.metric):
                own[name] = abs(row.value) if is_size else row.value
                flags |= {name} if is_flag(row.unit) else set()
        for name, value in own.items():
            values.setdefault(name, []).append(value)
    return RunSummary(
        folder=folder,
        status=record.status,
        reason="" if failed is None else f"{failed.address}: {failed.error_message}",
        n_errors=sum(group.worst.severity == "error" for group in grouped(standing(record.cells))),
        workflow=record.name,
        run_id=record.run_id,
        started=record.started,
        metrics={
            name: middle_of(np.array(found), FLAG if name in flags else "")
            for name, found in values.items()
        },
        n_datasets=len(parts),
        headlines=tuple(map(".".join, headline_keys(cell for cells in of_parts for cell in cells))),
        facts=facts,
        parameters=_parameters(record.cells),
    )


def _parameters(cells: Iterable[RecordedCell]) -> dict[str, tuple[JsonValue, ...]]:
    found: dict[str, dict[str, JsonValue]] = {}
    for cell in cells:
        if cell.repeat == 0 and cell.status != "skipped":
            for name, value in cell.params.items():
                known = found.setdefault(f"{cell.step}.{name}", {})
                known.setdefault(_sorted_json(value), value)
    return {name: tuple(known.values()) for name, known in found.items()}


def _unfinished(folder: Path) -> RunSummary:
    try:
        with open_file(folder / JOURNAL) as journal:
            first = parse_json(journal.readline(_FIRST_LINE_BYTES).decode("utf-8"))
    except (OSError, ValueError) as error:
        reason = f"it has no {RECORD_FILE}, and its journal cannot be read: {error}"
        return RunSummary(folder=folder, status="damaged", reason=reason)
    stated = first if isinstance(first, dict) else {}
    is_under_way = is_running(folder)
    return RunSummary(
        folder=folder,
        status="running" if is_under_way else "unfinished",
        reason="" if is_under_way else f"resume with the same command and -o {folder}",
        workflow=str(stated.get("workflow", "")),
        run_id=str(stated.get("run_id", "")),
        started=str(stated.get("time", "")),
    )
