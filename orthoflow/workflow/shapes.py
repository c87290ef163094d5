"""What may stand behind a key of a workflow file: every shape checks, and says itself to others.

A shape takes a value out of the document and reports what does not fit; the JSON Schema and the
documentation of the format are made of what it says about itself.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Generic, Protocol, TypeAlias, TypeVar

from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.catalog.wording import did_you_mean
from orthoflow.files.yaml_positions import (
    Entry,
    Listing,
    Position,
    Scalar,
    Table,
    Text,
    Value,
    describe,
    join,
)
from orthoflow.products.product import JsonValue
from orthoflow.workflow.problems import ProblemLog

INPUTS_NAME: Final = "inputs"
_NAME_RULE: Final = (
    "a name starts with a lower-case letter, has at most 32 lower-case letters, digits, - or _, "
    "and is not that of a device (con, prn, aux, nul, com1, lpt1 ...)"
)
_REFERENCE: Final = re.compile(rf"({NAME_PATTERN})\.({NAME_PATTERN})")
_TIME: Final = re.compile(r"(\d+(?:\.\d+)?) *(s|min|h)")
_METRIC: Final = re.compile(r"[^.]+\..+", re.DOTALL)
# Records keep numbers of fewer than a hundred digits.
_MOST_OF_A_NUMBER: Final = 10**80
_SECONDS: Final = {"s": 1.0, "min": 60.0, "h": 3600.0}

Schema: TypeAlias = dict[str, JsonValue]
Found = TypeVar("Found")
Found_co = TypeVar("Found_co", covariant=True)
Word = TypeVar("Word", bound=str)


class Shape(Protocol[Found_co]):
    """What a value must be."""

    @property
    def words(self) -> str:
        """What is expected, as problems and the documentation say it: `true or false`."""

    def schema(self) -> Schema:
        """Say the same as JSON Schema 2020-12."""

    def read(self, value: Value, path: str, log: ProblemLog) -> Found_co | None:
        """Take the value; what does not fit goes to the log, and nothing usable gives None."""


@dataclass(frozen=True, kw_only=True)
class Key(Generic[Found]):
    """A key that a mapping of the file may hold.

    Attributes:
        name: the key.
        shape: what may stand behind it.
        meaning: one sentence, for the JSON Schema and the documentation.
        example: YAML that may stand behind it.
        default: what holds without it, in words; empty where nothing is left to say.
        missing: what a file without it is told; empty where it may be left out.
    """

    name: str
    shape: Shape[Found]
    meaning: str
    example: str
    default: str = ""
    missing: str = ""

    def read(self, table: Table, path: str, log: ProblemLog) -> Found | None:
        """Take what stands behind the key; None when there is nothing, or nothing usable."""
        entry = table.get(self.name)
        return self.shape.read(entry.value, join(path, self.name), log) if entry else None

    def schema(self) -> Schema:
        """Say what may stand behind the key, as JSON Schema."""
        return {**self.shape.schema(), "description": self.meaning}


# Single values ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Single(Generic[Found]):
    """A single value: text, number, true or false.

    Attributes:
        words: what is expected.
        says: the same as JSON Schema.
        take: gives what a value stands for; None for what does not fit.
        noun: one of it, e.g. `text`.
    """

    words: str
    says: Schema
    take: Callable[[Scalar], Found | None]
    noun: str = "value"

    def schema(self) -> Schema:
        """Give what it says."""
        return self.says

    def read(self, value: Value, path: str, log: ProblemLog) -> Found | None:
        """Take the value."""
        found = self.take(value.value) if isinstance(value, Text) else None
        if found is None:
            _report_unexpected(self, value, path, log)
        return found


TEXT: Final[Single[str]] = Single(
    words="a text",
    says={"type": "string", "minLength": 1},
    take=lambda raw: raw if isinstance(raw, str) and raw else None,
    noun="text",
)
FLAG: Final[Single[bool]] = Single(
    words="true or false",
    says={"type": "boolean"},
    take=lambda raw: raw if isinstance(raw, bool) else None,
)


def whole_number(*, minimum: int, maximum: int | None = None) -> Single[int]:
    """A whole number from `minimum` on, up to `maximum` if there is one; `true` is none."""
    upper = _MOST_OF_A_NUMBER if maximum is None else maximum
    return Single(
        words=f"a whole number from {minimum} {'on' if maximum is None else f'to {maximum}'}",
        says={
            "type": "integer",
            "minimum": minimum,
            **({} if maximum is None else {"maximum": maximum}),
        },
        take=lambda raw: raw if type(raw) is int and minimum <= raw <= upper else None,
    )


def seconds_in(raw: Scalar) -> float | None:
    """Give the seconds that a time stands for, e.g. 1800 for `30min`; None when it is no time.

    >>> seconds_in("30min"), seconds_in(2), seconds_in("soon")
    (1800.0, 2.0, None)
    """
    seconds = 0.0
    if isinstance(raw, int | float) and not isinstance(raw, bool):
        seconds = float(raw)
    elif isinstance(raw, str) and (match := _TIME.fullmatch(raw)):
        seconds = float(match[1]) * _SECONDS[match[2]]
    return seconds if math.isfinite(seconds) and seconds > 0 else None


TIME_SPAN: Final[Single[float]] = Single(
    words="a time such as 90s, 30min, 2h or a number of seconds above 0",
    says={
        "oneOf": [
            {"type": "number", "exclusiveMinimum": 0},
            {"type": "string", "pattern": f"^{_TIME.pattern}$"},
        ]
    },
    take=seconds_in,
)


@dataclass(frozen=True)
class FormatVersion:
    """The version of the format; newer ones than `current` are refused."""

    current: int

    @property
    def words(self) -> str:
        """The only version that is written today."""
        return f"the number {self.current}"

    def schema(self) -> Schema:
        """Exactly this version."""
        return {"const": self.current}

    def read(self, value: Value, path: str, log: ProblemLog) -> int | None:
        """Take a version, whether it can be read or not."""
        version = whole_number(minimum=1).read(value, path, log)
        if version is not None and version > self.current:
            log.add(
                value.position,
                path,
                f"the file has workflow format {version}, this orthoflow reads {self.current}; "
                f"upgrade orthoflow",
            )
        return version


class Name:
    """A name that the user chooses, and that addresses and file names are made of."""

    words = "a name"

    def schema(self) -> Schema:
        """The pattern of names."""
        return {"type": "string", "pattern": f"^{NAME_PATTERN}$"}

    def read(self, value: Value, path: str, log: ProblemLog) -> str | None:
        """Take a name."""
        name = TEXT.read(value, path, log)
        return name if name and check_name(name, value.position, path, log) else None


def check_name(name: str, position: Position, path: str, log: ProblemLog) -> bool:
    """Whether a name can be used; if not, say why."""
    if re.fullmatch(NAME_PATTERN, name):
        return True
    log.add(position, path, f"{name!r} cannot be a name: {_NAME_RULE}")
    return False


@dataclass(frozen=True, kw_only=True)
class Choice(Generic[Word]):
    """One of a few words.

    Attributes:
        noun: what the words stand for, e.g. `design`.
        choices: the words.
    """

    noun: str
    choices: tuple[Word, ...]

    @property
    def words(self) -> str:
        """All words."""
        return " or ".join(f"`{word}`" for word in self.choices)

    def schema(self) -> Schema:
        """All words."""
        return {"enum": [*self.choices]}

    def read(self, value: Value, path: str, log: ProblemLog) -> Word | None:
        """Take one of the words."""
        text = TEXT.read(value, path, log)
        if text is None:
            return None
        for word in self.choices:
            if text == word:
                return word
        log.add(
            value.position,
            path,
            f"unknown {self.noun} {text}{did_you_mean(text, self.choices)}; known: "
            f"{', '.join(self.choices)}",
        )
        return None


# References ---------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Where a port may take its product from.

    Attributes:
        source: name of a step, or `inputs`.
        name: output port of the step, or name of the input.
    """

    source: str
    name: str

    @property
    def is_input(self) -> bool:
        """Whether it names an input of the workflow."""
        return self.source == INPUTS_NAME

    def __str__(self) -> str:
        return f"{self.source}.{self.name}"


