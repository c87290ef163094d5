"""How a process without a result is told of: each way that it can end, in a sentence of its own."""

from __future__ import annotations

import errno
import signal

import pytest

from orthoflow.engine.local import (
    describe_exit,
    describe_memory,
    describe_timeout,
    duration,
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
    ("seconds", "said"),
    [
        (0.5, "0.5 s"),
        (59.0, "59 s"),
        (60.0, "1 min"),
        (90.0, "90 s"),
        (3540.0, "59 min"),
        (3600.0, "1 h"),
        (5400.0, "90 min"),
        (7200.0, "2 h"),
        (7201.0, "7201 s"),
    ],
)
def test_a_timeout_is_told_in_the_largest_whole_unit(seconds: float, said: str) -> None:
    assert duration(seconds) == said
    sentence = f"{WHO} ran past its timeout of {said} and was stopped"
    assert str(describe_timeout(WHO, seconds)) == sentence


def test_want_of_memory_and_unknown_signals_are_told() -> None:
    assert str(describe_memory(WHO, 5 << 29)) == (
        f"{WHO} needed more memory than the machine has (2.5 GiB when stopped); give it less data "
        "or coarser parameters"
    )
    assert "(signal 99)" in describe_exit(WHO, -99, 0, "")


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
