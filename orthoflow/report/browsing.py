"""Many runs at a glance: which lie below some folders, what came out, and in what they differ."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np

from orthoflow.engine.journal import JOURNAL, RECORD_FILE, is_running
from orthoflow.errors import ArgumentError, OrthoflowError
from orthoflow.foreign_text import open_file, parse_json
from orthoflow.products import JsonValue
from orthoflow.records import RecordedCell
from orthoflow.records.datasets import parts_of
from orthoflow.records.published import MetricRow, cell_metrics
from orthoflow.records.runs import Run
from orthoflow.records.unfinished import open_run
from orthoflow.records.verification import broken_seal
from orthoflow.report.combinations import baseline_cells
from orthoflow.report.paired import middle_of
from orthoflow.report.rankings import FLAG, Sense, is_flag, sense_of
from orthoflow.report.summaries import headline_keys
from orthoflow.workflow.model import (
    DATA,
)

RunState: TypeAlias = Literal["ok", "failed", "running", "unfinished", "damaged"]

# Runs lie in runs/, sorted into folders at most; deeper lies something else.
_DEEPEST: Final = 6
# Folders of a run, and of what is no run: to look into them costs time and finds nothing.
_NO_RUNS: Final = frozenset({"products", "logs", "pages", "node_modules", "__pycache__"})
# In the folder of a run: parts of it, and what was exported.
_OF_A_RUN: Final = frozenset({"datasets", "export"})
_FIRST_LINE_BYTES: Final = 1 << 16


@dataclass(frozen=True, kw_only=True)
class Fact:
    """Something in which runs may differ.

    Attributes:
        values: of it, as JSON; one, but of a sweep all.
        shared: of one of several datasets, its name without it.
        set_as: of a parameter of a variant, the baseline's too, `step.variant.parameter`.
        beside: of a parameter of another variant, the name that the fact of the baseline has.
    """

    values: tuple[JsonValue, ...]
    shared: str = ""
    set_as: str = ""
    beside: str = ""

    @property
    def told(self) -> JsonValue:
        """The value, of a sweep all of them as one text."""
        return self.values[0] if len(self.values) == 1 else "|".join(map(_sorted_json, self.values))


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """What a table of runs says of one.

    Attributes:
        folder: of the run, as its finder named it.
        state: `ok`; `failed`, some cell did; `running`, just now; `unfinished`, it was broken off;
            `damaged`, the record cannot be read, or its seal does not hold.
        reason: what failed, first, or why it cannot be read; empty where all is well.
        workflow: name of the workflow.
        run_id: of the run.
        started: ISO 8601 UTC; empty where nothing says it.
        metrics: numbers of the baseline by `step.metric`, and by `metric` alone as the last step
            has it; of several datasets the median, of what is yes or no the share.
        n_datasets: that it ran on; 0 for a run on none.
        n_values: how many of these have each of the numbers; empty for a run on none.
        labels: what each of these is, in words.
        headlines: those that say how good the result is, most important first.
        flags: those that are 1 where something is so and 0 where not.
        facts: what may differ between runs: parameters of the baseline by `step.parameter`, its
            methods by `step.use`, and parameters of other variants by `step.variant.parameter`;
            `seed`, `orthoflow` (its version), and inputs by `input <name>`.
        variants: all values of parameters as `--set` names them for one variant,
            `step.variant.parameter`; of one with a sweep those of all that it became.
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
    labels: Mapping[str, str] = field(default_factory=dict)
    headlines: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
    facts: Mapping[str, Fact] = field(default_factory=dict)
    variants: Mapping[str, tuple[JsonValue, ...]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """What `values` knows something of."""
        shared = (fact.shared for fact in self.facts.values() if fact.shared)
        return (*self.metrics, *self.facts, *shared, *self.variants)

    def values(self, name: str) -> tuple[JsonValue, ...]:
        """Give a metric or a fact: of a sweep all values, without a dataset those of every one."""
        if name in self.metrics:
            return (self.metrics[name],)
        if name in self.variants:
            return self.variants[name]
        return tuple(
            value
            for own, fact in self.facts.items()
            if name in (own, fact.shared)
            for value in fact.values
        )


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
    """Sum up run folders one after the other; what cannot be read is told, not raised."""
    for folder in folders:
        yield _summary(folder)


def differing_facts(runs: Sequence[RunSummary]) -> dict[Path, dict[str, JsonValue]]:
    """What of its told facts tells each run from others of the same workflow, by its folder.

    A fact that some of them lack differs only where two others disagree on it.
    """
    told = distinct_facts(runs)
    values: dict[tuple[str, str], set[str]] = {}
    for run in runs:
        for name, value in told[run.folder].items():
            values.setdefault((run.workflow, name), set()).add(_sorted_json(value))
    return {
        run.folder: {
            name: value
            for name, value in told[run.folder].items()
            if len(values[run.workflow, name]) > 1
        }
        for run in runs
    }


def distinct_facts(runs: Sequence[RunSummary]) -> dict[Path, dict[str, JsonValue]]:
    """All facts of each run, by its folder: each once, by the name that `--set` takes.

    Of a sweep all values are told, without the dataset what is the same on all datasets of each
    run of the workflow, and without the variant what is the same in all variants.
    """
    apart: set[tuple[str, str]] = set()
    for run in runs:
        on_datasets: dict[str, set[str]] = {}
        for fact in run.facts.values():
            if fact.shared:
                on_datasets.setdefault(fact.shared, set()).add(_sorted_json(fact.told))
        apart |= {(run.workflow, short) for short, found in on_datasets.items() if len(found) > 1}

    def called(run: RunSummary, name: str) -> str:
        short = run.facts[name].shared or name
        return name if (run.workflow, short) in apart else short

    names = _names_as_set(runs, called)
    return {
        run.folder: {
            name: fact.told
            for own, fact in run.facts.items()
            if (name := names.get((run.workflow, called(run, own)), called(run, own)))
        }
        for run in runs
    }


def _names_as_set(
    runs: Sequence[RunSummary], called: Callable[[RunSummary, str], str]
) -> dict[tuple[str, str], str]:
    """Other names of parameters that several variants take, by workflow and name.

    Where another variant has the baseline's value in every run, its own name is empty: what is
    said of the baseline holds for it. Where not, the baseline's is named with its variant, too,
    as long as that is the same one in all runs.
    """
    follows: dict[tuple[str, str], bool] = {}
    of_baseline: dict[tuple[str, str], set[str]] = {}
    for run in runs:
        for own, fact in run.facts.items():
            name = run.workflow, called(run, own)
            if first := run.facts.get(fact.beside):
                follows[name] = fact.told == first.told and follows.get(name, True)
            elif not fact.beside:
                of_baseline.setdefault(name, set()).add(fact.set_as)
    names = {name: "" for name, does in follows.items() if does}
    for run in runs:
        for own, fact in run.facts.items():
            name = run.workflow, called(run, own)
            if fact.beside in run.facts and not follows[name]:
                of_first = run.workflow, called(run, fact.beside)
                if len(of_baseline[of_first]) == 1:
                    (written,) = of_baseline[of_first]
                    names[of_first] = written or of_first[1]
    return names


def _sorted_json(value: JsonValue) -> str:
    return json.dumps(value, sort_keys=True)


def key_metrics(runs: Iterable[RunSummary], *, most: int) -> list[str]:
    """Names of the numbers that say how good some runs are, those of most of them first."""
    counts = Counter(name for run in runs for name in run.headlines)
    chosen = sorted(counts, key=lambda name: -counts[name])[:most]
    return [name for name in counts if name in chosen]


def told_apart(names: Iterable[str], runs: Sequence[RunSummary]) -> Iterator[str]:
    """Put `step.metric` in the place of names that are not the same thing in all runs."""
    for name in names:
        said = {run.labels[name] for run in runs if name in run.labels}
        if len(said) < 2:
            yield name
            continue
        yield from dict.fromkeys(
            own
            for run in runs
            for own, label in run.labels.items()
            if own.endswith(f".{name}") and label in said
        )


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
    except OrthoflowError as error:
        return RunSummary(folder=folder, state="damaged", reason=str(error))
    except Exception as error:  # noqa: BLE001 - a record may hold anything; the others shall be told
        reason = f"the record is not as one was written: {type(error).__name__}: {error}"
        return RunSummary(folder=folder, state="damaged", reason=reason)


def _of_run(folder: Path, run: Run) -> RunSummary:
    record = run.record
    failed = next((cell for cell in record.cells if cell.status == "failed"), None)
    said: dict[str, JsonValue] = {"seed": record.seed, "orthoflow": record.created_by}
    parts = parts_of(run)
    if parts:
        said["datasets"] = len(parts)
    for given in record.inputs:
        said[f"input {given.name}"] = [f"{file.name} {file.sha256[:8]}" for file in given.files]
    baseline = {cell.address for part in parts.values() or (run,) for cell in baseline_cells(part)}
    facts = {name: Fact(values=(value,)) for name, value in said.items()}
    for one in _alike(record.cells, baseline):
        facts |= one.facts
    values = _values(run)
    measured = [
        row
        for part in parts.values() or (run,)
        for cell in baseline_cells(part)
        for row in cell_metrics(cell)
    ]
    flags = tuple(
        name
        for row in measured
        if is_flag(row.unit)
        for name in (row.metric, f"{row.step}.{row.metric}")
    )
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
        labels=_labels(measured),
        headlines=tuple(
            name
            for _, name in headline_keys(
                cell for part in parts.values() or (run,) for cell in baseline_cells(part)
            )
        ),
        flags=flags,
        facts=facts,
        variants=_variants(record.cells),
    )


