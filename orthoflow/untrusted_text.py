"""Escaping of untrusted text for terminals, pages and tables, and reading of text files."""

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

# Unicode categories of control characters, invisible format characters, surrogates and line ends.
_UNSEEN: Final = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
# Format characters that join or separate letters in Persian and Indic scripts, and join parts of
# emoji.
_JOINERS: Final = "\u200c\u200d"
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE | re.ASCII)
# Full-width forms of = + - @, which some programs treat like the plain characters.
_WIDE: Final = ("\uff1d", "\uff0b", "\uff0d", "\uff20")
# First characters that make spreadsheets treat a cell as a formula, and the apostrophe that
# prevents this.
_FORMULA: Final = ("=", "+", "-", "@", "\t", "\r", "\n", *_WIDE, "'")
# A separator or line end that is followed by the beginning of a formula, possibly after quotes and
# spaces that a program may strip. A number that extends to the next separator is not a formula.
_INNER_CELL: Final = re.compile(
    rf"""[,;|\t\r\n] [\s"']*
    (?=[=@{"".join(_WIDE)}] | [+-] (?!(\d+\.?\d*|\.\d+)(e[+-]?\d+)?[\s"']*([,;|\t\r\n]|$)))""",
    re.VERBOSE | re.IGNORECASE,
)


def shown(text: str, *, keep: str = "") -> str:
    r"""Escape control characters, text direction marks and other invisible characters.

    Args:
        text: any text; it may contain unpaired surrogates.
        keep: characters that are not escaped, such as line ends in text with several lines.

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
    r"""Escape the characters that `shown` escapes in JSON, without changing its values.

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
    r"""Return rows as CSV that no program interprets as formulas, whichever separator it assumes.

    Depending on country and settings, spreadsheets split a line at `,`, `;` or tabs. Text is
    therefore quoted. Cells that begin with `= + - @`, a tab, a line end or an apostrophe are
    prefixed with an apostrophe, unless they are numbers. Inside a cell, an apostrophe is also
    inserted before `= + - @` after a separator or line end, even if quotes or spaces are in
    between. To restore the text, remove these apostrophes. Numbers are written with all their
    digits.

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
        ValueError: the text is not JSON, is nested too deeply, or contains a number with too many
            digits.
    """
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def json_bytes(value: object, *, indent: int | None) -> bytes:
    r"""Write readable JSON in UTF-8; unpaired surrogates, which UTF-8 does not allow, are escaped.

    Raises:
        ValueError: the value contains a number that is not finite.

    >>> json_bytes(["\xe9", "\ud800"], indent=None).decode()
    '["é", "\\ud800"]'
    """
    text = json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8", "backslashreplace")


def _refuse_constant(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a JSON number")


def open_file(path: Path) -> BufferedReader:
    """Open a file for reading without blocking.

    Raises:
        OSError: the file cannot be read, or is a folder, a pipe or a device.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise OSError(errno.EINVAL, "it is a folder, a pipe or a device", str(path))


@contextmanager
def reading(path: Path, most_bytes: int, what: str, *, way_out: str = "") -> Iterator[None]:
    """Convert errors that occur while the block opens and reads a file into an `InputError`.

    Args:
        path: the file.
        most_bytes: maximum size; a larger file is refused.
        what: expected content, e.g. `a title block (YAML)`.
        way_out: end of the message for a file that is too large, which states the remedy.
    """
    try:
        n_bytes = path.stat().st_size
        if n_bytes > most_bytes:
            raise InputError(
                f"{path.name} has {n_bytes} bytes, but {what} may have at most "
                f"{most_bytes}{way_out}"
            )
        yield
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path.name} is not UTF-8 text: expected {what}; save it as UTF-8"
        ) from error
    except OSError as error:
        raise InputError(f"cannot read {path.name}: {error.strerror}") from error


def open_text(path: Path) -> TextIOWrapper:
    """Open a UTF-8 text file, with or without a byte order mark.

    Raises:
        OSError: the file cannot be read, or is a folder, a pipe or a device.
    """
    return TextIOWrapper(open_file(path), encoding="utf-8-sig")


def text_of_file(path: Path, most_bytes: int, what: str, *, way_out: str = "") -> str:
    """Read a whole text file, with the arguments of `reading`.

    Raises:
        InputError: the file cannot be read, is not text, or is too large.
    """
    with reading(path, most_bytes, what, way_out=way_out), open_text(path) as stream:
        return stream.read()


def first_few(names: Sequence[str], most: int = 3) -> str:
    """List the first few names and the number of others.

    >>> first_few(["a", "b", "c", "d", "e"]), first_few(["a", "b"], most=1)
    ('a, b, c and 2 more', 'a and 1 more')
    """
    n_more = len(names) - most
    named = ", ".join(names[:most])
    return f"{named} and {n_more} more" if n_more > 0 else named