@dataclass(frozen=True, kw_only=True)
class PlacedReference:
    """A reference with its place in the file."""

    position: Position
    path: str
    reference: Reference


@dataclass(frozen=True, kw_only=True)
class PlacedPort:
    """A wired port with its place in the file."""

    position: Position
    path: str
    name: str
    references: tuple[PlacedReference, ...]


class Source:
    """A reference to what a step makes, or to an input."""

    words = "step.port or inputs.name"
    noun = "reference"

    def schema(self) -> Schema:
        """Two names with a dot between them."""
        return {
            "type": "string",
            "pattern": rf"^{NAME_PATTERN}\.{NAME_PATTERN}$",
            "description": self.words,
        }

    def read(self, value: Value, path: str, log: ProblemLog) -> PlacedReference | None:
        """Take a reference; whether it leads anywhere is not asked here."""
        raw = value.value if isinstance(value, Text) else None
        match = _REFERENCE.fullmatch(raw) if isinstance(raw, str) else None
        if match is None:
            _report_unexpected(self, value, path, log)
            return None
        return PlacedReference(
            position=value.position, path=path, reference=Reference(source=match[1], name=match[2])
        )


class InputSource:
    """A reference to an input."""

    words = "an input such as inputs.scan"

    def schema(self) -> Schema:
        """The name of an input behind `inputs.`."""
        return {"type": "string", "pattern": rf"^{INPUTS_NAME}\.{NAME_PATTERN}$"}

    def read(self, value: Value, path: str, log: ProblemLog) -> PlacedReference | None:
        """Take a reference to an input; whether there is such an input is not asked here."""
        placed = Source().read(value, path, log)
        if placed is None or placed.reference.is_input:
            return placed
        log.add(value.position, path, f"expected {self.words}, got {placed.reference}")
        return None


