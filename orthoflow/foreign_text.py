"""Text from records, plugins and files, made harmless where it leaves: terminal, page, table."""

from __future__ import annotations

import csv
import re
import unicodedata
from collections.abc import Iterable, Sequence
from types import SimpleNamespace
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
    r"""Write rows as CSV that no spreadsheet takes for formulas.

    A text that begins with one of `= + - @`, a tab, a line end or an apostrophe, and is no number,
    gets an apostrophe before it; who reads the table takes the first apostrophe of a cell away.
    Numbers stay numbers, with every digit that they have.

    >>> csv_text([("name", "value"), ("=1+1", -2.5), ("-3.5e-2", None)])
    "name,value\n'=1+1,-2.5\n-3.5e-2,\n"
    """
    # With this end of lines, cells that hold either of its letters are quoted.
    lines: list[str] = []
    writer = csv.writer(SimpleNamespace(write=lines.append), lineterminator="\r\n")
    writer.writerows([_cell(value) for value in row] for row in rows)
    return "".join(f"{line[:-2]}\n" for line in lines)


def _is_unseen(letter: str) -> bool:
    return unicodedata.category(letter) in _UNSEEN and letter not in _JOINERS


def _escaped(letter: str) -> str:
    return letter.encode("unicode_escape").decode("ascii")


def _escaped_in_json(letter: str) -> str:
    units = letter.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at : at + 2].hex()}" for at in range(0, len(units), 2))


def _cell(value: Value) -> Value:
    if isinstance(value, str) and value.startswith(_FORMULA) and not _NUMBER.fullmatch(value):
        return f"'{value}"
    return value
