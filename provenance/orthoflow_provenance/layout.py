"""Where things lie in a record: groups by name, fields of the model by their annotations."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Final, Literal, TypeVar, Union

import h5py

from orthoflow_provenance.digests import canonical_json
from orthoflow_provenance.encoding import (
    Columns,
    column_titles,
    float_attribute,
    has_attribute,
    int_attribute,
    parse_json,
    read_json,
    read_table,
    read_text,
    read_texts,
    set_attributes,
    text_attribute,
    write_table,
    write_text,
    write_texts,
)
from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.model import RecordedDiagnostic, Stored

WORKFLOW: Final = "workflow"
INPUTS: Final = "inputs"
INPUT_CONTENTS: Final = "content"
ENVIRONMENTS: Final = "environments"
CELLS: Final = "cells"
CELL_INPUTS: Final = "in"
CELL_OUTPUTS: Final = "out"
FIGURES: Final = "figures"
PUBLISHED: Final = "published"

Entry = TypeVar("Entry")


# Any: which type a codec takes and gives, its field's annotation says, which mypy does not see.
@dataclass(frozen=True, kw_only=True)
class _Codec:
    """How one field is written under its name, and read again."""

    write: Callable[[h5py.Group, str, Any], None]
    read: Callable[[h5py.Group, str], Any]


def write_fields(group: h5py.Group, entry: object, part: type | None = None) -> None:
    """Write the fields of a dataclass into a group, but for those that are stored elsewhere.

    Args:
        group: takes attributes and datasets with the names of the fields.
        entry: the dataclass.
        part: write the fields of this class only, which the entry's is made from.
    """
    for name, codec in _codecs(part or type(entry)).items():
        codec.write(group, name, getattr(entry, name))


def read_fields(group: h5py.Group, cls: type) -> dict[str, Any]:
    """Read what `write_fields` wrote, as keywords for the class.

    Raises:
        RecordFormatError: a field is missing or damaged.
    """
    return {name: codec.read(group, name) for name, codec in _codecs(cls).items()}


def write_rows(group: h5py.Group, name: str, rows: tuple[object, ...], cls: type) -> None:
    """Write dataclasses of texts and numbers as a table, a column per field.

    Columns of later versions are left out where all rows have what earlier ones stand for.
    """
    defaults = _later(cls)
    columns = [
        (title, kind)
        for title, kind in _columns(cls)
        if title not in defaults or any(getattr(row, title) != defaults[title] for row in rows)
    ]
    write_table(
        group, name, columns, [tuple(getattr(row, title) for title, _ in columns) for row in rows]
    )


def read_rows(group: h5py.Group, name: str, cls: Callable[..., Entry]) -> tuple[Entry, ...]:
    """Read what `write_rows` wrote.

    Raises:
        RecordFormatError: the table is missing, damaged, or lacks a column.
    """
    columns = _columns(cls)
    later = _later(cls).keys() & ({title for title, _ in columns} - column_titles(group, name))
    present = [(title, kind) for title, kind in columns if title not in later]
    titles = [title for title, _ in present]
    return tuple(
        cls(**dict(zip(titles, row, strict=True))) for row in read_table(group, name, present)
    )


@cache
def _codecs(cls: type) -> Mapping[str, _Codec]:
    hints = typing.get_type_hints(cls, include_extras=True)
    found: dict[str, _Codec] = {}
    for field in dataclasses.fields(cls):
        hint = hints[field.name]
        marks = hint.__metadata__ if typing.get_origin(hint) is Annotated else ()
        if Stored.ELSEWHERE not in marks:
            found[field.name] = _codec(_bare(hint), marks)
    return found


def _codec(hint: object, marks: tuple[object, ...]) -> _Codec:
    if Stored.DATASET in marks:
        return _Codec(write=write_text, read=read_text)
    if Stored.DIGITS in marks:
        return _digits(is_optional=_is_optional(hint))
    if _is_optional(hint):
        return _later_number()
    codec = _scalars().get(hint) or _many(hint, marks)
    if codec is None:
        raise TypeError(f"the record format has no place for a field of type {hint}")
    return codec


@cache
def _scalars() -> Mapping[object, _Codec]:
    return {
        str: _attribute(str, text_attribute),
        int: _attribute(int, int_attribute),
        float: _attribute(float, float_attribute),
    }


def _many(hint: object, marks: tuple[object, ...]) -> _Codec | None:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return _choice(arguments)
    if origin is tuple and arguments[0] is RecordedDiagnostic:
        return _diagnostics()
    if origin is tuple:
        is_text = arguments[0] is str
        return _Codec(write=write_texts, read=read_texts) if is_text else _rows(arguments[0])
    if origin is Mapping:
        pairs = next((mark for mark in marks if isinstance(mark, tuple)), None)
        return _json() if pairs is None else _pairs(*pairs)
    return None


def _attribute(kind: type, read: Callable[[h5py.Group, str], Any]) -> _Codec:
    return _Codec(
        write=lambda group, name, value: set_attributes(group, {name: kind(value)}), read=read
    )


def _later_number() -> _Codec:
    """A number that records of earlier versions do not state."""

    def write(group: h5py.Group, name: str, value: float | None) -> None:
        if value is not None:
            set_attributes(group, {name: float(value)})

    def read(group: h5py.Group, name: str) -> float | None:
        return float_attribute(group, name) if has_attribute(group, name) else None

    return _Codec(write=write, read=read)


def _choice(options: tuple[str, ...]) -> _Codec:
    def read(group: h5py.Group, name: str) -> str:
        value = text_attribute(group, name)
        if value not in options:
            raise RecordFormatError(
                f"{group.name}@{name} must be {', '.join(options[:-1])} or {options[-1]}, got "
                f"{value!r}"
            )
        return value

    return _Codec(write=lambda group, name, value: set_attributes(group, {name: value}), read=read)


def _digits(*, is_optional: bool) -> _Codec:
    def write(group: h5py.Group, name: str, value: int | None) -> None:
        set_attributes(group, {name: "" if value is None else str(value)})

    def read(group: h5py.Group, name: str) -> int | None:
        text = text_attribute(group, name)
        if not text and is_optional:
            return None
        digits = text.removeprefix("-")
        if not (digits.isascii() and digits.isdigit() and len(digits) < 100):
            raise RecordFormatError(
                f"{group.name}@{name} must be a whole number in decimal digits, got {text!r}"
            )
        return int(text)

    return _Codec(write=write, read=read)


def _json() -> _Codec:
    return _Codec(
        write=lambda group, name, value: write_text(group, name, canonical_json(value)),
        read=read_json,
    )


def _diagnostics() -> _Codec:
    def write(group: h5py.Group, name: str, rows: tuple[RecordedDiagnostic, ...]) -> None:
        # As later columns: a record in which nobody reported anything is one of before.
        texts = [{**dataclasses.asdict(row), "settled_by": list(row.settled_by)} for row in rows]
        if rows:
            write_text(group, name, canonical_json(texts))

    def read(group: h5py.Group, name: str) -> tuple[RecordedDiagnostic, ...]:
        if name not in group:
            return ()
        rows: Any = parse_json(read_text(group, name), f"{group.name}/{name}")
        try:
            return tuple(
                RecordedDiagnostic(**{**row, "settled_by": tuple(row["settled_by"])})
                for row in rows
            )
        except (TypeError, KeyError) as error:
            raise RecordFormatError(f"{group.name}/{name} holds no diagnostics") from error

    return _Codec(write=write, read=read)


def _pairs(key: str, value: str) -> _Codec:
    columns: Columns = ((key, str), (value, str))
    return _Codec(
        write=lambda group, name, pairs: write_table(group, name, columns, list(pairs.items())),
        read=lambda group, name: {str(k): str(v) for k, v in read_table(group, name, columns)},
    )


def _rows(cls: type) -> _Codec:
    return _Codec(
        write=lambda group, name, rows: write_rows(group, name, rows, cls),
        read=lambda group, name: read_rows(group, name, cls),
    )


@cache
# Any: a dataclass, which mypy does not let be both a key of the cache and what it constructs.
def _columns(cls: Any) -> Columns:
    hints = typing.get_type_hints(cls)
    return tuple((field.name, hints[field.name]) for field in dataclasses.fields(cls))


@cache
# Any: as above.
def _later(cls: Any) -> Mapping[str, str | int | float]:
    """Columns that tables of earlier versions lack, and what stands for them."""
    return {
        field.name: field.default
        for field in dataclasses.fields(cls)
        if field.default is not dataclasses.MISSING
    }


def _bare(hint: object) -> object:
    """The type without what is noted beside it, such as a unit."""
    return typing.get_args(hint)[0] if typing.get_origin(hint) is Annotated else hint


def _is_optional(hint: object) -> bool:
    is_union = typing.get_origin(hint) in (Union, types.UnionType)
    return is_union and types.NoneType in typing.get_args(hint)
