"""The workflow in which a new method stands beside an installed one: short, judged, whole."""

from __future__ import annotations

from typing import Any

import pytest
from ruamel.yaml import YAML

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.scaffold import comparing
from orthoflow.scaffold.comparing import comparison_text, own_comparison_text


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return discover_catalog()


def read(text: str) -> Any:
    return YAML(typ="safe").load(text)


def recipe(name: str) -> Any:
    return read(comparing.shipped_workflow(name).read_text(encoding="utf-8"))


def test_a_method_stands_beside_the_last_step_of_its_kind(catalog: Catalog) -> None:
    found = read(comparison_text("plane.mine", "mine", catalog))
    shipped = recipe("direct")
    (name,) = [step for step, node in shipped["steps"].items() if node["use"].startswith("plane.")]
    node, before = found["steps"][name], shipped["steps"][name]
    sibling = before["use"].partition(".")[2]
    ours = {"use": before["use"]} | ({"params": before["params"]} if "params" in before else {})
    assert node["variants"] == {sibling: ours, "mine": {"use": "plane.mine"}}
    assert "use" not in node
    assert node["in"] == before["in"]
    assert found["name"] == "compare-mine"
    assert found["compare"]["design"] == "product"
    # What a detector says of its own planes is good where it found but the easy ones.
    assert found["compare"]["metrics"] == [
        "check.true_planes_found",
        "check.label_iou_mean",
        "check.plane_angle_deg",
        "check.plane_offset_mm",
    ]
    others = {key: value for key, value in found["steps"].items() if key != name}
    assert others.keys() == shipped["steps"].keys() - {name}


def test_a_comparison_of_points_on_a_wall_runs_in_seconds(catalog: Catalog) -> None:
    steps = read(comparison_text("plane.mine", "mine", catalog))["steps"]
    params = {node["use"]: node.get("params") for node in steps.values() if "use" in node}
    # Points two centimetres apart, cells of six, one wall.
    assert params["simulate.room"] == {"scan_step_m": 0.02}
    assert params["raster.grid"] == {"gsd_m": 0.06, "n_walls_max": 1}


def test_a_kind_that_the_first_recipe_has_not_is_compared_in_the_second(catalog: Catalog) -> None:
    found = read(comparison_text("orient.mine", "mine", catalog))
    assert found["steps"].keys() == recipe("quickstart")["steps"].keys()
    assert "metrics" not in found["compare"]


@pytest.mark.parametrize("method_id", ["read.mine", "simulate.mine"])
def test_sources_take_no_variants(method_id: str, catalog: Catalog) -> None:
    assert comparison_text(method_id, "mine", catalog) == ""


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
    # What it does not need is left out, inputs too.
    assert not any(str(one.get("use", "")).startswith("ortho.") for one in found["steps"].values())
    for name in found.get("inputs", {}):
        assert f"inputs.{name}" in str(found["steps"])


def test_what_a_recipe_does_not_give_installed_methods_make_of_it(catalog: Catalog) -> None:
    found = read(comparison_text("colour.mine", "mine", catalog))
    steps = found["steps"]
    assert steps["colour"]["variants"] == {
        "photos": {"use": "colour.photos"},
        "mine": {"use": "colour.mine"},
    }
    # The first recipe has no photos on walls: the first methods that match and orient lead there.
    made = {name: node["in"] for name, node in steps.items() if name in ("match", "orient")}
    assert made == {
        "match": {"photos": "room.photos", "walls": "wall.walls"},
        "orient": {"ties": "match.ties", "photos": "room.photos"},
    }
    assert steps["colour"]["in"]["cameras"] == "orient.cameras"
    # What its sibling says of itself, and no pattern of names.
    assert found["compare"]["design"] == "product"
    specs = catalog.method("colour.photos").load().metric_specs()
    assert found["compare"]["metrics"] == [f"colour.{one.name}" for one in specs[:4]]


def test_what_no_recipe_gives_is_compared_in_none(catalog: Catalog) -> None:
    assert own_comparison_text("part.mine", ["no_such_product"], catalog) == ""
    # Nor where a recipe has a step of that name already.
    assert "plane" in recipe("direct")["steps"].keys() & recipe("quickstart")["steps"].keys()
    assert own_comparison_text("plane.mine", ["cloud"], catalog) == ""


def test_steps_are_needed_with_all_before_them() -> None:
    steps: dict[str, dict[str, Any]] = {
        "a": {},
        "b": {"in": {"x": "a.x"}},
        "c": {"in": {"x": ["b.x", "d.x"], "y": "inputs.file"}},
        "d": {"in": {"x": "a.x"}},
        "e": {"in": {"x": "c.x"}},
        "f": {"in": {"x": "e.x"}},
    }
    assert comparing._needed(steps, ["c.y"]) == {"a", "b", "c", "d"}
    assert comparing._needed(steps, ["b.x", ["d.x", "inputs.file"]]) == {"a", "b", "d"}
    assert comparing._needed(steps, []) == set()


def test_a_sibling_keeps_its_parameters() -> None:
    node: dict[str, Any] = {"use": "plane.old", "params": {"a": 1}, "in": {}}
    comparing._vary(node, "mine", "plane.mine")
    assert node == {
        "in": {},
        "variants": {
            "old": {"use": "plane.old", "params": {"a": 1}},
            "mine": {"use": "plane.mine"},
        },
    }
