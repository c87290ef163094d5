"""What the executor for a cluster makes of what dask says, without any cluster."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from distributed import KilledWorker

from orthoflow.engine import dask as engine_dask
from orthoflow.engine.dask import CANCEL_FILE, CORES, DaskExecutor, Surroundings
from orthoflow.engine.local import Capacity, TaskEnd
from orthoflow.engine.results import CellResult, result_to_json
from orthoflow.engine.worker import Task
from orthoflow.errors import ArgumentError, CancelledStepError, ClusterError, PluginError
from orthoflow.sdk.context import StepEvent
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
        "_running": {
            str(n): engine_dask._Running(task=a_task(folder, str(n)), future=future)  # type: ignore[arg-type]
            for n, future in enumerate(futures)
        },
        "_news": queue.SimpleQueue(),
        "_stop_at": None,
        "_capacity": ONE,
        "_looked": time.monotonic(),
        "_with_workers": time.monotonic(),
        "_client": a_client(),
    }
    executor.told = []
    executor._tell = lambda address, event: executor.told.append((address, event))
    for name, value in (plain | more).items():
        setattr(executor, name, value)
    return executor


GOOD = CellResult(status="ok", key="k", method="work.add", run_id="r1", log="said\n")


def test_what_ended_is_given_with_its_log_and_what_runs_is_told(tmp_path: Path) -> None:
    executor = an_executor(tmp_path, Future(result_to_json(GOOD)), Future())
    said = StepEvent(kind="progress", text="half", fraction=0.5)
    for news in (("1", said), ("gone", said), ("0", None), ("gone", None)):
        executor._news.put(news)
    assert executor.poll(0.01) == (TaskEnd(address="0", result=GOOD),)
    assert executor.told == [("1", said)]
    assert list(executor._running) == ["1"]
    assert (tmp_path / "0.log").read_text() == "said\n"
    assert executor.poll(0.01) == ()


@pytest.mark.parametrize(
    ("outcome", "kind", "said"),
    [
        # Two retries: three workers were lost.
        (KilledWorker("k", None, 2), "StepFailedError", "its workers were lost, 3 in a row"),
        (PluginError("no library"), "PluginError", "no library"),
        (ZeroDivisionError("by\nzero"), "StepFailedError", "its worker (ZeroDivisionError: by ze"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_befell_a_worker_fails_its_step(
    tmp_path: Path, outcome: Exception, kind: str, said: str
) -> None:
    executor = an_executor(tmp_path, Future(outcome))
    executor._news.put(("0", None))
    (end,) = executor.poll(0.01)
    assert (end.result.status, end.result.error_type) == ("failed", kind)
    assert said in end.result.error_message


@pytest.mark.parametrize("status", ["cancelled", "lost"])
def test_a_task_that_nobody_knows_any_more_was_stopped_or_the_cluster_is_gone(
    tmp_path: Path, status: str
) -> None:
    executor = an_executor(tmp_path, Future(status=status))
    executor._news.put(("0", None))
    with pytest.raises(ClusterError, match=r"all workers of tcp://x:1 are gone; what is finished"):
        executor.poll(0.01)
    executor = an_executor(tmp_path, Future(status=status), _stop_at=time.monotonic() + 60)
    executor._news.put(("0", None))
    (end,) = executor.poll(0.01)
    assert end.result.error_message == "step 0 was interrupted"
    assert end.result.exit_code == CancelledStepError.exit_code
    executor = an_executor(tmp_path, Future(TimeoutError()), _address="")
    executor._news.put(("0", None))
    with pytest.raises(ClusterError, match="all workers of this run are gone"):
        executor.poll(0.01)


def test_tasks_that_do_not_stop_are_given_up(tmp_path: Path) -> None:
    futures = Future(), Future()
    executor = an_executor(tmp_path, *futures)
    executor.cancel()
    assert all((tmp_path / name / CANCEL_FILE).exists() for name in "01")
    assert 15.0 < executor._stop_at - time.monotonic() <= 20.0
    assert executor.poll(0.0) == ()
    executor._stop_at = time.monotonic() - 0.01
    ends = executor.poll(0.0)
    assert [(end.address, end.result.error_message) for end in ends] == [
        *(("0", "step 0 was interrupted"), ("1", "step 1 was interrupted")),
    ]
    assert executor._running == {}
    assert all(future.is_cancelled for future in futures)


def test_an_executor_lets_go_of_all_when_it_is_closed(tmp_path: Path) -> None:
    def closer(who: str) -> Callable[..., None]:
        return lambda timeout: closed.append(who)

    closed: list[str] = []
    future = Future()
    cluster = SimpleNamespace(close=closer("cluster"))
    executor = an_executor(
        tmp_path, future, _client=a_client(cluster=cluster, close=closer("client"))
    )
    executor.close()
    assert (closed, future.is_cancelled) == (["client", "cluster"], True)
    closed.clear()
    an_executor(tmp_path, _client=a_client(close=closer("client"))).close()
    assert closed == ["client"]


def test_who_is_there_is_looked_up_every_two_seconds(tmp_path: Path) -> None:
    long_ago = time.monotonic() - 2.1
    executor = an_executor(tmp_path)
    executor._watch()
    assert executor.capacity == ONE
    executor = an_executor(tmp_path, _looked=long_ago, _with_workers=0.0)
    executor._watch()
    # Of those that say how many cores they have.
    assert executor.capacity == Capacity(n_tasks=1, n_cores=4, cores_of_one=4, share=4)
    assert executor._with_workers > long_ago
    # Workers of its own share the cores of this machine.
    executor = an_executor(tmp_path, _looked=long_ago, _address="")
    executor._watch()
    assert executor.capacity == ONE
    executor = an_executor(tmp_path, _looked=long_ago, _client=a_client(status="closed"))
    with pytest.raises(ClusterError, match="the scheduler or all workers of tcp://x:1 are gone"):
        executor._watch()


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


def test_what_a_worker_says_is_heard_where_it_is_an_event(tmp_path: Path) -> None:
    executor = an_executor(tmp_path, Future())
    good = {"address": "0", "kind": "progress", "text": "half", "fraction": "0.5"}
    for said in (good, {"address": "0"}, "nonsense", None):
        executor._hear((0.0, said))
    executor.poll(0.01)
    assert executor.told == [("0", StepEvent(kind="progress", text="half", fraction=0.5))]


@pytest.mark.parametrize(
    ("said", "error", "told"),
    [
        ({}, None, ""),
        ({"seen": "No such file"}, ArgumentError, "does not see the store .*No such file"),
        ({"clock_s": 61.0}, ArgumentError, r"is \+6[01] s off this one: set both"),
        ({"clock_s": -61.0}, ArgumentError, r"is -6[12] s off this one: set both"),
        ({"clock_s": 58.0}, None, ""),
        ({"misfit": "numpy is older"}, PluginError, "w1: numpy is older; install there what the"),
        (ImportError("no orthoflow"), PluginError, "cannot run orthoflow .ImportError: no ortho"),
    ],
)
def test_workers_are_looked_at_before_they_get_a_task(
    tmp_path: Path, said: dict[str, Any] | Exception, error: type[Exception] | None, told: str
) -> None:
    asked: list[Any] = []

    def look(function: object, path: str, methods: str, **more: Any) -> dict[str, Any]:
        asked.append((function, methods, more["workers"]))
        if isinstance(said, Exception):
            return {"w1": said}
        seen = said.get("seen", Path(path).read_text())
        clock_s = time.time() + said.get("clock_s", 0.0)
        return {"w1": Surroundings(seen=seen, clock_s=clock_s, misfit=said.get("misfit", ""))}

    executor = an_executor(tmp_path, _client=a_client(run=look))
    if error is None:
        executor._look_at_workers(tmp_path)
    else:
        with pytest.raises(error, match=told):
            executor._look_at_workers(tmp_path)
    assert asked == [(engine_dask.look_around, "{}", ["w1"])]


# A worker -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("times", "said"),
    [(1, "its worker was lost;"), (3, "its workers were lost, 3 in a row; the logs of the work")],
)
def test_a_loss_is_told_with_how_often_it_happened(times: int, said: str) -> None:
    told = engine_dask.describe_loss("method work.add", times)
    assert told.startswith("method work.add was given up: ")
    assert said in told


@pytest.mark.parametrize(
    ("status", "state", "is_given_up"),
    [
        ("running", "executing", False),
        ("running", "cancelled", True),
        ("running", None, True),
        ("closing", "executing", True),
    ],
)
def test_a_task_is_given_up_where_nobody_waits_for_it(
    status: str, state: str | None, is_given_up: bool
) -> None:
    from distributed.core import Status

    tasks = {} if state is None else {"name": SimpleNamespace(state=state)}
    worker: Any = SimpleNamespace(status=Status[status], state=SimpleNamespace(tasks=tasks))
    assert engine_dask._is_given_up(worker, "name") is is_given_up


@pytest.mark.parametrize("why", ["asked", "given up"])
def test_a_worker_stops_its_task_once_and_waits_for_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    done: list[str] = []

    def poll(_timeout_s: float) -> tuple[TaskEnd, ...]:
        done.append("poll")
        return (TaskEnd(address="step", result=GOOD),) if len(done) > 5 else ()

    if why == "asked":
        (tmp_path / CANCEL_FILE).touch()
    monkeypatch.setattr(engine_dask, "_is_given_up", lambda *_: why == "given up")
    monkeypatch.setattr(engine_dask, "_LOOK_S", 0.0)
    executor: Any = SimpleNamespace(poll=poll, cancel=lambda: done.append("cancel"))
    nobody: Any = None
    assert engine_dask._result(executor, tmp_path, nobody, "name") == GOOD
    assert done == ["poll", "cancel", "poll", "poll", "poll", "poll"]
