"""The resolved form of a workflow, as records keep it: all defaults and overrides, as JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

from pydantic import AfterValidator, BaseModel, Field, TypeAdapter, ValidationError

from orthoflow.errors import WorkflowError
from orthoflow.products.product import JsonValue
from orthoflow.workflow.model import (
    FORMAT,
    Comparison,
    Dataset,
    Workflow,
    WorkflowInputSpec,
    WorkflowStep,
    check_name,
    factors_of,
    is_acyclic,
)

_STEP: Final = TypeAdapter(WorkflowStep)
_PLACE: Final = "the resolved workflow"


class _ResolvedInput(BaseModel):
    files: tuple[str, ...]
    optional: bool

    def spec(self, name: str) -> WorkflowInputSpec:
        return WorkflowInputSpec(name=name, files=self.files, optional=self.optional)


class _ResolvedDataset(BaseModel):
    inputs: dict[str, _ResolvedInput]
    sets: dict[str, Any] = Field(alias="set")
    seeds: tuple[int, ...] = ()


_ResolvedName: TypeAlias = Annotated[str, AfterValidator(check_name)]


class _Resolved(BaseModel):
    """The form of a resolved workflow: a record may contain anything."""

    orthoflow: Literal[1]
    name: _ResolvedName
    seed: int
    seeds: tuple[int, ...] = ()
    inputs: dict[_ResolvedName, _ResolvedInput]
    steps: dict[_ResolvedName, WorkflowStep]
    compare: Comparison | None
    overrides: tuple[str, ...]
    datasets: dict[_ResolvedName, _ResolvedDataset] = {}


def resolved_json(workflow: Workflow) -> str:
    """Return the workflow with all defaults and overrides as canonical JSON.

    Paths from the command line are reduced to their last part: records contain no paths of the
    machine on which they were made.
    """
    document: dict[str, object] = {
        "orthoflow": FORMAT,
        "name": workflow.name,
        "seed": workflow.seed,
        "inputs": {name: _input_json(spec) for name, spec in workflow.inputs.items()},
        "steps": {
            name: _STEP.dump_python(step, mode="json", by_alias=True)
            for name, step in workflow.steps.items()
        },
        "compare": workflow.compare.model_dump() if workflow.compare else None,
        "overrides": list(workflow.overrides),
    }
    if workflow.seeds:
        document["seeds"] = list(workflow.seeds)
    if workflow.datasets:
        document["datasets"] = {
            item.name: {
                "inputs": {name: _input_json(spec) for name, spec in item.inputs.items()},
                "set": dict(item.sets),
                **({"seeds": list(item.seeds)} if item.seeds else {}),
            }
            for item in workflow.chosen_data
        }
    return json.dumps(
        document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def _input_json(spec: WorkflowInputSpec) -> JsonValue:
    def recorded(name: str) -> str:
        # A table, unlike the workflow, is not in the record with its folders.
        is_private = spec.is_given or (spec.table and Path(name).is_absolute())
        return Path(name).name if is_private else name

    return {"files": [recorded(name) for name in spec.files], "optional": spec.optional}


def workflow_from_resolved(resolved: str, source: str) -> Workflow:
    """Build a workflow that was checked and resolved before; plugins are not needed.

    Args:
        resolved: result of `resolved_json`.
        source: text of the workflow file as written.

    Raises:
        WorkflowError: the text is not a resolved workflow, or one of a newer format.
    """
    try:
        workflow = _from_resolved(_Resolved.model_validate_json(resolved, strict=True), source)
        _check_resolved(workflow)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise WorkflowError(f"{_PLACE} cannot be read: {place}: {first['msg']}") from error
    except (ValueError, KeyError, RecursionError) as error:
        raise WorkflowError(f"{_PLACE} cannot be read: {type(error).__name__} {error}") from error
    return workflow


def _from_resolved(document: _Resolved, source: str) -> Workflow:
    return Workflow(
        name=document.name,
        path=Path(f"{document.name}.yaml"),
        source=source,
        seed=document.seed,
        seeds=document.seeds,
        inputs={name: given.spec(name) for name, given in document.inputs.items()},
        steps={name: replace(step, name=name) for name, step in document.steps.items()},
        compare=document.compare,
        overrides=document.overrides,
        datasets={
            data: Dataset(
                name=data,
                inputs={name: item.spec(f"{name}@{data}") for name, item in given.inputs.items()},
                sets=given.sets,
                seeds=given.seeds,
            )
            for data, given in document.datasets.items()
        },
    )


def _check_resolved(workflow: Workflow) -> None:
    """Repeat the checks of a file, since a record may have been changed.

    Raises:
        ValueError: a value is out of range, or names something that does not exist.
    """
    factors = factors_of(workflow)
    for dataset in workflow.datasets.values():
        if unknown := dataset.inputs.keys() - workflow.inputs.keys():
            raise ValueError(f"dataset {dataset.name} names an unknown input {min(unknown)!r}")
    if taken := factors & workflow.steps.keys():
        raise ValueError(f"a step is called {min(taken)}, which is a factor of addresses")
    for step in workflow.steps.values():
        _check_resolved_step(workflow, step)
    if not is_acyclic({name: step.upstream() for name, step in workflow.steps.items()}):
        raise ValueError("its steps need each other in a circle")
    compare = workflow.compare or Comparison()
    named = [pair for one in (compare.baseline, *compare.exclude) for pair in one.items()]
    for name, variant in named:
        if name not in factors and variant not in [
            one.name for one in workflow.steps[name].variants
        ]:
            raise ValueError(f"step {name} has no variant of the comparison")


def _check_resolved_step(workflow: Workflow, step: WorkflowStep) -> None:
    if not step.variants or not (step.is_varied or len(step.variants) == 1):
        raise ValueError(f"step {step.name} has {len(step.variants)} variants")
    if not step.is_varied and step.variants[0].name:
        raise ValueError(f"step {step.name} has a variant, but is stated to have none")
    for variant in step.variants if step.is_varied else ():
        check_name(variant.name)
    if len({variant.name for variant in step.variants}) != len(step.variants):
        raise ValueError(f"step {step.name} has two variants of one name")
    if not step.conditions <= workflow.inputs.keys():
        raise ValueError(f"step {step.name} depends on an unknown input")
    for reference in step.references:
        known = workflow.inputs if reference.is_input else workflow.steps
        if (reference.name if reference.is_input else reference.source) not in known:
            raise ValueError(f"step {step.name} takes {reference}, which is not there")
