"""The resolved form: a workflow comes back from it whole; other text is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.errors import WorkflowError
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.model import Workflow
from orthoflow.workflow.views import resolved_json, workflow_from_resolved

RECIPES = sorted((Path(__file__).resolve().parents[2] / "workflows").glob("*.yaml"))


def loaded(path: Path) -> Workflow:
    return load_workflow(path, discover_catalog())


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_every_recipe_comes_back_whole(path: Path) -> None:
    workflow = loaded(path)
    text = resolved_json(workflow)
    again = workflow_from_resolved(text, workflow.source)
    assert resolved_json(again) == text
    assert (again.source, again.path) == (workflow.source, Path(f"{workflow.name}.yaml"))
    assert again.compare == workflow.compare
    assert list(again.steps) == sorted(workflow.steps)


def changed(change: Callable[[dict[str, object]], object]) -> str:
    document = json.loads(resolved_json(loaded(RECIPES[0])))
    change(document)
    return json.dumps(document)


def _first(document: Any, key: str) -> Any:
    return next(iter(document[key].values()))


CHANGES: dict[str, tuple[Callable[[Any], object], str]] = {
    "a step that leaves its folder": (
        lambda d: d["steps"].update({"../x": _first(d, "steps")}),
        "'../x' cannot be a name",
    ),
    "a repeat that is text": (
        lambda d: _first(d, "steps")["variants"][0].update(repeat="2"),
        r"variants\.0\.repeat: Input should be a valid integer",
    ),
    "a billion repeats": (
        lambda d: _first(d, "steps")["variants"][0].update(repeat=10**9),
        r"variants\.0\.repeat: Input should be less than or equal to 10000",
    ),
    "no variants": (lambda d: _first(d, "steps").update(variants=[]), "has 0 variants"),
    "a hidden variant": (
        lambda d: _first(d, "steps")["variants"][0].update(name="other"),
        "has a variant, but is stated to have none",
    ),
    "a method that is a list": (
        lambda d: _first(d, "steps")["variants"][0].update(use=["a"]),
        r"variants\.0\.use: Input should be a valid string",
    ),
    "a reference to nothing": (
        lambda d: _first(d, "steps")["in"].update(cloud=["nowhere.cloud"]),
        "takes nowhere.cloud, which is not there",
    ),
    "a circle": (
        lambda d: _first(d, "steps")["in"].update(cloud=[f"{next(iter(d['steps']))}.cloud"]),
        "need each other in a circle",
    ),
    "an endless time limit": (
        lambda d: _first(d, "steps")["variants"][0].update(timeout_s=-1.0),
        r"timeout_s: Input should be greater than 0",
    ),
    "an unknown input": (lambda d: _first(d, "steps").update(unless="no"), "an unknown input"),
    "no such input": (lambda d: _first(d, "steps").update({"if": "no"}), "an unknown input"),
    "a flag that is a number": (
        lambda d: _first(d, "inputs").update(optional=1),
        "optional: Input should be a valid bool",
    ),
    "a seed that is true": (lambda d: d.update(seed=True), "seed: Input should be a valid integer"),
    "files that are numbers": (
        lambda d: _first(d, "inputs").update(files=[1]),
        r"files\.0: Input should be a valid string",
    ),
    "an unknown design": (
        lambda d: d.update(compare={"design": "all", "baseline": {}, "exclude": [], "metrics": []}),
        r"compare\.design: Input should be",
    ),
    "a baseline of nothing": (
        lambda d: d.update(
            compare={
                "design": "product",
                "baseline": {next(iter(d["steps"])): "no"},
                "exclude": [],
                "metrics": [],
            }
        ),
        "has no variant of the comparison",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_the_checks_of_a_file_would_refuse_is_refused(change: str) -> None:
    act, words = CHANGES[change]
    with pytest.raises(WorkflowError, match=words):
        workflow_from_resolved(changed(act), "")
