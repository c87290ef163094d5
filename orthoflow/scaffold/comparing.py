"""Workflow for a new plugin: a shipped recipe that compares the new method with another."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from ruamel.yaml import YAML

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import PluginError
from orthoflow.scaffold.kinds import loadable_method
from orthoflow.sdk import port_specs
from orthoflow.sdk.hooks import FILES
from orthoflow.workflow.source import shipped_workflow

# The first recipe that contains a step of the kind is used; with one wall and large cells it runs
# in seconds and without a warning.
_RECIPES: Final = ("direct", "quickstart")
_COARSE: Final = {
    "direct": {
        "simulate.room": {"scan_step_m": 0.02},
        "raster.grid": {"gsd_m": 0.06, "n_walls_max": 1},
    }
}
_METRICS_MOST: Final = 4
# Maximum length of a workflow's name in characters.
_NAME_MOST: Final = 32
# Metrics to compare. The RMS reported by a detector is no criterion: it is low if only easy planes
# are found.
_JUDGED: Final = {
    "plane": ("true_planes_found", "label_iou_mean", "plane_angle_deg", "plane_offset_mm")
}


def comparison_text(method_id: str, name: str, catalog: Catalog) -> str:
    """Return a shipped recipe with a new method as a variant next to the method of its kind.

    Args:
        method_id: the new method.
        name: name of its variant.
        catalog: the installed plugins.

    Returns:
        YAML; empty for a source, which cannot have variants, and if no shipped recipe has a step of
        the kind and no installed method of the kind can be added to one.
    """
    kind = method_id.partition(".")[0]
    if catalog.kinds[kind].spec.is_source:
        return ""
    for recipe in _RECIPES:
        document = _coarse_document(recipe)
        steps: dict[str, dict[str, Any]] = document["steps"]
        of_kind = [step for step, node in steps.items() if node["use"].startswith(f"{kind}.")]
        if not of_kind:
            continue
        _vary(steps[of_kind[-1]], name, method_id)
        return _dumped(document, name, _judged(kind, steps, catalog))
    sibling = loadable_method(catalog, kind)
    if sibling is None:
        return ""
    ports = [port for port in port_specs(sibling.load().In).values() if port.required]
    variants = {
        sibling.spec.id.partition(".")[2]: {"use": sibling.spec.id},
        name: {"use": method_id},
    }
    takes = {port.name: port.type_name for port in ports}
    # A metric whose name is a pattern may not occur, and the comparison would report that.
    metrics = [one.name for one in sibling.load().metric_specs() if one.name.isidentifier()]
    asked = [f"{kind}.{one}" for one in metrics[:_METRICS_MOST]]
    return _dumped(_behind_a_recipe(kind, takes, variants, catalog), name, asked)


def _judged(kind: str, steps: Mapping[str, Mapping[str, Any]], catalog: Catalog) -> list[str]:
    """Return the metrics in a recipe that show which method is better."""
    wanted = _JUDGED.get(kind, ())
    measured = {
        metric.name: f"{name}.{metric.name}"
        for name, node in steps.items()
        if "use" in node
        for metric in catalog.method(node["use"]).load().metric_specs()
    }
    return [measured[metric] for metric in wanted if metric in measured]


def own_comparison_text(method_id: str, takes: Sequence[str], catalog: Catalog) -> str:
    """Return a shipped recipe that continues with a method of a new kind in two variants.

    Args:
        method_id: the new method, which has a parameter `factor`.
        takes: product types of its inputs.
        catalog: the installed plugins.

    Returns:
        YAML; empty if no shipped recipe provides all inputs.
    """
    kind = method_id.partition(".")[0]
    variants = {
        "plain": {"use": method_id},
        "double": {"use": method_id, "params": {"factor": 2.0}},
    }
    document = _behind_a_recipe(kind, dict(zip(takes, takes, strict=True)), variants, catalog)
    return _dumped(document, kind, [f"{kind}.n_items"])


def _behind_a_recipe(
    step: str, takes: Mapping[str, str], variants: Mapping[str, object], catalog: Catalog
) -> dict[str, Any]:
    """Return the part of a recipe that a step needs, and the step; empty if none provides it.

    Args:
        step: name of the step.
        takes: port -> product type; types missing in the recipe are made by installed methods.
        variants: variants of the step.
        catalog: the installed plugins.
    """
    for recipe in _RECIPES:
        document = _coarse_document(recipe)
        steps: dict[str, dict[str, Any]] = document["steps"]
        if step in steps or not all(_reach(kind, steps, catalog) for kind in takes.values()):
            continue
        wires = _wires(takes, steps, catalog)
        needed = _needed(steps, wires.values())
        document["steps"] = {name: node for name, node in steps.items() if name in needed}
        document["steps"][step] = {"in": wires, "variants": dict(variants)}
        document["inputs"] = {
            name: spec
            for name, spec in document.get("inputs", {}).items()
            if f"inputs.{name}" in str(document["steps"])
        }
        if not document["inputs"]:
            del document["inputs"]
        return document
    return {}


def _reach(
    type_name: str,
    steps: dict[str, dict[str, Any]],
    catalog: Catalog,
    asked: frozenset[str] = frozenset(),
) -> bool:
    """Add steps until one outputs a product type; return whether that succeeded."""
    if type_name in _given(steps, catalog):
        return True
    if type_name in asked:
        return False
    for entry in catalog.methods.values():
        kind = entry.spec.kind
        try:
            method = entry.load()
        except PluginError:
            continue
        gives = {port.type_name for port in port_specs(method.Out).values()}
        takes = {p.name: p.type_name for p in port_specs(method.In).values() if p.required}
        if type_name not in gives or FILES in takes.values() or kind in steps:
            continue
        if all(_reach(one, steps, catalog, asked | {type_name}) for one in takes.values()):
            steps[kind] = {"use": entry.spec.id, "in": _wires(takes, steps, catalog)}
            return True
    return False


def _given(steps: Mapping[str, Mapping[str, Any]], catalog: Catalog) -> dict[str, list[str]]:
    """Return references to the outputs of steps, by product type."""
    given: dict[str, list[str]] = {}
    for name, node in steps.items():
        for port in port_specs(catalog.method(node["use"]).load().Out).values():
            given.setdefault(port.type_name, []).append(f"{name}.{port.name}")
    return given


def _wires(
    takes: Mapping[str, str], steps: Mapping[str, Mapping[str, Any]], catalog: Catalog
) -> dict[str, str | list[str]]:
    """Return the sources of ports: all clouds, otherwise the last output of the type."""
    given = _given(steps, catalog)
    return {
        port: given[kind] if kind == "cloud" else given[kind][-1] for port, kind in takes.items()
    }


def _coarse_document(recipe: str) -> dict[str, Any]:
    """Return a shipped recipe, changed so that it runs in seconds."""
    text = shipped_workflow(recipe).read_text(encoding="utf-8")
    # `Any`: a document of nested mappings.
    document: dict[str, Any] = YAML(typ="safe").load(text)
    for node in document["steps"].values():
        if coarse := _COARSE.get(recipe, {}).get(node["use"]):
            node["params"] = coarse
    return document


def _needed(
    steps: Mapping[str, Mapping[str, Any]], wires: Iterable[str | Sequence[str]]
) -> set[str]:
    """Return the steps that references come from, and all steps upstream of them."""
    found: set[str] = set()
    waiting = list(wires)
    while waiting:
        wire = waiting.pop()
        for reference in [wire] if isinstance(wire, str) else wire:
            name = reference.partition(".")[0]
            if name in steps and name not in found:
                found.add(name)
                waiting += steps[name].get("in", {}).values()
    return found


def _vary(node: dict[str, Any], name: str, method_id: str) -> None:
    ours: dict[str, object] = {"use": node.pop("use")}
    if params := node.pop("params", None):
        ours["params"] = params
    sibling = str(ours["use"]).partition(".")[2]
    node["variants"] = {sibling: ours, name: {"use": method_id}}


def _dumped(document: dict[str, Any], name: str, metrics: Sequence[str]) -> str:
    """Return the document as a comparison with a new name; empty for an empty document."""
    if not document:
        return ""
    document["name"] = f"compare-{name}"[:_NAME_MOST].rstrip("_-")
    asked = {"metrics": [*metrics]} if metrics else {}
    document["compare"] = {"design": "product", **asked}
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 4096
    stream = io.StringIO()
    yaml.dump(document, stream)
    return stream.getvalue()
