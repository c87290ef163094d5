"""How values are written: numbers with a comma or a unit, names in another unit, nested lists."""

from __future__ import annotations

import math
import re
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Final, Literal

from orthoflow.products.product import JsonValue

# Each unit in the first of its family, by the suffixes of parameter names.
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
_LEAVES: Final[Mapping[object, str]] = {
    int: "number",
    float: "number",
    str: "text",
    bool: "true or false",
    type(None): "null",
}


def written_form(annotation: object, description: str) -> str:
    """Return how a list or mapping of plain values is written; empty for other values.

    Args:
        annotation: the type of a parameter.
        description: its description; if it contains such a value, that is returned.

    >>> written_form(tuple[tuple[float, float], ...] | None, "")
    '[[number, number], ...]'
    >>> written_form(tuple[tuple[float, float], ...], "Points [[x, y], ...] in metres.")
    '[[x, y], ...]'
    >>> written_form(float, "A length [m].")
    ''
    """
    forms = [form for form in map(_form, _alternatives(annotation)) if form != "null"]
    if not all(forms) or not any(form[0] in "[{" for form in forms):
        return ""
    return " or ".join(dict.fromkeys(_bracketed(description)) or forms)


def _alternatives(annotation: object) -> tuple[object, ...]:
    is_union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    return typing.get_args(annotation) if is_union else (annotation,)


def _form(annotation: object) -> str:
    """Return how a value of a type is written; empty if parts of it are not plain values."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return _form(parts[0])
    if origin is Literal:
        return "text"
    inner = [_form(part) for part in parts if part is not Ellipsis]
    if not inner or not all(inner):
        return _LEAVES.get(annotation, "")
    if origin is tuple or origin is list:
        more = [] if origin is tuple and Ellipsis not in parts else ["..."]
        return f"[{', '.join((*inner, *more))}]"
    if origin is dict:
        return f"{{name: {inner[1]}, ...}}"
    return " or ".join(inner) if len(_alternatives(annotation)) > 1 else ""


def _bracketed(text: str) -> Iterator[str]:
    """Yield lists and mappings in a text, outermost brackets each."""
    depth, start = 0, 0
    for place, letter in enumerate(text):
        if letter in "[{":
            start = start if depth else place
            depth += 1
        elif letter in "]}" and depth:
            depth -= 1
            if not depth:
                yield text[start : place + 1]


def meant_number(parameter: str, text: object) -> str:
    """Return how a number given as text is written; empty if it does not look like one.

    >>> meant_number("tolerance_m", "0,02")
    '; decimals have a point: 0.02'
    >>> meant_number("tolerance_m", "5 cm")
    '; it is in metres; write it without a unit: 0.05'
    """
    found = _NUMBER.fullmatch(text.strip()) if isinstance(text, str) else None
    if found is None:
        return ""
    value = float(found[1].replace(",", "."))
    unit = found[2]
    if not unit:
        has_comma = "," in found[1]
        return f"; decimals have a point: {value:g}" if has_comma else "; write it without quotes"
    own = parameter.rpartition("_")[2]
    factor = _factor(unit, own)
    if factor is None:
        return "; write numbers without a unit"
    return f"; it is in {_WORDS.get(own, own)}; write it without a unit: {value * factor:g}"


def meant_parameter(name: str, known: Iterable[str], value: JsonValue) -> str:
    """Return the parameter with the same meaning in another unit; empty if there is none.

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
    """Return the factor between two units."""
    for family in _FAMILIES:
        if given in family and wanted in family:
            return family[given] / family[wanted]
    return None
