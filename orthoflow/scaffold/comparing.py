"""A workflow that compares a new method with an installed one: a shipped recipe with variants."""

from __future__ import annotations

import io
from typing import Any, Final

from ruamel.yaml import YAML

from orthoflow.catalog import Catalog
from orthoflow.workflow import shipped_workflow

# The first recipe that has a step of the kind is taken; cells of 2 cm let it run in seconds.
_RECIPES: Final = ("direct", "quickstart")
_COARSE: Final = {
    "direct": {"simulate.room": {"scan_step_m": 0.02}, "raster.grid": {"gsd_m": 0.02}}
}


def comparison_text(method_id: str, name: str, catalog: Catalog) -> str:
    """Give a workflow in which a method stands beside the shipped recipe's own of its kind.

    Args:
        method_id: the new method.
        name: its variant's name.
        catalog: says which kinds are sources, which take no variants.

    Returns:
        YAML; empty when no shipped recipe has a step of the kind.
    """
    kind = method_id.partition(".")[0]
    if catalog.kinds[kind].spec.is_source:
        return ""
    for recipe in _RECIPES:
        text = shipped_workflow(recipe).read_text(encoding="utf-8")
        # Any: a document of nested mappings.
        document: dict[str, Any] = YAML(typ="safe").load(text)
        steps: dict[str, dict[str, Any]] = document["steps"]
        of_kind = [step for step, node in steps.items() if node["use"].startswith(f"{kind}.")]
        if not of_kind:
            continue
        for node in steps.values():
            if coarse := _COARSE.get(recipe, {}).get(node["use"]):
                node["params"] = coarse
        _vary(steps[of_kind[-1]], name, method_id)
        document["name"] = f"compare-{name}"
        document["compare"] = {"design": "product"}
        return _dumped(document)
    return ""


def _vary(node: dict[str, Any], name: str, method_id: str) -> None:
    ours: dict[str, object] = {"use": node.pop("use")}
    if params := node.pop("params", None):
        ours["params"] = params
    sibling = str(ours["use"]).partition(".")[2]
    node["variants"] = {sibling: ours, name: {"use": method_id}}


def _dumped(document: dict[str, Any]) -> str:
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 4096
    stream = io.StringIO()
    yaml.dump(document, stream)
    return stream.getvalue()
