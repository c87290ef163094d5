"""What the executor for a cluster makes of what dask says, without any cluster."""

from __future__ import annotations

import queue
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.engine import dask as engine_dask
from orthoflow.engine.dask import CANCEL_FILE, CORES, DaskExecutor
from orthoflow.engine.local import Capacity
from orthoflow.engine.worker import Task
from orthoflow.errors import ClusterError, PluginError
from tests.engine_tasks import bare_task

ONE = Capacity(n_tasks=1, n_cores=1, cores_of_one=1, share=1)


def a_task(folder: Path, address: str = "step") -> Task:
    (folder / address).mkdir(exist_ok=True)
    return bare_task(
        address=address,
        store=str(folder / "store"),
        folder=str(folder / address),
        log=str(folder / f"{address}.log"),
    )


class Future:
    """One that has ended so, or that raises when it is asked."""

    def __init__(self, outcome: str | Exception = "", status: str = "finished") -> None:
        self.outcome = outcome
        self.status = status
        self.is_cancelled = False

    def result(self, timeout: float) -> str:
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome

    def cancel(self) -> None:
        self.is_cancelled = True


def a_client(**more: Any) -> Any:
    workers = {
        "w1": {"nthreads": 2, "resources": {CORES: 4}},
        "idle": {"nthreads": 2, "resources": {}},
    }
    plain: dict[str, Any] = {
        "status": "running",
        "cluster": None,
        "scheduler_info": lambda n_workers: {"workers": workers if n_workers == -1 else {}},
    }
    return SimpleNamespace(**(plain | more))


def an_executor(folder: Path, *futures: Future, **more: Any) -> Any:
    """An executor with tasks under way that are called `0`, `1` and so on."""
    executor: Any = object.__new__(DaskExecutor)
    plain: dict[str, Any] = {
        "_retries": 2,
        "_address": "tcp://x:1",
        "_methods": "{}",
        "_running": {str(n): (a_task(folder, str(n)), future) for n, future in enumerate(futures)},
        "_messages": queue.SimpleQueue(),
        "_stop_at": None,
        "_capacity": ONE,
        "_looked": time.monotonic(),
        "_with_workers": time.monotonic(),
        "_client": a_client(),
    }
    executor.told = []
    executor._listen = lambda address, event: executor.told.append((address, event))
    for name, value in (plain | more).items():
        setattr(executor, name, value)
    return executor


def test_tasks_that_do_not_stop_are_given_up(tmp_path: Path) -> None:
    futures = Future(), Future()
    executor = an_executor(tmp_path, *futures)
    executor.cancel()
    assert all((tmp_path / name / CANCEL_FILE).exists() for name in "01")
    assert 15.0 < executor._stop_at - time.monotonic() <= 20.0
    assert executor.poll(0.0) == {}
    executor._stop_at = time.monotonic() - 0.01
    ends = executor.poll(0.0)
    assert [(address, end.error_message) for address, end in ends.items()] == [
        *(("0", "step 0 was interrupted"), ("1", "step 1 was interrupted")),
    ]
    assert executor._running == {}
    assert all(future.is_cancelled for future in futures)


@pytest.mark.parametrize(
    ("status", "n_running", "alone_s", "is_lost"),
    [
        ("running", 1, 54.0, False),
        ("running", 1, 66.0, True),
        ("running", 0, 66.0, False),
        # It looks for a scheduler that it has lost.
        ("connecting", 1, 66.0, True),
    ],
)
def test_without_workers_a_run_waits_a_minute(
    tmp_path: Path, status: str, n_running: int, alone_s: float, is_lost: bool
) -> None:
    def nobody(n_workers: int) -> dict[str, Any]:
        raise OSError("no answer")

    now = time.monotonic()
    client = a_client(status=status)
    if status == "running":
        client.scheduler_info = nobody
    executor = an_executor(
        tmp_path,
        *[Future()] * n_running,
        _client=client,
        _looked=now - 3.0,
        _with_workers=now - alone_s,
    )
    if is_lost:
        with pytest.raises(ClusterError):
            executor._watch()
    else:
        executor._watch()


@pytest.mark.parametrize("is_able", [True, False])
def test_workers_are_looked_at_before_they_get_a_task(tmp_path: Path, *, is_able: bool) -> None:
    asked: list[Any] = []

    def look(function: object, path: str, methods: str, **more: Any) -> dict[str, Any]:
        asked.append((function, methods, more["workers"]))
        return {"w1": (Path(path).read_text(), "") if is_able else ImportError("no orthoflow")}

    executor = an_executor(tmp_path, _client=a_client(run=look))
    if is_able:
        executor._look_at_workers(tmp_path)
    else:
        with pytest.raises(PluginError, match=r"cannot run orthoflow .ImportError: no ortho"):
            executor._look_at_workers(tmp_path)
    assert asked == [(engine_dask.look_around, "{}", ["w1"])]
