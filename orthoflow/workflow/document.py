"""Reads and checks a workflow file, and reports all problems at once."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.errors import PluginError, WorkflowError
from orthoflow.files.yaml_positions import Location, describe
from orthoflow.products.product import JsonValue
from orthoflow.sdk.methods import Method
from orthoflow.untrusted_text import first_few
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
)
from orthoflow.workflow.model import (
    INPUTS,
    NAME_RULE,
    SEED,
    CallSection,
    Comparison,
    SeedSection,
    StepSection,
    Workflow,
    WorkflowFile,
    WorkflowStep,
)
from orthoflow.workflow.parameters import (
    DraftCall,
    DraftStep,
    expand_sweeps,
    joined,
    overrides_of_options,
    overrides_of_settings,
    resolve_call,
)
from orthoflow.workflow.source import ProblemLog, find_workflow, read_text, validate

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
        name_or_path: path of a workflow file, or name of a shipped recipe.
        catalog: the installed plugins.
        sets: settings in the form `step[.variant].param=value`, as for `--set`.
        inputs: inputs as `NAME=PATH`, as for `--input`; paths are relative to the working
            directory.
        datasets: path of a table that replaces the datasets in the file, as for `--datasets`, or
            the content of the section `datasets`.
        only_data: names of the datasets to select, as for `--only-data`.
        set_files: YAML files with lines `step.parameter: value`, as for `--set-file`; values in
            `sets` take precedence.
        also_files: whether to report missing input files, too, if the file has other problems.

    Raises:
        InvalidWorkflowError: the file has problems; the message lists all of them.
        InvalidArgumentsError: the file is valid, but the options are not.
        UnusablePluginError: plugins are broken or missing, and there is no other problem.
        WorkflowError: the file does not exist or cannot be read.
    """
    path = find_workflow(name_or_path)
    source = read_text(path)
    log = ProblemLog(file=str(name_or_path), lines=tuple(source.splitlines()))
    if not _is_mapping(log, source):
        log.raise_any()
        raise WorkflowError(f"{name_or_path} is empty; expected a workflow")
    for key, needed in (
        ("orthoflow", "a workflow begins with orthoflow: 1"),
        (_STEPS, "a workflow needs the key `steps`"),
    ):
        if not log.has((key,)):
            log.report((key,), needed)
    if not log.has((_STEPS,)):
        # The other sections refer to steps, so each of these references would be reported as a
        # problem.
        _sections(log)
        log.raise_any()
    profiles = [_read_profile(Path(name), log) for name in set_files]
    reader = _Reader(path=path, source=source, catalog=catalog, log=log)
    workflow = reader.read(tuple(sets), tuple(inputs), datasets, tuple(only_data), tuple(profiles))
    if also_files and log.has_any:
        # If there are no other problems, the caller searches for the input files itself.
        add_missing_inputs(workflow, log)
    log.raise_any()
    return workflow


def _is_mapping(log: ProblemLog, text: str) -> bool:
    found = log.parse(text)
    if found and not isinstance(found.value, dict):
        log.report((), f"expected a mapping, got {describe(found.value)}")
    return isinstance(log.document.value, dict)


def _sections(log: ProblemLog) -> WorkflowFile:
    data = log.get(())
    assert isinstance(data, dict)  # noqa: S101 - checked before
    sections = {key: value for key, value in data.items() if key != "datasets"}
    return validate(WorkflowFile, sections, log) or WorkflowFile()


def _read_profile(path: Path, log: ProblemLog) -> ProblemLog:
    try:
        text = read_text(path, "a settings file")
    except WorkflowError as error:
        log.report_option(f"--set-file {path}", str(error))
        text = "{}"
    beside = log.beside(str(path), text)
    _is_mapping(beside, text)
    return beside


def _settings(profile: ProblemLog) -> dict[str, JsonValue]:
    settings = profile.get(())
    return settings if isinstance(settings, dict) else {}


