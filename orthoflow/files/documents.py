"""Validation of user documents by pydantic models, with the positions of errors in messages."""

from __future__ import annotations

import json
import math
import re
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from orthoflow.errors import did_you_mean, nearest
from orthoflow.files.yaml_positions import (
    MOST_VALUES,
    Location,
    Position,
    describe,
    path_text,
    read_yaml,
)
from orthoflow.products.product import JsonValue
from orthoflow.untrusted_text import first_few

Model = TypeVar("Model", bound=BaseModel)
# Maximum lengths of a value and of a path in messages, in characters.
_SHOWN: Final = 60
_LONGEST_PATH: Final = 100


def read_model(
    text: str, model: type[Model], most_values: int = MOST_VALUES
) -> tuple[Model | None, list[tuple[Position, str]]]:
    """Read a document as a pydantic model, or list its errors with their positions.

    Args:
        text: the document.
        model: a model that forbids additional keys.
        most_values: maximum number of values, with aliases expanded.

    Returns:
        The model and no problems, or None and the problems in the order of the text.
    """
    log = _Collected()
    document = read_yaml(text, log, most_values)
    if document is None or log.found:
        return None, sorted(log.found)
    if not isinstance(document.value, dict):
        keys = first_few(list(model.model_fields))
        expected = f"expected the keys {keys}, got {describe(document.value)}"
        return None, [(document.position(()), expected)]
    try:
        return model.model_validate(document.value), []
    except ValidationError as error:
        for loc, message, at_key in mistakes(error, model, document.value):
            position = document.position(loc, at_key=at_key)
            log.add(position, path_text(loc)[:_LONGEST_PATH], message)
        return None, sorted(log.found)


class _Collected:
    def __init__(self) -> None:
        self.found: list[tuple[Position, str]] = []

    def add(self, position: Position, path: str, message: str) -> None:
        self.found.append((position, f"{path}: {message}" if path else message))


# Expected value by pydantic's error code, in terms of YAML or JSON instead of Python. Our own
# validators raise custom errors with a `form`.
_FORMS: Final[Mapping[str, str]] = {
    "bool_type": "true or false",
    "dict_type": "a mapping",
    "finite_number": "a finite number",
    "float_type": "a valid number",
    "greater_than": "greater than {gt:g}",
    "greater_than_equal": "greater than or equal to {ge:g}",
    "int_from_float": "a whole number",
    "int_type": "a whole number",
    "less_than": "less than {lt:g}",
    "less_than_equal": "less than or equal to {le:g}",
    "list_type": "a list",
    "literal_error": "{expected}",
    "model_type": "a mapping",
    "string_type": "text",
    "tuple_type": "a list",
}
_OF_NUMBERS: Final = frozenset(
    ("finite_number", "float_type", "int_from_float", "int_type", "time")
)
_OF_LISTS: Final = frozenset(("tuple_type", "list_type", "missing", "too_long", "too_short"))
# Keys of a method call that users often write among its parameters by mistake.
_BESIDE: Final = ("use", "repeat", "resources", "timeout")


def mistakes(
    error: ValidationError, model: type[BaseModel], data: JsonValue, owner: str = ""
) -> Iterator[tuple[Location, str, bool]]:
    """Yield each mistake once: its location, a message, and whether the key itself is wrong.

    Args:
        error: the validation error.
        model: the model against which the data were checked.
        data: the data that failed validation.
        owner: name of the method with these parameters; empty for sections of a file.
    """
    # Each alternative of a type union reports its own error.
    places: dict[tuple[Location, bool], list[ErrorDetails]] = {}
    for details in error.errors(include_url=False):
        at_key = details["loc"][-1:] == ("[key]",) or details["type"] == "extra_forbidden"
        loc = tuple(part for part in details["loc"] if part != "[key]")
        is_missing = details["type"] == "missing"
        named = existing(data, loc[:-1]) + loc[-1:] if is_missing else existing(data, loc)
        places.setdefault((named, at_key), []).append(details)
    for name in {loc[0] for loc, _ in places if owner and loc}:
        group = [key for key in places if key[0][:1] == (name,)]
        kinds = {one["type"] for key in group for one in places[key]}
        form = _list_form(model, str(name)) if kinds & _OF_LISTS else ""
        # All errors within one malformed list count as one mistake.
        if form and isinstance(data, dict):
            yield (
                (name,),
                f"{name} must be written as {form}, got {_shown(data.get(str(name)))}",
                True,
            )
            for key in group:
                del places[key]
    keys = {loc for loc, at_key in places if at_key}
    for (loc, at_key), alternatives in places.items():
        # Skip errors that follow from others: a list that is too short because some items are
        # invalid, a wrong value of an invalid key (but not the key itself), and a key that is
        # missing because it is misspelt.
        is_outer = any(len(other) > len(loc) and other[: len(loc)] == loc for other, _ in places)
        follows = is_outer and not at_key
        is_missing = alternatives[0]["type"] == "missing"
        beside = [str(key[-1]) for key in keys if key[:-1] == loc[:-1]]
        follows |= is_missing and any(nearest(name, [str(loc[-1])]) for name in beside)
        if not follows and (at_key or not any(loc[: len(key)] == key for key in keys)):
            yield loc, _sentence(alternatives, loc, model, owner), at_key or is_missing


