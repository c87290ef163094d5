"""Time and memory of methods, processes and the machine, and choice of a step to stop."""

from __future__ import annotations

import errno
import gc
import importlib
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any, Final, Self, cast

import psutil

from orthoflow.geometry.threads import start_beside

MIB: Final = 1 << 20
GIB: Final = 1 << 30
_CGROUPS: Final = Path("/sys/fs/cgroup")
# Version 1 expresses "unlimited" as a number near 2**63.
_UNLIMITED: Final = 1 << 60
# A process can allocate memory at about this rate; the next check must precede the limit.
_FASTEST_BYTES_PER_S: Final = 6 * GIB
_SHORTEST_S: Final = 0.01
_LONGEST_S: Final = 0.25


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


@dataclass(frozen=True, kw_only=True)
class AvailableMemory:
    """Memory that processes here can still get, and the total."""

    available: int
    total: int

    @property
    def floor(self) -> int:
        """Below this the machine fails unpredictably: 512 MiB or 3 % of the total."""
        return min(max(512 * MIB, self.total * 3 // 100), self.total // 8)


def available_memory() -> AvailableMemory:
    """Measure the machine and every control group of this process."""
    memory = psutil.virtual_memory()
    total, available = memory.total, memory.available
    for limit, used in _group_limits():
        total = min(total, limit)
        available = min(available, limit - used)
    return AvailableMemory(available=max(0, available), total=total)


def _group_limits() -> list[tuple[int, int]]:
    """Yield (limit, used) of this process's memory control groups and their parents, in bytes."""
    try:
        lines = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    found: list[tuple[int, int]] = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            found += _limits_upwards(_CGROUPS, path, _V2)
        elif "memory" in controllers.split(","):
            found += _limits_upwards(_CGROUPS / "memory", path, _V1)
    return found


_V1: Final = {
    "limit": "memory.limit_in_bytes",
    "used": "memory.usage_in_bytes",
    "cache": "total_inactive_file",
}
_V2: Final = {"limit": "memory.max", "used": "memory.current", "cache": "inactive_file"}


def _limits_upwards(root: Path, path: str, names: Mapping[str, str]) -> list[tuple[int, int]]:
    folder = root / path.lstrip("/")
    found: list[tuple[int, int]] = []
    # Inside a container the path may be the host's; the container's own group is then the root.
    for level in [folder, *folder.parents]:
        if not level.is_relative_to(root):
            break
        limit = _number(level / names["limit"])
        used = _number(level / names["used"])
        if limit is not None and used is not None and limit < _UNLIMITED:
            found.append((limit, used - _reclaimable(level, names["cache"])))
    return found


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def _reclaimable(folder: Path, name: str) -> int:
    try:
        lines = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in lines if line.split()[0] == name)


class MemoryGuard:
    """Watches the remaining memory while steps run.

    Attributes:
        interval_s: time until the next check at the latest.
    """

    def __init__(self) -> None:
        self.interval_s = _LONGEST_S

    def check(self, roots: Iterable[int]) -> tuple[int, int] | None:
        """Choose a step to stop if too little memory is left.

        Args:
            roots: root process of every running step.

        Returns:
            Root process of that step, and its memory in bytes.
        """
        memory = available_memory()
        margin = memory.available - memory.floor
        self.interval_s = min(max(margin / _FASTEST_BYTES_PER_S, _SHORTEST_S), _LONGEST_S)
        held = {root: tree_memory(root) for root in roots} if margin <= 0 else {}
        largest, n_bytes = max(held.items(), key=lambda item: item[1], default=(0, 0))
        # Another program may be the cause: stopping a small step would not help.
        return (largest, n_bytes) if held and n_bytes >= memory.floor else None


def oom_kills() -> int:
    """Return how often the kernel has killed processes for lack of memory since it started."""
    try:
        lines = Path("/proc/vmstat").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in lines if line.startswith("oom_kill "))


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
# A longer load leaves many objects; garbage collection over them takes a few hundredths of it.
_LONG_S: Final = 0.25
_SAMPLE_S: Final = 0.05


class LoadingMeter:
    """Measures, while it is entered, how long this process loads modules and compiles.

    Times of several threads that load concurrently count once. A daemon thread that loads blocks
    nobody: its seconds stop no clock, only its processor time is counted.
    """

    def __init__(self, *, sets_aside: bool = False) -> None:
        """Start at zero.

        Args:
            sets_aside: whether garbage collection ignores everything loaded so far: only for a
                process that ends with the step.
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