class Wires:
    """A mapping from ports to what they may take."""

    words = "a mapping from ports to step.port or inputs.name, or to lists of these"

    def schema(self) -> Schema:
        """References by any keys: which ports there are is the method's to say."""
        return {"type": "object", "additionalProperties": OneOrMore(Source()).schema()}

    def read(self, value: Value, path: str, log: ProblemLog) -> tuple[PlacedPort, ...]:
        """Take all ports; those without a usable reference have none."""
        return tuple(
            PlacedPort(
                position=entry.position,
                path=join(path, entry.key),
                name=entry.key,
                references=OneOrMore(Source()).read(entry.value, join(path, entry.key), log),
            )
            for entry in read_table(value, path, log) or ()
        )


# Lists and mappings -------------------------------------------------------------------------------


class Item(Shape[Found_co], Protocol[Found_co]):
    """What a list may be of; `noun` says one of it."""

    @property
    def noun(self) -> str:
        """One of it, e.g. `text`."""


@dataclass(frozen=True)
class OneOrMore(Generic[Found]):
    """A value, or a list of at least one."""

    item: Item[Found]

    @property
    def words(self) -> str:
        """The value, or several."""
        return f"{self.item.words}, or a list of them"

    def schema(self) -> Schema:
        """The value, or a list that is not empty."""
        item = self.item.schema()
        return {"oneOf": [item, {"type": "array", "minItems": 1, "items": item}]}

    def read(self, value: Value, path: str, log: ProblemLog) -> tuple[Found, ...]:
        """Take all that can be used."""
        if not isinstance(value, Listing):
            one = self.item.read(value, path, log)
            return () if one is None else (one,)
        if not value.items:
            log.add(
                value.position, path, f"expected at least one {self.item.noun}, got an empty list"
            )
        several = (
            self.item.read(item, f"{path}[{index}]", log) for index, item in enumerate(value.items)
        )
        return tuple(one for one in several if one is not None)


class MetricPatterns:
    """Patterns of metrics, each with the step before the dot."""

    words = "step.metric, * allowed, or a list of them"

    def schema(self) -> Schema:
        """Texts with a dot inside."""
        pattern: Schema = {"type": "string", "pattern": f"^{_METRIC.pattern}$"}
        return {"oneOf": [pattern, {"type": "array", "minItems": 1, "items": pattern}]}

    def read(self, value: Value, path: str, log: ProblemLog) -> tuple[str, ...]:
        """Take all patterns that name a step and a metric."""
        patterns = OneOrMore(TEXT).read(value, path, log)
        fitting = tuple(text for text in patterns if _METRIC.fullmatch(text))
        for text in patterns:
            if text not in fitting:
                message = f"expected step.metric, * allowed, got {text}"
                log.add(place_of(text, value), path, message)
        return fitting


def place_of(text: str, value: Value) -> Position:
    """Where a text stands in a list of texts; where the value stands, if it is none."""
    items = value.items if isinstance(value, Listing) else ()
    places = (item.position for item in items if isinstance(item, Text) and item.value == text)
    return next(places, value.position)


@dataclass(frozen=True, kw_only=True)
class OpenTable:
    """A mapping whose keys the workflow does not know; it is taken as it is written.

    Attributes:
        words: what is expected.
        values: what may stand behind each key, as JSON Schema.
    """

    words: str
    values: Schema = field(default_factory=dict)

    def schema(self) -> Schema:
        """An object of any keys."""
        return {"type": "object", "additionalProperties": self.values or True}

    def read(self, value: Value, path: str, log: ProblemLog) -> Table | None:
        """Take the mapping."""
        return read_table(value, path, log)


