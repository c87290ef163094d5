"""Text from records, plugins and files, made harmless where it leaves: terminal, page, table."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from typing import Final, TypeAlias

Value: TypeAlias = str | int | float | None

# Controls, marks of direction and other letters without a shape, halves of letters, line ends.
_UNSEEN: Final = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
# They join letters in Persian and Indian scripts, and the parts of an emoji.
_JOINERS: Final = "\u200c\u200d"
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE | re.ASCII)
# The wide forms of = + - @, which some programs read as these.
_WIDE: Final = ("\uff1d", "\uff0b", "\uff0d", "\uff20")
# What spreadsheets take for the beginning of a formula, and the mark that is put before one.
_FORMULA: Final = ("=", "+", "-", "@", "\t", "\r", "\n", *_WIDE, "'")
# Before what another reader takes for the beginning of a formula: a separator or line end, and
# what it may strip. Numbers up to the next separator are none.
_INNER_CELL: Final = re.compile(
    rf"""[,;|\t\r\n] [\s"']*
    (?=[=@{"".join(_WIDE)}] | [+-] (?!(\d+\.?\d*|\.\d+)(e[+-]?\d+)?[\s"']*([,;|\t\r\n]|$)))""",
    re.VERBOSE | re.IGNORECASE,
)


def shown(text: str, *, keep: str = "") -> str:
    r"""Write what a terminal would obey, and what turns reading round, as what it is.

    Args:
        text: any text, also with halves of surrogate pairs.
        keep: letters that stay, such as the line ends of a text of many lines.

    >>> print(shown("a\x1b[2Jb\u202etxt.exe\n"), shown("one\ntwo", keep="\n"))
    a\x1b[2Jb\u202etxt.exe\n one
    two
    """
    if text.isprintable():
        return text
    return "".join(
        letter if letter in keep or not _is_unseen(letter) else _escaped(letter) for letter in text
    )


def shown_json(text: str) -> str:
    r"""Do the same to JSON, which stays the same JSON.

    >>> print(shown_json('{"name": "a\x9b\u202e"}'))
    {"name": "a\u009b\u202e"}
    """
    if text.isprintable():
        return text
    return "".join(
        letter if letter == "\n" or not _is_unseen(letter) else _escaped_in_json(letter)
        for letter in text
    )


def csv_text(rows: Iterable[Sequence[Value]]) -> str:
    r"""Write rows as CSV in which no reader finds a formula, whatever it separates by.

    Spreadsheets separate by `,`, `;` or tab, as the country or the user has it, and each sees other
    cells. Text is therefore quoted, and what could begin a cell and is one of `= + - @`, a tab, a
    line end or an apostrophe gets an apostrophe before it, unless the cell is a number: at the
    beginning of a text, and in it behind a separator or a line end, with quotes or spaces between.
    Who reads the table takes the first apostrophe of a cell away. Numbers stay numbers, with every
    digit that they have.

    >>> csv_text([("name", "value"), ("=1+1", -2.5), ("a;=1+1", None)])
    '"name","value"\n"\'=1+1",-2.5\n"a;\'=1+1",\n'
    """
    return "".join(f"{','.join(map(_cell, row))}\n" for row in rows)


def _is_unseen(letter: str) -> bool:
    return unicodedata.category(letter) in _UNSEEN and letter not in _JOINERS


def _escaped(letter: str) -> str:
    return letter.encode("unicode_escape").decode("ascii")


def _escaped_in_json(letter: str) -> str:
    units = letter.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at : at + 2].hex()}" for at in range(0, len(units), 2))


def _cell(value: Value) -> str:
    if isinstance(value, float):
        return repr(float(value))
    if not isinstance(value, str):
        return "" if value is None else str(value)
    if value.startswith(_FORMULA) and not _NUMBER.fullmatch(value):
        value = f"'{value}"
    value = _INNER_CELL.sub(lambda found: f"{found[0]}'", value)
    return '"{}"'.format(value.replace('"', '""'))
