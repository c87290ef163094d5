"""The resolved form: a workflow comes back from it whole; other text is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from orthoflow.catalog import discover_catalog
from orthoflow.errors import WorkflowError
from orthoflow.workflow import Workflow, load_workflow
from orthoflow.workflow.resolved import resolved_json, workflow_from_resolved

RECIPES = sorted((Path(__file__).resolve().parents[2] / "workflows").glob("*.yaml"))


def loaded(path: Path) -> Workflow:
    return load_workflow(path, discover_catalog())


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_every_recipe_comes_back_whole(path: Path) -> None:
    workflow = loaded(path)
    text = resolved_json(workflow)
    again = workflow_from_resolved(text, workflow.source)
    assert resolved_json(again) == text
    assert (again.name, again.seed, again.source) == (workflow.name, workflow.seed, workflow.source)
    assert again.path == Path(f"{workflow.name}.yaml")
    assert list(again.steps) == sorted(workflow.steps)
    for name, step in workflow.steps.items():
        found = again.steps[name]
        assert found.inputs == step.inputs
        assert (found.unless, found.is_varied) == (step.unless, step.is_varied)
        assert [variant.method for variant in found.variants] == [
            variant.method for variant in step.variants
        ]
        assert [variant.repeat for variant in found.variants] == [
            variant.repeat for variant in step.variants
        ]
    for name, spec in workflow.inputs.items():
        assert again.inputs[name].files == spec.files
        assert again.inputs[name].optional == spec.optional
    assert (again.compare is None) == (workflow.compare is None)
    if again.compare is not None and workflow.compare is not None:
        assert again.compare == workflow.compare
    assert again.overrides == workflow.overrides == ()


def changed(change: Callable[[dict[str, object]], object]) -> str:
    document = json.loads(resolved_json(loaded(RECIPES[0])))
    change(document)
    return json.dumps(document)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("not JSON", r"the resolved workflow cannot be read: JSONDecodeError"),
        ("[]", r"the resolved workflow cannot be read: TypeError"),
        ("{}", r"the resolved workflow cannot be read: KeyError 'orthoflow'"),
        (
            changed(lambda document: document.update(orthoflow=2)),
            r"the resolved workflow has format 2, this orthoflow reads 1",
        ),
        (
            changed(lambda document: document.pop("seed")),
            r"the resolved workflow cannot be read: KeyError 'seed'",
        ),
        (
            changed(lambda document: document.update(steps=[])),
            r"the resolved workflow cannot be read: AttributeError",
        ),
        (
            changed(
                lambda document: [
                    step["variants"][0].pop("repeat") for step in document["steps"].values()
                ]
            ),
            r"the resolved workflow cannot be read: KeyError 'repeat'",
        ),
    ],
    ids=["text", "list", "empty", "newer", "no seed", "steps are a list", "no repeat"],
)
def test_other_text_is_refused_in_a_sentence(text: str, sentence: str) -> None:
    with pytest.raises(WorkflowError, match=sentence):
        workflow_from_resolved(text, "")


def test_paths_of_the_command_line_are_not_recorded(tmp_path: Path) -> None:
    document = json.loads(resolved_json(loaded(RECIPES[0])))
    assert document["orthoflow"] == 1
    assert str(tmp_path.anchor + "home") not in json.dumps(document)
