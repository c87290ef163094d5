"""Reading a workflow file: one pass that finds every problem, or a workflow that can run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from orthoflow.catalog import Catalog
from orthoflow.errors import WorkflowError
from orthoflow.files.yaml_positions import Entry, Table, read_yaml
from orthoflow.workflow.comparison import check_baseline, read_compare
from orthoflow.workflow.format import (
    COMPARE,
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
from orthoflow.workflow.inputs import override_inputs, read_input_options, read_inputs
from orthoflow.workflow.parameters import CallName, assign_overrides, resolve_params
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.recipes import find_workflow
from orthoflow.workflow.shapes import check_name
from orthoflow.workflow.steps import DraftStep, read_steps
from orthoflow.workflow.wiring import check_wiring

MOST_BYTES: Final = 400_000


def load_workflow(
    name_or_path: str | Path,
    catalog: Catalog,
    *,
    sets: Sequence[str] = (),
    inputs: Sequence[str] = (),
) -> Workflow:
    """Read and check a workflow.

    Args:
        name_or_path: an existing file, else the name of a shipped recipe.
        catalog: the installed plugins.
        sets: `step[.variant].param=value`, each as behind `--set`.
        inputs: `NAME=PATH`, each as behind `--input`; relative to the working directory.

    Raises:
        InvalidWorkflowError: the file has problems; the message lists all of them.
        InvalidArgumentsError: the file is fine, `sets` or `inputs` are not.
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
    reader = _Reader(path=path, source=source, catalog=catalog, log=log)
    workflow = reader.read(table, sets, inputs)
    log.raise_any()
    return workflow


def _read_text(path: Path) -> str:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise WorkflowError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) > MOST_BYTES:
        raise WorkflowError(
            f"{path} has {len(content)} bytes; a workflow file has at most {MOST_BYTES}"
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise WorkflowError(
            f"{path}:{line}: expected UTF-8 text, got the byte 0x{content[error.start]:02x}"
        ) from error


@dataclass(frozen=True, kw_only=True)
class _Reader:
    """Reads one document; everything wrong goes to the log."""

    path: Path
    source: str
    catalog: Catalog
    log: ProblemLog

    def read(self, table: Table, sets: Sequence[str], input_options: Sequence[str]) -> Workflow:
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
        compare = self._compare(table.get(COMPARE.name), steps, step_names)
        given = read_input_options(input_options, self.log)
        return Workflow(
            name=self._name(table),
            path=self.path,
            source=self.source,
            seed=SEED.read(table, "", self.log) or 0,
            inputs=override_inputs(specs, given, self.log),
            steps=self._steps(steps, sets),
            compare=compare,
            overrides=(
                *(f"--set {text}" for text in sets),
                *(option.without_folder for option in given),
            ),
        )

    def _name(self, table: Table) -> str:
        if table.get(NAME.name) is not None:
            return NAME.read(table, "", self.log) or ""
        check_name(self.path.stem, table.position, NAME.name, self.log)
        return self.path.stem

    def _compare(
        self, entry: Entry | None, steps: Sequence[DraftStep], step_names: Sequence[str]
    ) -> Comparison | None:
        if entry is None:
            return None
        comparison = read_compare(entry.value, steps, step_names, self.log)
        if comparison is not None:
            check_baseline(comparison, entry.position, self.log)
        return comparison

    def _steps(self, drafts: Sequence[DraftStep], sets: Sequence[str]) -> dict[str, WorkflowStep]:
        overrides = assign_overrides(sets, drafts, self.log)
        steps: dict[str, WorkflowStep] = {}
        for draft in drafts:
            variants = []
            for variant in draft.variants:
                call = CallName(step=draft.name, variant=variant.call.name)
                params = resolve_params(variant, overrides.get(call, ()), self.log)
                variants.append(
                    replace(variant.call, params=params.resolved, params_set=params.as_set)
                )
            steps[draft.name] = WorkflowStep(
                name=draft.name,
                variants=tuple(variants),
                inputs={
                    port.name: tuple(placed.reference for placed in port.references)
                    for port in draft.ports
                },
                unless=draft.unless.reference.name if draft.unless else "",
                is_varied=draft.is_varied,
            )
        return steps
