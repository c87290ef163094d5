"""A workflow from its resolved form, as records keep it: the way back from `resolved_json`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from orthoflow.errors import WorkflowError
from orthoflow.workflow.document import FORMAT
from orthoflow.workflow.model import (
    Comparison,
    Reference,
    StepVariant,
    Workflow,
    WorkflowInputSpec,
    WorkflowStep,
)

_PLACE: Final = "the resolved workflow"


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


def _check_format(version: object) -> None:
    if version != FORMAT:
        raise WorkflowError(f"{_PLACE} has format {version}, this orthoflow reads {FORMAT}")


# Any: JSON whose form the caller's `except` checks.
def _step(name: str, entry: Mapping[str, Any]) -> WorkflowStep:
    return WorkflowStep(
        name=name,
        variants=tuple(
            StepVariant(
                name=variant["name"],
                method=variant["use"],
                params=variant["params"],
                params_set=variant["params_set"],
                repeat=variant["repeat"],
                cores=variant["cores"],
                timeout_s=variant["timeout_s"],
            )
            for variant in entry["variants"]
        ),
        inputs={
            port: tuple(_reference(text) for text in texts) for port, texts in entry["in"].items()
        },
        unless=entry["unless"],
        is_varied=entry["is_varied"],
    )


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
