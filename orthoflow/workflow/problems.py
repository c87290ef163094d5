"""Problems of a workflow, all collected before any is reported, each with its place."""

from __future__ import annotations

import json
import math
import re
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, NoReturn, TypeAlias, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from orthoflow.catalog.wording import did_you_mean
from orthoflow.errors import ArgumentError, OrthoflowError, PluginError, WorkflowError
from orthoflow.files.yaml_positions import (
    Entry,
    Listing,
    Position,
    Table,
    Value,
    describe_scalar,
    plain,
    read_yaml,
)
from orthoflow.products.product import JsonValue

#: problems of a workflow that are reported at once
MOST_PROBLEMS: Final = 100
_SNIPPET_WIDTH: Final = 120
# Letters of a value that a message repeats.
_SHOWN: Final = 60
# Keys and indices that lead to a value: `("steps", "wall", "in", "cloud", 0)`.
Location: TypeAlias = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)
_Origin: TypeAlias = Literal["file", "plugin", "input", "option"]


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One problem.

    Attributes:
        file: the workflow file as the user named it, or the command-line option.
        line: from 1; 0 for a command-line option.
        column: from 1; 0 for a command-line option.
        path: location in the document, keys joined by dots, e.g. `steps.wall.params.gsd_m`.
        message: one sentence.
        text: the offending line, empty for a command-line option.
    """

    file: str
    line: int = 0
    column: int = 0
    path: str = ""
    message: str
    text: str = ""

    @property
    def place(self) -> str:
        """Return its place, as the sentence begins: `hall.yaml:3:9: steps.wall: `."""
        where = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        return f"{where}: {self.path}: " if self.path else f"{where}: "

    def __str__(self) -> str:
        head = f"{self.place}{self.message}"
        # Around the column, so that a line of a thousand characters does not hide the message.
        is_long = len(self.text) > _SNIPPET_WIDTH
        start = max(0, self.column - 1 - _SNIPPET_WIDTH // 2) if is_long else 0
        cut = self.text[start : start + _SNIPPET_WIDTH]
        shown = "".join(char if char.isprintable() else " " for char in cut)
        if not shown.strip():
            return head
        indent = len(shown) - len(shown.lstrip())
        caret = " " * max(0, self.column - 1 - start - indent) + "^"
        return f"{head}\n    {shown.strip()}\n    {caret}"


class _ProblemsError(OrthoflowError):
    """Some problems, a line each or more; `problems` holds them for tools."""

    def __init__(self, problems: tuple[Problem, ...]) -> None:
        self.problems = problems
        super().__init__("\n".join(str(problem) for problem in problems))


class InvalidWorkflowError(_ProblemsError, WorkflowError):
    """A workflow file has problems."""


class UnusablePluginError(_ProblemsError, PluginError):
    """A workflow is correct, but plugins it needs are not; `problems` names where it needs them."""


class InvalidArgumentsError(_ProblemsError, ArgumentError):
    """Command-line options do not fit the workflow."""


@dataclass
class ProblemLog:
    """Collects problems while a workflow is read.

    Attributes:
        file: the workflow file as the user named it.
        lines: its text.
        tree: its values with their positions, None before it is parsed.
        unnamed: the first key of locations, if paths do not state it.
    """

    file: str
    lines: tuple[str, ...] = ()
    tree: Value | None = None
    unnamed: str = ""
    _found: list[tuple[_Origin, Problem]] = field(default_factory=list)

    def parse(self, text: str) -> Value | None:
        """Parse YAML; problems are added, None if nothing can be read."""
        self.tree = read_yaml(text, self)
        return self.tree

    def beside(self, file: str, text: str) -> ProblemLog:
        """Return a log of another file, whose problems are raised together with these."""
        return replace(self, file=file, lines=tuple(text.splitlines()), tree=None, unnamed="")

    @property
    def has_any(self) -> bool:
        """Whether there is a problem besides missing input files."""
        return any(origin != "input" for origin, _ in self._found)

    def add(self, position: Position, path: str, message: str) -> None:
        """Add a problem at a position.

        Raises:
            InvalidWorkflowError: there are so many that the file must be something else.
        """
        self._add("file", self._at(position, path, message))
        if sum(origin == "file" for origin, _ in self._found) > MOST_PROBLEMS:
            more = f"more than {MOST_PROBLEMS} problems; correct those above and try again"
            self._found[-1] = ("file", self._at(position, path, more))
            self._raise()

    def _add(self, origin: _Origin, problem: Problem) -> None:
        if (origin, problem) not in self._found:
            self._found.append((origin, problem))

    def report(
        self,
        location: Location,
        message: str,
        *,
        at_key: bool = False,
        shown: Location | None = None,
    ) -> None:
        """Add a problem of the value, or of the key, at a location in the tree.

        Args:
            location: where it is in the tree.
            message: one sentence.
            at_key: the position is that of the key.
            shown: the path stated in the problem, if it differs.
        """
        path = self.path(location if shown is None else shown)
        self.add(self.position(location, at_key=at_key), path, message)

    def report_plugin(self, location: Location, message: str) -> None:
        """Add a problem of a plugin that the file needs here."""
        problem = self._at(self.position(location), self.path(location), message)
        self._add("plugin", problem)

    def report_input(self, place: Problem | None, message: str) -> None:
        """Add a problem of input files; the file itself decides the type of the error."""
        if len(self._found) < 2 * MOST_PROBLEMS:
            nowhere = Problem(file=self.file, message="")
            self._add("input", replace(place or nowhere, message=message))

    def report_option(self, option: str, message: str) -> None:
        """Add a problem of a command-line option, e.g. `--set wall.gsd_m=0`."""
        self._add("option", Problem(file=option, message=message))

    def place(self, location: Location) -> Problem | None:
        """Return a problem without its message; None if the value comes from no file."""
        position = self.position(location)
        return self._at(position, self.path(location), "") if position.line else None

    def position(self, location: Location, *, at_key: bool = False) -> Position:
        """Return the position of a value, or of the nearest enclosing one."""
        found = self.tree.position if self.tree else Position(line=1, column=1)
        for _, value, entry in self._walk(location):
            if value is not None:
                found = entry.position if at_key and entry else value.position
        return found

    def path(self, location: Location) -> str:
        """Format a location: `steps.wall.in.cloud[1]`, without indices of non-lists."""
        parts = [part for part, _, _ in self._walk(location)]
        if parts[:1] == [self.unnamed]:
            del parts[0]
        texts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts)
        return "".join(texts).removeprefix(".")

    def value(self, location: Location) -> Value | None:
        """Return the value at a location; None if there is none."""
        value = self.tree
        for _, value, _ in self._walk(location):  # noqa: B007 - the last one
            pass
        return value

    def get(self, location: Location) -> JsonValue:
        """Return the value at a location without positions; None if there is none."""
        value = self.value(location)
        return None if value is None else plain(value)

    def _walk(self, location: Location) -> Iterator[tuple[str | int, Value | None, Entry | None]]:
        """Yield each part of a location that is in the tree, its value, and the entry of a key."""
        value = self.tree
        for part in location:
            entry = None
            if isinstance(value, Listing) and isinstance(part, int):
                value = value.items[part] if part < len(value.items) else None
            elif isinstance(part, int) and value is not None:
                continue
            else:
                entry = value.get(str(part)) if isinstance(value, Table) else None
                value = entry.value if entry else None
            yield part, value, entry

    def raise_any(self) -> None:
        """End with all problems found so far, if there are any.

        Raises:
            InvalidWorkflowError: the file has problems.
            InvalidArgumentsError: only command-line options have.
            UnusablePluginError: only plugins have.
        """
        if self.has_any:
            self._raise()

    def _raise(self) -> NoReturn:
        # Those of the command line stand last.
        in_order = sorted(
            self._found,
            key=lambda one: ("" if one[0] == "option" else one[1].file, one[1].line, one[1].column),
        )
        in_order.sort(key=lambda one: one[0] == "option")
        origins = {origin for origin, _ in in_order}
        error: type[_ProblemsError] = InvalidWorkflowError
        if "file" not in origins:
            error = InvalidArgumentsError if "option" in origins else UnusablePluginError
        raise error(tuple(problem for _, problem in in_order))

    def _at(self, position: Position, path: str, message: str) -> Problem:
        text = self.lines[position.line - 1] if 0 < position.line <= len(self.lines) else ""
        return Problem(
            file=self.file,
            line=position.line,
            column=position.column,
            path=path,
            message=message,
            text=text,
        )


# What pydantic finds ------------------------------------------------------------------------------

# In the words of a workflow file instead of Python's.
_FORMS: Final[Mapping[str, str]] = {
    "bool_type": "true or false",
    "dict_type": "a mapping",
    "int_from_float": "a whole number",
    "int_type": "a whole number",
    "model_type": "a mapping",
    "list_type": "a list",
    "tuple_type": "a list",
    "string_type": "a text",
}
_OF_LISTS: Final = frozenset(("tuple_type", "list_type", "missing", "too_long", "too_short"))
_LEADING: Final = "Input should be "
# Keys of a call that are often written among its parameters.
_BESIDE: Final = ("use", "repeat", "resources", "timeout")


def validate(
    model: type[Model], data: JsonValue, log: ProblemLog, location: Location = ()
) -> Model | None:
    """Validate the content of a document; all mistakes are reported at their places.

    Invalid parts are then removed, so that the following checks see the rest.

    Args:
        model: the expected form.
        data: the value at the location.
        log: has the tree of the document, and receives the problems.
        location: of the value in the tree.

    Returns:
        The model of all valid parts; None if the whole is invalid.
    """
    is_first = True
    while True:
        try:
            return model.model_validate(data)
        except ValidationError as error:
            found = list(mistakes(error, model, data))
        for loc, message, at_key in found if is_first else ():
            log.report((*location, *loc), message, at_key=at_key)
        is_first = False
        unfit = {_existing(data, loc) for loc, _, _ in found}
        if () in unfit:
            return None
        # Later items of a list first.
        for *outer, last in sorted(unfit, key=_depth, reverse=True):
            place: Any = data
            for part in outer:
                place = place[part]
            del place[last]


def _depth(loc: Location) -> tuple[int, list[tuple[str, int]]]:
    return len(loc), [("", part) if isinstance(part, int) else (part, 0) for part in loc]


def mistakes(
    error: ValidationError, model: type[BaseModel], data: JsonValue, owner: str = ""
) -> Iterator[tuple[Location, str, bool]]:
    """Yield each mistake once: its location in the data, a sentence, and whether it is of a key.

    Args:
        error: of the model.
        model: the expected form.
        data: what was validated.
        owner: whose parameters they are; empty for sections of a file.
    """
    # Each alternative of a type reports its own expectation.
    places: dict[tuple[Location, bool], list[ErrorDetails]] = {}
    for details in error.errors(include_url=False):
        at_key = details["loc"][-1:] == ("[key]",) or details["type"] == "extra_forbidden"
        loc = tuple(part for part in details["loc"] if part != "[key]")
        is_missing = details["type"] == "missing"
        named = _existing(data, loc[:-1]) + loc[-1:] if is_missing else _existing(data, loc)
        places.setdefault((named, at_key), []).append(details)
    for name in {loc[0] for loc, _ in places if owner and loc}:
        group = [key for key in places if key[0][:1] == (name,)]
        kinds = {one["type"] for key in group for one in places[key]}
        form = _list_form(model, str(name)) if kinds & _OF_LISTS else ""
        # A wrong form of one list is one mistake.
        if form and isinstance(data, dict):
            yield (name,), f"{name} is written {form}, got {_shown(data.get(str(name)))}", True
            for key in group:
                del places[key]
    keys = {loc for loc, at_key in places if at_key}
    for (loc, at_key), alternatives in places.items():
        # A list is too short because of its items, a value is wrong because of its key.
        follows = any(len(other) > len(loc) and other[: len(loc)] == loc for other, _ in places)
        is_missing = alternatives[0]["type"] == "missing"
        follows |= is_missing and any(key[:-1] == loc[:-1] for key in keys)
        if not follows and (at_key or not any(loc[: len(key)] == key for key in keys)):
            yield loc, _sentence(alternatives, loc, model, owner), at_key


def _existing(data: Any, loc: Location) -> Location:
    """Return the parts of a location that lead to values, without pydantic's names of types."""
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
    forms = [
        _FORMS.get(one["type"], one["msg"].removeprefix(_LEADING))
        for one in alternatives
        if one["type"] in _FORMS or one["msg"].startswith(_LEADING)
    ]
    if not forms:
        text = details["msg"].replace("Tuple", "list").replace("Dictionary", "mapping")
        return text[:1].lower() + text[1:] if kind.startswith("too_") else text
    meant = ""
    if kind == "literal_error":
        meant = did_you_mean(str(given), re.findall(r"'([^']*)'", details["msg"]))
    elif any("number" in form for form in forms):
        meant = meant_number(name, given)
    shown = describe_scalar(given)
    if isinstance(given, list | dict):
        shown = "a list" if isinstance(given, list) else "a mapping"
        if owner and len(loc) == 1 and len(given) > 1 and isinstance(given, list):
            meant += f"; to try each: {{sweep: {_shown(given)}}}"
    return f"input should be {' or '.join(dict.fromkeys(forms))}, got {shown}{meant}"


def _shown(value: JsonValue) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]} ..."


def _list_form(model: type[BaseModel], name: str) -> str:
    """Return how a parameter is written if it is a list, else nothing."""
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
        meant = f" ({name} belongs beside params, not in it)"
    inside = "; parameters of the method belong in params" if "params" in known else ""
    whose = f"{owner} has" if owner else "known here:"
    listed = f"; {whose} {', '.join(known) or 'none'}" if known or not owner else ""
    return f"unknown {'parameter' if owner else 'key'} {name}{meant}{listed}{inside}"


def _keys_at(model: type[BaseModel], loc: Location) -> list[str]:
    """Return the keys that the model at a location has."""
    models = [model]
    for part in loc:
        fields = [
            info
            for one in models
            for name, info in one.model_fields.items()
            if part == (info.alias or name)
        ]
        # Else it is a name in a mapping, or an index.
        if fields:
            models = [one for info in fields for one in _models_in(info.annotation)]
    return [info.alias or name for one in models for name, info in one.model_fields.items()]


def _models_in(annotation: object) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in typing.get_args(annotation):
        yield from _models_in(part)


# Units and decimals ------------------------------------------------------------------------------

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
