"""The executor for clusters, which runs tasks on Dask workers that can access the store.

A worker runs each task in a child process, as on a single machine. Products go to the store; Dask
transfers only the task and its result. Each attempt at a task has its own folder inside the folder
of the task, because a worker that was given up may still write to the folder of its attempt. The
attempts are counted by these folders. Without a scheduler address, the executor starts its own
workers as threads of this process.
"""

from __future__ import annotations

import logging
import queue
import time
import uuid
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, Worker, get_worker
from distributed.worker import WORKER_ANY_RUNNING

from orthoflow.engine.durability import write_whole, writing_to
from orthoflow.engine.environment import environment
from orthoflow.engine.keys import methods_text, misfit
from orthoflow.engine.local import EVENTS, Capacity, LocalExecutor, StepListener
from orthoflow.engine.results import CellResult, result_from_json, result_to_json
from orthoflow.engine.worker import Task, failed_result
from orthoflow.errors import (
    ArgumentError,
    CancelledStepError,
    ClusterError,
    OrthoflowError,
    PluginError,
    StepFailedError,
)
from orthoflow.sdk.context import StepEvent
from orthoflow.sdk.lines import one_line

if TYPE_CHECKING:
    from orthoflow.engine.plan import RunPlan


_ATTEMPT: Final = "attempt-"
_POLL_S: Final = 0.1
_LOOK_S: Final = 1.0


def look_around(path: str, methods: str) -> tuple[str, str]:
    """Check the environment of a worker; called on each worker before it gets a task.

    Returns:
        Two strings: the content of the file at `path`, or the reason why it cannot be read; and the
        first difference between the worker's methods and `methods`, which is empty if they agree.
    """
    try:
        seen = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        seen = error.strerror or "it cannot be read"
    return seen, misfit(methods)


def run_attempt(task: Task, name: str, topic: str, retries: int, methods: str) -> str:
    """Run a task in a child process of this worker, and return the result as JSON.

    Args:
        task: what to run.
        name: name of the task in the scheduler.
        topic: topic for progress messages.
        retries: how many times the task is repeated, at most, if its worker is lost.
        methods: methods of the plan (see `methods_text`); empty if the worker runs in the process
            that made the plan.
    """
    worker = get_worker()
    home = Path(task.folder)
    n_before = sum(1 for _ in home.glob(f"{_ATTEMPT}*"))
    folder = home / f"{_ATTEMPT}{uuid.uuid4().hex[:12]}"
    with writing_to(home):
        folder.mkdir()
    own = replace(
        task, folder=str(folder), log=str(folder / "log"), environment=environment(task.cores)
    )
    if n_before > retries:
        return _refused(own, StepFailedError(describe_loss(task.who, n_before)))
    if wrong := methods and misfit(methods):
        return _refused(own, PluginError(f"{task.who} cannot run on {worker.address}: {wrong}"))

    def forward(_: str, event: StepEvent) -> None:
        worker.log_event(topic, (task.address, EVENTS.dump_json(event)))

    executor = LocalExecutor(Capacity.of_jobs(1, task.cores), forward)
    with closing(executor):
        executor.start(own)
        return result_to_json(_result(executor, worker, name))


def describe_loss(who: str, times: int) -> str:
    """Return the error message for a task that was abandoned because workers were lost."""
    lost = "its worker was lost" if times == 1 else f"its workers were lost {times} times in a row"
    return f"{who} failed because {lost}; see the logs of the workers"


def _result(executor: LocalExecutor, worker: Worker, name: str) -> CellResult:
    next_look_s, is_stopping = 0.0, False
    while True:
        for result in executor.poll(_POLL_S).values():
            return result
        if is_stopping or time.monotonic() < next_look_s:
            continue
        next_look_s = time.monotonic() + _LOOK_S
        if _is_given_up(worker, name):
            is_stopping = True
            executor.cancel()


def _is_given_up(worker: Worker, name: str) -> bool:
    state = worker.state.tasks.get(name)
    is_closing = worker.status not in WORKER_ANY_RUNNING
    return is_closing or state is None or state.state == "cancelled"


def _refused(task: Task, error: StepFailedError | PluginError) -> str:
    return result_to_json(failed_result(task, error))


