"""`orthoflow plugins new`: what it writes installs, works and passes its tests, for every kind."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.errors import ArgumentError
from orthoflow.scaffold import Project, write_project
from orthoflow.scaffold.comparing import own_comparison_text
from orthoflow.testing import Trial, conformance_cases, example_inputs, run_trial
from orthoflow.workflow.checks import lint_workflow
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import expand_cells
from tests.author_environments import install, new_environment, succeed
from tests.long_loops import IS_LONG, long_only
from tests.studios import asked

KINDS = sorted(discover_catalog().kinds)
ALL_BUT_TRUTH = ",".join(sorted({*discover_catalog().products} - {"truth"}))
COMPARED = {"surface", "plane", "raster", "ortho", "mosaic", "inspect", "match", "orient"}


def write_installed(project: Project, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_project(project, folder, discover_catalog())
    install(folder / project.name, project.name, monkeypatch)
    return folder / project.name


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_plugin_of_every_kind_loads_and_its_comparison_is_valid(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = Project(name=f"new-{kind}", kind=kind)
    folder = write_installed(project, tmp_path, monkeypatch)
    catalog = discover_catalog()
    method = catalog.method(project.method_id).load()
    # A template that reports a metric declares it.
    text = (folder / project.package / "method.py").read_text(encoding="utf-8")
    reported = set(re.findall(r"^ +ctx\.metric\(\"(\w+)", text, re.MULTILINE))
    assert {metric.name for metric in method.metric_specs()} == reported
    comparison = folder / "compare.yaml"
    readme_text = (folder / "README.md").read_text(encoding="utf-8")
    # Sources take no variants, and some kinds are in no recipe; their step is in the text instead.
    assert comparison.exists() == (kind in COMPARED)
    assert ("there is no `compare.yaml`" in readme_text) != comparison.exists()
    if comparison.exists():
        workflow = load_workflow(comparison, catalog)
        cells = [one for one in expand_cells(workflow, catalog) if one.method == project.method_id]
        assert [one.skip_reason for one in cells] == [""]
    else:
        assert f"`{kind}: {{use: {project.method_id}" in readme_text


@pytest.mark.parametrize("kind", ["simulate", "segment", "face", "dense"])
def test_a_new_plugin_passes_the_suite_as_it_is(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = Project(name=f"fresh-{kind}", kind=kind)
    write_installed(project, tmp_path, monkeypatch)
    golden = tmp_path / "golden.json"
    problems = [case.problem() for case in conformance_cases(project.method_id, golden=golden)]
    assert [problem for problem in problems if problem] == []
    assert project.method_id in golden.read_text()


@pytest.mark.parametrize(
    ("takes", "gives"),
    [
        ("cloud", "parts"),
        *long_only(("planes,cloud", "parts")),
        # A filter; one that also gives a product of its own.
        ("cloud", "cloud"),
        ("cloud,labels", "labels,scores"),
        # Every product that a method can make from nothing.
        ("truth", ALL_BUT_TRUTH),
        ("cloud", "labels,planes,sums"),
    ],
)
def test_a_new_kind_takes_and_gives_what_is_asked_and_passes_the_suite(
    takes: str, gives: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"kind-{takes}-{gives}".replace(",", "-")[:30]
    kind = name.replace("-", "_")
    known = set(discover_catalog().products)
    words = ["--new-kind", kind, "--takes", takes, "--gives", gives, "--folder", str(tmp_path)]
    asked("plugins", "new", name, *words, code=0)
    folder = tmp_path / name
    install(folder, name, monkeypatch)
    catalog = discover_catalog()
    assert list(catalog.kinds[kind].spec.inputs) == takes.split(",")
    assert set(catalog.kinds[kind].spec.outputs) == set(gives.split(","))
    assert set(catalog.products) - known == set(gives.split(",")) - known
    # What takes a new process is checked once.
    cases = conformance_cases(f"{kind}.{name}")
    is_whole = IS_LONG or gives == "labels,scores"
    problems = [case.problem() for case in cases if is_whole or case.check.is_quick]
    assert [problem for problem in problems if problem] == []
    comparison = folder / "compare.yaml"
    assert comparison.exists() == bool(set(gives.split(",")) - known)
    if not comparison.exists():
        readme = (folder / "README.md").read_text(encoding="utf-8")
        assert f"{name}, in: {{{takes}: STEP.{takes}}}}}`" in readme
        return
    workflow = load_workflow(folder / "compare.yaml", catalog)
    cells = [cell for cell in expand_cells(workflow, catalog) if cell.step == kind]
    assert [cell.params["factor"] for cell in cells] == [1.0, 2.0]
    assert [cell.skip_reason for cell in cells] == ["", ""]
    assert lint_workflow(workflow) == ()
    assert workflow.compare is not None
    assert workflow.compare.metrics == (f"{kind}.n_items",)


def test_what_no_recipe_gives_is_compared_in_none() -> None:
    catalog = discover_catalog()
    assert own_comparison_text("part.mine", ["no_such_product"], catalog) == ""
    # Nor where every recipe has a step of that name already.
    assert own_comparison_text("plane.mine", ["cloud"], catalog) == ""


def test_a_new_plugin_on_another_ones_product_requires_it_and_has_an_example(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = Project(name="firsts", kind="first", product="firsts", takes=("cloud",))
    then = Project(name="then-own", kind="then", product="thens", takes=("firsts", "cloud"))
    for project in (first, then, Project(name="first-again", kind="first")):
        folder = write_installed(project, tmp_path, monkeypatch)
        text = (folder / "pyproject.toml").read_text(encoding="utf-8")
        needed = tomllib.loads(text)["project"]["dependencies"]
        assert needed[0].startswith("orthoflow-tls>=")
        assert needed[1:] == ([] if project is first else ["firsts>=0.1.0"])
    method = discover_catalog().method("then.then-own").load()
    inputs = example_inputs(method)
    assert {name: type(given).__name__ for name, given in inputs.items()} == {
        "firsts": "FirstsProduct",
        "cloud": "PointCloud",
    }
    made = run_trial(Trial(method=method, inputs=inputs), tmp_path / "scratch", draws=False)
    assert made.metrics[0].value > 0


PARTS = {"kind": "part", "product": "parts", "takes": ("cloud",)}


@pytest.mark.parametrize(
    ("project", "sentence"),
    [
        ({**PARTS, "kind": "plane"}, "kind plane is already declared by an installed plugin"),
        ({**PARTS, "kind": "my-parts"}, "lower-case letters, digits and underscores, got 'my-par"),
        ({**PARTS, "product": "planes"}, "product planes is already registered"),
        ({**PARTS, "takes": ("clouds",)}, r"no product type clouds \(did you mean cloud\?\)"),
        ({"name": "My Detector"}, "a plugin's name must consist of 2 to 32 lower-case letters"),
        ({"name": "x"}, "a plugin's name must consist of 2 to 32 lower-case letters"),
        ({"kind": "plain"}, r"plugin declares the kind plain \(did you mean plane\?\)"),
        ({"name": "hough2d"}, "already provides the method plane.hough2d; choose another"),
        ({"name": "numpy"}, "a Python package numpy is already installed"),
        ({"name": "taken"}, "taken already exists"),
    ],
)
def test_a_project_that_cannot_be_is_refused(
    project: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    (tmp_path / "taken").mkdir()
    wanted = Project(**{"name": "mine", "kind": "plane", **project})
    with pytest.raises(ArgumentError, match=sentence):
        write_project(wanted, tmp_path, discover_catalog())
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return new_environment(tmp_path_factory.mktemp("author"))


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_a_new_plugin_installs_and_passes_its_tests_at_once(
    kind: str, environment: Path, tmp_path: Path
) -> None:
    run, name = (environment, "-m"), f"own-{kind}"
    succeed(tmp_path, *run, "orthoflow", "plugins", "new", name, "--kind", kind)
    succeed(tmp_path / name, *run, "pip", "install", "-q", "--no-deps", "-e", ".")
    succeed(tmp_path / name, *run, "pytest", "-q", "-W", "error")
