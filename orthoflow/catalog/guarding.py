"""Protection from side effects of third-party code while it is being loaded.

Like the whole catalog, this module imports no heavy libraries.
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
    """Ctrl-C by the user, as opposed to a KeyboardInterrupt raised by a plugin."""


@contextmanager
def guarded() -> Iterator[None]:
    """Protect the program from side effects of the code in the block.

    Output of the code goes to standard error; working directory and recursion limit are restored.

    Raises:
        UserInterrupt: the user pressed Ctrl-C.
        PluginError: the code lowered the recursion limit.
    """
    limit = sys.getrecursionlimit()
    try:
        with _working_folder_kept(), contextlib.redirect_stdout(sys.stderr), _interrupts_marked():
            yield
    finally:
        left = sys.getrecursionlimit()
        sys.setrecursionlimit(limit)
        if left < limit:
            # This error replaces a RecursionError caused by the lower limit.
            raise PluginError(f"the plugin lowers Python's recursion limit from {limit} to {left}")


@contextmanager
def _working_folder_kept() -> Iterator[None]:
    folder = os.open(".", os.O_PATH)
    try:
        yield
    finally:
        os.fchdir(folder)
        os.close(folder)


@contextmanager
def _interrupts_marked() -> Iterator[None]:
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
