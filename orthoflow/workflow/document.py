"""Reading a workflow file: one pass that finds every problem, or a workflow that can run."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from orthoflow.alike import first_few
from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import WorkflowError
from orthoflow.files.yaml_positions import Entry, Position, Table, plain, read_yaml
from orthoflow.products.product import JsonValue
from orthoflow.workflow.comparison import check_baseline, first_variants, read_compare
from orthoflow.workflow.datasets import DatasetReader, choose_data
from orthoflow.workflow.format import (
    COMPARE,
    DATASETS,
    FILE,
    INPUTS,
    NAME,
    ORTHOFLOW,
    SEED,
    STEPS,
    Comparison,
    Workflow,
    WorkflowStep,
)
from orthoflow.workflow.inputs import (
    add_missing_inputs,
    check_shared_inputs,
    override_inputs,
    read_input_options,
    read_inputs,
)
from orthoflow.workflow.parameters import (
    CallName,
    Override,
    assign_overrides,
    assign_settings,
    resolve_params,
)
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.recipes import find_workflow
from orthoflow.workflow.shapes import check_name, read_table
from orthoflow.workflow.steps import DraftStep, read_steps
from orthoflow.workflow.sweeps import expand_sweeps
from orthoflow.workflow.wiring import check_wiring

MOST_BYTES: Final = 400_000


def load_workflow(  # noqa: PLR0913 - an argument for each option of the command line
    name_or_path: str | Path,
    catalog: Catalog,
    *,
    sets: Sequence[str] = (),
    inputs: Sequence[str] = (),
    datasets: str | Mapping[str, JsonValue] = "",
    only_data: Sequence[str] = (),
    set_files: Sequence[str | Path] = (),
    also_files: bool = False,
) -> Workflow:
    """Read and check a workflow.

    Args:
        name_or_path: an existing file, else the name of a shipped recipe.
        catalog: the installed plugins.
        sets: `step[.variant].param=value`, each as behind `--set`.
        inputs: `NAME=PATH`, each as behind `--input`; relative to the working directory.
        datasets: a table in the place of the file's datasets, as behind `--datasets`, or what the
            file would say of them.
        only_data: names of datasets, each as behind `--only-data`.
        set_files: YAML files of `step.parameter: value`, as behind `--set-file`; what stands
            behind `--set` goes before them.
        also_files: of a file with problems, input files that are missing are told with them.

    Raises:
        InvalidWorkflowError: the file has problems; the message lists all of them.
        InvalidArgumentsError: the file is fine, what came with it is not.
        UnusablePluginError: only plugins that the workflow needs are broken or missing.
        WorkflowError: there is no such file, or it cannot be read at all.
    """
    path = find_workflow(name_or_path)
    source = _read_text(path)
    log = ProblemLog(file=str(name_or_path), lines=tuple(source.splitlines()))
    value = read_yaml(source, log)
    table = FILE.read(value, "", log) if value is not None else None
    if table is None:
        log.raise_any()
        raise WorkflowError(f"{name_or_path} holds no workflow")
    if table.get(STEPS.name) is None:
        # All else names steps: each of these names would be one more complaint.
        log.raise_any()
    options = _Options(
        sets=tuple(sets),
        inputs=tuple(inputs),
        datasets=datasets,
        only_data=tuple(only_data),
        profiles=tuple(_read_profile(Path(name), log) for name in set_files),
    )
    reader = _Reader(path=path, source=source, catalog=catalog, log=log, options=options)
    workflow = reader.read(table)
    if also_files and log.has_any:
        # Else they are looked for by who needs them.
        add_missing_inputs(workflow, log)
    log.raise_any()
    return workflow


def _read_text(path: Path, what: str = "a workflow file") -> str:
    try:
        # No more than is looked at: what was named by mistake may be a scan, or a device.
        with path.open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)
    except OSError as error:
        raise WorkflowError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) > MOST_BYTES:
        raise WorkflowError(f"{path} is too large: {what} has at most {MOST_BYTES} bytes")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        column = error.start - content.rfind(b"\n", 0, error.start)
        raise WorkflowError(
            f"{path}:{line}:{column}: expected UTF-8 text, got the byte "
            f"0x{content[error.start]:02x}; save the file as UTF-8"
        ) from error


@dataclass(frozen=True, kw_only=True)
class _Options:
    """What the command line says of the workflow."""

    sets: tuple[str, ...]
    inputs: tuple[str, ...]
    datasets: str | Mapping[str, JsonValue]
    only_data: tuple[str, ...]
    profiles: tuple[_Profile, ...]


@dataclass(frozen=True, kw_only=True)
class _Profile:
    """What a file of `--set-file` holds, and the log of that file."""

    settings: Table
    log: ProblemLog


def _read_profile(path: Path, log: ProblemLog) -> _Profile:
    try:
        text = _read_text(path, "a file of parameters")
    except WorkflowError as error:
        log.add_option(f"--set-file {path}", str(error))
        text = "{}"
    beside = log.beside(str(path), text)
    value = read_yaml(text, beside)
    settings = read_table(value, "", beside) if value is not None else None
    return _Profile(
        settings=settings or Table(position=Position(line=1, column=1), entries=()), log=beside
    )


@dataclass(frozen=True, kw_only=True)
class _Reader:
    """Reads one document; everything wrong goes to the log."""

    path: Path
    source: str
    catalog: Catalog
    log: ProblemLog
    options: _Options

    def read(self, table: Table) -> Workflow:
        """Read all sections; the result may be used only when the log stays empty."""
        ORTHOFLOW.read(table, "", self.log)
        section = table.get(INPUTS.name)
        specs = read_inputs(section.value, self.path.resolve().parent, self.log) if section else {}
        steps_entry = table.get(STEPS.name)
        steps: tuple[DraftStep, ...] = ()
        step_names: tuple[str, ...] = ()
        if steps_entry is not None:
            steps = read_steps(steps_entry.value, self.catalog, self.log)
            if isinstance(steps_entry.value, Table):
                step_names = tuple(entry.key for entry in steps_entry.value)
        check_wiring(steps, step_names, tuple(specs), self.log)
        given = read_input_options(self.options.inputs, self.log)
        shared = tuple(option for option in given if not option.is_of_dataset)
        specs = override_inputs(specs, shared, self.log)
        expanded = expand_sweeps(steps, self._overrides(steps), self.log)
        steps, overrides = expanded.steps, expanded.overrides
        read = {step.name: self._step(step, overrides) for step in steps}
        datasets = DatasetReader(
            folder=self.path.resolve().parent,
            inputs=specs,
            steps=steps,
            overrides=overrides,
            calls={
                (step.name, variant.name): variant
                for step in read.values()
                for variant in step.variants
                if variant.params
            },
            log=self.log,
        ).read(table.get(DATASETS.name), self.options.datasets)
        compare = self._compare(table.get(COMPARE.name), steps, step_names, tuple(datasets))
        if compare is None and expanded.has_sweeps:
            compare = Comparison(baseline=first_variants(steps))
        workflow = Workflow(
            name=self._name(table),
            path=self.path,
            source=self.source,
            seed=SEED.read(table, "", self.log) or 0,
            inputs=specs,
            steps=read,
            compare=compare,
            overrides=(
                *self._set_options(),
                *(option.without_folder for option in given),
                *self._data_options(),
            ),
            datasets=datasets,
            only_data=choose_data(self.options.only_data, datasets, self.log),
        )
        check_shared_inputs(workflow, shared, self.log)
        own = tuple(option for option in given if option.is_of_dataset)
        return workflow.with_input_specs(override_inputs(workflow.input_specs, own, self.log))

    def _overrides(self, steps: Sequence[DraftStep]) -> dict[CallName, tuple[Override, ...]]:
        """What files of `--set-file` and then `--set` say of each call."""
        found: dict[CallName, tuple[Override, ...]] = {}
        said = [
            *(assign_settings(one.settings, "", steps, one.log) for one in self.options.profiles),
            assign_overrides(self.options.sets, steps, self.log),
        ]
        for overrides in said:
            for call, several in overrides.items():
                found[call] = (*found.get(call, ()), *several)
        return found

    def _set_options(self) -> Iterator[str]:
        # A record holds no files of profiles: what they say stands there as if it had been set.
        for profile in self.options.profiles:
            for entry in profile.settings:
                yield f"--set {entry.key}={json.dumps(plain(entry.value), ensure_ascii=False)}"
        yield from (f"--set {text}" for text in self.options.sets)

    def _data_options(self) -> Iterator[str]:
        datasets = self.options.datasets
        if isinstance(datasets, Mapping):
            yield f"datasets={first_few(list(datasets))}"
        elif datasets:
            yield f"--datasets {Path(datasets).name}"
        yield from (f"--only-data {text}" for text in self.options.only_data)

    def _name(self, table: Table) -> str:
        if table.get(NAME.name) is not None:
            return NAME.read(table, "", self.log) or ""
        check_name(self.path.stem, table.position, NAME.name, self.log)
        return self.path.stem

    def _compare(
        self,
        entry: Entry | None,
        steps: Sequence[DraftStep],
        step_names: Sequence[str],
        datasets: Sequence[str],
    ) -> Comparison | None:
        if entry is None:
            return None
        comparison = read_compare(entry.value, steps, step_names, datasets, self.log)
        if comparison is not None:
            check_baseline(comparison, entry.position, self.log)
        return comparison

    def _step(
        self, draft: DraftStep, overrides: Mapping[CallName, tuple[Override, ...]]
    ) -> WorkflowStep:
        variants = []
        for variant in draft.variants:
            call = CallName(step=draft.name, variant=variant.call.name)
            params = resolve_params(variant, overrides.get(call, ()), self.log)
            variants.append(replace(variant.call, params=params.resolved, params_set=params.as_set))
        return WorkflowStep(
            name=draft.name,
            variants=tuple(variants),
            inputs={
                port.name: tuple(placed.reference for placed in port.references)
                for port in draft.ports
            },
            only_if=draft.only_if.reference.name if draft.only_if else "",
            unless=draft.unless.reference.name if draft.unless else "",
            is_varied=draft.is_varied,
        )
