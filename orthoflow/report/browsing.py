"""Many runs at a glance: which lie below some folders, what came out, and in what they differ."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np

from orthoflow.engine.journal import JOURNAL, RECORD_FILE, is_running
from orthoflow.errors import ArgumentError, OrthoflowError
from orthoflow.products import JsonValue
from orthoflow.records import RecordedCell
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run, cell_metrics, parts_of
from orthoflow.records.verify import broken_seal
from orthoflow.report.combinations import baseline_cells
from orthoflow.report.paired import middle_of
from orthoflow.report.rankings import FLAG, is_flag
from orthoflow.report.summaries import headline_keys
from orthoflow.untrusted_text import open_file, parse_json

RunState: TypeAlias = Literal["ok", "failed", "running", "unfinished", "damaged"]

# Runs lie in runs/, sorted into folders at most; deeper lies something else.
_DEEPEST: Final = 6
# Folders of a run, and of what is no run: to look into them costs time and finds nothing.
_NO_RUNS: Final = frozenset({"products", "logs", "pages", "node_modules", "__pycache__"})
# In the folder of a run: parts of it, and what was exported.
_OF_A_RUN: Final = frozenset({"datasets", "export"})
_FIRST_LINE_BYTES: Final = 1 << 16


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """A row of a table of runs.

    Attributes:
        folder: of the run, as its finder named it.
        state: `ok`; `failed`, some cell did; `running`, just now; `unfinished`, it was interrupted;
            `damaged`, the record cannot be read, or its seal does not hold.
        reason: what failed, first, or why it cannot be read; empty where all is well.
        workflow: name of the workflow.
        run_id: of the run.
        started: ISO 8601 UTC; empty if unknown.
        metrics: numbers of the baseline by `step.metric`, and by `metric` alone as the last step
            has it; of several datasets the median, of what is yes or no the share.
        n_datasets: that it ran on; 0 for a run on none.
        n_values: how many of these have each of the numbers; empty for a run on none.
        headlines: the headline numbers, most important first.
        flags: those that are 1 where something is so and 0 where not.
        facts: what may differ between runs beside parameters: `seed`, `orthoflow` (its version),
            methods of the baseline by `step.use`, and inputs by `input <name>`.
        parameters: `step.parameter` -> its values, of variants and datasets several.
    """

    folder: Path
    state: RunState
    reason: str = ""
    workflow: str = ""
    run_id: str = ""
    started: str = ""
    metrics: Mapping[str, float] = field(default_factory=dict)
    n_datasets: int = 0
    n_values: Mapping[str, int] = field(default_factory=dict)
    headlines: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
    facts: Mapping[str, JsonValue] = field(default_factory=dict)
    parameters: Mapping[str, tuple[JsonValue, ...]] = field(default_factory=dict)

    @property
    def names(self) -> frozenset[str]:
        """What `values` knows something of."""
        return frozenset((*self.metrics, *self.facts, *self.parameters))

    def values(self, name: str) -> tuple[JsonValue, ...]:
        """Return a metric, a fact, or all values of a parameter."""
        for known in (self.metrics, self.facts):
            if name in known:
                return (known[name],)
        return self.parameters.get(name, ())

    @property
    def all_facts(self) -> dict[str, JsonValue]:
        """Facts and parameters; several values of one are a text, as `0.02|0.05`."""
        return dict(self.facts) | {
            name: values[0] if len(values) == 1 else "|".join(map(_sorted_json, values))
            for name, values in self.parameters.items()
        }


def run_folders(folders: Sequence[Path]) -> list[Path]:
    """Find the run folders in and below some folders, sorted; no link is followed.

    Raises:
        ArgumentError: one of them is no folder.
    """
    found: dict[Path, None] = {}
    for folder in folders:
        if not folder.is_dir():
            raise ArgumentError(f"{folder} is not a folder: give folders that contain runs")
        found.update(dict.fromkeys(_below(folder)))
    return list(found)


def summaries(folders: Iterable[Path]) -> Iterator[RunSummary]:
    """Summarise run folders one after the other; those that cannot be read are reported."""
    for folder in folders:
        yield _summary(folder)


def differing_facts(runs: Sequence[RunSummary]) -> dict[Path, dict[str, JsonValue]]:
    """Facts that distinguish each run from others of the same workflow, by its folder.

    A fact that some of them lack differs only where two others disagree on it.
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
    """Names of the headline numbers of some runs, those of most runs first."""
    counts = Counter(name for run in runs for name in run.headlines)
    chosen = sorted(counts, key=lambda name: -counts[name])[:most]
    return [name for name in counts if name in chosen]


