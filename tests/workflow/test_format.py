"""The declaration of the workflow format: what is made of it says the same everywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jsonschema
import pytest
from ruamel.yaml import YAML

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.files.yaml_positions import read_yaml
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.format import INPUTS, STEPS
from orthoflow.workflow.problems import InvalidWorkflowError, ProblemLog
from orthoflow.workflow.schema import workflow_schema
from orthoflow.workflow.shapes import Key
from tests import workflow_format
from tests.laboratories import with_steps

KEYS = dict(workflow_format.keys())


def test_the_reference_is_made_of_the_declaration() -> None:
    written = workflow_format.REFERENCE.read_text(encoding="utf-8")
    assert written == workflow_format.reference(), f"run {workflow_format.COMMAND}"


@pytest.mark.parametrize("key", KEYS.values(), ids=list(KEYS))
def test_the_example_of_a_key_keeps_its_shape_and_its_schema(key: Key[Any]) -> None:
    log = ProblemLog(file="example")
    value = read_yaml(key.example, log)
    assert value is not None
    assert key.shape.read(value, key.name, log) is not None
    log.raise_any()
    document = YAML(typ="safe", pure=True).load(key.example)
    jsonschema.Draft202012Validator(key.schema()).validate(document)


@pytest.mark.parametrize("key", KEYS.values(), ids=list(KEYS))
def test_a_key_says_in_a_sentence_what_it_means_and_what_holds_without_it(key: Key[Any]) -> None:
    assert key.meaning.endswith(".")
    assert bool(key.default) != bool(key.missing)


def test_the_example_of_the_reference_is_a_workflow(tmp_path: Path) -> None:
    path = tmp_path / "example.yaml"
    path.write_text(workflow_format.EXAMPLE, encoding="utf-8")
    catalog = discover_catalog()
    assert load_workflow(path, catalog).name == "palace-room"
    document = YAML(typ="safe", pure=True).load(workflow_format.EXAMPLE)
    jsonschema.Draft202012Validator(workflow_schema(catalog)).validate(document)


@pytest.mark.parametrize(
    "step",
    [
        "{use: plane.hough2d, in: {cloud: cloud.cloud}, variants: {a: {use: plane.ransac}}}",
        "{params: {cell_m: 1}, in: {cloud: cloud.cloud}, variants: {a: {use: plane.hough2d}}}",
        "{use: plane.hough2d, in: {cloud: cloud.cloud}, unless: cloud.cloud}",
        "{use: plane.hough2d, in: {cloud: []}}",
        "{in: {cloud: cloud.cloud}, variants: {}}",
        "{in: {cloud: cloud.cloud}}",
    ],
)
def test_reader_and_schema_refuse_the_same_steps(
    step: str, catalog: Catalog, tmp_path: Path
) -> None:
    text = with_steps(f"x: {step}")
    path = tmp_path / "flow.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidWorkflowError):
        load_workflow(path, catalog)
    document = YAML(typ="safe", pure=True).load(text)
    validator = jsonschema.Draft202012Validator(workflow_schema(catalog))
    assert list(validator.iter_errors(document))


@pytest.mark.parametrize("metrics", ["a.n_points", "[]", "[a]", "['a.*', '*.wall_s']"])
def test_reader_and_schema_agree_on_metrics(metrics: str, catalog: Catalog, tmp_path: Path) -> None:
    text = f"orthoflow: 1\nsteps: {{a: {{use: simulate.room}}}}\ncompare: {{metrics: {metrics}}}\n"
    path = tmp_path / "flow.yaml"
    path.write_text(text, encoding="utf-8")
    document = YAML(typ="safe", pure=True).load(text)
    is_valid = jsonschema.Draft202012Validator(workflow_schema(catalog)).is_valid(document)
    try:
        load_workflow(path, catalog)
    except InvalidWorkflowError:
        assert not is_valid
    else:
        assert is_valid


def test_names_that_are_taken_are_no_names_in_the_schema() -> None:
    steps, files = STEPS.shape.schema(), INPUTS.shape.schema()
    assert steps["propertyNames"]["not"] == {"enum": ["inputs"]}
    assert steps["minProperties"] == 1
    # An input may be called anything, and there may be none.
    assert "not" not in files["propertyNames"]
    assert "minProperties" not in files
