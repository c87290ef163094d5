"""JSON from outside: whatever is wrong with it is one kind of error."""

from __future__ import annotations

import json


def parse_json(text: str) -> object:
    """Parse JSON.

    Raises:
        ValueError: it is no JSON, nested too deeply, or has a number of too many digits.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
