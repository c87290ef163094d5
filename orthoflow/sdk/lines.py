"""What methods report, made fit to be shown and kept: one line, printable, of bounded length."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from orthoflow.untrusted_text import shown

_LONGEST: Final = 2000
_LONGEST_ERROR: Final = 500
_LONGEST_NAME_BYTES: Final = 200


def one_line(text: object, longest: int = _LONGEST) -> str:
    r"""Return a text as one printable line; of a longer one the beginning.

    >>> one_line("no\n  plane \x1b[31m at all")
    'no plane \\x1b[31m at all'
    >>> one_line("far too long", 8)
    'far too ... (12 characters)'
    """
    whole = _text_of(text)
    # Cut first: what is dropped need not be looked at.
    line = shown(" ".join(whole[: longest + 1].split()))
    return line if len(whole) <= longest else f"{line[:longest]}... ({len(whole)} characters)"


def describe_error(error: BaseException) -> str:
    r"""Return class and message of an error in one line.

    >>> describe_error(ValueError("no such\n  plane"))
    'ValueError: no such plane'
    """
    text = one_line(error, _LONGEST_ERROR)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def is_name(name: object, *, also_of_file: bool = True) -> bool:
    r"""Whether something can name a metric, or its unit, in tables and records.

    Args:
        name: anything.
        also_of_file: `/`, `.` and `..` are no names; a unit such as `m/s` may have them.

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
    """A path as text that can be kept and read again; None where it is no UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return None
    return str(path)


def _text_of(text: object) -> str:
    try:
        return str(text)
    except Exception:  # noqa: BLE001 - the text of a third-party exception may raise one itself
        return f"a {type(text).__name__} without words"
