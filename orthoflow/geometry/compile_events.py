"""Reports which kernel is being compiled; does not load the compiler itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Listener = Callable[[str], None]

_listeners: list[Listener] = []


@contextmanager
def on_compiling(listener: Listener) -> Iterator[None]:
    """Report the kernels that are compiled while the block runs, in any thread.

    Args:
        listener: called with `compiling NAME (3 so far)` when one is begun, and with an empty text
            when it and all that it needs are compiled.
    """
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def report_compiling(text: str) -> None:
    """Pass an event of the compiler to all listeners."""
    for listener in tuple(_listeners):
        listener(text)
