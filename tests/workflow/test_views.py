"""A workflow as JSON, JSON Schema and Mermaid, and read back from its resolved form."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from ruamel.yaml import YAML
from syrupy.assertion import SnapshotAssertion

from docs import workflow_format
from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.errors import WorkflowError
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.model import Workflow
from orthoflow.workflow.source import shipped_workflow, shipped_workflows
from orthoflow.workflow.views import mermaid, resolved_json, workflow_from_resolved, workflow_schema
from tests.laboratories import GOOD, load


def test_the_resolved_workflow_is_canonical_json_without_paths_of_this_machine(
    catalog: Catalog, write: Path, tmp_path: Path
) -> None:
    write.write_text(GOOD)
    workflow = load_workflow(
        write, catalog, sets=["wall.gsd_m=0.5"], inputs=[f"scan={tmp_path}/secret/mine.e57"]
    )
    text = resolved_json(workflow)
    document = json.loads(text)
    assert text == json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert str(tmp_path) not in text
    assert "datasets" not in document
    assert document["inputs"]["scan"]["files"] == ["mine.e57"]
    assert document["overrides"] == ["--set wall.gsd_m=0.5", "--input scan=mine.e57"]
    (wall,) = document["steps"]["wall"]["variants"]
    assert (wall["params"], wall["params_set"]) == ({"gsd_m": 0.5}, {"gsd_m": 0.5})
    assert document["steps"]["wall"]["in"] == {"cloud": ["cloud.cloud"], "planes": ["plane.planes"]}


def test_mermaid_draws_inputs_steps_and_what_flows(
    catalog: Catalog, write: Path, snapshot: SnapshotAssertion
) -> None:
    text = """\
orthoflow: 1
inputs: {scan: {optional: true}, photos: {files: photos}}
steps:
  end: {use: read.scan, in: {files: inputs.scan}}
  room: {use: simulate.room, if: inputs.photos, unless: inputs.scan}
  plane:
    in: {cloud: [end.cloud, room.cloud]}
    variants: {hough2d: {use: plane.hough2d}, many: {use: plane.ransac, repeat: 10}}
  wall: {use: raster.grid, in: {cloud: room.cloud, planes: plane.planes}}
  ortho: {use: ortho.direct, in: {walls: wall.walls, cloud: room.cloud, photos: room.photos}}
"""
    assert mermaid(load(text, write, catalog), catalog) == snapshot


def test_a_shipped_recipe_is_found_from_anywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("direct", "direct.yaml", "workflows/direct.yaml"):
        assert shipped_workflow(name) == shipped_workflows()["direct"]


# --- the reference of the format ---

KEYS = {name: (section, key, info) for name, section, key, info in workflow_format.all_keys()}


def test_the_reference_is_made_of_the_models() -> None:
    written = workflow_format.REFERENCE.read_text(encoding="utf-8")
    assert written == workflow_format.reference(), f"run {workflow_format.COMMAND}"


@pytest.mark.parametrize("name", KEYS)
def test_the_example_of_a_key_fits_its_model_and_its_schema(name: str) -> None:
    section, key, info = KEYS[name]
    assert (info.description or "").endswith(".")
    (example,) = info.examples or []
    section.model_validate({key: example})
    schema = section.model_json_schema()
    schema["required"] = []
    jsonschema.Draft202012Validator(schema).validate({key: example})


def test_the_example_of_the_reference_is_a_workflow(tmp_path: Path) -> None:
    path = tmp_path / "example.yaml"
    path.write_text(workflow_format.EXAMPLE, encoding="utf-8")
    catalog = discover_catalog()
    assert load_workflow(path, catalog).name == "palace-room"
    document = YAML(typ="safe", pure=True).load(workflow_format.EXAMPLE)
    jsonschema.Draft202012Validator(workflow_schema(catalog)).validate(document)


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