@dataclass(frozen=True, kw_only=True)
class _Reader:
    """Reads one document and adds all problems to the log."""

    path: Path
    source: str
    catalog: Catalog
    log: ProblemLog

    def read(
        self,
        sets: Sequence[str],
        inputs: Sequence[str],
        datasets: str | Mapping[str, JsonValue],
        only_data: Sequence[str],
        profiles: Sequence[ProblemLog],
    ) -> Workflow:
        """Read all sections; the result is valid only if the log is empty."""
        log = self.log
        file = _sections(log)
        folder = self.path.resolve().parent
        seeds = SeedSection(seed=file.seed).seeds
        specs = input_specs(file.inputs, folder, log)
        steps = tuple(self._steps(file.steps))
        section = log.get((_STEPS,))
        step_names = tuple(section) if isinstance(section, dict) else ()
        if section == {}:
            log.report((_STEPS,), "a workflow needs at least one step")
        check_wiring(steps, step_names, tuple(specs), log)
        given = read_input_options(inputs, log)
        shared = tuple(option for option in given if not option.is_of_dataset)
        specs = override_inputs(specs, shared, log)
        overrides = joined(
            *(overrides_of_settings(_settings(one), (), steps, one) for one in profiles),
            overrides_of_options(sets, steps, log),
        )
        steps, overrides = expand_sweeps(steps, overrides, log)
        read = {
            step.name: WorkflowStep(
                name=step.name,
                variants=tuple(
                    resolve_call(call, overrides.get((step.name, call.name), ()), log)
                    for call in step.calls
                ),
                inputs=step.inputs,
                only_if=step.only_if.name if step.only_if else "",
                unless=step.unless.name if step.unless else "",
                is_varied=step.is_varied,
            )
            for step in steps
        }
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
        found = reader.read(datasets)
        is_swept = len(seeds) > 1
        if is_swept or any(item.seeds for item in found.values()):
            check_no_step(steps, SEED, log, (SEED,) if is_swept else ("datasets",))
        compare = check_comparison(
            file.compare, steps, step_names, tuple(found), seeds if is_swept else (), log
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
                # Records contain no settings files, so each setting in them is recorded as `--set`.
                *(
                    f"--set {key}={json.dumps(value, ensure_ascii=False)}"
                    for profile in profiles
                    for key, value in _settings(profile).items()
                ),
                *(f"--set {text}" for text in sets),
                *(option.without_folder for option in given),
                *_data_options(datasets, only_data),
            ),
            datasets=found,
            only_data=choose_data(only_data, found, log),
        )
        check_shared_inputs(workflow, shared, log)
        own = tuple(option for option in given if option.is_of_dataset)
        return workflow.with_input_specs(override_inputs(workflow.input_specs, own, log))

    def _name(self, file: WorkflowFile) -> str:
        if not self.log.has(("name",)):
            if re.fullmatch(NAME_PATTERN, self.path.stem):
                return self.path.stem
            message = (
                f"the file name {self.path.stem!r} cannot be the name of a workflow: {NAME_RULE}"
            )
            self.log.report((), message, shown=("name",))
        return file.name or self.path.stem

    def _steps(self, sections: Mapping[str, StepSection]) -> Iterator[DraftStep]:
        for name, section in sections.items():
            location = (_STEPS, name)
            if name == INPUTS:
                message = (
                    "a step cannot be called inputs, because inputs.NAME refers to input files"
                )
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
            if self.log.has((*location, key)):
                message = f"a step with variants cannot have {key}; move it into each variant"
                self.log.report((*location, key), message, at_key=True)
        calls = [
            self._call(name, call, (*location, "variants", name))
            for name, call in (section.variants or {}).items()
        ]
        if self.log.get((*location, "variants")) == {}:
            self.log.report((*location, "variants"), "expected at least one variant")
        kinds = [call.kind.name for call in calls if call.kind is not None]
        for call in calls:
            if call.kind is None:
                continue
            if call.kind.is_source:
                message = (
                    f"{call.id} is a source, and sources cannot have variants; make it a separate "
                    "step"
                )
                self.log.report((*call.location, "use"), message)
            elif call.kind.name != kinds[0]:
                message = (
                    "all variants of a step must have the same kind, got "
                    f"{call.kind.name} and {kinds[0]}"
                )
                self.log.report((*call.location, "use"), message)
        return tuple(calls)

    def _call(self, name: str, call: CallSection, location: Location) -> DraftCall:
        if self.log.get((*location, "use")) is None:
            message = "the key `use` is missing; it selects a method, such as plane.hough2d"
            self.log.report(location, message, at_key=True)
        kind = self.catalog.kinds.get((call.use or "").partition(".")[0])
        return DraftCall(
            location=location,
            name=name,
            call=call,
            method=self._method(call.use, (*location, "use")) if call.use else None,
            kind=kind.spec if kind is not None and kind.state == "fine" else None,
        )

    def _method(self, method: str, location: Location) -> type[Method] | None:
        try:
            return self.catalog.method(method).load()
        except WorkflowError as error:
            self.log.report(location, str(error))
        except PluginError as error:
            self.log.report_plugin(location, str(error))
        return None


def _data_options(
    datasets: str | Mapping[str, JsonValue], only_data: Iterable[str]
) -> Iterator[str]:
    if isinstance(datasets, Mapping):
        yield f"datasets={first_few(list(datasets))}"
    elif datasets:
        yield f"--datasets {Path(datasets).name}"
    yield from (f"--only-data {text}" for text in only_data)
