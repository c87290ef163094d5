"""Did-you-mean: the known name that a misspelt one most likely stands for."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Give ` (did you mean X?)` for the nearest known name, or nothing when none is near.

    >>> did_you_mean("plane.hugh2d", ["plane.hough2d", "plane.ransac"])
    ' (did you mean plane.hough2d?)'
    >>> did_you_mean("colour", ["plane.hough2d"])
    ''
    """
    near = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.6)
    return f" (did you mean {near[0]}?)" if near else ""
