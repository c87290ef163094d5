"""`docs/papers.md` names methods, parameters and workflows that exist."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.workflow.source import shipped_workflow, shipped_workflows

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs" / "papers.md").read_text()
CODE = sorted(set(re.findall(r"`([^`]+)`", TEXT)))
KINDS = sorted({method_id.partition(".")[0] for method_id in discover_catalog().methods})
METHOD = re.compile(rf"({'|'.join(KINDS)})\.[a-z0-9-]+")
NAMED = [code for code in CODE if METHOD.match(code)]
FIGURES = sorted(
    {
        name
        for names in re.findall(r"figures? ((?:`[^`]+`(?:, )?)+)", TEXT)
        for name in re.findall(r"`([^` ]+)`", names)
    }
)
METRICS = sorted(
    {
        name
        for names in re.findall(r"metrics? ((?:`[^`]+`(?:, )?)+)", TEXT)
        for name in re.findall(r"`([^` ]+)`", names)
    }
)

# Rows of both papers by what they are of: method, theirs, by their estimator, ours, deviation.
ROWS = {
    f"{section}: {where}, {what}": tuple(rest)
    for section, table in re.findall(
        r"^## (\w+2\d{3})\n(.*?)(?=^## |\Z)", TEXT, re.MULTILINE | re.DOTALL
    )
    for where, what, *rest in (
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in table.splitlines()
        if line.startswith("|") and not line.startswith(("| where", "| ---"))
    )
}
# The marks of the page's beginning, a test, a benchmark, or a recipe.
SOURCE = re.compile(r"\((Q|planes|orient|ortho|surfaces)\)|`tests/|benchmarks/|[a-z-]+\.yaml`")


def test_the_page_names_most_built_in_methods() -> None:
    methods = discover_catalog().methods
    ours = {name for name in methods if methods[name].distribution.name == "orthoflow-tls"}
    named = {METHOD.match(code).group() for code in NAMED}  # type: ignore[union-attr]
    assert named <= ours, "a method was renamed"
    for kind in ("plane", "ortho", "mosaic", "register", "inspect"):
        missing = {name for name in ours if name.startswith(f"{kind}.")} - named
        # Neither paper asks for openings.
        assert missing <= {"inspect.truth", "inspect.openings", "plane.open3d-patches"}


@pytest.mark.parametrize("code", NAMED)
def test_every_parameter_named_exists_and_takes_the_value(code: str) -> None:
    method_id, _, setting = code.partition(" ")
    params = discover_catalog().method(method_id).load().Params
    if not setting:
        return
    name, _, value = setting.partition(": ")
    assert name in params.model_fields
    if value:
        params.model_validate({name: YAML(typ="safe").load(value)})


@pytest.mark.parametrize("figure", FIGURES)
def test_every_figure_named_is_drawn_by_a_method(figure: str) -> None:
    name = re.escape(figure.removesuffix("_...")).replace("_0_", r"_\{[^}]+\}_")
    sources = (ROOT / "plugins" / "orthoflow_plugins").rglob("*.py")
    assert any(re.search(rf'"{name}"', source.read_text()) for source in sources)


def test_every_metric_named_is_declared_by_a_method() -> None:
    methods = discover_catalog().methods
    ours = [name for name in methods if methods[name].distribution.name == "orthoflow-tls"]
    loaded = [discover_catalog().method(name).load() for name in ours]
    known = {metric.name for method in loaded for metric in method.metric_specs()}
    assert len(METRICS) > 15
    unknown = {name for name in METRICS if not any(fnmatchcase(name, one) for one in known)}
    assert unknown == set()


@pytest.mark.parametrize("code", [code for code in CODE if re.fullmatch(r"[a-z-]+\.yaml", code)])
def test_every_workflow_named_is_shipped(code: str) -> None:
    assert code.removesuffix(".yaml") in shipped_workflows()


@pytest.mark.parametrize("code", [code for code in CODE if code.startswith("orthoflow run")])
def test_every_command_named_sets_what_its_workflow_has(code: str) -> None:
    _, _, recipe, *options = code.split()
    path = ROOT / recipe if "/" in recipe else shipped_workflow(recipe)
    steps = YAML(typ="safe").load(path.read_text())["steps"]
    for setting in options[1::2]:
        step, parameter = setting.partition("=")[0].split(".")
        method_id = steps[step]["use"]
        assert parameter in discover_catalog().method(method_id).load().Params.model_fields


@pytest.mark.parametrize("what", list(ROWS))
def test_every_row_has_a_way_and_what_came_of_it_or_the_reason_why_not(what: str) -> None:
    """A row that names no method, or a number without its command, is a promise, no audit."""
    assert len(ROWS[what]) == 5
    here, theirs, by_theirs, ours, deviation = ROWS[what]
    assert theirs
    assert deviation, "none where there is none"
    if here == "-":
        assert deviation != "none", "neither a method nor the reason why there is none"
        return
    assert SOURCE.search(f"{by_theirs} {ours}"), "no command behind what came out"


def test_the_page_is_what_its_template_becomes() -> None:
    """No number was written by hand: between places for numbers the template stands."""
    template = (ROOT / "benchmarks" / "pages" / "papers.md").read_text()
    fixed = re.split(r"\{\{[^}]+\}\}", template)
    assert len(fixed) > 200
    place = 0
    for text in fixed:
        found = TEXT.find(text, place)
        # The longest number is the line that states date, machine and rooms.
        assert 0 <= found - place < 250, text
        place = found + len(text)
    assert place == len(TEXT)


def test_a_row_of_less_is_found() -> None:
    assert SOURCE.search("0.25 mm (planes)")
    assert not SOURCE.search("0.25 mm (about)")
    assert len(ROWS) > 90


@pytest.mark.parametrize("path", [code for code in CODE if re.match(r"(tests|benchmarks)/", code)])
def test_every_file_named_is_there(path: str) -> None:
    assert (ROOT / path).is_file()
