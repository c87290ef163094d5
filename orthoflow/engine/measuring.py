"""Measurement of the time and memory used by methods and processes, and of free memory."""

from __future__ import annotations

import errno
import importlib
import sys
import threading
import time
from collections.abc import Callable
from functools import wraps
from typing import Any, Final, Self, cast

import psutil

MIB: Final = 1 << 20
GIB: Final = 1 << 30


def process_memory(process_id: int | None = None) -> int:
    """Return the memory in bytes allocated by a process, by default this one; 0 if it has ended.

    Mapped files are not counted, because the system can discard and reread them.
    """
    try:
        memory = psutil.Process(process_id).memory_info()
    except psutil.Error:
        return 0
    return int(memory.rss - getattr(memory, "shared", 0))


def tree_memory(root: int) -> int:
    """Return the memory in bytes allocated by a process and all its descendants."""
    try:
        children = psutil.Process(root).children(recursive=True)
    except psutil.Error:
        return 0
    return sum(process_memory(process) for process in (root, *(one.pid for one in children)))


def memory_shortage() -> int:
    """Return the required free memory in bytes if less is available, otherwise 0.

    The required free memory is 512 MiB, or 3 % of the total if this is more, but at most one
    eighth of the total. With less, programs fail unpredictably. Without /proc, the free memory is
    unknown, and the result is 0.
    """
    try:
        memory = psutil.virtual_memory()
    except OSError:
        return 0
    floor = min(max(512 * MIB, memory.total * 3 // 100), memory.total // 8)
    return floor if memory.available <= floor else 0


def is_for_want_of_memory(error: BaseException) -> bool:
    """Whether an error was caused by a lack of memory.

    If a library cannot be loaded or a thread cannot be started, only the message shows the cause.
    """
    if isinstance(error, ImportError):
        return "failed to map segment" in str(error) or "allocate memory" in str(error)
    if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
        return True
    return isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM


# Every import calls these functions, even for a module that another thread is still loading. The
# public hooks (finders and loaders) are not sufficient, because they are not called when the
# import of a module ends.
_BOOTSTRAP: Final = cast("Any", importlib)._bootstrap  # noqa: SLF001
_IMPORTS: Final = ("_find_and_load", "_lock_unlock_module")
_NUMBA_EVENTS: Final = "numba.core.event"
# Name of the numba event that lasts while a kernel is compiled or read from its file.
_COMPILER_LOCK: Final = "numba:compiler_lock"


class LoadingMeter:
    """Measures how long a block loads modules and compiles kernels.

    If several threads load at the same time, the elapsed time is counted once. Loading in a daemon
    thread does not delay the method, so only its processor time is counted.
    """

    def __init__(self) -> None:
        """Create a meter that reads zero."""
        self._lock = threading.RLock()
        self._own = threading.local()
        self._n_open = 0
        self._opened_s = 0.0
        self._total_s = 0.0
        self._processor_s = 0.0
        self._replaced: dict[str, Callable[..., object]] = {}
        self._listener: object | None = None

    def __enter__(self) -> Self:
        for name in _IMPORTS:
            self._replaced[name] = getattr(_BOOTSTRAP, name)
            setattr(_BOOTSTRAP, name, self._timed(self._replaced[name]))
        self._listen_to_numba()
        return self

    def __exit__(self, *_: object) -> None:
        for name, function in self._replaced.items():
            setattr(_BOOTSTRAP, name, function)
        if self._listener is not None:
            sys.modules[_NUMBA_EVENTS].unregister(_COMPILER_LOCK, self._listener)
            self._listener = None

    @property
    def total_s(self) -> float:
        """Elapsed seconds spent on loading and compiling so far."""
        with self._lock:
            running_s = time.perf_counter() - self._opened_s if self._n_open else 0.0
            return self._total_s + running_s

    @property
    def processor_s(self) -> float:
        """Processor seconds of all threads so far, without loading that is still in progress."""
        with self._lock:
            return self._processor_s

    def clock_s(self) -> float:
        """Return the time in seconds of a clock that pauses while anything is loaded."""
        with self._lock:
            return time.perf_counter() - self.total_s

    def begin(self) -> None:
        """Record that this thread starts to load; nested calls are counted once."""
        own = self._own
        own.depth = getattr(own, "depth", 0) + 1
        if own.depth > 1:
            return
        own.processor_s = time.thread_time()
        if threading.current_thread().daemon:
            return
        with self._lock:
            if self._n_open == 0:
                self._opened_s = time.perf_counter()
            self._n_open += 1

    def end(self) -> None:
        """Record that this thread has finished its outermost loading."""
        own = self._own
        depth = getattr(own, "depth", 0)
        if depth == 0:
            # This loading started before the measurement.
            return
        own.depth = depth - 1
        if own.depth:
            return
        with self._lock:
            self._processor_s += time.thread_time() - own.processor_s
            if threading.current_thread().daemon:
                return
            self._n_open -= 1
            if self._n_open == 0:
                self._total_s += time.perf_counter() - self._opened_s

    def _timed(self, function: Callable[..., object]) -> Callable[..., object]:
        @wraps(function)
        def timed(*arguments: object) -> object:
            self.begin()
            try:
                return function(*arguments)
            finally:
                self.end()
                self._listen_to_numba()

        return timed

    def _listen_to_numba(self) -> None:
        # Do not load numba here; a method that compiles kernels loads numba itself.
        events = cast("Any", sys.modules.get(_NUMBA_EVENTS))
        if self._listener is not None or not hasattr(events, "install_listener"):
            return
        listener = type(
            "Listener",
            (events.Listener,),
            {"on_start": lambda _, event: self.begin(), "on_end": lambda _, event: self.end()},
        )()
        events.register(_COMPILER_LOCK, listener)
        self._listener = listener
