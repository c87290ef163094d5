"""The workflow in which a new method stands beside an installed one: short, judged, whole."""

from __future__ import annotations

from typing import Any

import pytest
from ruamel.yaml import YAML

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.scaffold import comparing
from orthoflow.scaffold.comparing import own_comparison_text


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return discover_catalog()


def read(text: str) -> Any:
    return YAML(typ="safe").load(text)


def recipe(name: str) -> Any:
    return read(comparing.shipped_workflow(name).read_text(encoding="utf-8"))


def test_a_new_kind_is_compared_with_itself_behind_what_it_takes(catalog: Catalog) -> None:
    found = read(own_comparison_text("part.mine", ["planes", "cloud"], catalog))
    node = found["steps"]["part"]
    assert node["variants"] == {
        "plain": {"use": "part.mine"},
        "double": {"use": "part.mine", "params": {"factor": 2.0}},
    }
    assert node["in"]["planes"] == "plane.planes"
    # Read or simulated, whichever is there.
    assert {wire.partition(".")[2] for wire in node["in"]["cloud"]} == {"cloud"}
    assert len(node["in"]["cloud"]) > 1
    assert found["compare"] == {"design": "product", "metrics": ["part.n_items"]}
    assert found["name"] == "compare-part"


def test_what_no_recipe_gives_is_compared_in_none(catalog: Catalog) -> None:
    assert own_comparison_text("part.mine", ["no_such_product"], catalog) == ""
    # Nor where a recipe has a step of that name already.
    assert "plane" in recipe("direct")["steps"].keys() & recipe("quickstart")["steps"].keys()
    assert own_comparison_text("plane.mine", ["cloud"], catalog) == ""
