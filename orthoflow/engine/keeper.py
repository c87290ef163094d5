"""The process above a step's own: whatever a step starts ends with it.

A process that takes leave of its group and session (`setsid`, as daemons do) is out of reach of its
group's signals, and nobody's child once its parent has ended. So each step is forked from a keeper
to which the kernel hands its orphans, and which ends them when the step has ended, when the
coordinator asks for it, and when the coordinator dies.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import time
from typing import Final

from orthoflow.engine.process_trees import descendants
from orthoflow.system import resource

# Ends a step with all that it started; the kernel sends it too, when the coordinator dies.
END_ALL: Final = signal.SIGHUP
_PR_SET_PDEATHSIG: Final = 1
_PR_SET_CHILD_SUBREAPER: Final = 36
_PATIENCE_S: Final = 5.0
_PAUSE_S: Final = 0.005


def fork_kept(coordinator: int) -> None:
    """Fork: the step goes on from here in the new process, this one keeps it and never returns.

    Args:
        coordinator: process id of the parent that spawned this process.
    """
    # Taken by `sigwait`: a handler would have to be safe at any moment.
    signal.pthread_sigmask(signal.SIG_BLOCK, [END_ALL, signal.SIGCHLD])
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)
    _prctl(_PR_SET_PDEATHSIG, END_ALL)
    keeper = os.getpid()
    if os.getppid() != coordinator:
        # It died before the line above.
        os._exit(1)
    step = os.fork()
    if step == 0:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != keeper:
            os._exit(1)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [END_ALL, signal.SIGCHLD])
        return
    status = _wait_for(step)
    _end_all()
    _leave_like(status)


def _wait_for(step: int) -> int:
    """Reap until the step itself ends, by itself or because it was asked for."""
    while True:
        is_asked = signal.sigwait([END_ALL, signal.SIGCHLD]) == END_ALL
        if is_asked:
            os.kill(step, signal.SIGKILL)
            return os.waitpid(step, 0)[1]
        with contextlib.suppress(ChildProcessError):
            while True:
                ended, status = os.waitpid(-1, os.WNOHANG)
                if ended == step:
                    return status
                if ended == 0:
                    break


def _end_all() -> None:
    """Kill and reap until nothing is left; what stands still in the kernel is not waited for."""
    deadline = time.monotonic() + _PATIENCE_S
    with contextlib.suppress(ChildProcessError):
        while time.monotonic() < deadline:
            if os.waitpid(-1, os.WNOHANG)[0] != 0:
                continue
            for process in descendants(os.getpid()):
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(process, signal.SIGKILL)
            time.sleep(_PAUSE_S)


def _leave_like(status: int) -> None:
    """End as the step has ended, so that the coordinator reads its status from this process."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [number])
        os.kill(os.getpid(), number)
    os._exit(os.waitstatus_to_exitcode(status) & 0xFF)


def _prctl(option: int, value: int) -> None:
    ctypes.CDLL(None, use_errno=True).prctl(option, value)
