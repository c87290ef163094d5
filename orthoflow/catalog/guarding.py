"""Running third-party code while it loads: reported when slow, kept from side effects.

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
from typing import Final, NoReturn

from orthoflow.errors import PluginError

_SLOW_S: Final = 3.0


class UserInterrupt(KeyboardInterrupt):
    """Ctrl-C of the user, not an exception that a plugin raises."""


@contextmanager
def guarded(what: str) -> Iterator[None]:
    """Keep what the code inside does from the rest of the program.

    What it prints goes to standard error, the working directory and the limit of recursion stay,
    and where it ends the process at once it raises `SystemExit` instead. After 3 s a line on
    standard error names what is slow.

    Args:
        what: as the sentence about it begins, e.g. `method plane.mine of mine 1.0`.

    Raises:
        UserInterrupt: the user pressed Ctrl-C.
        PluginError: it lowered the limit of recursion.
    """
    watch = threading.Timer(_SLOW_S, _report_slow, [what])
    watch.daemon = True
    watch.start()
    limit = sys.getrecursionlimit()
    try:
        with (
            _working_folder_kept(),
            contextlib.redirect_stdout(sys.stderr),
            _exits_refused(),
            _interrupts_marked(),
        ):
            yield
    finally:
        left = sys.getrecursionlimit()
        sys.setrecursionlimit(limit)
        watch.cancel()
        # Joined, so that nobody forks a process with threads.
        watch.join()
        if left < limit:
            # Also in the place of the RecursionError that it leads to.
            raise PluginError(f"it lowers Python's recursion limit from {limit} to {left}")


@contextmanager
def _working_folder_kept() -> Iterator[None]:
    """Return to the working folder, even if it has no name any more."""
    folder = os.open(".", os.O_PATH if hasattr(os, "O_PATH") else os.O_RDONLY)
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


@contextmanager
def _exits_refused() -> Iterator[None]:
    real, process = os._exit, os.getpid()
    is_over = False

    def refuse(status: int) -> NoReturn:
        # The function may outlive this block, and a forked process may end as it likes.
        if is_over or os.getpid() != process:
            real(status)
        raise SystemExit(status)

    os._exit = refuse
    try:
        yield
    finally:
        is_over = True
        os._exit = real


def _report_slow(what: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.write(f"{what} is slow to load: waiting for it\n")
        sys.stderr.flush()
