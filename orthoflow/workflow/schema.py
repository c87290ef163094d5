"""JSON Schema of the workflow file: the format, with the parameters of every installed method."""

from __future__ import annotations

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import PluginError
from orthoflow.products.product import JsonValue
from orthoflow.workflow.format import CALL, FILE, PARAMS, STEP, STEPS, SWEPT, USE, VARIANTS
from orthoflow.workflow.methods import MethodInfo, describe_method
from orthoflow.workflow.shapes import Schema


def workflow_schema(catalog: Catalog) -> Schema:
    """Give the schema, JSON Schema 2020-12, for editors and other programs.

    Methods that cannot be loaded are left out. The schema is weaker than `load_workflow`: it
    cannot know whether references and ports fit together.
    """
    methods = _loadable(catalog)
    steps: Schema = {
        **STEPS.schema(),
        "additionalProperties": {"$ref": "#/$defs/step"},
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "orthoflow workflow",
        **_with_properties(FILE.schema(), {STEPS.name: steps}),
        "$defs": {
            **{f"params.{info.id}": _params(info) for info in methods},
            **{f"call.{info.id}": _call(info) for info in methods},
            "step": _step(methods),
        },
    }


def _loadable(catalog: Catalog) -> list[MethodInfo]:
    infos: list[MethodInfo] = []
    for method_id in sorted(catalog.methods):
        try:
            infos.append(describe_method(catalog, method_id))
        except PluginError:
            continue
    return infos


def _params(info: MethodInfo) -> Schema:
    # Each schema keeps its own $defs; the references inside must then name the way to them.
    schema: Schema = info.method.Params.model_json_schema(
        ref_template=f"#/$defs/params.{info.id}/$defs/{{model}}"
    )
    properties = schema.get("properties")
    if isinstance(properties, dict):
        schema["properties"] = {name: _swept_or(said) for name, said in properties.items()}
    return schema


def _swept_or(said: JsonValue) -> JsonValue:
    """A value or a sweep; what editors show of the parameter stays where they look for it."""
    assert isinstance(said, dict)  # noqa: S101 - the schema of a field
    shown: Schema = {k: said[k] for k in ("title", "description", "default") if k in said}
    return {**shown, "anyOf": [said, SWEPT.schema()]}


def _call(info: MethodInfo) -> Schema:
    own: Schema = {
        USE.name: _use([info]),
        PARAMS.name: {"$ref": f"#/$defs/params.{info.id}"},
    }
    return {**_with_properties(CALL.schema(), own), "required": [USE.name]}


def _step(methods: list[MethodInfo]) -> Schema:
    calls: list[JsonValue] = [
        {"$ref": f"#/$defs/call.{info.id}"} for info in methods if not info.is_source
    ]
    variants: Schema = {**VARIANTS.schema(), "additionalProperties": {"oneOf": calls}}
    own: Schema = {USE.name: _use(methods), VARIANTS.name: variants}
    return {
        **_with_properties(STEP.schema(), own),
        # With variants, what belongs to a call stands in each of them.
        "oneOf": [
            {"required": [USE.name], "properties": {VARIANTS.name: False}},
            {
                "required": [VARIANTS.name],
                "properties": {key.name: False for key in CALL.keys},
            },
        ],
        "allOf": [_params_rule(info) for info in methods],
    }


def _with_properties(schema: Schema, properties: Schema) -> Schema:
    """Put what is known of some properties in the place of what the format says."""
    known = schema["properties"]
    return {**schema, "properties": {**known, **properties} if isinstance(known, dict) else {}}


def _use(methods: list[MethodInfo]) -> Schema:
    return {"enum": [info.id for info in methods], "description": USE.meaning}


def _params_rule(info: MethodInfo) -> Schema:
    return {
        "if": {"required": [USE.name], "properties": {USE.name: {"const": info.id}}},
        "then": {"properties": {PARAMS.name: {"$ref": f"#/$defs/params.{info.id}"}}},
    }