def _variants(cells: Sequence[RecordedCell]) -> dict[str, tuple[JsonValue, ...]]:
    found: dict[str, list[JsonValue]] = {}
    for cell in cells:
        variant = cell.assignment.get(cell.step, "")
        if not variant or cell.repeat or cell.status == "skipped":
            continue
        for name in {variant, _called_by_set(cell)} - {""}:
            for parameter, value in cell.params.items():
                found.setdefault(f"{cell.step}.{name}.{parameter}", []).append(value)
    return {name: tuple(values) for name, values in found.items()}


def _called_by_set(cell: RecordedCell) -> str:
    """The variant that `--set` names: a sweep puts parameters and values behind its name."""
    variant = cell.assignment.get(cell.step, "")
    swept = [f"-{variant}".find(f"-{parameter}-") for parameter in cell.params]
    return variant[: min((max(at - 1, 0) for at in swept if at >= 0), default=None)]


@dataclass(frozen=True, kw_only=True)
class _Alike:
    """Cells of a step whose parameters `--set` changes together, whatever varies before them.

    Attributes:
        step: theirs.
        data: their dataset, empty for none.
        variant: of their step as `--set` names it, empty for none.
        cells: one, or of a sweep one for each of its values.
        chosen: the cell of the baseline, if it is among them.
    """

    step: str
    data: str
    variant: str
    cells: tuple[RecordedCell, ...]
    chosen: RecordedCell | None

    @property
    def facts(self) -> dict[str, Fact]:
        """Their parameters, and the method of the baseline, by the names that no others have."""
        values: dict[str, dict[str, JsonValue]] = {}
        for cell in self.cells:
            for name, value in cell.params.items():
                values.setdefault(name, {})[_sorted_json(value)] = value
        if self.chosen:
            values["use"] = {"": self.chosen.method}
        written = f"{self.step}.{self.variant}" if self.variant else self.step
        of_baseline = f"{self.step}@{DATA}={self.data}" if self.data else self.step
        is_beside = bool(self.variant) and self.chosen is None
        own = of_baseline
        if is_beside:
            own = f"{of_baseline},{self.step}={self.variant}" if self.data else written
        # Without the dataset the baseline's is its step, whatever its variant.
        shared = written if is_beside else self.step
        return {
            f"{own}.{name}": Fact(
                values=tuple(several.values()),
                shared=f"{shared}.{name}" if self.data else "",
                set_as=f"{written}.{name}" if self.variant else "",
                beside=f"{of_baseline}.{name}" if is_beside else "",
            )
            for name, several in values.items()
        }


