"""Sentences for steps that ended without a result: crashed, killed, too large, too slow."""

from __future__ import annotations

import signal
from typing import Final

from orthoflow.engine.memory import GIB
from orthoflow.errors import StepFailedError

_CRASHES: Final = {
    signal.SIGSEGV: "segmentation fault",
    signal.SIGBUS: "bus error, as when the disk is full under a memory-mapped file",
    signal.SIGABRT: "abort",
    signal.SIGFPE: "arithmetic error",
    signal.SIGILL: "illegal instruction",
}


def describe_exit(who: str, code: int, n_bytes: int, tail: str) -> str:
    """Say how a process ended that left no result.

    Args:
        who: method and distribution, as `Task.who` has them.
        code: as `subprocess` has it, negative for signals.
        n_bytes: largest memory seen.
        tail: last line of its log.
    """
    if code >= 0:
        last = f"; its log ends with: {tail}" if tail else ""
        return f"{who} ended its process without a result (exit status {code}){last}"
    name = _signal_name(-code)
    if -code in _CRASHES:
        return f"{who} crashed ({_CRASHES[signal.Signals(-code)]}, {name})"
    return f"{who} was killed from outside ({name}) while it held {n_bytes / GIB:.1f} GiB of memory"


def describe_memory(who: str, n_bytes: int) -> StepFailedError:
    """Say that a step was stopped for want of memory."""
    return StepFailedError(
        f"{who} needed more memory than the machine has ({n_bytes / GIB:.1f} GiB when "
        f"stopped); give it less data or coarser parameters"
    )


def describe_timeout(who: str, limit_s: float) -> StepFailedError:
    """Say that a step took longer than its workflow allows."""
    return StepFailedError(f"{who} ran past its timeout of {duration(limit_s)} and was stopped")


def duration(seconds: float) -> str:
    """Write a duration as people say it.

    >>> [duration(s) for s in (0.5, 90, 1800, 7200)]
    ['0.5 s', '90 s', '30 min', '2 h']
    """
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= length and seconds % length == 0:
            return f"{seconds / length:g} {unit}"
    return f"{seconds:g} s"


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
