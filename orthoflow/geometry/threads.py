"""Division of work among threads.

Results are identical for any number of threads, because either the division into parts does not
depend on this number, or it does not affect the result. Compiled kernels release the GIL.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Thread
from typing import Final, TypeVar

_ROOM_FOR_THREADS: Final = 2 << 30
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def usable_cores() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def address_space() -> int | None:
    """Return the limit of the address space in bytes (`ulimit -v`); None if unlimited."""
    import resource  # noqa: PLC0415 - only of Unix, where steps run

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def has_room_for_threads() -> bool:
    """Return whether memory suffices for threads; otherwise, starting one would block forever."""
    limit = address_space()
    return limit is None or limit >= _ROOM_FOR_THREADS


def start_beside(work: Callable[[], object]) -> Thread | None:
    """Start a task in a thread; return None if the thread cannot be started."""
    if not has_room_for_threads():
        return None
    thread = Thread(target=work, daemon=True)
    thread.start()
    return thread


def in_threads(tasks: Sequence[Callable[[], None]], *, threads: int | None = None) -> None:
    """Run tasks in threads.

    Args:
        tasks: functions to run.
        threads: maximum number of tasks that run at the same time; None for no limit.
    """
    if len(tasks) == 1 or not has_room_for_threads():
        for task in tasks:
            task()
        return
    with ThreadPoolExecutor(len(tasks) if threads is None else max(1, threads)) as pool:
        for future in [pool.submit(task) for task in tasks]:
            future.result()


def in_order(
    function: Callable[[_Item], _Result], items: Iterable[_Item], *, threads: int | None = None
) -> Iterator[_Result]:
    """Yield the results of a function in order, computed in threads (None: one per processor)."""
    if not has_room_for_threads():
        yield from map(function, items)
        return
    with ThreadPoolExecutor(os.cpu_count() if threads is None else max(1, threads)) as pool:
        yield from pool.map(function, items)


def even_parts(n_items: int, n_parts: int, *, multiple: int = 1) -> list[slice]:
    """Divide a range into parts of similar length; parts may be empty.

    Args:
        n_items: length of the range.
        n_parts: number of parts.
        multiple: each part begins at a multiple of this number.
    """
    n_units = -(-n_items // multiple)
    edges = [part * n_units // n_parts * multiple for part in range(n_parts)] + [n_items]
    return [slice(first, end) for first, end in itertools.pairwise(edges)]


def in_parts(work: Callable[[int, int], None], n_items: int, *, threads: int) -> None:
    """Divide a range into one part per thread, and call `work(first, end)` for each part."""
    parts = even_parts(n_items, threads)
    in_threads([partial(work, part.start, part.stop) for part in parts])


def in_runs(
    work: Callable[[int, int], None], n_items: int, *, n_per_run: int, threads: int
) -> None:
    """Divide a range into parts of equal length, and call `work(first, end)` for each part."""
    starts = range(0, n_items, n_per_run)
    in_threads(
        [partial(work, first, min(n_items, first + n_per_run)) for first in starts],
        threads=threads,
    )
