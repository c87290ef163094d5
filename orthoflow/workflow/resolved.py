"""The resolved form of a workflow, as records keep it: all defaults and overrides, as JSON."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, Field, ValidationError

from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.errors import WorkflowError
from orthoflow.files.json_texts import parse_json
from orthoflow.products.product import JsonValue
from orthoflow.workflow.format import (
    DATA,
    FORMAT,
    MOST_REPEATS,
    Comparison,
    Dataset,
    StepVariant,
    Workflow,
    WorkflowInputSpec,
    WorkflowStep,
)
from orthoflow.workflow.shapes import Reference, seconds_in
from orthoflow.workflow.wiring import is_acyclic, step_graph

_PLACE: Final = "the resolved workflow"


def resolved_json(workflow: Workflow) -> str:
    """Give the workflow with all defaults and overrides as canonical JSON.

    Paths that came from the command line are reduced to their last part: records hold no paths of
    the machine they were made on.
    """
    document: dict[str, object] = {
        "orthoflow": FORMAT,
        "name": workflow.name,
        "seed": workflow.seed,
        "inputs": {name: _input_json(spec) for name, spec in workflow.inputs.items()},
        "steps": {step.name: _step_json(step) for step in workflow.steps.values()},
        "compare": asdict(workflow.compare) if workflow.compare else None,
        "overrides": list(workflow.overrides),
    }
    if workflow.datasets:
        document["datasets"] = {
            item.name: {
                "inputs": {name: _input_json(spec) for name, spec in item.inputs.items()},
                "set": dict(item.sets),
            }
            for item in workflow.chosen_data
        }
    return json.dumps(
        document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def _input_json(spec: WorkflowInputSpec) -> JsonValue:
    def recorded(name: str) -> str:
        # A table, unlike the workflow, is not in the record with its folders.
        is_private = spec.is_given or (spec.said_in and Path(name).is_absolute())
        return Path(name).name if is_private else name

    return {"files": [recorded(name) for name in spec.files], "optional": spec.optional}


def workflow_from_resolved(resolved: str, source: str) -> Workflow:
    """Build a workflow that was checked and resolved before; no plugin is asked.

    Args:
        resolved: what `resolved_json` gave.
        source: text of the workflow file as written.

    Raises:
        WorkflowError: the text is no resolved workflow, or one of a newer format.
    """
    try:
        _check_format(parse_json(resolved))
        document = _Document.model_validate_json(resolved, strict=True)
        workflow = _workflow(document, source)
        _check(workflow)
    except WorkflowError:
        raise
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise WorkflowError(f"{_PLACE} cannot be read: {place}: {first['msg']}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise WorkflowError(f"{_PLACE} cannot be read: {type(error).__name__} {error}") from error
    return workflow


def _workflow(document: _Document, source: str) -> Workflow:
    return Workflow(
        name=document.name,
        path=Path(f"{document.name}.yaml"),
        source=source,
        seed=document.seed,
        inputs={name: given.spec(name) for name, given in document.inputs.items()},
        steps={name: _step(name, given) for name, given in document.steps.items()},
        compare=document.compare,
        overrides=document.overrides,
        datasets={
            data: Dataset(
                name=data,
                inputs={name: item.spec(f"{name}@{data}") for name, item in given.inputs.items()},
                sets=given.sets,
            )
            for data, given in document.datasets.items()
        },
    )


def _step_json(step: WorkflowStep) -> dict[str, object]:
    return {
        "in": {port: [str(item) for item in items] for port, items in step.inputs.items()},
        "unless": step.unless,
        **({"if": step.only_if} if step.only_if else {}),
        "is_varied": step.is_varied,
        "variants": [_variant_json(variant) for variant in step.variants],
    }


def _variant_json(variant: StepVariant) -> dict[str, object]:
    document = asdict(variant)
    return {"use": document.pop("method"), **document}


# Any: JSON whose form the caller's `except` looks at.
def _check_format(document: Any) -> None:
    version = document["orthoflow"]
    if version != FORMAT:
        raise WorkflowError(f"{_PLACE} has format {version}, this orthoflow reads {FORMAT}")


class _VariantDocument(BaseModel, extra="forbid"):
    """A recorded method call."""

    name: str
    method: str = Field(alias="use")
    params: dict[str, Any]
    params_set: dict[str, Any]
    repeat: int = Field(ge=1)
    cores: int | None = Field(ge=1)
    timeout_s: float | None = Field(gt=0, allow_inf_nan=False)


class _StepDocument(BaseModel):
    inputs: dict[str, list[str]] = Field(alias="in")
    only_if: str = Field(alias="if", default="")
    unless: str
    is_varied: bool
    variants: list[_VariantDocument]


class _InputDocument(BaseModel):
    files: tuple[str, ...]
    optional: bool

    def spec(self, name: str) -> WorkflowInputSpec:
        return WorkflowInputSpec(name=name, files=self.files, optional=self.optional)


class _DatasetDocument(BaseModel):
    inputs: dict[str, _InputDocument]
    sets: dict[str, Any] = Field(alias="set")


class _Document(BaseModel):
    """The form of a resolved workflow: whoever wrote the record may have written anything."""

    name: str
    seed: int
    inputs: dict[str, _InputDocument]
    steps: dict[str, _StepDocument]
    compare: Comparison | None
    overrides: tuple[str, ...]
    datasets: dict[str, _DatasetDocument] = {}


def _step(name: str, given: _StepDocument) -> WorkflowStep:
    return WorkflowStep(
        name=name,
        variants=tuple(StepVariant(**dict(variant)) for variant in given.variants),
        inputs={
            port: tuple(_reference(text) for text in texts) for port, texts in given.inputs.items()
        },
        only_if=given.only_if,
        unless=given.unless,
        is_varied=given.is_varied,
    )


def _reference(text: str) -> Reference:
    source, _, name = text.partition(".")
    return Reference(source=source, name=name)


def _check(workflow: Workflow) -> None:
    """Look at what the file's checks had looked at, since a record may have been changed.

    Raises:
        ValueError: a value is out of range, or names what is not there.
    """
    names = [workflow.name, *workflow.inputs, *workflow.steps]
    for dataset in workflow.datasets.values():
        names += [dataset.name, *dataset.inputs]
        if strangers := dataset.inputs.keys() - workflow.inputs.keys():
            raise ValueError(f"dataset {dataset.name} names an unknown input {min(strangers)!r}")
    if workflow.datasets and DATA in workflow.steps:
        raise ValueError(f"a step is called {DATA} beside datasets")
    for step in workflow.steps.values():
        names += [variant.name for variant in step.variants if step.is_varied]
    for name in names:
        if not re.fullmatch(NAME_PATTERN, name):
            raise ValueError(f"{name[:60]!r} cannot be a name")
    for step in workflow.steps.values():
        _check_step(workflow, step)
    if not is_acyclic(step_graph(workflow.steps).sources):
        raise ValueError("its steps need each other in a circle")
    if workflow.compare is not None:
        _check_comparison(workflow, workflow.compare)


def _check_step(workflow: Workflow, step: WorkflowStep) -> None:
    if not step.variants or not (step.is_varied or len(step.variants) == 1):
        raise ValueError(f"step {step.name} has {len(step.variants)} variants")
    if not step.is_varied and step.variants[0].name:
        raise ValueError(f"step {step.name} has a variant, and is said to have none")
    for variant in step.variants:
        _check_variant(variant)
    if len({variant.name for variant in step.variants}) != len(step.variants):
        raise ValueError(f"step {step.name} has two variants of one name")
    if not step.asked_inputs <= workflow.inputs.keys():
        raise ValueError(f"step {step.name} hangs on an unknown input")
    for reference in (item for references in step.inputs.values() for item in references):
        known = workflow.inputs if reference.is_input else workflow.steps
        if (reference.name if reference.is_input else reference.source) not in known:
            raise ValueError(f"step {step.name} takes {reference}, which is not there")


def _check_variant(variant: StepVariant) -> None:
    if variant.repeat > MOST_REPEATS:
        raise ValueError(f"{variant.method} is repeated {variant.repeat} times")
    if variant.timeout_s is not None and seconds_in(variant.timeout_s) is None:
        raise ValueError(f"{variant.method} has no usable time limit")


def _check_comparison(workflow: Workflow, comparison: Comparison) -> None:
    for assignment in (comparison.baseline, *comparison.exclude):
        for step, variant in assignment.items():
            if step == DATA and workflow.datasets:
                continue
            if variant not in [item.name for item in workflow.steps[step].variants]:
                raise ValueError(f"step {step} has no variant of the comparison")