# Name of the Dask resource by which workers report their number of cores.
CORES: Final = "cores"
_PROOF_FILE: Final = "workers-see-this"
CONNECT_S: Final = 15.0
# How long to wait for the first worker, for a lost scheduler, and for a new worker after all
# workers are lost.
PATIENCE_S: Final = 60.0
_WATCH_S: Final = 2.0
_CLOSE_S: Final = 5.0
# Reduce polling: by default, each worker profiles its thread 100 times a second and checks its
# event loop 50 times a second.
_QUIET: Final = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "5s",
}


class DaskExecutor:
    """Runs tasks on the workers of a cluster, or on its own workers."""

    def __init__(
        self, plan: RunPlan, scratch: Path, capacity: Capacity, listen: StepListener
    ) -> None:
        """Connect to the scheduler, and check that all workers can execute the plan.

        Args:
            plan: the plan; its options contain the scheduler address.
            scratch: folder of the run in the store.
            capacity: limits of the workers that the executor starts if no scheduler is given.
            listen: called with the address of a task and its message.

        Raises:
            ArgumentError: there is no scheduler at the address, the scheduler has no workers, or a
                worker cannot access the store.
            PluginError: orthoflow is missing on a worker, or methods or libraries on a worker have
                other versions.
        """
        self._listen = listen
        self._retries = plan.options.retries
        self._address = plan.options.scheduler
        # The executor's own workers run in this process, so their methods need no check.
        self._methods = methods_text(plan.methods) if self._address else ""
        self._running: dict[str, tuple[Task, Future[str]]] = {}
        self._messages: queue.SimpleQueue[tuple[str, StepEvent | None]] = queue.SimpleQueue()
        self._topic = f"orthoflow-{uuid.uuid4().hex}"
        self._is_cancelled = False
        self._capacity = capacity
        self._looked = self._with_workers = time.monotonic()
        self._client = _client(self._address, capacity)
        try:
            self._client.subscribe_topic(self._topic, self._receive)
            if self._address:
                self._wait_for_workers()
                self._look_at_workers(scratch)
        except BaseException:
            self.close()
            raise

    @property
    def capacity(self) -> Capacity:
        """Return how many tasks the current workers can run at the same time."""
        return self._capacity

    def start(self, task: Task) -> None:
        """Submit a task to the scheduler.

        Raises:
            StoreError: the files of the task cannot be written.
        """
        with writing_to(Path(task.folder).parent):
            Path(task.folder).mkdir(parents=True, exist_ok=True)
        name = f"{task.address}-{uuid.uuid4().hex[:12]}"
        future = self._client.submit(
            run_attempt,
            *(task, name, self._topic, self._retries, self._methods),
            key=name,
            pure=False,
            retries=0,
            resources={CORES: task.cores},
        )
        self._running[task.address] = (task, future)
        future.add_done_callback(
            lambda _, address=task.address: self._messages.put((address, None))
        )

    def poll(self, timeout_s: float) -> dict[str, CellResult]:
        """Wait for tasks to end, up to a time limit; forward messages of running tasks.

        Raises:
            ClusterError: the scheduler or all workers are lost.
        """
        ended: list[str] = []
        with suppress(queue.Empty):
            while True:
                address, event = self._messages.get(timeout=timeout_s)
                timeout_s = 0.0
                if event is None:
                    ended.append(address)
                elif address in self._running:
                    self._listen(address, event)
        ends = {address: self._end(address) for address in ended if address in self._running}
        self._watch()
        return ends

    def cancel(self) -> None:
        """Cancel all tasks; the workers notice this within a second and stop the processes."""
        self._is_cancelled = True
        for _, future in self._running.values():
            with suppress(Exception):
                future.cancel()

    def close(self) -> None:
        """Release all tasks that are still running; the workers then stop them."""
        self.cancel()
        cluster = self._client.cluster
        # Dask may raise errors about lost connections, which are expected here.
        with suppress(Exception):
            self._client.close(timeout=_CLOSE_S)
        if cluster is not None:
            with suppress(Exception):
                cluster.close(timeout=_CLOSE_S)

    def _end(self, address: str) -> CellResult:
        task, future = self._running[address]
        result = self._result(task, future)
        del self._running[address]
        write_whole(Path(task.log), result.log.encode())
        return result

    def _result(self, task: Task, future: Future[str]) -> CellResult:
        if future.status in ("cancelled", "lost"):
            if self._is_cancelled:
                interrupted = CancelledStepError(f"step {task.address} was interrupted")
                return failed_result(task, interrupted)
            raise self._lost()
        try:
            return result_from_json(future.result(timeout=PATIENCE_S), f"result of {task.address}")
        except KilledWorker:
            return failed_result(task, StepFailedError(describe_loss(task.who, self._retries + 1)))
        except OrthoflowError as error:
            return failed_result(task, error)
        except TimeoutError as error:
            raise self._lost() from error
        except Exception as error:  # noqa: BLE001 - any error of the worker
            reason = f"{type(error).__name__}: {one_line(error)}"
            return failed_result(
                task, StepFailedError(f"{task.who} could not be run on its worker ({reason})")
            )

    def _receive(self, event: tuple[float, Any]) -> None:
        with suppress(TypeError, ValueError):
            address, text = event[1]
            self._messages.put((str(address), EVENTS.validate_json(text, strict=True)))

    def _watch(self) -> None:
        now = time.monotonic()
        if now - self._looked < _WATCH_S:
            return
        self._looked = now
        if self._client.status == "closed":
            raise self._lost()
        workers = self._workers() if self._client.status == "running" else {}
        if workers:
            self._with_workers = now
            # The executor's own workers share the cores of this machine, so its capacity does not
            # depend on their number.
            self._capacity = _capacity(workers) if self._address else self._capacity
        elif self._running and now - self._with_workers > PATIENCE_S:
            raise self._lost()

    def _lost(self) -> ClusterError:
        who = f"of {self._address}" if self._address else "of this run"
        return ClusterError(
            f"the scheduler or all workers {who} were lost; finished steps are kept: repeat the "
            "command with the same -o and any executor to continue"
        )

    def _workers(self) -> Mapping[str, Any]:
        try:
            known = self._client.scheduler_info(n_workers=-1)["workers"]
        except Exception:  # noqa: BLE001 - any error means no answer
            return {}
        return {address: facts for address, facts in known.items() if facts["resources"].get(CORES)}

    def _wait_for_workers(self) -> None:
        while not (workers := self._workers()):
            if time.monotonic() - self._with_workers > PATIENCE_S:
                raise ArgumentError(
                    f"--scheduler {self._address}: no worker there reports its number of cores; "
                    f"start workers with `dask worker {self._address} --resources {CORES}=N`"
                )
            time.sleep(0.1)
        self._capacity = _capacity(workers)

    def _look_at_workers(self, scratch: Path) -> None:
        path, word = scratch / _PROOF_FILE, uuid.uuid4().hex
        write_whole(path, word.encode())
        found: Mapping[str, tuple[str, str] | Exception] = self._client.run(
            look_around, str(path), self._methods, workers=list(self._workers()), on_error="return"
        )
        for address, answer in found.items():
            if isinstance(answer, Exception):
                raise PluginError(
                    f"worker {address} cannot run orthoflow ({type(answer).__name__}: "
                    f"{one_line(answer)}); install the same version as on this machine"
                )
            seen, wrong = answer
            if seen != word:
                raise ArgumentError(
                    f"worker {address} cannot access the store {scratch.parent.parent} "
                    f"({one_line(seen)}): choose a --store on a file system that all workers have "
                    "mounted at the same path"
                )
            if wrong:
                raise PluginError(
                    f"worker {address}: {wrong}; install the version used for the plan"
                )


