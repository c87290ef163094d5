"""Lists of names, cut to the first few."""

from __future__ import annotations

from collections.abc import Sequence


def first_few(names: Sequence[str], most: int = 3) -> str:
    """Name the first few, and count the others.

    >>> first_few(["a", "b", "c", "d", "e"]), first_few(["a", "b"], most=1)
    ('a, b, c and 2 more', 'a and 1 more')
    """
    n_more = len(names) - most
    named = ", ".join(names[:most])
    return f"{named} and {n_more} more" if n_more > 0 else named
