"""Says which kernel is being compiled to whoever waits for it; loads no compiler itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Hear = Callable[[str], None]

_listeners: list[Hear] = []


@contextmanager
def heard_by(hear: Hear) -> Iterator[None]:
    """Report a function of the kernels that are compiled while the block runs, in any thread.

    Args:
        hear: gets `compiling NAME (3 so far)` when one is begun, and nothing, an empty text, when
            it and all that it needs is there.
    """
    _listeners.append(hear)
    try:
        yield
    finally:
        _listeners.remove(hear)


def tell(text: str) -> None:
    """Pass on what the compiler does."""
    for hear in tuple(_listeners):
        hear(text)
