"""A workflow for other programs: the JSON Schema of its file, and its steps as a flowchart."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, TypeAlias

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.errors import PluginError
from orthoflow.products.product import JsonValue
from orthoflow.sdk.methods import Method, port_specs
from orthoflow.workflow.model import (
    INPUTS,
    CallSection,
    StepVariant,
    SweepSection,
    Workflow,
    WorkflowFile,
    WorkflowStep,
)

# Any: JSON.
Schema: TypeAlias = dict[str, Any]
_SWEEP: Final = {"$ref": "#/$defs/SweepSection"}
# Parts of a parameter's schema that stay where editors look for them if a sweep may replace it.
_SHOWN: Final = ("description", "default")


def workflow_schema(catalog: Catalog) -> dict[str, JsonValue]:
    """Return the schema, JSON Schema 2020-12, for editors and other programs.

    Methods that cannot be loaded are left out. The schema is weaker than `load_workflow`: it
    cannot know whether references and ports fit together.
    """
    methods = list(_loadable(catalog))
    schema = WorkflowFile.model_json_schema(by_alias=True)
    defs: Schema = schema["$defs"]
    defs["SweepSection"] = SweepSection.model_json_schema()
    for info in methods:
        params = info.Params.model_json_schema()
        defs |= {
            f"{info.id}.{name}": _renamed(inner, info)
            for name, inner in params.pop("$defs", {}).items()
        }
        properties = params.get("properties", {})
        params["properties"] = {name: _or_sweep(inner) for name, inner in properties.items()}
        defs[info.id] = _renamed(params, info)
    # One rule per method, which steps and variants share.
    defs["parameters"] = {
        "allOf": [
            {
                "if": {"required": ["use"], "properties": {"use": {"const": info.id}}},
                "then": {"properties": {"params": {"$ref": f"#/$defs/{info.id}"}}},
            }
            for info in methods
        ]
    }
    step, call = defs["StepSection"], defs["CallSection"]
    for section, chosen in (
        (step, methods),
        (call, [info for info in methods if not _is_source(info, catalog)]),
    ):
        use = section["properties"]["use"]
        section["properties"]["use"] = {
            "enum": [info.id for info in chosen],
            "description": use["description"],
        }
        section["allOf"] = [{"$ref": "#/$defs/parameters"}]
    call["required"] = ["use"]
    # With variants, the keys of a call are in each of them.
    step["oneOf"] = [
        {"required": ["use"], "properties": {"variants": False}},
        {
            "required": ["variants"],
            "properties": dict.fromkeys(CallSection.model_fields, False),
        },
    ]
    properties = schema["properties"]
    _name_keys(properties["inputs"])
    _name_keys(properties["steps"], taken=INPUTS)
    step["properties"]["variants"] = _first_of(step["properties"]["variants"])
    _name_keys(step["properties"]["variants"], is_needed=True)
    _name_keys(properties["steps"], is_needed=True, taken=INPUTS)
    for choice in properties["datasets"]["anyOf"]:
        if choice.get("type") == "object":
            _name_keys(choice, is_needed=True)
    schema["required"] = ["orthoflow", "steps"]
    _tidy(schema)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "orthoflow workflow",
        **schema,
    }


def _loadable(catalog: Catalog) -> Iterator[type[Method]]:
    for method_id in sorted(catalog.methods):
        try:
            yield catalog.method(method_id).load()
        except PluginError:
            continue


def _is_source(method: type[Method], catalog: Catalog) -> bool:
    kind = catalog.methods[method.id].kind
    return kind is not None and kind.is_source


def _renamed(schema: Any, info: type[Method]) -> Any:
    """Update the references of a method's own definitions to their new place."""
    if isinstance(schema, dict):
        return {
            key: f"#/$defs/{info.id}.{value.rpartition('/')[2]}"
            if key == "$ref" and value != _SWEEP["$ref"]
            else _renamed(value, info)
            for key, value in schema.items()
        }
    return [_renamed(item, info) for item in schema] if isinstance(schema, list) else schema