def _alike(cells: Iterable[RecordedCell], baseline: Collection[str]) -> Iterator[_Alike]:
    """Put together what `--set` does; `baseline` has the addresses of the baseline's cells."""
    found: dict[tuple[str, str, str], list[RecordedCell]] = {}
    for cell in cells:
        if cell.repeat == 0 and cell.status != "skipped":
            key = cell.step, cell.assignment.get(DATA, ""), _called_by_set(cell)
            found.setdefault(key, []).append(cell)
    for (step, data, variant), several in found.items():
        chosen = next((cell for cell in several if cell.address in baseline), None)
        yield _Alike(step=step, data=data, variant=variant, cells=tuple(several), chosen=chosen)


def _values(run: Run) -> dict[str, list[float]]:
    """Numbers of the baseline, one of each dataset that has one.

    Of several datasets errors with signs are given by their sizes, as in the report.
    """
    values: dict[str, list[float]] = {}
    parts = parts_of(run)
    for part in parts.values() or (run,):
        own: dict[str, float] = {}
        for cell in baseline_cells(part):
            for row in cell_metrics(cell):
                is_size = len(parts) > 1 and sense_of(row.better) is Sense.LESS
                value = abs(row.value) if is_size else row.value
                own |= {f"{row.step}.{row.metric}": value, row.metric: value}
        for name, value in own.items():
            values.setdefault(name, []).append(value)
    return values


def _labels(measured: Iterable[MetricRow]) -> dict[str, str]:
    """What the numbers of the baseline are; of several datasets, as the last has them."""
    found: dict[str, str] = {}
    for row in measured:
        found |= {f"{row.step}.{row.metric}": row.title, row.metric: row.title}
    return found


def _unfinished(folder: Path) -> RunSummary:
    """What the first line of the journal says of a run without a record."""
    try:
        with open_file(folder / JOURNAL) as journal:
            first = parse_json(journal.readline(_FIRST_LINE_BYTES).decode("utf-8"))
    except (OSError, ValueError) as error:
        reason = f"it has no {RECORD_FILE}, and its journal cannot be read: {error}"
        return RunSummary(folder=folder, state="damaged", reason=reason)
    said = first if isinstance(first, dict) else {}
    is_under_way = is_running(folder)
    return RunSummary(
        folder=folder,
        state="running" if is_under_way else "unfinished",
        reason="" if is_under_way else f"continues with the same command and -o {folder}",
        workflow=str(said.get("workflow", "")),
        run_id=str(said.get("run_id", "")),
        started=str(said.get("time", "")),
    )
