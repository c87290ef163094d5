"""Workflow for a new plugin: a shipped recipe that compares the new method with another."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, Final

from ruamel.yaml import YAML

from orthoflow.catalog.catalog import Catalog
from orthoflow.sdk import port_specs
from orthoflow.workflow.source import shipped_workflow

# The first recipe that contains a step of the kind is used.
_RECIPES: Final = ("direct", "quickstart")
# With one wall and large cells, a recipe runs within seconds and without warnings.
_COARSE: Final = {
    ("direct", "simulate.room"): {"scan_step_m": 0.02},
    ("direct", "raster.grid"): {"gsd_m": 0.06, "n_walls_max": 1},
}
# Maximum length of a workflow's name in characters.
_NAME_MOST: Final = 32
# Metrics to compare. The RMS that a detector reports is not a criterion, since it is low if only
# easy planes are found.
_JUDGED: Final = {
    "plane": [
        "check.true_planes_found",
        "check.label_iou_mean",
        "check.plane_angle_deg",
        "check.plane_offset_mm",
    ]
}


def comparison_text(method_id: str, name: str, catalog: Catalog) -> str:
    """Return a shipped recipe in which a new method is a variant next to the existing one.

    Args:
        method_id: the new method.
        name: name of its variant.
        catalog: the installed plugins.

    Returns:
        YAML; empty if the method is a source, which cannot have variants, or if no recipe has a
        step of its kind.
    """
    kind = method_id.partition(".")[0]
    for recipe in _RECIPES:
        document = _coarse_document(recipe)
        of_kind = [one for one in document["steps"].values() if one["use"].startswith(f"{kind}.")]
        if of_kind and not catalog.kinds[kind].spec.is_source:
            node = of_kind[-1]
            ours = {key: node.pop(key) for key in ("use", "params") if key in node}
            sibling = ours["use"].partition(".")[2]
            node["variants"] = {sibling: ours, name: {"use": method_id}}
            return _dumped(document, name, _JUDGED.get(kind, []))
    return ""


def own_comparison_text(method_id: str, takes: Sequence[str], catalog: Catalog) -> str:
    """Return a shipped recipe to which two variants of a method of a new kind are added.

    Args:
        method_id: the new method, which has a parameter `factor`.
        takes: product types of its inputs.
        catalog: the installed plugins.

    Returns:
        YAML; empty if no shipped recipe provides all inputs.
    """
    kind = method_id.partition(".")[0]
    for recipe in _RECIPES:
        document = _coarse_document(recipe)
        given: dict[str, list[str]] = {}
        for name, node in document["steps"].items():
            for port in port_specs(catalog.method(node["use"]).load().Out).values():
                given.setdefault(port.type_name, []).append(f"{name}.{port.name}")
        if kind not in document["steps"] and given.keys() >= set(takes):
            # Connect both the reader and the simulation of the cloud, since only one of them runs.
            wires = {name: given[name] if name == "cloud" else given[name][-1] for name in takes}
            double = {"use": method_id, "params": {"factor": 2.0}}
            variants = {"plain": {"use": method_id}, "double": double}
            document["steps"][kind] = {"in": wires, "variants": variants}
            return _dumped(document, kind, [f"{kind}.n_items"])
    return ""


def _coarse_document(recipe: str) -> dict[str, Any]:
    text = shipped_workflow(recipe).read_text(encoding="utf-8")
    # Any, because the document consists of nested mappings.
    document: dict[str, Any] = YAML(typ="safe").load(text)
    for node in document["steps"].values():
        if coarse := _COARSE.get((recipe, node["use"])):
            node["params"] = coarse
    return document


def _dumped(document: dict[str, Any], name: str, metrics: Sequence[str]) -> str:
    document["name"] = f"compare-{name}"[:_NAME_MOST].rstrip("_-")
    asked = {"metrics": [*metrics]} if metrics else {}
    document["compare"] = {"design": "product", **asked}
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 4096
    stream = io.StringIO()
    yaml.dump(document, stream)
    return stream.getvalue()
