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


@pytest.mark.parametrize(
    ("code", "tail", "sentence"),
    [
        (1, "", f"{WHO} ended its process without a result (exit status 1)"),
        (0, "", f"{WHO} ended its process without a result (exit status 0)"),
        (
            3,
            "no.",
            f"{WHO} ended its process without a result (exit status 3); its log ends with: no.",
        ),
        (
            -signal.SIGTERM,
            "no licence",
            f"{WHO} was killed from outside (SIGTERM) while it held 1.5 GiB of memory",
        ),
    ],
    ids=["without a word", "as if all were well", "with a last word", "from outside"],
)
def test_an_exit_is_told_with_what_is_known_of_it(code: int, tail: str, sentence: str) -> None:
    assert describe_exit(WHO, code, 3 << 29, tail) == sentence


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
