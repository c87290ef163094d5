"""Workflow files: what is read, which files inputs stand for, and what is hardly meant."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.errors import InputError, PluginError, WorkflowError
from orthoflow.workflow.checks import lint_workflow
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.inputs import present_inputs, resolve_input_files
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


# Which files inputs stand for, and what a valid workflow may still not mean -----------------------


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a workflow and data, which is not the working directory."""
    folder = tmp_path / "project"
    for name in ("b.jpg", "a.jpg", ".hidden.jpg", "deep/c.jpg", "[1].jpg"):
        path = folder / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    (folder / "empty").mkdir()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "mine.jpg").touch()
    monkeypatch.chdir(elsewhere)
    return folder


def names(project: Path, catalog: Catalog, spec: str, *options: str) -> list[str] | None:
    path = project / "flow.yaml"
    path.write_text(
        f"orthoflow: 1\ninputs: {{photos: {spec.replace('PROJECT', str(project))}}}\n"
        f"steps: {{shots: {{use: read.photos, in: {{files: inputs.photos}}}}}}\n"
    )
    workflow = load_workflow(path, catalog, inputs=options)
    files = resolve_input_files(workflow)["photos"]
    assert (files is not None) == ("photos" in present_inputs(workflow))
    if files is None:
        return None
    assert files.name == "photos"
    assert all(item.is_file() and item.is_absolute() for item in files.paths)
    return [item.name for item in files.paths]


FOUND = {
    "{files: PROJECT/photos/a.*}": ["a.jpg"],
    "{files: photos}": ["[1].jpg", "a.jpg", "b.jpg", "c.jpg"],
    "{files: photos/*.jpg}": ["[1].jpg", "a.jpg", "b.jpg"],
    "{files: 'photos/[1].jpg'}": ["[1].jpg"],
    "{files: 'photos/**/?.jpg'}": ["a.jpg", "b.jpg", "c.jpg"],
    "{files: [photos/deep, photos/b.jpg, photos/b.*]}": ["b.jpg", "c.jpg"],
    "{optional: true}": None,
    "{files: empty, optional: true}": None,
}
MISSING = {
    "{files: nowhere.jpg}": (
        r"\.yaml:\d+:\d+: inputs.photos.files: input photos: there is no file nowhere.jpg"
    ),
    "{files: '*.png'}": r"input photos: no file matches \*.png next to the workflow",
    "{files: empty}": r"photos: the folder empty next to the workflow \(.*\) contains no files",
    "{files: /nowhere/x.jpg}": r"input photos: there is no file /nowhere/x\.jpg$",
    "{files: photos/b_.jpg}": r"no file photos/b_\.jpg next to .* \(did you mean b\.jpg\?\)",
    "{files: [photos/a.jpg, x.jpg]}": "input photos: there is no file x.jpg",
    "{}": r"input photos has no files; list them .* or pass --input photos=PATH",
}


def test_files_are_found_beside_the_workflow_and_sorted_by_name(
    project: Path, catalog: Catalog
) -> None:
    assert {spec: names(project, catalog, spec) for spec in FOUND} == FOUND
    for spec, message in MISSING.items():
        with pytest.raises(InputError, match=message):
            names(project, catalog, spec)


def test_an_input_option_must_exist_even_when_the_input_is_optional(
    project: Path, catalog: Catalog
) -> None:
    with pytest.raises(InputError, match=r"there is no file a\.jpg in the working directory"):
        names(project, catalog, "{optional: true}", "photos=a.jpg")
    Path("b.jpg").symlink_to("nowhere.jpg")
    with pytest.raises(
        InputError, match=r"b\.jpg .*is a link to nowhere\.jpg, which does not exist"
    ):
        names(project, catalog, "{optional: true}", "photos=b.jpg")


def test_cells_that_cannot_be_meant_are_told(catalog: Catalog, tmp_path: Path) -> None:
    limits = "which is implausible: a cell is usually 0.0001 to 0.5 m wide"
    for gsd_m, said in (
        ("3", f"wall.gsd_m is 3 m, {limits}; for 3 mm write gsd_m: 0.003"),
        ("5e-6", f"wall.gsd_m is 5e-06 m, {limits}"),
        ("0.003", ""),
        ("0.5", ""),
    ):
        workflow = load(GOOD.replace("{gsd_m: 1}", f"{{gsd_m: {gsd_m}}}"), tmp_path / "a", catalog)
        assert lint_workflow(workflow) == ((said,) if said else ())


@pytest.mark.parametrize(("recipe", "n"), [("photos-on-scan", 1), ("direct", 0)])
def test_a_crop_is_reported_where_photos_are_matched_to_it(recipe: str, n: int) -> None:
    """A scan's own colours lose nothing by a crop."""
    catalog, sets = discover_catalog(), ["wall.crop=[0, 0, 1, 1]"]
    reported = lint_workflow(load_workflow(recipe, catalog, sets=sets))
    assert len([text for text in reported if text.startswith("wall.crop reduces ")]) == n
    # Cameras from elsewhere need no matches.
    given = ["cameras=cameras.json"] if n else []
    reported = lint_workflow(load_workflow(recipe, catalog, inputs=given, sets=sets))
    assert not [text for text in reported if "crop" in text]


def test_inputs_that_nothing_takes_are_told(catalog: Catalog, tmp_path: Path) -> None:
    text = GOOD.replace("{gsd_m: 1}", "{gsd_m: 0.01}")
    more = text.replace("inputs:\n", "inputs:\n  other: {optional: true}\n")
    assert lint_workflow(load(more, tmp_path / "flow.yaml", catalog)) == (
        "no step uses the input other: connect inputs.other to a step, or remove the input",
    )
    # One that only says whether a step runs is of use.
    asked = more.replace("wall:   {use", "wall:   {unless: inputs.other, use")
    assert lint_workflow(load(asked, tmp_path / "flow.yaml", catalog)) == ()