def existing(data: Any, loc: Location) -> Location:
    """Return the part of a location that exists in the data, without pydantic's type names."""
    found: list[str | int] = []
    for part in loc:
        is_index = isinstance(data, list) and isinstance(part, int) and part < len(data)
        if is_index or (isinstance(data, dict) and part in data):
            data = data[part]
            found.append(part)
    return tuple(found)


def _sentence(
    alternatives: Sequence[ErrorDetails], loc: Location, model: type[BaseModel], owner: str
) -> str:
    details = alternatives[0]
    kind, given, name = details["type"], details["input"], str(loc[-1]) if loc else ""
    if kind == "extra_forbidden":
        return _unknown_key(name, _keys_at(model, loc[:-1]), given, owner)
    if kind == "missing":
        return f"{owner} needs parameter {name}" if owner else f"{name} is missing"
    if kind in {"value_error", "assertion_error"}:
        return str(details.get("ctx", {}).get("error", details["msg"]))
    context = [one.get("ctx", {}) for one in alternatives]
    forms = [
        _FORMS.get(one["type"], "{form}").format_map(values)
        for one, values in zip(alternatives, context, strict=True)
        if one["type"] in _FORMS or "form" in values
    ]
    if not forms:
        text = details["msg"].replace("Tuple", "list").replace("Dictionary", "mapping")
        return text[:1].lower() + text[1:] if kind in _OF_LISTS else text
    meant = ""
    if kind == "literal_error":
        meant = did_you_mean(str(given), _literals_at(model, loc))
    elif any(one["type"] in _OF_NUMBERS for one in alternatives):
        meant = meant_number(name, given)
    if owner and len(loc) == 1 and isinstance(given, list) and len(given) > 1:
        meant += f"; to compare these values: {{sweep: {_shown(given)}}}"
    return f"input should be {' or '.join(dict.fromkeys(forms))}, got {describe(given)}{meant}"


def _shown(value: JsonValue) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]} ..."


def _list_form(model: type[BaseModel], name: str) -> str:
    schema = model.model_json_schema()
    form = type_text(schema.get("properties", {}).get(name, {}), schema.get("$defs", {}))
    return form if "[" in form else ""


def type_text(node: Mapping[str, Any], definitions: Mapping[str, Mapping[str, Any]]) -> str:
    """Describe the type of a JSON Schema node in a few words, with its limits.

    >>> type_text({"type": "array", "items": {"type": "number", "minimum": 0}}, {})
    '[number >= 0, ...]'
    """
    if reference := node.get("$ref"):
        return type_text(definitions.get(reference.rpartition("/")[2], {}), definitions)
    if choices := node.get("enum", [node["const"]] if "const" in node else []):
        return " or ".join(map(str, choices))
    if alternatives := node.get("anyOf"):
        return " or ".join(type_text(option, definitions) for option in alternatives)
    if items := node.get("prefixItems"):
        return f"[{', '.join(type_text(item, definitions) for item in items)}]"
    if node.get("type") == "array":
        return f"[{type_text(node.get('items', {}), definitions)}, ...]"
    limits = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    shown = "".join(f" {sign} {node[key]}" for key, sign in limits.items() if key in node)
    return f"{node.get('type', 'any')}{shown}"


