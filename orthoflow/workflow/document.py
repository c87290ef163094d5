"""Reading a workflow file: one pass that finds every problem, or a workflow that can run."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.errors import PluginError, WorkflowError
from orthoflow.files.yaml_positions import Table, Value, describe
from orthoflow.foreign_text import first_few
from orthoflow.products.product import JsonValue
from orthoflow.workflow.checks import check_comparison, check_wiring, first_variants
from orthoflow.workflow.inputs import (
    DatasetReader,
    add_missing_inputs,
    check_no_step,
    check_shared_inputs,
    choose_data,
    input_specs,
    override_inputs,
    read_input_options,
    read_seeds,
)
from orthoflow.workflow.model import (
    INPUTS,
    NAME_RULE,
    SEED,
    CallSection,
    Comparison,
    StepSection,
    Workflow,
    WorkflowFile,
    WorkflowStep,
)
from orthoflow.workflow.parameters import (
    DraftCall,
    DraftStep,
    MethodInfo,
    Overrides,
    describe_method,
    expand_sweeps,
    joined,
    overrides_of_options,
    overrides_of_settings,
    resolve_call,
)
from orthoflow.workflow.problems import (
    Location,
    ProblemLog,
)
from orthoflow.workflow.source import (
    as_plain,
    find_workflow,
    read_text,
    validate,
)

_STEPS: Final = "steps"
_OF_CALLS: Final = tuple(CallSection.model_fields)


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
        sets: `step[.variant].param=value`, each as given with `--set`.
        inputs: `NAME=PATH`, each as given with `--input`; relative to the working directory.
        datasets: a table in the place of the file's datasets, as given with `--datasets`, or what
            the file would state in their place.
        only_data: names of datasets, each as given with `--only-data`.
        set_files: YAML files of `step.parameter: value`, as given with `--set-file`; what is
            given with `--set` takes precedence.
        also_files: for a file with problems, missing input files are reported with them.

    Raises:
        InvalidWorkflowError: the file has problems; the message lists all of them.
        InvalidArgumentsError: the file is correct, the options are not.
        UnusablePluginError: only plugins that the workflow needs are broken or missing.
        WorkflowError: there is no such file, or it cannot be read at all.
    """
    path = find_workflow(name_or_path)
    source = read_text(path)
    log = ProblemLog(file=str(name_or_path), lines=tuple(source.splitlines()))
    tree = log.parse(source)
    if tree is not None and not isinstance(tree, Table):
        log.report((), f"expected a mapping, got {describe(tree)}")
    if not isinstance(tree, Table):
        log.raise_any()
        raise WorkflowError(f"{name_or_path} holds no workflow")
    for key, needed in (
        ("orthoflow", "a workflow begins with orthoflow: 1"),
        (_STEPS, "a workflow needs the key steps"),
    ):
        if tree.get(key) is None:
            log.report((key,), needed)
    if tree.get(_STEPS) is None:
        # All others name steps: each of these names would be another problem.
        _sections(tree, log)
        log.raise_any()
    reader = _Reader(
        path=path,
        source=source,
        catalog=catalog,
        log=log,
        tree=tree,
        sets=tuple(sets),
        inputs=tuple(inputs),
        datasets=datasets,
        only_data=tuple(only_data),
        profiles=tuple(_read_profile(Path(name), log) for name in set_files),
    )
    workflow = reader.read()
    if also_files and log.has_any:
        # Otherwise they are searched when needed.
        add_missing_inputs(workflow, log)
    log.raise_any()
    return workflow


def _sections(tree: Table, log: ProblemLog) -> WorkflowFile:
    """Validate the file; `datasets` and `seed` have several forms and are read apart."""
    data = as_plain(tree)
    assert isinstance(data, dict)  # noqa: S101 - a table is a mapping
    for key in ("datasets", SEED):
        data.pop(key, None)
    return validate(WorkflowFile, data, log) or WorkflowFile()


