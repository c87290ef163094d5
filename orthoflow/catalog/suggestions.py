"""Did-you-mean: the known name that a misspelt one most likely stands for."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(name: str, known: Iterable[str]) -> str:
    """Give the known name most like another, or nothing when none is near.

    >>> nearest("hugh2d", ["hough2d", "ransac"])
    'hough2d'
    """
    matches = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.6)
    return matches[0] if matches else ""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Give ` (did you mean X?)` for the nearest known name, or nothing when none is near.

    >>> did_you_mean("gsd", ["gsd_m", "buffer_m"])
    ' (did you mean gsd_m?)'
    >>> did_you_mean("colour", ["gsd_m", "buffer_m"])
    ''
    """
    near = nearest(name, known)
    return f" (did you mean {near}?)" if near else ""