def _unknown_key(name: str, known: Sequence[str], value: JsonValue, owner: str) -> str:
    meant = meant_parameter(name, known, value) or did_you_mean(name, known)
    if owner and name in _BESIDE:
        meant = f" ({name} belongs next to params, not in it)"
    inside = "; parameters of the method belong in params" if "params" in known else ""
    whose = f"{owner} has" if owner else "known keys:"
    listed = f"; {whose} {', '.join(known) or 'none'}" if known or not owner else ""
    return f"unknown {'parameter' if owner else 'key'} {name}{meant}{listed}{inside}"


def _keys_at(model: type[BaseModel], loc: Location) -> list[str]:
    models = _models_in(_annotations_at(model, loc))
    return [info.alias or name for one in models for name, info in one.model_fields.items()]


def _literals_at(model: type[BaseModel], loc: Location) -> list[str]:
    parts = _parts_of(_annotations_at(model, loc))
    literals = (part for part in parts if typing.get_origin(part) is typing.Literal)
    return [str(word) for one in literals for word in typing.get_args(one)]


def _annotations_at(model: type[BaseModel], loc: Location) -> list[object]:
    found: list[object] = [model]
    for part in loc:
        fields: list[object] = [
            info.annotation
            for one in _models_in(found)
            for name, info in one.model_fields.items()
            if part == (info.alias or name)
        ]
        found = fields or found
    return found


def _models_in(annotations: Iterable[object]) -> list[type[BaseModel]]:
    parts = _parts_of(annotations)
    return [part for part in parts if isinstance(part, type) and issubclass(part, BaseModel)]


def _parts_of(annotations: Iterable[object]) -> Iterator[object]:
    for annotation in annotations:
        yield annotation
        yield from _parts_of(typing.get_args(annotation))


# Factors by which units are converted to the first of their family; keys are suffixes of
# parameters.
_FAMILIES: Final[tuple[Mapping[str, float], ...]] = (
    {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "km": 1e3, "um": 1e-6, "µm": 1e-6},
    {"deg": 1.0, "rad": 180.0 / math.pi, "°": 1.0, "gon": 0.9},
    {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
    {"px": 1.0},
)
_WORDS: Final = {
    "m": "metres",
    "mm": "millimetres",
    "deg": "degrees",
    "rad": "radians",
    "s": "seconds",
}
_NUMBER: Final = re.compile(r"([+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?)\s*([a-zµ°]*)")


def meant_number(parameter: str, text: object) -> str:
    """Return a hint on how to write a number given as text; empty if the text is not a number.

    >>> meant_number("tolerance_m", "0,02")
    '; write a decimal point: 0.02'
    >>> meant_number("tolerance_m", "5 cm")
    '; write it in metres, without a unit: 0.05'
    """
    found = _NUMBER.fullmatch(text.strip()) if isinstance(text, str) else None
    if found is None:
        return ""
    value = float(found[1].replace(",", "."))
    unit = found[2]
    if not unit:
        has_comma = "," in found[1]
        return f"; write a decimal point: {value:g}" if has_comma else "; write it without quotes"
    own = parameter.rpartition("_")[2]
    factor = _factor(unit, own)
    if factor is None:
        return "; write numbers without a unit"
    return f"; write it in {_WORDS.get(own, own)}, without a unit: {value * factor:g}"


def meant_parameter(name: str, known: Iterable[str], value: JsonValue) -> str:
    """Return a hint on the parameter for this quantity in another unit; empty if there is none.

    >>> meant_parameter("gsd_mm", ["gsd_m", "crs"], 50)
    ' (it is gsd_m, in metres: gsd_m: 0.05)'
    """
    stem, _, unit = name.rpartition("_")
    for other in known:
        its_stem, _, own = other.rpartition("_")
        factor = _factor(unit, own)
        if stem and stem == its_stem and factor is not None and unit != own:
            written = ""
            if isinstance(value, int | float) and not isinstance(value, bool):
                written = f": {other}: {value * factor:g}"
            return f" (it is {other}, in {_WORDS.get(own, own)}{written})"
    return ""


def _factor(given: str, wanted: str) -> float | None:
    """Return the conversion factor between two units; None if they measure different quantities."""
    for family in _FAMILIES:
        if given in family and wanted in family:
            return family[given] / family[wanted]
    return None
