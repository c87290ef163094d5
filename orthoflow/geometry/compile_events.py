"""Progress of the compilation of kernels. This module does not load the compiler."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Listener = Callable[[str], None]

_listeners: list[Listener] = []


@contextmanager
def on_compiling(listener: Listener) -> Iterator[None]:
    """Report the kernels that any thread compiles during a `with` block.

    Args:
        listener: called with `compiling NAME (3 so far)` when a compilation begins, and with an
            empty string when it is complete.
    """
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def report_compiling(text: str) -> None:
    """Call all listeners."""
    for listener in tuple(_listeners):
        listener(text)
