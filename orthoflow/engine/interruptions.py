"""Ctrl-C and SIGTERM while a run goes on: remembered, and asked for between steps."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interruption:
    """Whether the run was asked to stop.

    Attributes:
        is_asked: a signal came.
    """

    def __init__(self) -> None:
        self.is_asked = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle the signal; a second one does not wait for anybody.

        Raises:
            KeyboardInterrupt: asked a second time.
        """
        if self.is_asked:
            raise KeyboardInterrupt
        self.is_asked = True


@contextmanager
def watching_interruptions() -> Iterator[Interruption]:
    """Catch SIGINT and SIGTERM inside the block; only the main thread can, others never see any."""
    interruption = Interruption()
    if threading.current_thread() is not threading.main_thread():
        yield interruption
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, interruption) for number in numbers}
    try:
        yield interruption
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
