"""Sharing work over threads: everything once, in order, with as many at once as were asked for."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import threading
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoflow.geometry import threads
from orthoflow.geometry.threads import (
    address_space,
    even_parts,
    in_order,
    in_runs,
    in_threads,
    start_beside,
    usable_cores,
)

WAIT_S = 20.0


@pytest.mark.parametrize(("threads", "n_tasks"), [(None, 4), (4, 4), (3, 6)])
def test_as_many_tasks_run_at_once_as_there_are_threads(threads: int | None, n_tasks: int) -> None:
    # Each party waits for the others: fewer at once would break the barrier.
    together = threading.Barrier(n_tasks if threads is None else threads)
    in_threads([lambda: together.wait(WAIT_S) and None] * n_tasks, threads=threads)
    assert not together.broken


def test_what_a_task_raises_reaches_the_caller_after_the_others_ended() -> None:
    done: list[int] = []

    def fail() -> None:
        raise ValueError("the third wall is missing")

    for others in ([], [partial(done.append, index) for index in range(4)]):
        with pytest.raises(ValueError, match="the third wall is missing"):
            in_threads([fail, *others], threads=2)
    assert sorted(done) == [0, 1, 2, 3]


@pytest.mark.parametrize("threads", [0, 1, 4])
def test_results_come_in_the_order_of_the_items(threads: int) -> None:
    first_may_end = threading.Event()

    def square(item: int) -> int:
        if threads > 1 and item == 0:
            first_may_end.wait(WAIT_S)
        first_may_end.set()
        return item * item

    assert list(in_order(square, range(9), threads=threads)) == [n * n for n in range(9)]


@given(
    n_items=st.integers(0, 500), n_parts=st.integers(1, 40), multiple=st.sampled_from([1, 2, 7, 64])
)
def test_parts_are_even_and_make_up_the_range(n_items: int, n_parts: int, multiple: int) -> None:
    parts = even_parts(n_items, n_parts, multiple=multiple)
    assert len(parts) == n_parts
    assert [item for part in parts for item in range(n_items)[part]] == list(range(n_items))
    filled = [part for part in parts if part.stop > part.start]
    assert all(part.start % multiple == 0 for part in filled)
    # In whole multiples no part has more than one above another.
    units = [-(-(part.stop - part.start) // multiple) for part in parts]
    assert max(units) - min(units) <= 1


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize(
    ("n_items", "runs"),
    [(0, []), (1, [(0, 1)]), (4, [(0, 4)]), (5, [(0, 4), (4, 5)]), (8, [(0, 4), (4, 8)])],
)
def test_runs_have_one_length_but_for_the_last(
    n_items: int, runs: list[tuple[int, int]], threads: int
) -> None:
    seen: list[tuple[int, int]] = []
    in_runs(lambda *run: seen.append(run), n_items, n_per_run=4, threads=threads)
    assert sorted(seen) == runs


def test_no_thread_is_started_with_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """CPython waits without end for a thread that finds no memory at its beginning."""

    def refuse(*_: object) -> None:
        raise AssertionError("a thread was started")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    monkeypatch.setattr(threads, "address_space", lambda: 250 << 20)
    done: list[int] = []
    in_threads([partial(done.append, index) for index in range(4)])
    assert done == [0, 1, 2, 3]
    assert list(in_order(abs, [-2, 1, -3])) == [2, 1, 3]
    assert start_beside(done.clear) is None
    monkeypatch.setattr(threads, "address_space", lambda: 8 << 30)
    with pytest.raises(AssertionError, match="a thread was started"):
        start_beside(done.clear)


def test_processors_and_memory_are_those_that_the_process_may_use() -> None:
    usable = sorted(os.sched_getaffinity(0))
    limit = resource.getrlimit(resource.RLIMIT_AS)
    program = "from orthoflow.geometry.threads import *; print(usable_cores(), address_space())"

    def restrict() -> None:
        os.sched_setaffinity(0, usable[:1])
        resource.setrlimit(resource.RLIMIT_AS, (3 << 30, limit[1]))

    command = [sys.executable, "-c", program]
    said = subprocess.check_output(command, preexec_fn=restrict, text=True)
    assert said.split() == ["1", str(3 << 30)]
    assert usable_cores() == len(usable)
    assert address_space() == (None if limit[0] == resource.RLIM_INFINITY else limit[0])
