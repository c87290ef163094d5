"""The resolved form: a workflow comes back from it whole; other text is refused."""

from __future__ import annotations

import json
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


FIRST = "steps.0.variants.0"
# Where a document is changed (a number is the place of an entry), the value there, the sentence.
CHANGES: list[tuple[str, object, str]] = [
    ("steps.../x", {"variants": [{"name": "", "use": "a.b"}]}, "'../x' cannot be a name"),
    (f"{FIRST}.repeat", "2", r"variants\.0\.repeat: Input should be a valid integer"),
    (f"{FIRST}.repeat", 10**9, r"variants\.0\.repeat: Input should be less than or equal to 10000"),
    ("steps.0.variants", [], "has 0 variants"),
    (f"{FIRST}.name", "other", "has a variant, but is marked as having none"),
    (f"{FIRST}.use", ["a"], r"variants\.0\.use: Input should be a valid string"),
    ("steps.0.in.cloud", ["nowhere.cloud"], "uses nowhere.cloud, which does not exist"),
    ("steps.0.in.cloud", ["NAME.cloud"], "its steps form a cycle"),
    (f"{FIRST}.timeout_s", -1.0, r"timeout_s: Input should be greater than 0"),
    ("steps.0.unless", "no", "an unknown input"),
    ("steps.0.if", "no", "an unknown input"),
    ("inputs.0.optional", 1, "optional: Input should be a valid bool"),
    ("seed", True, "seed: Input should be a valid integer"),
    ("inputs.0.files", [1], r"files\.0: Input should be a valid string"),
    ("compare", {"design": "all"}, r"compare\.design: Input should be"),
    ("compare", {"baseline": {"NAME": "no"}}, "has no variant of the comparison"),
]


@pytest.mark.parametrize(("place", "value", "words"), CHANGES)
def test_what_the_checks_of_a_file_would_refuse_is_refused(
    place: str, value: object, words: str
) -> None:
    document = json.loads(resolved_json(loaded(RECIPES[0])))
    name = next(iter(document["steps"]))
    *outer, last = place.split(".", 1) if "../x" in place else place.split(".")
    found: Any = document
    for key in outer:
        values = found if isinstance(found, list) else list(found.values())
        found = values[0] if key == "0" else found[key]
    found[last] = json.loads(json.dumps(value).replace("NAME", name))
    with pytest.raises(WorkflowError, match=words):
        workflow_from_resolved(json.dumps(document), "")
