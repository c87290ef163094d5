"""Sanitising of reported text: one printable line of limited length."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from orthoflow.untrusted_text import shown

_LONGEST: Final = 2000
_LONGEST_ERROR: Final = 500
_LONGEST_NAME_BYTES: Final = 200


def one_line(text: object, longest: int = _LONGEST) -> str:
    r"""Return text as one printable line, truncated if it is too long.

    >>> one_line("no\n  plane \x1b[31m at all")
    'no plane \\x1b[31m at all'
    >>> one_line("far too long", 8)
    'far too ... (12 characters)'
    """
    whole = _text_of(text)
    # Truncate first, so that the remainder need not be processed.
    line = shown(" ".join(whole[: longest + 1].split()))
    return line if len(whole) <= longest else f"{line[:longest]}... ({len(whole)} characters)"


def describe_error(error: BaseException) -> str:
    r"""Return the class and message of an error as one line.

    >>> describe_error(ValueError("no such\n  plane"))
    'ValueError: no such plane'
    """
    text = one_line(error, _LONGEST_ERROR)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def is_name(name: object, *, also_of_file: bool = True) -> bool:
    r"""Return whether an object is valid as the name or unit of a metric in tables and records.

    Args:
        name: any object.
        also_of_file: also require a valid file name (without `/`, and not `.` or `..`); False for
            units such as `m/s`.

    >>> [is_name(name) for name in ("rms_mm", "", "a\nb", "../a", "..", 5, "n" * 300)]
    [True, False, False, False, False, False, False]
    """
    return (
        isinstance(name, str)
        and name.isprintable()
        and name != ""
        and not (also_of_file and (name in (".", "..") or "/" in name))
        and len(name.encode()) <= _LONGEST_NAME_BYTES
    )


def text_of_path(path: Path) -> str | None:
    """Return a path as a string that can be stored and read again; None if it is not UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return None
    return str(path)


def _text_of(text: object) -> str:
    try:
        return str(text)
    except Exception:  # noqa: BLE001 - the text of an exception may raise an exception
        return f"a {type(text).__name__} without a message"
