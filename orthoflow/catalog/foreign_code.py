"""Running strangers' code in this process while it loads: named when slow, without a say here.

Light on purpose, as all of the catalog.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, NoReturn

from orthoflow.system import working_folder_kept

_SLOW_S: Final = 3.0


@contextmanager
def foreign_code(what: str) -> Iterator[None]:
    """Keep what the code inside does from the rest of the program.

    What it prints goes to standard error, the working directory stays, and where it ends the
    process at once it raises `SystemExit` instead. After 3 s the user is told who is slow.

    Args:
        what: as the sentence about it begins, e.g. `method plane.mine of mine 1.0`.
    """
    watch = threading.Timer(_SLOW_S, _say_slow, [what])
    watch.daemon = True
    watch.start()
    try:
        with working_folder_kept(), contextlib.redirect_stdout(sys.stderr), _exits_refused():
            yield
    finally:
        watch.cancel()
        # Joined, so that nobody forks a process with threads.
        watch.join()


@contextmanager
def _exits_refused() -> Iterator[None]:
    real, process = os._exit, os.getpid()
    is_over = False

    def refuse(status: int) -> NoReturn:
        # Somebody may have taken it along, and a forked process may do as it likes.
        if is_over or os.getpid() != process:
            real(status)
        raise SystemExit(status)

    os._exit = refuse
    try:
        yield
    finally:
        is_over = True
        os._exit = real


def _say_slow(what: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.write(f"{what} is slow to load: waiting for it\n")
        sys.stderr.flush()
