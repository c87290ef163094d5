"""Reports which kernel is being compiled; does not load the compiler itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Hear = Callable[[str], None]

_listeners: list[Hear] = []


@contextmanager
def heard_by(hear: Hear) -> Iterator[None]:
    """Report a function of the kernels that are compiled while the block runs, in any thread.

    Args:
        hear: called with `compiling NAME (3 so far)` when one is begun, and with an empty text when
            it and all that it needs are compiled.
    """
    _listeners.append(hear)
    try:
        yield
    finally:
        _listeners.remove(hear)


def tell(text: str) -> None:
    """Forward the events of the compiler."""
    for hear in tuple(_listeners):
        hear(text)
