"""Taking values of an expected type out of a document; what does not fit becomes a problem."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Final

from orthoflow.catalog import did_you_mean
from orthoflow.files.yaml_positions import (
    Entry,
    Listing,
    Position,
    Table,
    Text,
    Value,
    describe,
    join,
)
from orthoflow.workflow.problems import ProblemLog

NAME: Final = r"[a-z][a-z0-9_-]{0,31}"
_NAME_RULE: Final = (
    "a name starts with a lower-case letter and has at most 32 lower-case letters, digits, - or _"
)


def expect_table(
    value: Value, path: str, log: ProblemLog, known: Collection[str] | None = None
) -> Table | None:
    """Take a mapping; with `known`, report every key that is not among them."""
    if not isinstance(value, Table):
        log.add(value.position, path, f"expected a mapping, got {describe(value)}")
        return None
    for entry in value:
        if known is not None and entry.key not in known:
            log.add(
                entry.position,
                join(path, entry.key),
                f"unknown key {entry.key}{did_you_mean(entry.key, known)}; "
                f"known here: {', '.join(known)}",
            )
    return value


def expect_named(value: Value, path: str, log: ProblemLog) -> tuple[Entry, ...]:
    """Take a mapping from names that the user chose; entries with unusable names are left out."""
    table = expect_table(value, path, log)
    entries = tuple(table) if table else ()
    return tuple(
        entry
        for entry in entries
        if check_name(entry.key, entry.position, join(path, entry.key), log)
    )


def check_name(name: str, position: Position, path: str, log: ProblemLog) -> bool:
    """Whether a name can be used; if not, say why."""
    if re.fullmatch(NAME, name):
        return True
    log.add(position, path, f"{name!r} cannot be a name: {_NAME_RULE}")
    return False


def expect_text(value: Value, path: str, log: ProblemLog) -> str | None:
    """Take a text that is not empty."""
    if isinstance(value, Text) and isinstance(value.value, str) and value.value:
        return value.value
    log.add(value.position, path, f"expected a text, got {describe(value)}")
    return None


def expect_texts(value: Value, path: str, log: ProblemLog) -> tuple[str, ...]:
    """Take a text, or a list of at least one."""
    if not isinstance(value, Listing):
        text = expect_text(value, path, log)
        return (text,) if text else ()
    if not value.items:
        log.add(value.position, path, "expected at least one text, got an empty list")
    texts = (expect_text(item, f"{path}[{index}]", log) for index, item in enumerate(value.items))
    return tuple(text for text in texts if text)


def expect_whole_number(value: Value, path: str, log: ProblemLog, *, minimum: int) -> int | None:
    """Take a whole number from `minimum` on."""
    if isinstance(value, Text) and type(value.value) is int and value.value >= minimum:
        return value.value
    log.add(
        value.position, path, f"expected a whole number from {minimum} on, got {describe(value)}"
    )
    return None


def expect_flag(value: Value, path: str, log: ProblemLog) -> bool:
    """Take true or false; False when it is neither."""
    if isinstance(value, Text) and isinstance(value.value, bool):
        return value.value
    log.add(value.position, path, f"expected true or false, got {describe(value)}")
    return False