@dataclass(frozen=True, kw_only=True)
class _Profile:
    """The content of a file of `--set-file`, and the log of that file."""

    settings: Mapping[str, JsonValue]
    log: ProblemLog


def _read_profile(path: Path, log: ProblemLog) -> _Profile:
    try:
        text = read_text(path, "a file of parameters")
    except WorkflowError as error:
        log.report_option(f"--set-file {path}", str(error))
        text = "{}"
    beside = log.beside(str(path), text)
    tree = beside.parse(text)
    if tree is not None and not isinstance(tree, Table):
        beside.report((), f"expected a mapping, got {describe(tree)}")
    settings = as_plain(tree)
    return _Profile(settings=settings if isinstance(settings, dict) else {}, log=beside)


@dataclass(frozen=True, kw_only=True)
class _Reader:
    """Reads one document; all problems go to the log."""

    path: Path
    source: str
    catalog: Catalog
    log: ProblemLog
    tree: Table
    sets: tuple[str, ...]
    inputs: tuple[str, ...]
    datasets: str | Mapping[str, JsonValue]
    only_data: tuple[str, ...]
    profiles: tuple[_Profile, ...]

    def read(self) -> Workflow:
        """Read all sections; the result may be used only when the log stays empty."""
        log = self.log
        file = _sections(self.tree, log)
        folder = self.path.resolve().parent
        seeds = read_seeds(self._value(SEED), log, (SEED,)) or (0,)
        specs = input_specs(file.inputs, folder, log)
        steps = tuple(self._steps(file.steps))
        section = self._value(_STEPS)
        step_names = tuple(entry.key for entry in section) if isinstance(section, Table) else ()
        if isinstance(section, Table) and not step_names:
            log.report((_STEPS,), "a workflow needs at least one step")
        check_wiring(steps, step_names, tuple(specs), log)
        given = read_input_options(self.inputs, log)
        shared = tuple(option for option in given if not option.is_of_dataset)
        specs = override_inputs(specs, shared, log)
        steps, overrides = expand_sweeps(steps, self._overrides(steps), log)
        read = {step.name: self._step(step, overrides) for step in steps}
        reader = DatasetReader(
            folder=folder,
            inputs=specs,
            steps=steps,
            overrides=overrides,
            calls={
                (step.name, variant.name): variant
                for step in read.values()
                for variant in step.variants
                if variant.params
            },
            log=log,
        )
        datasets = reader.read(self._value("datasets"), self.datasets)
        is_swept = len(seeds) > 1
        if is_swept or any(item.seeds for item in datasets.values()):
            check_no_step(steps, SEED, log, (SEED,) if is_swept else ("datasets",))
        compare = check_comparison(
            file.compare, steps, step_names, tuple(datasets), seeds if is_swept else (), log
        )
        if compare is None and any(call.swept for step in steps for call in step.calls):
            compare = Comparison(baseline=first_variants(steps))
        workflow = Workflow(
            name=self._name(file),
            path=self.path,
            source=self.source,
            seed=seeds[0],
            seeds=seeds if is_swept else (),
            inputs=specs,
            steps=read,
            compare=compare,
            overrides=(
                *self._set_options(),
                *(option.without_folder for option in given),
                *self._data_options(),
            ),
            datasets=datasets,
            only_data=choose_data(self.only_data, datasets, log),
        )
        check_shared_inputs(workflow, shared, log)
        own = tuple(option for option in given if option.is_of_dataset)
        return workflow.with_input_specs(override_inputs(workflow.input_specs, own, log))

    def _value(self, key: str) -> Value | None:
        entry = self.tree.get(key)
        return entry.value if entry else None

    def _name(self, file: WorkflowFile) -> str:
        if file.name is None and self._value("name") is None:
            if re.fullmatch(NAME_PATTERN, self.path.stem):
                return self.path.stem
            message = f"{self.path.stem!r} cannot be a name: {NAME_RULE}"
            self.log.report((), message, shown=("name",))
        return file.name or self.path.stem

    def _overrides(self, steps: Sequence[DraftStep]) -> Overrides:
        """Return the settings of `--set-file` and then `--set` for each call."""
        return joined(
            *(overrides_of_settings(one.settings, (), steps, one.log) for one in self.profiles),
            overrides_of_options(self.sets, steps, self.log),
        )

    def _set_options(self) -> Iterator[str]:
        # A record contains no settings files: their entries are kept as if each had been set.
        for profile in self.profiles:
            for key, value in profile.settings.items():
                yield f"--set {key}={json.dumps(value, ensure_ascii=False)}"
        yield from (f"--set {text}" for text in self.sets)

    def _data_options(self) -> Iterator[str]:
        if isinstance(self.datasets, Mapping):
            yield f"datasets={first_few(list(self.datasets))}"
        elif self.datasets:
            yield f"--datasets {Path(self.datasets).name}"
        yield from (f"--only-data {text}" for text in self.only_data)

    # Steps ----------------------------------------------------------------------------------------

    def _steps(self, sections: Mapping[str, StepSection]) -> Iterator[DraftStep]:
        for name, section in sections.items():
            location = (_STEPS, name)
            if name == INPUTS:
                message = "a step cannot be called inputs, which names files"
                self.log.report(location, message, at_key=True)
                continue
            is_varied = section.variants is not None
            yield DraftStep(
                location=location,
                name=name,
                calls=self._variants(section, location)
                if is_varied
                else (self._call("", section, location),),
                inputs=section.in_,
                only_if=section.if_,
                unless=section.unless,
                is_varied=is_varied,
            )

    def _variants(self, section: StepSection, location: Location) -> tuple[DraftCall, ...]:
        for key in _OF_CALLS:
            if self.log.value((*location, key)) is not None:
                message = f"with variants, {key} belongs in each of them"
                self.log.report((*location, key), message, at_key=True)
        calls = [
            self._call(name, call, (*location, "variants", name))
            for name, call in (section.variants or {}).items()
        ]
        if (
            isinstance(table := self.log.value((*location, "variants")), Table)
            and not table.entries
        ):
            self.log.report((*location, "variants"), "expected at least one variant")
        kinds = [call.kind.name for call in calls if call.kind is not None]
        for call in calls:
            if call.kind is None:
                continue
            if call.kind.is_source:
                message = f"{call.method} is a source, and sources take no variants; give it a step"
                self.log.report((*call.location, "use"), message)
            elif call.kind.name != kinds[0]:
                message = (
                    "variants of a step must be of one kind, got "
                    f"{call.kind.name} beside {kinds[0]}"
                )
                self.log.report((*call.location, "use"), message)
        return tuple(calls)

    def _call(self, name: str, call: CallSection, location: Location) -> DraftCall:
        if as_plain(self.log.value((*location, "use"))) is None:
            message = "needs the key use, a method such as plane.hough2d"
            self.log.report(location, message, at_key=True)
        kind = self.catalog.kinds.get((call.use or "").partition(".")[0])
        return DraftCall(
            location=location,
            name=name,
            call=call,
            info=self._method(call.use, (*location, "use")) if call.use else None,
            kind=kind.spec if kind is not None and kind.state == "fine" else None,
        )

    def _method(self, method: str, location: Location) -> MethodInfo | None:
        try:
            return describe_method(self.catalog, method)
        except WorkflowError as error:
            self.log.report(location, str(error))
        except PluginError as error:
            self.log.report_plugin(location, str(error))
        return None

    def _step(self, draft: DraftStep, overrides: Overrides) -> WorkflowStep:
        return draft.checked(
            resolve_call(call, overrides.get((draft.name, call.name), ()), self.log)
            for call in draft.calls
        )
