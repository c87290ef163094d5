"""What a worker of dask does with a task: the same guarded child process as on one machine.

An attempt has a folder of its own in that of the task, on the shared file system. A worker that was
given up, because the network to it is cut, say, may still write into its own; and the number of
folders tells how often the task was tried.
"""

from __future__ import annotations

import time
import uuid
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from distributed import Worker, get_worker
from distributed.worker import WORKER_ANY_RUNNING

from orthoflow.engine.durability import writing_to
from orthoflow.engine.environment import environment
from orthoflow.engine.local import Capacity, LocalExecutor
from orthoflow.engine.method_versions import misfit
from orthoflow.engine.results import CellResult, result_to_json
from orthoflow.engine.worker import Task, failed_result
from orthoflow.errors import PluginError, StepFailedError
from orthoflow.sdk.context import StepEvent

# In the folder of a task: who finds it stops.
CANCEL_FILE: Final = "cancel"
_ATTEMPT: Final = "attempt-"
_POLL_S: Final = 0.1
_LOOK_S: Final = 1.0


@dataclass(frozen=True, kw_only=True)
class Order:
    """What a worker is told besides the task itself.

    Attributes:
        task: what to run.
        name: what the scheduler calls it.
        topic: where to say how it goes.
        retries: so often it may be tried again after its worker was lost.
        methods: what the plan says of its methods, see `methods_text`; empty for a worker in the
            process that made the plan.
    """

    task: Task
    name: str
    topic: str
    retries: int
    methods: str


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """What a worker finds where it is.

    Attributes:
        seen: content of the file that it was asked to read, or why it cannot.
        clock_s: its time, seconds since 1970.
        misfit: in what its methods or libraries are others; empty when they are the same.
    """

    seen: str
    clock_s: float
    misfit: str


def look_around(path: str, methods: str) -> Surroundings:
    """Say what a worker sees: runs on each before it gets a task."""
    try:
        seen = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        seen = error.strerror or "it cannot be read"
    return Surroundings(seen=seen, clock_s=time.time(), misfit=misfit(methods))


def run_attempt(order: Order) -> str:
    """Run a task in a child process of this worker; give its result as JSON."""
    worker = get_worker()
    task = order.task
    home = Path(task.folder)
    n_before = sum(1 for _ in home.glob(f"{_ATTEMPT}*"))
    folder = home / f"{_ATTEMPT}{uuid.uuid4().hex[:12]}"
    with writing_to(home):
        folder.mkdir()
    own = replace(
        task, folder=str(folder), log=str(folder / "log"), environment=environment(task.cores)
    )
    if n_before > order.retries:
        return _refused(own, StepFailedError(describe_loss(task.who, n_before)))
    if wrong := order.methods and misfit(order.methods):
        return _refused(own, PluginError(f"{task.who} cannot run on {worker.address}: {wrong}"))

    def tell(_: str, event: StepEvent) -> None:
        worker.log_event(order.topic, {"address": task.address, **asdict(event)})

    executor = LocalExecutor(Capacity.of_jobs(1, task.cores), tell)
    with closing(executor):
        executor.start(own)
        return result_to_json(_result(executor, home, worker, order.name))


def describe_loss(who: str, times: int) -> str:
    """Say that a task was given up because workers were lost under it."""
    lost = "its worker was lost" if times == 1 else f"its workers were lost, {times} in a row"
    return f"{who} was given up: {lost}; the logs of the workers may say why"


def _result(executor: LocalExecutor, home: Path, worker: Worker, name: str) -> CellResult:
    next_look_s, is_stopping = 0.0, False
    while True:
        for end in executor.poll(_POLL_S):
            return end.result
        if is_stopping or time.monotonic() < next_look_s:
            continue
        next_look_s = time.monotonic() + _LOOK_S
        if (home / CANCEL_FILE).exists() or _is_given_up(worker, name):
            is_stopping = True
            executor.cancel()


def _is_given_up(worker: Worker, name: str) -> bool:
    """Whether nobody waits for a task any more: its run has ended, or gave it to another worker."""
    state = worker.state.tasks.get(name)
    is_closing = worker.status not in WORKER_ANY_RUNNING
    return is_closing or state is None or state.state == "cancelled"


def _refused(task: Task, error: StepFailedError | PluginError) -> str:
    return result_to_json(failed_result(task, error))
