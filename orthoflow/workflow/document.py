"""Reading a workflow file: one pass that finds every problem, or a workflow that can run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.catalog import Catalog
from orthoflow.errors import WorkflowError
from orthoflow.files.yaml_positions import Entry, Table, read_yaml
from orthoflow.products.product import JsonValue
from orthoflow.workflow.expectations import (
    check_name,
    expect_table,
    expect_text,
    expect_whole_number,
)
from orthoflow.workflow.input_options import override_inputs, read_input_options
from orthoflow.workflow.model import Comparison, StepVariant, Workflow, WorkflowStep
from orthoflow.workflow.overrides import CallName, assign_overrides
from orthoflow.workflow.parameters import resolve_params
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.recipes import find_workflow
from orthoflow.workflow.sections import check_baseline, read_compare, read_inputs
from orthoflow.workflow.steps import DraftStep, read_steps
from orthoflow.workflow.wiring import check_wiring

FORMAT: Final = 1
MAX_BYTES: Final = 1 << 20
_KEYS: Final = ("orthoflow", "name", "seed", "inputs", "steps", "compare")


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
    table = expect_table(value, "", log, _KEYS) if value is not None else None
    if table is None:
        log.raise_any()
        raise WorkflowError(f"{name_or_path} holds no workflow")
    reader = _Reader(path=path, source=source, catalog=catalog, log=log)
    workflow = reader.read(table, sets, inputs)
    log.raise_any()
    return workflow


def resolved_json(workflow: Workflow) -> str:
    """Give the workflow with all defaults and overrides as canonical JSON.

    Paths that came from the command line are reduced to their last part: records hold no paths of
    the machine they were made on.
    """
    document: dict[str, object] = {
        "orthoflow": FORMAT,
        "name": workflow.name,
        "seed": workflow.seed,
        "inputs": {
            spec.name: {
                "files": [Path(name).name if spec.is_given else name for name in spec.files],
                "optional": spec.optional,
            }
            for spec in workflow.inputs.values()
        },
        "steps": {step.name: _step_json(step) for step in workflow.steps.values()},
        "compare": _compare_json(workflow.compare),
        "overrides": list(workflow.overrides),
    }
    return json.dumps(
        document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def _step_json(step: WorkflowStep) -> dict[str, object]:
    return {
        "in": {port: [str(item) for item in items] for port, items in step.inputs.items()},
        "unless": step.unless,
        "is_varied": step.is_varied,
        "variants": [
            {
                "name": variant.name,
                "use": variant.method,
                "params": dict(variant.params),
                "params_set": dict(variant.params_set),
                "repeat": variant.repeat,
                "cores": variant.cores,
                "timeout_s": variant.timeout_s,
            }
            for variant in step.variants
        ],
    }


def _compare_json(comparison: Comparison | None) -> JsonValue:
    if comparison is None:
        return None
    return {
        "design": comparison.design,
        "baseline": dict(comparison.baseline),
        "exclude": [dict(combination) for combination in comparison.exclude],
        "metrics": list(comparison.metrics),
    }


def _read_text(path: Path) -> str:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise WorkflowError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) > MAX_BYTES:
        raise WorkflowError(
            f"{path} has {len(content)} bytes; a workflow file has at most {MAX_BYTES}"
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
        self._check_format(table)
        section = table.get("inputs")
        specs = read_inputs(section.value, self.path.resolve().parent, self.log) if section else {}
        steps_entry = table.get("steps")
        steps: tuple[DraftStep, ...] = ()
        step_names: tuple[str, ...] = ()
        if steps_entry is None:
            self.log.add(table.position, "steps", "a workflow needs the key steps")
        else:
            steps = read_steps(steps_entry.value, self.catalog, self.log)
            if isinstance(steps_entry.value, Table):
                step_names = tuple(entry.key for entry in steps_entry.value)
        check_wiring(steps, step_names, tuple(specs), self.log)
        compare = self._compare(table.get("compare"), steps, step_names)
        given = read_input_options(input_options, self.log)
        return Workflow(
            name=self._name(table),
            path=self.path,
            source=self.source,
            seed=self._seed(table.get("seed")),
            inputs=override_inputs(specs, given, self.log),
            steps=self._steps(steps, sets),
            compare=compare,
            overrides=(
                *(f"--set {text}" for text in sets),
                *(option.without_folder for option in given),
            ),
        )

    def _check_format(self, table: Table) -> None:
        entry = table.get("orthoflow")
        if entry is None:
            self.log.add(table.position, "orthoflow", f"a workflow begins with orthoflow: {FORMAT}")
            return
        version = expect_whole_number(entry.value, "orthoflow", self.log, minimum=1)
        if version is not None and version > FORMAT:
            self.log.add(
                entry.value.position,
                "orthoflow",
                f"the file has workflow format {version}, this orthoflow reads {FORMAT}; "
                f"upgrade orthoflow",
            )

    def _name(self, table: Table) -> str:
        entry = table.get("name")
        if entry is None:
            check_name(self.path.stem, table.position, "name", self.log)
            return self.path.stem
        name = expect_text(entry.value, "name", self.log)
        if name is not None:
            check_name(name, entry.value.position, "name", self.log)
        return name or ""

    def _seed(self, entry: Entry | None) -> int:
        if entry is None:
            return 0
        return expect_whole_number(entry.value, "seed", self.log, minimum=0) or 0

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
            variants: list[StepVariant] = []
            for variant in draft.variants:
                call = CallName(step=draft.name, variant=variant.name)
                params = resolve_params(variant, overrides.get(call, ()), self.log)
                variants.append(
                    StepVariant(
                        name=variant.name,
                        method=variant.method,
                        params=params.resolved,
                        params_set=params.as_set,
                        repeat=variant.repeat,
                        cores=variant.cores,
                        timeout_s=variant.timeout_s,
                    )
                )
            steps[draft.name] = WorkflowStep(
                name=draft.name,
                variants=tuple(variants),
                inputs={
                    port.name: tuple(reference.reference for reference in port.references)
                    for port in draft.ports
                },
                unless=draft.unless.reference.name if draft.unless else "",
                is_varied=draft.is_varied,
            )
        return steps
