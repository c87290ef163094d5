"""Conversion of YAML 1.2 text to values with line and column; unusual features are refused.

ruamel.yaml composes the nodes. They are converted to values here, so that duplicate keys, tags and
alias bombs are reported together with other problems instead of as a single exception.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Protocol, TypeAlias

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    CollectionStartEvent,
    MappingEndEvent,
    NodeEvent,
    SequenceEndEvent,
)
from ruamel.yaml.nodes import Node, ScalarNode, SequenceNode
from ruamel.yaml.parser import Parser
from ruamel.yaml.resolver import VersionedResolver
from ruamel.yaml.scanner import Scanner
from ruamel.yaml.tag import Tag

from orthoflow.products.product import JsonValue

#: nesting levels of a workflow or calibration file
DEEPEST: Final = 60
#: digits of an integer in a workflow or calibration file
MOST_DIGITS: Final = 1000
#: values of a workflow file, with aliases expanded
MOST_VALUES: Final = 10_000
_LONGEST_SHOWN: Final = 100
# Maximum length of a key in characters; the limit is YAML's own.
_LONGEST_KEY: Final = 1024
_TAG: Final = "tag:yaml.org,2002:"

Scalar: TypeAlias = bool | int | float | str | None
# Keys and indices that lead to a value: `("steps", "wall", "in", "cloud", 0)`.
Location: TypeAlias = tuple[str | int, ...]


@dataclass(frozen=True, kw_only=True, order=True)
class Position:
    """A position in the text; line and column count from 1."""

    line: int
    column: int


_START: Final = Position(line=1, column=1)


@dataclass(frozen=True, kw_only=True)
class Document:
    """A document as plain values with positions.

    Attributes:
        value: content of the whole document.
        places: position of each value by location; contains at least `()`, the whole document.
        keys: position of each key by location.
    """

    value: JsonValue
    places: Mapping[Location, Position]
    keys: Mapping[Location, Position] = field(default_factory=dict)

    def resolve(self, location: Location) -> tuple[Location, Location]:
        """Return a location without indices into single values, and the part of it that exists."""
        value, stated, found = self.value, list[str | int](), Location()
        is_found = True
        for part in location:
            # A single value given instead of a list has no index.
            if is_found and isinstance(part, int) and not isinstance(value, list):
                continue
            stated.append(part)
            parts = range(len(value)) if isinstance(value, list) else value
            is_found = is_found and isinstance(value, dict | list) and part in parts  # type: ignore[operator]
            if is_found:
                value, found = value[part], (*found, part)  # type: ignore[index]
        return tuple(stated), found

    def get(self, location: Location) -> JsonValue:
        """Return the value at a location; None if there is none."""
        stated, found = self.resolve(location)
        value: Any = self.value
        for part in found:
            value = value[part]
        return value if found == stated else None

    def position(self, location: Location, *, at_key: bool = False) -> Position:
        """Return the position of a value or its key; if missing, the enclosing value's position."""
        _, found = self.resolve(location)
        # For values that were passed from Python, only the position of the whole document is known.
        while found not in self.places:
            found = found[:-1]
        return (at_key and self.keys.get(found)) or self.places[found]


class Problems(Protocol):
    """Interface that collects the problems of a document."""

    def add(self, position: Position, path: str, message: str) -> None:
        """Add a problem with its position, the path of keys joined by dots, and a sentence."""


def path_text(location: Location) -> str:
    """Return a location as text.

    >>> path_text(("steps", "wall", "in", "cloud", 1))
    'steps.wall.in.cloud[1]'
    """
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    return "".join(parts).removeprefix(".")


def describe(value: object) -> str:
    """Describe a value for messages.

    >>> describe("0.003"), describe(0.003), describe(None), describe([1])
    ('the text "0.003"', '0.003', 'nothing', 'a list')
    """
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'the text "{_cut(value)}"'
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "a mapping"
    return str(value)


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."


def read_yaml(text: str, log: Problems, most_values: int = MOST_VALUES) -> Document | None:
    """Read a document and add its problems to `log`; return None if the text is unreadable."""
    try:
        converter = _Converter(log=log, most_values=most_values)
        value = converter.convert(_compose(text, most_values), ())
    except _UnreadableError as error:
        log.add(error.position, "", str(error))
        return None
    return Document(value=value, places=converter.places, keys=converter.keys)


class _UnreadableError(Exception):
    def __init__(self, position: Position, message: str) -> None:
        super().__init__(message)
        self.position = position


