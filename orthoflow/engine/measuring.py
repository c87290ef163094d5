"""Time and memory of methods, processes and the machine."""

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

from orthoflow.geometry.threads import start_beside

MIB: Final = 1 << 20
GIB: Final = 1 << 30


def process_memory(process_id: int | None = None) -> int:
    """Return the memory that a process, by default this one, has allocated; 0 if it is gone.

    Mapped files are not counted: they can be read again.
    """
    try:
        memory = psutil.Process(process_id).memory_info()
    except psutil.Error:
        return 0
    return int(memory.rss - getattr(memory, "shared", 0))


def tree_memory(root: int) -> int:
    """Return the memory that a process and all its descendants have allocated."""
    try:
        children = psutil.Process(root).children(recursive=True)
    except psutil.Error:
        return 0
    return sum(process_memory(process) for process in (root, *(one.pid for one in children)))


def memory_shortage() -> int:
    """Return the least memory that should stay free, in bytes, if less is available; else 0.

    Below it, 512 MiB or 3 % of the total, a machine fails unpredictably.
    """
    memory = psutil.virtual_memory()
    floor = min(max(512 * MIB, memory.total * 3 // 100), memory.total // 8)
    return floor if memory.available <= floor else 0


def is_for_want_of_memory(error: BaseException) -> bool:
    """Whether an error means lack of memory, even while a library or a thread was started.

    The loader and threads report it only as text.
    """
    if isinstance(error, ImportError):
        return "failed to map segment" in str(error) or "allocate memory" in str(error)
    if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
        return True
    return isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM


# Every import passes through these, for new modules and for those that another thread still loads.
# Private, but finders and loaders are only called when a module is searched, not when all its
# imports are finished.
_BOOTSTRAP: Final = cast("Any", importlib)._bootstrap  # noqa: SLF001
_IMPORTS: Final = ("_find_and_load", "_lock_unlock_module")
_NUMBA_EVENTS: Final = "numba.core.event"
# Held while a kernel is compiled, or read from its file.
_COMPILER_LOCK: Final = "numba:compiler_lock"
_SAMPLE_S: Final = 0.05


class LoadingMeter:
    """Measures, while it is entered, how long this process loads modules and compiles.

    Times of several threads that load concurrently count once. A daemon thread that loads blocks
    nobody: its seconds stop no clock, only its processor time is counted.
    """

    def __init__(self) -> None:
        """Start at zero."""
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
        """Seconds so far, on the clock."""
        with self._lock:
            running_s = time.perf_counter() - self._opened_s if self._n_open else 0.0
            return self._total_s + running_s

    @property
    def processor_s(self) -> float:
        """Processor seconds so far, of all threads, without what is being loaded right now."""
        with self._lock:
            return self._processor_s

    def clock_s(self) -> float:
        """Return seconds as `time.perf_counter`, but paused while something is loaded."""
        with self._lock:
            return time.perf_counter() - self.total_s

    def begin(self) -> None:
        """Record that this thread begins to load; nested loads are part of it."""
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
        """Record that this thread has finished its outermost load."""
        own = self._own
        depth = getattr(own, "depth", 0)
        if depth == 0:
            # It began before the measurement.
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
        # Numba is not loaded for this: a method that compiles loads it.
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


class MemorySampler:
    """Samples this process's memory in a thread while a method runs.

    Attributes:
        processor_s: processor seconds of the samples so far. They grow with the clock, so a step
            that compiles for minutes would seem to compute longer.
    """

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._peak_bytes = 0
        self.processor_s = 0.0

    def __enter__(self) -> Self:
        self._note()
        self._thread = start_beside(self._sample)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self._note()

    @property
    def peak_mib(self) -> float:
        """Largest own memory."""
        return round(self._peak_bytes / MIB, 1)

    def _sample(self) -> None:
        while not self._stop.wait(_SAMPLE_S):
            self._note()
            self.processor_s = time.thread_time()

    def _note(self) -> None:
        self._peak_bytes = max(self._peak_bytes, process_memory())
