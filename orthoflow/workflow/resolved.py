"""The resolved form of a workflow, as records keep it: all defaults and overrides, as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from orthoflow.errors import WorkflowError
from orthoflow.products.product import JsonValue
from orthoflow.workflow.format import (
    FORMAT,
    Comparison,
    StepVariant,
    Workflow,
    WorkflowInputSpec,
    WorkflowStep,
)
from orthoflow.workflow.shapes import Reference

_PLACE: Final = "the resolved workflow"
# What every record says of a method call; a key that came later may be missing in older ones.
_EVER_RECORDED: Final = frozenset(
    {"name", "use", "params", "params_set", "repeat", "cores", "timeout_s"}
)


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


def workflow_from_resolved(resolved: str, source: str) -> Workflow:
    """Build a workflow that was checked and resolved before; no plugin is asked.

    Args:
        resolved: what `resolved_json` gave.
        source: text of the workflow file as written.

    Raises:
        WorkflowError: the text is no resolved workflow, or one of a newer format.
    """
    try:
        document = json.loads(resolved)
        _check_format(document["orthoflow"])
        return Workflow(
            name=document["name"],
            path=Path(f"{document['name']}.yaml"),
            source=source,
            seed=document["seed"],
            inputs={
                name: WorkflowInputSpec(
                    name=name, files=tuple(entry["files"]), optional=entry["optional"]
                )
                for name, entry in document["inputs"].items()
            },
            steps={name: _step(name, entry) for name, entry in document["steps"].items()},
            compare=_comparison(document["compare"]),
            overrides=tuple(document["overrides"]),
        )
    except WorkflowError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise WorkflowError(f"{_PLACE} cannot be read: {type(error).__name__} {error}") from error


def _step_json(step: WorkflowStep) -> dict[str, object]:
    return {
        "in": {port: [str(item) for item in items] for port, items in step.inputs.items()},
        "unless": step.unless,
        "is_varied": step.is_varied,
        "variants": [_variant_json(variant) for variant in step.variants],
    }


def _variant_json(variant: StepVariant) -> dict[str, object]:
    document = asdict(variant)
    return {"use": document.pop("method"), **document}


def _compare_json(comparison: Comparison | None) -> JsonValue:
    if comparison is None:
        return None
    return {
        "design": comparison.design,
        "baseline": dict(comparison.baseline),
        "exclude": [dict(combination) for combination in comparison.exclude],
        "metrics": list(comparison.metrics),
    }


def _check_format(version: object) -> None:
    if version != FORMAT:
        raise WorkflowError(f"{_PLACE} has format {version}, this orthoflow reads {FORMAT}")


# Any: JSON whose form the caller's `except` checks.
def _step(name: str, entry: Mapping[str, Any]) -> WorkflowStep:
    return WorkflowStep(
        name=name,
        variants=tuple(_variant(variant) for variant in entry["variants"]),
        inputs={
            port: tuple(_reference(text) for text in texts) for port, texts in entry["in"].items()
        },
        unless=entry["unless"],
        is_varied=entry["is_varied"],
    )


def _variant(entry: Mapping[str, Any]) -> StepVariant:
    if missing := sorted(_EVER_RECORDED - entry.keys()):
        raise KeyError(missing[0])
    fields = dict(entry)
    return StepVariant(method=fields.pop("use"), **fields)


def _reference(text: str) -> Reference:
    source, _, name = text.partition(".")
    return Reference(source=source, name=name)


def _comparison(entry: Mapping[str, Any] | None) -> Comparison | None:
    if entry is None:
        return None
    return Comparison(
        design=entry["design"],
        baseline=entry["baseline"],
        exclude=tuple(entry["exclude"]),
        metrics=tuple(entry["metrics"]),
    )
