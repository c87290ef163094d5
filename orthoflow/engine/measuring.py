"""Time and memory of a method: what loading and compiling take is kept apart from all other.

It says something of the disk and of what ran before, and nothing of a method: a kernel that was
compiled once is read from a file ever after. So `compile_s` is measured here, and a clock that
stands still meanwhile measures the rest. What was loaded also makes each search for garbage longer
that a method's own objects set off, by a tenth of a second for numba and matplotlib: a step that
has a process of its own sets it aside.
"""

from __future__ import annotations

import gc
import importlib
import sys
import threading
import time
from collections.abc import Callable
from functools import wraps
from typing import Any, Final, Self, cast

from orthoflow.engine.memory import MIB, process_memory
from orthoflow.geometry.threads import start_beside

# Every import goes through these, where a module is not there yet and where another thread still
# loads it. Private, but finders and loaders only hear when a module is looked for, not when all
# that it imports is there.
_BOOTSTRAP: Final = cast("Any", importlib)._bootstrap  # noqa: SLF001
_IMPORTS: Final = ("_find_and_load", "_lock_unlock_module")
_NUMBA_EVENTS: Final = "numba.core.event"
# Held while a kernel is compiled, or read from its file.
_COMPILER_LOCK: Final = "numba:compiler_lock"
# A load as long as this leaves objects in number; to look for garbage among them takes a few
# hundredths of it.
_LONG_S: Final = 0.25
_SAMPLE_S: Final = 0.05


class LoadingMeter:
    """Measures, while it is entered, how long this process loads modules and compiles.

    Times of several threads that load at once count once. A daemon thread that loads keeps nobody
    waiting: its seconds stop no clock, only its processor time is known.
    """

    def __init__(self, *, sets_aside: bool = False) -> None:
        """Begin at nought.

        Args:
            sets_aside: whether no search for garbage looks again at what was loaded, nor at
                anything else that is there by then: only for a process that ends with the step.
        """
        self._sets_aside = sets_aside
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
        """Give seconds as `time.perf_counter`, but stand still while something is loaded."""
        with self._lock:
            return time.perf_counter() - self.total_s

    def begin(self) -> None:
        """Hear that this thread begins to load; what it loads for that is part of it."""
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
        """Hear that this thread has loaded what it began with."""
        own = self._own
        depth = getattr(own, "depth", 0)
        if depth == 0:
            # It began before anybody listened.
            return
        own.depth = depth - 1
        if own.depth:
            return
        if self._sets_aside and time.thread_time() - own.processor_s > _LONG_S:
            if not threading.current_thread().daemon:
                gc.collect()
            gc.freeze()
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
        processor_s: processor seconds that the samples took so far. They grow with the clock, so a
            step that compiles for minutes would seem to compute longer.
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
