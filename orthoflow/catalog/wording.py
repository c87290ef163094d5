"""Pieces of messages: the name that a misspelt one most likely stands for, an error in one line."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Final

from orthoflow.sdk.lines import one_line

_LONGEST: Final = 500
# Comparing takes some microseconds for each, for every name that is misspelt.
_MOST_CANDIDATES: Final = 1000
_LONGEST_NAME: Final = 200


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name most like another, or nothing when none is near.

    >>> nearest("hugh2d", ["hough2d", "ransac"])
    'hough2d'
    """
    candidates = sorted(known)
    if len(candidates) > _MOST_CANDIDATES or len(name) > _LONGEST_NAME:
        return ""
    matches = difflib.get_close_matches(name, candidates, n=1, cutoff=0.6)
    return matches[0] if matches else ""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ` (did you mean X?)` for the nearest known name, or nothing when none is near.

    >>> did_you_mean("gsd", ["gsd_m", "buffer_m"])
    ' (did you mean gsd_m?)'
    >>> did_you_mean("colour", ["gsd_m", "buffer_m"])
    ''
    """
    near = nearest(name, known)
    return f" (did you mean {near}?)" if near else ""


def describe_error(error: BaseException) -> str:
    r"""Return class and message of an error in one line.

    >>> describe_error(ValueError("no such\n  plane"))
    'ValueError: no such plane'
    """
    text = one_line(error, _LONGEST)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
