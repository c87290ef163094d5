"""`docs/papers.md` names methods, parameters and workflows that exist."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from benchmarks.drawn_rooms import filled_in, ranking_holds
from orthoflow.catalog.catalog import MethodEntry
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.version import DISTRIBUTION
from orthoflow.workflow.source import shipped_workflows

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

# Tables of both papers: section -> rows by what they are of. Those of results have seven columns,
# with theirs, by their estimator and ours; those of formulas, figures and rules five, with a test.
TABLES = {
    f"{paper}: {title}": [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in table.splitlines()
        if line.startswith("|") and not line.startswith(("| where", "|---"))
    ]
    for paper, text in re.findall(
        r"^## (\w+2\d{3})\n(.*?)(?=^## |\Z)", TEXT, re.MULTILINE | re.DOTALL
    )
    for title, table in re.findall(r"^### (.*?)\n(.*?)(?=^### |\Z)", text, re.MULTILINE | re.DOTALL)
}
ROWS = {
    f"{section}: {row[0]}, {row[1]}": (section, row)
    for section, rows in TABLES.items()
    for row in rows
}
# A part of the command that measures, named by a section's title.
PART = re.compile(r"\((planes|orient|ortho|surfaces)\)$")
SOURCE = re.compile(r"`(tests|benchmarks)/")


def ours() -> dict[str, MethodEntry]:
    methods = discover_catalog().methods
    return {name: one for name, one in methods.items() if one.distribution.name == DISTRIBUTION}


def test_the_page_names_most_built_in_methods() -> None:
    named = {METHOD.match(code).group() for code in NAMED}  # type: ignore[union-attr]
    assert named <= ours().keys(), "a method was renamed"
    for kind in ("plane", "ortho", "mosaic", "register", "inspect"):
        missing = {name for name in ours() if name.startswith(f"{kind}.")} - named
        # Neither paper asks for openings or curved walls.
        missing -= {"inspect.openings", "inspect.surfaces"}
        assert missing <= {"inspect.truth", "plane.open3d-patches"}


def test_every_parameter_named_exists_and_takes_the_value() -> None:
    catalog = discover_catalog()
    for code in NAMED:
        method_id, _, setting = code.partition(" ")
        params = catalog.method(method_id).load().Params
        name, _, value = setting.partition(": ")
        assert not name or name in params.model_fields, code
        if value:
            params.model_validate({name: YAML(typ="safe").load(value)})


def test_every_figure_metric_workflow_and_file_named_is_there() -> None:
    sources = (ROOT / "plugins" / "orthoflow_plugins").rglob("*.py")
    whole = "\n".join(source.read_text() for source in sources)
    for figure in FIGURES:
        name = re.escape(figure.removesuffix("_...")).replace("_0_", r"_\{[^}]+\}_")
        assert re.search(rf'"{name}"', whole), figure
    loaded = [entry.load() for entry in ours().values()]
    known = {metric.name for method in loaded for metric in method.metric_specs()}
    assert len(METRICS) > 15
    assert {name for name in METRICS if not any(fnmatchcase(name, one) for one in known)} == set()
    named = {code.removesuffix(".yaml") for code in CODE if re.fullmatch(r"[a-z-]+\.yaml", code)}
    assert set() < named <= {*shipped_workflows()}
    paths = [code for code in CODE if re.match(r"(tests|benchmarks)/", code)]
    assert [path for path in paths if not (ROOT / path).is_file()] == []


def test_every_row_has_a_source_or_the_reason_why_it_has_none() -> None:
    for what, (section, (_, _, here, *values, deviation)) in ROWS.items():
        assert deviation, f"{what}: none where there is none"
        if here == "-":
            assert deviation != "none", f"{what}: neither a method nor the reason"
        elif PART.search(section):
            theirs, by_theirs, ours = values
            assert theirs, what
            assert by_theirs, what
            assert ours, what
            assert (by_theirs, ours) != ("-", "-"), what
        else:
            (test,) = values
            assert SOURCE.search(test), f"{what}: nothing that checks it"


def test_the_page_is_what_its_template_becomes() -> None:
    """No number was written by hand: between places for numbers the template stands."""
    template = (ROOT / "benchmarks" / "pages" / "papers.md").read_text()
    fixed = re.split(r"\{\{[^}]+\}\}", template)
    assert len(fixed) > 150
    place = 0
    for text in fixed:
        found = TEXT.find(text, place)
        # The longest number is the line that states date, machine and rooms.
        assert 0 <= found - place < 350, text
        place = found + len(text)
    assert place == len(TEXT)


def test_no_table_is_missing() -> None:
    assert len(ROWS) == sum(map(len, TABLES.values())) > 85
    parts = [match[1] for section in TABLES if (match := PART.search(section))]
    assert set(parts) == {"planes", "orient", "ortho", "surfaces"}


@pytest.mark.parametrize(
    ("counts", "holds"),
    [
        ([(10, 10), (5, 5)], True),
        ([(9, 10), (5, 5)], True),
        ([(8, 10), (5, 5)], False),
        # In one set of seeds only.
        ([(10, 10), (4, 5)], False),
        ([(10, 10), (0, 0)], False),
        # By chance in one of eight cases.
        ([(2, 2), (2, 2)], False),
        ([(3, 3), (3, 3)], True),
    ],
)
def test_rankings_are_stated_where_they_hold_in_both_sets_of_seeds(
    counts: list[tuple[int, int]], holds: bool
) -> None:
    assert ranking_holds(counts) is holds
    rooms = [
        [{"a rms_mm": 1.0, "b rms_mm": 2.0 if k < n_true else 0.5} for k in range(n_both)]
        for n_true, n_both in counts
    ]
    text = filled_in("{{x: a rms_mm < b rms_mm ? a is better | not ranked}}.", {"x": rooms})
    (n1, m1), (n2, m2) = counts
    stated = "a is better" if holds else "not ranked"
    assert text == f"{stated} ({n1} of {m1} and {n2} of {m2} rooms)."


def test_places_become_the_mean_and_scatter_of_the_first_set() -> None:
    rooms = [[{"a s": value} for value in (0.01, 0.02, 0.03)], [{"a s": 9.0}]]
    text = "{{x: a s}}, {{x: a s : share}} %, {{x: a s : median}}, {{x: b s}}"
    assert filled_in(text, {"x": rooms}) == "0.02±0.01, 2±1 %, 0.02, no value"