def _or_sweep(schema: Schema) -> Schema:
    """A value or a sweep."""
    shown: Schema = {key: schema[key] for key in _SHOWN if key in schema}
    own = {key: value for key, value in schema.items() if key not in (*_SHOWN, "title")}
    choices = own.pop("anyOf") if set(own) == {"anyOf"} else [own]
    return {**shown, "anyOf": [*choices, _SWEEP]}


def _first_of(schema: Schema) -> Schema:
    """Return it without `null`: a key that is present has a value."""
    choices = schema.pop("anyOf", [])
    chosen = [choice for choice in choices if choice.get("type") != "null"]
    return {**schema, **(chosen[0] if len(chosen) == 1 else {"anyOf": chosen})}


def _name_keys(schema: Schema, *, is_needed: bool = False, taken: str = "") -> None:
    """State which keys a mapping may have; pydantic states patterns that need not be met."""
    for patterns in (schema.pop("patternProperties", None),):
        if patterns:
            schema["additionalProperties"] = next(iter(patterns.values()))
    names: Schema = {"pattern": f"^{NAME_PATTERN}$"}
    if taken:
        names["not"] = {"enum": [taken]}
    schema["propertyNames"] = names
    if is_needed:
        schema["minProperties"] = 1


def _tidy(schema: Any) -> None:
    """Drop what is of no use to an editor: titles made of names, `null` for absent keys."""
    if isinstance(schema, list):
        for item in schema:
            _tidy(item)
        return
    if not isinstance(schema, dict):
        return
    if isinstance(schema.get("title"), str):
        del schema["title"]
    for value in schema.values():
        _tidy(value)


# Flowchart ----------------------------------------------------------------------------------------


def mermaid(workflow: Workflow, catalog: Catalog) -> str:
    """Draw inputs, steps with their variants, and their connections, for Mermaid.

    Dotted edges may stay empty: the port has several candidates, or the input disables the step.
    Ports that all methods of a step ignore are not drawn.
    """
    # Names may be words that Mermaid reserves, such as `end`; only the labels show them.
    nodes = {f"{INPUTS}.{name}": f"input{k}" for k, name in enumerate(workflow.inputs)}
    nodes |= {name: f"step{k}" for k, name in enumerate(workflow.steps)}
    lines = ["flowchart LR"]
    for name, spec in workflow.inputs.items():
        note = "<br/>optional" if spec.optional else ""
        if name in workflow.data_inputs:
            note = f"<br/>of {len(workflow.chosen_data)} datasets"
        lines.append(f'    {nodes[f"{INPUTS}.{name}"]}[/"{name}{note}"/]')
    for name, step in workflow.steps.items():
        label = "<br/>".join([f"<b>{name}</b>", *map(_call_label, step.variants)])
        lines.append(f'    {nodes[name]}["{label}"]')
    for step in workflow.steps.values():
        labels: dict[tuple[str, str], list[str]] = {}
        for source, arrow, label in _wires(step, catalog):
            labels.setdefault((source, arrow), []).append(label)
        for (source, arrow), ports in labels.items():
            text = ", ".join(dict.fromkeys(ports))
            lines.append(f'    {nodes[source]} {arrow}|"{text}"| {nodes[step.name]}')
    return "\n".join(lines) + "\n"


def _call_label(variant: StepVariant) -> str:
    name = f"{variant.name}: " if variant.name else ""
    repeat = f", {variant.repeat} times" if variant.repeat > 1 else ""
    return f"{name}{variant.method}{repeat}"


def _wires(step: WorkflowStep, catalog: Catalog) -> Iterator[tuple[str, str, str]]:
    """Yield source, arrow and label of each wire of a step."""
    taken = {
        port
        for variant in step.variants
        for port in port_specs(catalog.method(variant.method).load().In)
    }
    for port, references in step.inputs.items():
        for reference in references if port in taken else ():
            source = str(reference) if reference.is_input else reference.source
            yield source, "-->" if len(references) == 1 else "-.->", port
    for name, word in ((step.only_if, "if"), (step.unless, "unless")):
        if name:
            yield f"{INPUTS}.{name}", "-.->", word