def _client(address: str, capacity: Capacity) -> Client:
    # Dask logs a traceback for each lost worker, but the executor reports lost workers itself.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    if address:
        try:
            return Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ArgumentError(
                f"--scheduler {address}: no Dask scheduler responds there "
                f"({one_line(error) or type(error).__name__}); expected tcp://HOST:PORT"
            ) from error
    with dask.config.set(_QUIET):
        cluster = LocalCluster(
            n_workers=capacity.n_tasks,
            threads_per_worker=1,
            processes=False,
            # The scheduler of the run already limits the number of cores used by all tasks.
            resources={CORES: capacity.n_cores},
            # Steps run in child processes, whose memory `LocalExecutor` monitors.
            memory_limit=0,
            # Make the dashboard inaccessible from other machines.
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        )
    return Client(cluster, set_as_default=False)


def _capacity(workers: Mapping[str, Any]) -> Capacity:
    cores = [int(facts["resources"][CORES]) for facts in workers.values()]
    share = max(1, min(cores))
    n_tasks = sum(
        min(int(facts["nthreads"]), max(1, own // share))
        for facts, own in zip(workers.values(), cores, strict=True)
    )
    return Capacity(n_tasks=n_tasks, n_cores=sum(cores), cores_of_one=max(1, *cores), share=share)
