"""Workflow files: what is read, and mistakes with their places."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import PluginError, WorkflowError
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.model import CallSection
from orthoflow.workflow.source import Problem, UnusablePluginError, find_workflow
from orthoflow.workflow.views import workflow_schema
from tests.laboratories import GOOD, laboratory_catalog, load, with_steps, write_distribution


def test_a_good_file_is_read_as_it_is_written(catalog: Catalog, write: Path) -> None:
    workflow = load(GOOD, write, catalog)
    assert (workflow.name, workflow.seed, workflow.source) == ("palace-room", 1729, GOOD)
    assert workflow.inputs["photos"].files == ("data/photos/*.jpg",)
    assert workflow.inputs["calibration"].optional
    plane = workflow.steps["plane"]
    assert [variant.name for variant in plane.variants] == ["hough2d", "ransac"]
    assert plane.variant("ransac").params == {"tolerance_m": 0.005, "iterations": 15}
    assert plane.variant("ransac").repeat == 10
    bundle = workflow.steps["orient"].variant("bundle")
    assert (bundle.cores, bundle.timeout_s) == (2, 1800.0)
    assert str(workflow.steps["wall"].inputs["planes"][0]) == "plane.planes"
    assert workflow.compare is not None
    assert workflow.compare.exclude == ({"plane": "ransac", "orient": "pnp"},)
    assert workflow.compare.metrics == ("plane.rms_mm", "*.wall_s")
    assert workflow.baseline == {"plane": "ransac", "orient": "bundle"}


def test_a_file_that_is_no_text_or_too_large_is_refused(catalog: Catalog, write: Path) -> None:
    write.write_bytes(b"orthoflow: 1\nname: caf\xe9\n")
    with pytest.raises(WorkflowError, match=r"flow.yaml:2:10: expected UTF-8 text, got the"):
        load_workflow(write, catalog)
    write.write_text("a" * 2_000_000)
    with pytest.raises(WorkflowError, match="a workflow file may have at most 400000"):
        load_workflow(write, catalog)


def test_a_name_that_is_neither_file_nor_recipe_lists_the_recipes(
    catalog: Catalog, write: Path
) -> None:
    with pytest.raises(WorkflowError, match=r"no workflow file nowhere.yaml .*shipped: .*direct"):
        load_workflow("nowhere.yaml", catalog)
    for name in ("folder", "direct"):
        write.with_name(name).mkdir()
    with pytest.raises(WorkflowError, match="folder is a folder or a device"):
        load_workflow("folder", catalog)
    assert find_workflow("direct").suffix == ".yaml"


BROKEN_METHOD = """
    from orthoflow.sdk.hooks import MethodSpec, hookimpl

    @hookimpl
    def orthoflow_methods():
        return [MethodSpec(id="plane.broken", target="no_such_library:Plane", summary="-")]
    """


def test_a_workflow_that_needs_a_missing_library_ends_as_plugin_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Path
) -> None:
    folder = write_distribution(tmp_path / "b", "broken", {"broken_hooks.py": BROKEN_METHOD})
    catalog = laboratory_catalog(monkeypatch, folder)
    # Others have their workflows and their completion.
    assert load(GOOD, write, catalog).name == "palace-room"
    schema = json.dumps(workflow_schema(catalog))
    assert "Edge of an accumulator cell." in schema
    assert "plane.broken" not in schema
    write.write_text(with_steps("x: {use: plane.broken, in: {cloud: cloud.cloud}}"))
    with pytest.raises(UnusablePluginError) as caught:
        load_workflow(write, catalog)
    assert isinstance(caught.value, PluginError)
    assert caught.value.exit_code == 4
    (problem,) = caught.value.problems
    assert (problem.line, problem.path) == (6, "steps.x.use")
    assert "method plane.broken of broken 1.0 cannot be loaded" in problem.message
    assert "No module named 'no_such_library'" in problem.message


def test_times_have_a_number_and_a_unit() -> None:
    for written, seconds in (("90s", 90.0), ("30min", 1800.0), ("0.5  h", 1800.0), (0.25, 0.25)):
        assert CallSection(timeout=written).timeout == seconds
    for wrong in (0, True, math.inf, "0s", "s", "5", "5m"):
        with pytest.raises(ValueError, match="a time such as"):
            CallSection(timeout=wrong)


def test_a_problem_stands_over_the_line_that_it_is_about() -> None:
    def problem(text: str, column: int, *, line: int = 3, path: str = "steps.a") -> str:
        place = {"line": line, "column": column, "path": path}
        return str(Problem(file="a.yaml", **place, message="odd", text=text))

    assert problem("  use: plane", 8) == ("a.yaml:3:8: steps.a: odd\n    use: plane\n         ^")
    assert problem("x\ty", 3) == "a.yaml:3:3: steps.a: odd\n    x y\n      ^"
    assert problem("", 1, path="") == "a.yaml:3:1: odd"
    assert problem("  \t ", 1) == "a.yaml:3:1: steps.a: odd"
    assert problem("a: b", 1, line=0) == "a.yaml: steps.a: odd\n    a: b\n    ^"
