"""JSON Schema of the workflow file, with the parameters of every installed method folded in."""

from __future__ import annotations

from typing import Final, TypeAlias

from orthoflow.catalog import Catalog
from orthoflow.errors import PluginError
from orthoflow.products.product import JsonValue
from orthoflow.workflow.document import FORMAT
from orthoflow.workflow.expectations import NAME
from orthoflow.workflow.methods import MethodInfo, describe_method

Schema: TypeAlias = dict[str, JsonValue]

_NAME: Final[Schema] = {"type": "string", "pattern": f"^{NAME}$"}
_NAMED: Final[Schema] = {"pattern": f"^{NAME}$"}
_REFERENCE: Final[Schema] = {
    "type": "string",
    "pattern": rf"^{NAME}\.{NAME}$",
    "description": "step.port or inputs.name",
}


def workflow_schema(catalog: Catalog) -> Schema:
    """Give the schema, JSON Schema 2020-12, for editors and other programs.

    Methods that cannot be loaded are left out. The schema is weaker than `load_workflow`: it
    cannot know whether references and ports fit together.
    """
    methods = _loadable(catalog)
    calls: Schema = {f"call.{info.id}": _call(info) for info in methods}
    definitions: Schema = {f"params.{info.id}": _params(info) for info in methods}
    anywhere = [info.id for info in methods]
    varied = [info.id for info in methods if not info.is_source]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "orthoflow workflow",
        "type": "object",
        "required": ["orthoflow", "steps"],
        "additionalProperties": False,
        "properties": {
            "orthoflow": {"const": FORMAT, "description": "version of this format"},
            "name": _NAME,
            "seed": {"type": "integer", "minimum": 0, "description": "root of all seeds"},
            "inputs": {
                "type": "object",
                "propertyNames": _NAMED,
                "additionalProperties": _input(),
            },
            "steps": {
                "type": "object",
                "minProperties": 1,
                "propertyNames": {**_NAMED, "not": {"const": "inputs"}},
                "additionalProperties": {"$ref": "#/$defs/step"},
            },
            "compare": _compare(),
        },
        "$defs": {
            **definitions,
            **calls,
            "step": {
                "type": "object",
                "oneOf": [{"required": ["use"]}, {"required": ["variants"]}],
                "properties": {
                    "in": _wires(),
                    "unless": {**_REFERENCE, "description": "skipped when this input is given"},
                    "variants": {
                        "type": "object",
                        "minProperties": 1,
                        "propertyNames": _NAMED,
                        "additionalProperties": _one_of(varied),
                    },
                    **_call_properties(anywhere),
                },
                "allOf": [_params_rule(name) for name in anywhere],
                "additionalProperties": False,
            },
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
    return schema


def _call(info: MethodInfo) -> Schema:
    return {
        "type": "object",
        "required": ["use"],
        "properties": {
            **_call_properties([info.id]),
            "params": {"$ref": f"#/$defs/params.{info.id}"},
        },
        "additionalProperties": False,
    }


def _call_properties(methods: list[str]) -> Schema:
    names: list[JsonValue] = [*methods]
    return {
        "use": {"enum": names, "description": "kind.method"},
        "params": {"type": "object"},
        "repeat": {"type": "integer", "minimum": 1, "description": "runs with seeds of their own"},
        "resources": {
            "type": "object",
            "properties": {"cores": {"type": "integer", "minimum": 1}},
            "additionalProperties": False,
        },
        "timeout": {
            "description": "90s, 30min, 2h, or seconds",
            "oneOf": [
                {"type": "number", "exclusiveMinimum": 0},
                {"type": "string", "pattern": r"^\d+(\.\d+)? *(s|min|h)$"},
            ],
        },
    }


def _params_rule(method_id: str) -> Schema:
    return {
        "if": {"required": ["use"], "properties": {"use": {"const": method_id}}},
        "then": {"properties": {"params": {"$ref": f"#/$defs/params.{method_id}"}}},
    }


def _one_of(methods: list[str]) -> Schema:
    return {"oneOf": [{"$ref": f"#/$defs/call.{name}"} for name in methods]}


def _wires() -> Schema:
    return {
        "type": "object",
        "description": "port: where its product comes from; of a list, the first that is present",
        "additionalProperties": {
            "oneOf": [_REFERENCE, {"type": "array", "minItems": 1, "items": _REFERENCE}]
        },
    }


def _input() -> Schema:
    text: Schema = {"type": "string", "minLength": 1}
    return {
        "type": "object",
        "properties": {
            "files": {
                "description": "a file, a folder, a pattern, or a list of them",
                "oneOf": [text, {"type": "array", "minItems": 1, "items": text}],
            },
            "optional": {"type": "boolean"},
        },
        "additionalProperties": False,
    }


def _compare() -> Schema:
    assignment: Schema = {
        "type": "object",
        "description": "step: variant",
        "additionalProperties": {"type": "string"},
    }
    return {
        "type": "object",
        "properties": {
            "design": {"enum": ["product", "one-at-a-time"]},
            "baseline": assignment,
            "exclude": {"type": "array", "items": {**assignment, "minProperties": 1}},
            "metrics": {"type": "array", "items": {"type": "string", "pattern": r"^[^.]+\..+$"}},
        },
        "additionalProperties": False,
    }
