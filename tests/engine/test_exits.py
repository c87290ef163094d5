"""How a process without a result is told of: each way that it can end, in a sentence of its own."""

from __future__ import annotations

import errno
import signal

import pytest

from orthoflow.engine.local import (
    describe_exit,
)
from orthoflow.engine.measuring import is_for_want_of_memory

WHO = "method plane.mine of mine 1.0"


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE])
def test_a_crash_is_named_by_its_signal(number: signal.Signals) -> None:
    told = describe_exit(WHO, -number, 0, "")
    assert told.startswith(f"{WHO} crashed (")
    assert told.endswith(f", {number.name})")


@pytest.mark.parametrize(
    ("error", "is_memory"),
    [
        (MemoryError(), True),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), True),
        (ImportError("a.so: failed to map segment from shared object"), True),
        (RuntimeError("can't start new thread"), True),
        (RuntimeError("no threads"), False),
        (ImportError("no module named a"), False),
        (OSError(errno.ENOSPC, "No space left on device"), False),
    ],
    ids=str,
)
def test_want_of_memory_is_told_from_other_errors(error: Exception, is_memory: bool) -> None:
    assert is_for_want_of_memory(error) == is_memory
