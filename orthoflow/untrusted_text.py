"""Text from records, plugins and files, made harmless where it leaves: terminal, page, table."""

from __future__ import annotations

import errno
import json
import os
import re
import stat
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import BufferedReader, TextIOWrapper
from pathlib import Path
from typing import Final, NoReturn, TypeAlias

from orthoflow.errors import InputError

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
    r"""Escape control characters, marks of text direction and other invisible letters.

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


def parse_json(text: str) -> object:
    """Parse JSON.

    Raises:
        ValueError: it is no JSON, nested too deeply, or has a number of too many digits.
    """
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def json_bytes(value: object, *, indent: int | None) -> bytes:
    r"""Write JSON as UTF-8 for people; halves of letters, which UTF-8 has not, as escapes.

    Raises:
        ValueError: it holds a number that is not finite.

    >>> json_bytes(["\xe9", "\ud800"], indent=None).decode()
    '["é", "\\ud800"]'
    """
    text = json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8", "backslashreplace")


def _refuse_constant(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a JSON number")


def open_file(path: Path) -> BufferedReader:
    """Open a file for reading, at once.

    Raises:
        OSError: it cannot be read, or is a folder, a pipe or a device.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise OSError(errno.EINVAL, "it is a folder, a pipe or a device", str(path))


@contextmanager
def reading(path: Path, most_bytes: int, what: str, *, way_out: str = "") -> Iterator[None]:
    """State what is wrong with a file that is opened and read in here, as an `InputError`.

    Args:
        path: the file.
        most_bytes: a larger one is not read.
        what: it should be, e.g. `a title block (YAML)`.
        way_out: for those whose file is too large.
    """
    try:
        n_bytes = path.stat().st_size
        if n_bytes > most_bytes:
            raise InputError(
                f"{path.name} has {n_bytes} bytes, {what} at most {most_bytes}{way_out}"
            )
        yield
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path.name} is not UTF-8 text: expected {what}; save it as UTF-8"
        ) from error
    except OSError as error:
        raise InputError(f"{path.name} cannot be read: {error.strerror}") from error


def open_text(path: Path) -> TextIOWrapper:
    """Open a text, UTF-8 with or without a mark at its beginning.

    Raises:
        OSError: it cannot be read, or is a folder, a pipe or a device.
    """
    return TextIOWrapper(open_file(path), encoding="utf-8-sig")


def text_of_file(path: Path, most_bytes: int, what: str, *, way_out: str = "") -> str:
    """Read a text whole, with the arguments of `reading`.

    Raises:
        InputError: it cannot be read, is no text, or is too large.
    """
    with reading(path, most_bytes, what, way_out=way_out), open_text(path) as stream:
        return stream.read()


def first_few(names: Sequence[str], most: int = 3) -> str:
    """Name the first few, and count the others.

    >>> first_few(["a", "b", "c", "d", "e"]), first_few(["a", "b"], most=1)
    ('a, b, c and 2 more', 'a and 1 more')
    """
    n_more = len(names) - most
    named = ", ".join(names[:most])
    return f"{named} and {n_more} more" if n_more > 0 else named