def _compose(text: str, most_values: int) -> Node:
    if re.search(r"^%YAML +(?!1\.2\s)", text, re.MULTILINE):
        raise _UnreadableError(
            _START, "expected YAML 1.2, got a %YAML line that asks for another version"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an anchor defined twice is legal YAML 1.2
            yaml = YAML(typ="safe", pure=True)
            yaml.Scanner, yaml.Parser = _QuickScanner, _LimitedParser
            yaml.Resolver = _CoreResolver
            yaml.parser.most_values = most_values
            node: Node | None = yaml.compose(text)
    except MarkedYAMLError as error:
        raise _unreadable(error, text) from error
    except YAMLError as error:
        raise _UnreadableError(
            _reader_position(text, error), f"this is not YAML: {_first_line(error)}"
        ) from error
    if node is None:
        raise _UnreadableError(_START, "the document is empty")
    return node


# The core schema of YAML 1.2.2, section 10.3.2. ruamel.yaml's own rules for 1.2 still treat `1_000`
# and `0b11` as numbers, and `.5e-1` as text.
_CORE_SCHEMA: Final = (
    ("null", re.compile(r"null|Null|NULL|~|")),
    ("bool", re.compile(r"true|True|TRUE|false|False|FALSE")),
    ("int", re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")),
    (
        "float",
        re.compile(
            r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
            r"|[-+]?(\.inf|\.Inf|\.INF)|\.nan|\.NaN|\.NAN"
        ),
    ),
)


class _CoreResolver(VersionedResolver):
    # Any: as in ruamel.yaml.
    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        if kind is ScalarNode and implicit[0]:
            for name, form in _CORE_SCHEMA:
                if form.fullmatch(value):
                    return Tag(suffix=_TAG + name)
        return super().resolve(kind, value, (False, True))


class _QuickScanner(Scanner):
    """A scanner that remains fast if many brackets are open."""

    def stale_possible_simple_keys(self) -> None:
        line, index = self.reader.line, self.reader.index
        for key in self.possible_simple_keys.values():
            if key.line != line or index - key.index > _LONGEST_KEY:
                super().stale_possible_simple_keys()
                return


class _LimitedParser(Parser):
    """A parser that stops, with an error, at documents that would take minutes to compose.

    Attributes:
        most_values: maximum number of values in a document.
        depth: current nesting depth of lists and mappings.
        n_values: number of values so far, including keys.
    """

    most_values = MOST_VALUES
    depth = 0
    n_values = 0

    # Any: as in ruamel.yaml.
    def get_event(self) -> Any:
        event = super().get_event()
        if isinstance(event, MappingEndEvent | SequenceEndEvent):
            self.depth -= 1
            return event
        self.n_values += isinstance(event, NodeEvent)
        self.depth += isinstance(event, CollectionStartEvent)
        if self.depth > DEEPEST or self.n_values > self.most_values:
            raise _UnreadableError(
                _mark_position(event.start_mark),
                f"the document is nested deeper than {DEEPEST} levels"
                if self.depth > DEEPEST
                else f"the document has more than {self.most_values} values",
            )
        return event


def _mark_position(mark: object) -> Position:
    line, column = getattr(mark, "line", 0), getattr(mark, "column", 0)
    return Position(line=int(line) + 1, column=int(column) + 1)


def _reader_position(text: str, error: YAMLError) -> Position:
    before = text[: int(getattr(error, "position", 0) or 0)]
    return Position(line=before.count("\n") + 1, column=len(before) - before.rfind("\n"))


_GLUED: Final = re.compile(r" *[\w-]+:(?=\w)")
_OPENED: Final = {
    "while parsing a flow mapping": "the brace { that opens here is not closed",
    "while parsing a flow sequence": "the bracket [ that opens here is not closed",
    "while scanning a quoted scalar": "the quotes that open here are not closed",
}


def _unreadable(error: MarkedYAMLError, text: str) -> _UnreadableError:
    """Return an error at the mistake rather than at the position where the parser detected it."""
    problem, context = str(error.problem or ""), str(error.context or "")
    noticed = _mark_position(error.problem_mark)
    words = ", ".join(" ".join(part.split()) for part in (context, problem) if part)
    if "\\t" in problem:
        return _UnreadableError(
            noticed, "this is not YAML: there is a tab here; indent with spaces"
        )
    stumbled = int(getattr(error.problem_mark, "index", 0) or 0)
    if re.search(r":[\[{]$", text[: stumbled + 1]):
        return _UnreadableError(noticed, "this is not YAML: put a space after the colon")
    # `key:value` in the line above is a single string, after which no key may follow.
    above = noticed.line - 1
    if "mapping values" in problem and (glued := _GLUED.match(text.splitlines()[above - 1])):
        position = Position(line=above, column=glued.end())
        return _UnreadableError(position, "this is not YAML: put a space after the colon")
    if context in _OPENED and error.context_mark is not None:
        opened = _mark_position(error.context_mark)
        where = f"noticed in line {noticed.line}"
        return _UnreadableError(opened, f"this is not YAML: {_OPENED[context]}; {where}: {problem}")
    if "block end" in problem:
        words = "the indentation of this line matches no line above, or a line above is incomplete"
    return _UnreadableError(noticed, f"this is not YAML: {words}")


def _first_line(error: YAMLError) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


@dataclass
class _Converter:
    """Converts composed nodes to values, expands aliases, and counts all values."""

    log: Problems
    most_values: int
    places: dict[Location, Position] = field(default_factory=dict)
    keys: dict[Location, Position] = field(default_factory=dict)
    n_nodes: int = 0
    open_nodes: set[int] = field(default_factory=set)

    def convert(self, node: Node, at: Location) -> JsonValue:
        position = _mark_position(node.start_mark)
        self.n_nodes += 1
        if self.n_nodes > self.most_values:
            raise _UnreadableError(
                position,
                f"the document has more than {self.most_values} values once aliases are expanded",
            )
        if id(node) in self.open_nodes:
            raise _UnreadableError(position, "the value contains itself through an alias")
        if len(at) > DEEPEST:
            raise _UnreadableError(position, f"the document is nested deeper than {DEEPEST} levels")
        self.places[at] = position
        if isinstance(node, ScalarNode):
            return self._scalar(node, at)
        self.open_nodes.add(id(node))
        if str(node.tag) not in (_TAG + "map", _TAG + "seq"):
            self._refuse_tag(node, at)
        value: JsonValue
        if isinstance(node, SequenceNode):
            items = self._joined_items(node.value, at)
            value = [self.convert(item, (*at, index)) for index, item in enumerate(items)]
        else:
            value = self._mapping(node, at)
        self.open_nodes.discard(id(node))
        return value

    def _mapping(self, node: Node, at: Location) -> dict[str, JsonValue]:
        entries: dict[str, JsonValue] = {}
        for key_node, value_node in self._joined_entries(node.value, at):
            position = _mark_position(key_node.start_mark)
            key = self._key(key_node, at)
            here = (*at, key)
            if key in entries:
                first = self.keys[here].line
                message = f"the key is already used in line {first}; remove one of them"
                self.log.add(position, path_text(here), message)
                continue
            self.keys[here] = position
            entries[key] = self.convert(value_node, here)
        return entries

    def _joined_items(self, items: list[Node], at: Location) -> list[Node]:
        """Join numbers that were split at a decimal comma: `[0,02]` is the list of 0 and 02."""
        joined = items[:1]
        for item in items[1:]:
            if self._is_split(joined[-1], item) and re.fullmatch(r"0\d+", str(item.value)):
                joined[-1] = self._join(joined[-1], item, (*at, len(joined) - 1))
            else:
                joined.append(item)
        return joined

    def _joined_entries(
        self, entries: list[tuple[Node, Node]], at: Location
    ) -> list[tuple[Node, Node]]:
        """Join such numbers in braces: `{a: 0,003}` is the value 0 and a key without a value."""
        joined = entries[:1]
        for key, value in entries[1:]:
            name, before = joined[-1]
            if self._is_split(before, key) and str(value.value) == "":
                joined[-1] = (name, self._join(before, key, (*at, str(name.value))))
            else:
                joined.append((key, value))
        return joined

    def _is_split(self, before: Node, behind: Node) -> bool:
        """Return whether there is nothing but a comma between two integers."""
        return (
            isinstance(before, ScalarNode)
            and isinstance(behind, ScalarNode)
            and str(before.tag) == str(behind.tag) == _TAG + "int"
            and behind.start_mark.index == before.end_mark.index + 1
        )

    def _join(self, before: Node, behind: Node, at: Location) -> Node:
        meant = f"{before.value}.{behind.value}"
        self._report(
            before,
            at,
            f"{before.value},{behind.value} is read as two numbers; write a decimal point: {meant}",
        )
        return ScalarNode(_TAG + "float", meant, before.start_mark, behind.end_mark)

    def _key(self, node: Node, at: Location) -> str:
        if not isinstance(node, ScalarNode):
            self._report(node, at, "a key must be text, got a list or mapping")
            return "?"
        if str(node.tag) != _TAG + "str":
            self._report(node, at, f"a key must be text, got {node.value or 'nothing'}")
        return str(node.value)

    def _scalar(self, node: ScalarNode, at: Location) -> Scalar:
        tag, text = str(node.tag), str(node.value)
        try:
            return _parse_scalar(tag.removeprefix(_TAG), text)
        except KeyError:
            self._refuse_tag(node, at)
        except ValueError:
            self._report(node, at, f"{_cut(text)!r} is not a valid {tag.removeprefix(_TAG)}")
        return text

    def _refuse_tag(self, node: Node, at: Location) -> None:
        self._report(node, at, f"tags are not allowed, got {node.tag}")

    def _report(self, node: Node, at: Location, message: str) -> None:
        self.log.add(_mark_position(node.start_mark), path_text(at), message)


def _parse_scalar(kind: str, text: str) -> Scalar:
    match kind:
        case "str":
            return text
        case "null":
            return None
        case "bool":
            return {"true": True, "false": False}[text.lower()]
        case "int":
            if len(text) > MOST_DIGITS:
                # Python itself refuses only long decimal integers, but cannot print any long
                # integer.
                raise ValueError(f"more than {MOST_DIGITS} digits")
            return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
        case "float":
            return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
        case _:
            raise KeyError(kind)