def _below(folder: Path) -> Iterator[Path]:
    for place, folders, files in os.walk(folder):
        if RECORD_FILE in files or JOURNAL in files:
            yield Path(place)
            # Who has a record alone in a folder replays it there.
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
            return RunSummary(folder=folder, state="damaged", reason=doubt)
        return _of_run(folder, run)
    except Exception as error:  # noqa: BLE001 - a record may contain anything; the others are still listed
        unforeseen = f"the record is not as one was written: {type(error).__name__}: "
        reason = f"{'' if isinstance(error, OrthoflowError) else unforeseen}{error}"
        return RunSummary(folder=folder, state="damaged", reason=reason)


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
    flags: dict[str, None] = {}
    of_parts = [baseline_cells(part) for part in parts.values() or (run,)]
    for cells in of_parts:
        own: dict[str, float] = {}
        for cell in cells:
            if cell.status != "skipped":
                facts[f"{cell.step}.use"] = cell.method
            for row in cell_metrics(cell):
                # Of several datasets errors with signs are given by their sizes.
                is_size = len(parts) > 1 and row.better == "lower"
                for name in (f"{row.step}.{row.metric}", row.metric):
                    own[name] = abs(row.value) if is_size else row.value
                    flags |= {name: None} if is_flag(row.unit) else {}
        for name, value in own.items():
            values.setdefault(name, []).append(value)
    return RunSummary(
        folder=folder,
        state=record.status,
        reason="" if failed is None else f"{failed.address}: {failed.error_message}",
        workflow=record.name,
        run_id=record.run_id,
        started=record.started,
        metrics={
            name: middle_of(np.array(found), FLAG if name in flags else "")
            for name, found in values.items()
        },
        n_datasets=len(parts),
        n_values={name: len(found) for name, found in values.items()} if parts else {},
        headlines=tuple(map(".".join, headline_keys(cell for cells in of_parts for cell in cells))),
        flags=tuple(flags),
        facts=facts,
        parameters=_parameters(record.cells),
    )


def _parameters(cells: Iterable[RecordedCell]) -> dict[str, tuple[JsonValue, ...]]:
    """Return the values that each parameter has in the cells, each once."""
    found: dict[str, dict[str, JsonValue]] = {}
    for cell in cells:
        if cell.repeat == 0 and cell.status != "skipped":
            for name, value in cell.params.items():
                known = found.setdefault(f"{cell.step}.{name}", {})
                known.setdefault(_sorted_json(value), value)
    return {name: tuple(known.values()) for name, known in found.items()}


def _unfinished(folder: Path) -> RunSummary:
    """Summarise a run without a record from the first line of its journal."""
    try:
        with open_file(folder / JOURNAL) as journal:
            first = parse_json(journal.readline(_FIRST_LINE_BYTES).decode("utf-8"))
    except (OSError, ValueError) as error:
        reason = f"it has no {RECORD_FILE}, and its journal cannot be read: {error}"
        return RunSummary(folder=folder, state="damaged", reason=reason)
    stated = first if isinstance(first, dict) else {}
    is_under_way = is_running(folder)
    return RunSummary(
        folder=folder,
        state="running" if is_under_way else "unfinished",
        reason="" if is_under_way else f"continues with the same command and -o {folder}",
        workflow=str(stated.get("workflow", "")),
        run_id=str(stated.get("run_id", "")),
        started=str(stated.get("time", "")),
    )
