"""The datasets of a workflow: reading them from its section or from a table, and choosing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from orthoflow.catalog.wording import did_you_mean
from orthoflow.errors import WorkflowError
from orthoflow.files.yaml_positions import (
    Entry,
    Listing,
    Position,
    Table,
    Text,
    Value,
    describe,
    join,
    plain,
)
from orthoflow.products.product import JsonValue
from orthoflow.workflow.dataset_files import read_rows, read_text
from orthoflow.workflow.format import (
    DATA,
    DATASET,
    DATASETS,
    FILES,
    NAMED_DATASETS,
    SET,
    Dataset,
    StepVariant,
    WorkflowInputSpec,
)
from orthoflow.workflow.inputs import some_of
from orthoflow.workflow.parameters import CallName, Override, assign_settings, resolve_params
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.steps import DraftStep

# What a caller from Python wrote them behind.
_ARGUMENT: Final = "datasets="


@dataclass(frozen=True, kw_only=True)
class DatasetReader:
    """Reads datasets against what a workflow has.

    Attributes:
        folder: of the workflow.
        inputs: of the workflow, with those of `--input`.
        steps: of the workflow.
        overrides: of `--set`, which go over those of datasets.
        calls: (step, variant) -> the call without datasets; those with mistakes are missing.
        log: takes the problems.
    """

    folder: Path
    inputs: Mapping[str, WorkflowInputSpec]
    steps: Sequence[DraftStep]
    overrides: Mapping[CallName, tuple[Override, ...]]
    calls: Mapping[tuple[str, str], StepVariant]
    log: ProblemLog

    def read(
        self, section: Entry | None, table: str | Mapping[str, JsonValue]
    ) -> dict[str, Dataset]:
        """Read the table of `--datasets`, else the section, which may name a table itself.

        Args:
            section: of the workflow file.
            table: of the command line, relative to the working directory; empty for none. From
                Python it may be what the section would say, with paths from there, too.
        """
        if isinstance(table, Mapping):
            return self._from_python(_unplaced(dict(table)))
        if table:
            return self._from_table(
                Path(table), table, partial(self.log.add_option, f"--datasets {table}")
            )
        if section is None:
            return {}
        self._check_steps(section.position, self.log)
        found = DATASETS.shape.read(section.value, DATASETS.name, self.log)
        if isinstance(found, str):
            report = partial(self.log.add, section.value.position, DATASETS.name)
            return self._from_table(self.folder / found, found, report)
        one = _OneFile(reader=self, log=self.log, path=DATASETS.name, folder=self.folder)
        return {entry.key: one.dataset(entry) for entry in found or ()}

    def _check_steps(self, position: Position, log: ProblemLog) -> None:
        if any(step.name == DATA for step in self.steps):
            log.add(
                position,
                DATASETS.name,
                f"a step is called {DATA}, which stands for the dataset in addresses; give the "
                "step another name",
            )

    def _from_python(self, said: Value) -> dict[str, Dataset]:
        log = self.log.beside(_ARGUMENT, "")
        self._check_steps(said.position, log)
        one = _OneFile(reader=self, log=log, path="", folder=Path.cwd(), is_given=True)
        return {entry.key: one.dataset(entry) for entry in NAMED_DATASETS.read(said, "", log)}

    def _from_table(self, path: Path, name: str, report: partial[None]) -> dict[str, Dataset]:
        if any(step.name == DATA for step in self.steps):
            report(f"a step is called {DATA}, which stands for the dataset in addresses")
        try:
            text = read_text(path)
        except WorkflowError as error:
            report(str(error))
            return {}
        log = self.log.beside(name, text)
        table = read_rows(text, log)
        before = log.has_any
        entries = NAMED_DATASETS.read(table, "", log) if table.entries else ()
        if not table.entries and not before:
            report(f"the table {name} holds no dataset")
        one = _OneFile(reader=self, log=log, path="", folder=path.resolve().parent, table=name)
        return {entry.key: one.dataset(entry) for entry in entries}


@dataclass(frozen=True, kw_only=True)
class _OneFile:
    """Reads the datasets of one file.

    Attributes:
        reader: what the workflow has.
        log: of the file.
        path: what stands before the names of datasets in problems.
        folder: what relative paths start from.
        table: the file's name, empty for the workflow itself.
        is_given: its paths were given with the call, from the working directory.
    """

    reader: DatasetReader
    log: ProblemLog
    path: str
    folder: Path
    table: str = ""
    is_given: bool = False

    def dataset(self, entry: Entry) -> Dataset:
        """Read one dataset."""
        here = join(self.path, entry.key)
        if not isinstance(entry.value, Table):
            form = f"{{{next(iter(self.reader.inputs), 'scan')}: FILE}}"
            self.log.add(
                entry.value.position,
                here,
                f"expected what the dataset gives, as in {form}, got {describe(entry.value)}",
            )
            return Dataset(name=entry.key)
        table = DATASET.read(entry.value, here, self.log)
        if table is None:
            return Dataset(name=entry.key)
        settings = SET.read(table, here, self.log)
        inputs = {item.key: self._spec(entry, item, here) for item in table if item.key != SET.name}
        self._check_complete(entry, inputs)
        return Dataset(
            name=entry.key,
            inputs={name: spec for name, spec in inputs.items() if name in self.reader.inputs},
            sets={item.key: plain(item.value) for item in settings or ()},
            calls=self._calls(settings, here) if settings else {},
        )

    def _spec(self, dataset: Entry, item: Entry, here: str) -> WorkflowInputSpec:
        if item.key not in self.reader.inputs:
            known = ", ".join(self.reader.inputs) or "none"
            self.log.add(
                item.position,
                # A column of a table is told of once, not for every line.
                item.key if self.table else join(here, item.key),
                f"there is no input {item.key}{did_you_mean(item.key, self.reader.inputs)}; "
                f"inputs: {known}{self._meant(item)}",
            )
        return WorkflowInputSpec(
            name=f"{item.key}@{dataset.key}",
            files=FILES.shape.read(item.value, join(here, item.key), self.log) or (),
            folder=self.folder,
            is_given=self.is_given,
            place=self.log.place(item.value.position, join(here, item.key)),
            said_in=f"{self.table}:{dataset.position.line}" if self.table else "",
        )

    def _meant(self, item: Entry) -> str:
        """Say where parameters stand, to who put one in the place of an input."""
        step, _, parameter = item.key.partition(".")
        if parameter and any(one.name == step for one in self.reader.steps):
            return f"; parameters stand in set: {{set: {{{item.key}: VALUE}}}}"
        # A table has parameters by the dot in the names of their columns.
        return "; columns of parameters are called step.parameter" if self.table else ""

    def _check_complete(self, entry: Entry, inputs: Mapping[str, WorkflowInputSpec]) -> None:
        for name, spec in self.reader.inputs.items():
            if name not in inputs and not spec.files and not spec.optional:
                self.log.add(
                    entry.position,
                    join(self.path, entry.key),
                    f"the dataset names no files for the input {name}, and neither does the "
                    f"workflow; give it {name}",
                )

    def _calls(self, settings: Table, here: str) -> dict[tuple[str, str], StepVariant]:
        reader = self.reader
        path, is_column = join(here, SET.name), bool(self.table)
        assigned = assign_settings(settings, path, reader.steps, self.log, is_column=is_column)
        blame = partial(self.log.add, settings.position, here if is_column else path)
        calls = {}
        for step in reader.steps:
            for variant in step.variants:
                name = CallName(step=step.name, variant=variant.call.name)
                call = reader.calls.get((name.step, name.variant))
                if name not in assigned:
                    continue
                overrides = (*assigned[name], *reader.overrides.get(name, ()))
                # Of a call with mistakes of its own, those are told at their places, and once.
                params = resolve_params(variant, overrides, self.log, blame if call else None)
                if call is None:
                    continue
                calls[name.step, name.variant] = replace(
                    call, params=params.resolved, params_set=params.as_set
                )
        return calls


def _unplaced(value: JsonValue) -> Value:
    """Give what a document would say of a value that comes from none."""
    nowhere = Position(line=0, column=0)
    if isinstance(value, dict):
        entries = [
            Entry(position=nowhere, key=key, value=_unplaced(item)) for key, item in value.items()
        ]
        return Table(position=nowhere, entries=tuple(entries))
    if isinstance(value, list):
        return Listing(position=nowhere, items=tuple(map(_unplaced, value)))
    return Text(position=nowhere, value=value)


def choose_data(
    texts: Sequence[str], datasets: Mapping[str, Dataset], log: ProblemLog
) -> tuple[str, ...]:
    """Read what stands behind each `--only-data`: names of datasets with commas between them."""
    chosen: dict[str, None] = {}
    for text in texts:
        for name in (part.strip() for part in text.split(",")):
            if name in datasets:
                chosen[name] = None
            elif not datasets and log.has_any:
                # Of a table that cannot be read nobody knows the names.
                continue
            elif not datasets:
                log.add_option(f"--only-data {text}", "the workflow has no datasets")
            else:
                log.add_option(
                    f"--only-data {text}",
                    f"there is no dataset {name or 'without a name'}"
                    f"{did_you_mean(name, datasets)}; datasets: {some_of(datasets)}",
                )
    return tuple(chosen)
