"""Running third-party code while it loads, kept from side effects.

Light on purpose, as all of the catalog.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

from orthoflow.errors import PluginError


class UserInterrupt(KeyboardInterrupt):
    """Ctrl-C of the user, not an exception that a plugin raises."""


@contextmanager
def guarded() -> Iterator[None]:
    """Keep what the code inside does from the rest of the program.

    What it prints goes to standard error; the working folder, which paths of users count from, and
    the limit of recursion stay.

    Raises:
        UserInterrupt: the user pressed Ctrl-C.
        PluginError: it lowered the limit of recursion.
    """
    limit = sys.getrecursionlimit()
    try:
        with _working_folder_kept(), contextlib.redirect_stdout(sys.stderr), _interrupts_marked():
            yield
    finally:
        left = sys.getrecursionlimit()
        sys.setrecursionlimit(limit)
        if left < limit:
            # Also in the place of the RecursionError that it leads to.
            raise PluginError(f"it lowers Python's recursion limit from {limit} to {left}")


@contextmanager
def _working_folder_kept() -> Iterator[None]:
    """Return to the working folder, even if it has no name any more."""
    folder = os.open(".", os.O_PATH)
    try:
        yield
    finally:
        os.fchdir(folder)
        os.close(folder)


@contextmanager
def _interrupts_marked() -> Iterator[None]:
    """Raise `UserInterrupt` on Ctrl-C, unlike a `KeyboardInterrupt` that a plugin raises."""
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler or threading.current_thread() is not (
        threading.main_thread()
    ):
        yield
        return

    def interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
        raise UserInterrupt

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