ASSIGNMENT: Final = OpenTable(words="a mapping step: variant", values=TEXT.schema())
PARAMETERS: Final = OpenTable(words="a mapping of the method's own parameters")


class Assignments:
    """A list of assignments, none of them empty."""

    words = "a list of mappings step: variant"

    def schema(self) -> Schema:
        """Assignments of at least one step."""
        return {"type": "array", "items": {**ASSIGNMENT.schema(), "minProperties": 1}}

    def read(self, value: Value, path: str, log: ProblemLog) -> tuple[tuple[str, Table], ...]:
        """Take the mappings as they are written, each behind its path."""
        if not isinstance(value, Listing):
            _report_unexpected(self, value, path, log)
            return ()
        tables: list[tuple[str, Table]] = []
        for index, item in enumerate(value.items):
            here = f"{path}[{index}]"
            table = ASSIGNMENT.read(item, here, log)
            if table is not None and not table.entries:
                log.add(item.position, here, "expected step: variant, got an empty mapping")
            elif table is not None:
                tables.append((here, table))
        return tuple(tables)


@dataclass(frozen=True, kw_only=True)
class Section:
    """A mapping whose keys the format fixes.

    Attributes:
        words: what it is.
        about: what a reader of the documentation has to know beside the keys.
        keys: all keys it may have, in the order in which they are listed.
        others: what any other key stands for; None where there is no other.
    """

    words: str
    about: str
    # Any: keys of all kinds of values.
    keys: tuple[Key[Any], ...]
    others: Key[Any] | None = None

    def schema(self) -> Schema:
        """An object of these keys and no others."""
        required: list[JsonValue] = [key.name for key in self.keys if key.missing]
        return {
            "type": "object",
            **({"required": required} if required else {}),
            "properties": {key.name: key.schema() for key in self.keys},
            "additionalProperties": self.others.schema() if self.others else False,
        }

    def read(self, value: Value, path: str, log: ProblemLog) -> Table | None:
        """Take the mapping; keys that are unknown or missing are reported."""
        table = read_table(value, path, log)
        if table is None:
            return None
        known = {key.name: key for key in self.keys}
        for entry in table:
            if entry.key not in known and self.others is None:
                log.add(
                    entry.position,
                    join(path, entry.key),
                    f"unknown key {entry.key}{did_you_mean(entry.key, known)}; "
                    f"known here: {', '.join(known)}",
                )
        for key in self.keys:
            if key.missing and table.get(key.name) is None:
                log.add(table.position, join(path, key.name), key.missing)
        return table


@dataclass(frozen=True, kw_only=True)
class Named:
    """A mapping from names that the user chose.

    Attributes:
        item: what stands behind each name.
        words: what it is, for the documentation.
        empty: what is said of a mapping without entries; empty where it may be so.
        taken: names that cannot be chosen -> why.
    """

    item: Section
    words: str
    empty: str = ""
    taken: Mapping[str, str] = field(default_factory=dict)

    def schema(self) -> Schema:
        """An object whose keys are names."""
        names: Schema = {"pattern": f"^{NAME_PATTERN}$"}
        if self.taken:
            names["not"] = {"enum": [*self.taken]}
        return {
            "type": "object",
            **({"minProperties": 1} if self.empty else {}),
            "propertyNames": names,
            "additionalProperties": self.item.schema(),
        }

    def read(self, value: Value, path: str, log: ProblemLog) -> tuple[Entry, ...]:
        """Take the entries whose names can be used; what stands behind them is not looked at."""
        table = read_table(value, path, log)
        if table is not None and not table.entries and self.empty:
            log.add(value.position, path, self.empty)
        return tuple(entry for entry in table or () if self._is_usable(entry, path, log))

    def _is_usable(self, entry: Entry, path: str, log: ProblemLog) -> bool:
        here = join(path, entry.key)
        if reason := self.taken.get(entry.key):
            log.add(entry.position, here, reason)
            return False
        return check_name(entry.key, entry.position, here, log)


def read_table(value: Value, path: str, log: ProblemLog) -> Table | None:
    """Take a mapping of any keys."""
    if isinstance(value, Table):
        return value
    log.add(value.position, path, f"expected a mapping, got {describe(value)}")
    return None


def _report_unexpected(shape: Shape[object], value: Value, path: str, log: ProblemLog) -> None:
    log.add(value.position, path, f"expected {shape.words}, got {describe(value)}")
