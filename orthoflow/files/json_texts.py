"""JSON from outside and to it: errors are of one kind, and any text can be written."""

from __future__ import annotations

import json
from typing import NoReturn


def parse_json(text: str) -> object:
    """Parse JSON.

    Raises:
        ValueError: it is no JSON, nested too deeply, or has a number of too many digits.
    """
    try:
        return json.loads(text, parse_constant=_refuse)
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


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number of JSON")
