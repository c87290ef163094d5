"""Executors for a single machine: one child process per task, or all tasks in this process.

Child processes are forked from a `multiprocessing` server that has loaded `engine.preload`.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Final, Protocol

import psutil
from pydantic import TypeAdapter

from orthoflow.engine.durability import write_whole, writing_to
from orthoflow.engine.environment import now
from orthoflow.engine.kernels import VARIABLE, kernel_folder, kernels_in, private_folder
from orthoflow.engine.measuring import (
    GIB,
    MIB,
    memory_shortage,
    process_memory,
    tree_memory,
)
from orthoflow.engine.results import CellResult, result_from_json
from orthoflow.engine.worker import EVENT, RESULT, Task, failed_result, run_step, run_task
from orthoflow.errors import CancelledStepError, OrthoflowError, StepFailedError, StoreError
from orthoflow.sdk.context import StepEvent
from orthoflow.sdk.lines import one_line
from orthoflow.untrusted_text import open_file, shown

PRELOADED: Final = ["orthoflow.engine.preload"]
_THREAD_VARIABLES: Final = (
    "BLIS_NUM_THREADS",
    "GDAL_NUM_THREADS",
    "GOTO_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
    "RAYON_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
# Environment variables that are read when Python starts or the server loads libraries. With the
# first, a module in the working folder cannot replace a standard module. By default, OpenBLAS
# threads spin for 2**26 clock cycles (about 0.05 s) when they start and after each matrix product;
# 2**20 cycles take less than 1 ms. Without the last, Numba would spend time on colouring the error
# messages of all functions that it tries.
_AT_START: Final = {
    "PYTHONSAFEPATH": "1",
    "PYTHONHASHSEED": "0",
    "OPENBLAS_THREAD_TIMEOUT": "20",
    "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1",
}
_starting: Final = threading.Lock()

StepListener = Callable[[str, StepEvent], None]
EVENTS: Final = TypeAdapter(StepEvent)
GRACE_S: Final = 5.0
# Maximum number of messages read per poll, so that a step that keeps sending messages cannot delay
# its own timeout.
_MOST_MESSAGES: Final = 256
_LARGEST_MESSAGE: Final = 64 << 20
_LONGEST_LAST_LINE: Final = 300
_FROM_OUTSIDE: Final = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
# Only this many bytes at the end of a log, where the errors are, become part of a record.
_KEPT_BYTES: Final = 256 << 10
_MOST_LINES: Final = 2000


@dataclass(frozen=True, kw_only=True)
class Capacity:
    """Limits for concurrent tasks.

    Attributes:
        n_tasks: maximum number of tasks.
        n_cores: total number of cores.
        cores_of_one: maximum number of cores per task.
        share: default number of cores per task.
    """

    n_tasks: int
    n_cores: int
    cores_of_one: int
    share: int

    @classmethod
    def of_jobs(cls, jobs: int, n_cores: int) -> Capacity:
        """Return the limits for a number of concurrent jobs that share the cores of one machine."""
        share = max(1, n_cores // jobs)
        return cls(n_tasks=jobs, n_cores=n_cores, cores_of_one=n_cores, share=share)


class Executor(Protocol):
    """Runs tasks; called from one thread only.

    The interface does not assume a single machine, because a task can be sent as JSON and its
    results are in the store.
    """

    @property
    def capacity(self) -> Capacity:
        """Return the current limits for concurrent tasks."""

    def start(self, task: Task) -> None:
        """Start a task, or queue it.

        Raises:
            StoreError: the files of the task cannot be written.
        """

    def poll(self, timeout_s: float) -> dict[str, CellResult]:
        """Wait for tasks to end, up to a time limit; forward messages of running tasks.

        Returns:
            Address -> result, for the tasks that have ended; the status is ok or failed, never
            skipped.
        """

    def cancel(self) -> None:
        """Ask all tasks to stop; kill them after a grace period. `poll` returns their results."""

    def close(self) -> None:
        """Stop all running tasks immediately."""


class InlineExecutor:
    """Runs tasks one by one in this process, for debugging.

    There are no timeouts, and a crash ends this process.
    """

    def __init__(
        self, capacity: Capacity, listen: StepListener, is_interrupted: Callable[[], bool]
    ) -> None:
        """Create the executor.

        Args:
            capacity: limits for a task.
            listen: called with the address of a task and its message.
            is_interrupted: returns whether the user asked to stop; also called while a task runs.
        """
        self.capacity = capacity
        self._listen = listen
        self._is_interrupted = is_interrupted
        self._waiting: deque[Task] = deque()
        self._is_cancelled = False

    def start(self, task: Task) -> None:
        """Add a task to the queue."""
        self._waiting.append(task)

    def poll(self, timeout_s: float) -> dict[str, CellResult]:
        """Run the next task to its end, without a timeout."""
        if not self._waiting:
            return {}
        task = self._waiting.popleft()
        if self._is_cancelled:
            reason = CancelledStepError(f"step {task.address} was interrupted")
            return {task.address: failed_result(task, reason)}
        log: deque[str] = deque(maxlen=_MOST_LINES)

        def listen(event: StepEvent) -> None:
            if event.kind != "progress":
                log.append(shown(event.text, keep="\n"))
            self._listen(task.address, event)

        with kernels_in(kernel_folder(task.kernels)):
            result = run_task(task, listen, self._is_interrupted)
        text = "".join(f"{line}\n" for line in log)
        write_whole(Path(task.log), text.encode())
        return {task.address: dataclasses.replace(result, log=text)}

    def cancel(self) -> None:
        """Cancel the queued tasks; never called while a task runs."""
        self._is_cancelled = True

    def close(self) -> None:
        """Remove the queued tasks."""
        self._waiting.clear()


def _log_text(path: Path) -> str:
    with suppress(OSError), open_file(path) as stream:
        n_before = max(0, os.fstat(stream.fileno()).st_size - _KEPT_BYTES)
        stream.seek(n_before)
        text = stream.read(_KEPT_BYTES).decode("utf-8", errors="replace").replace("\0", "")
        return f"... ({n_before} bytes before)\n{text}" if n_before else text
    return ""


def _with_descendants(process_id: int) -> list[psutil.Process]:
    with suppress(psutil.Error):
        root = psutil.Process(process_id)
        return [*root.children(recursive=True), root]
    return []


def _kill(processes: Iterable[psutil.Process]) -> None:
    for one in processes:
        with suppress(psutil.Error):
            one.kill()


def start_process(
    target: Callable[..., object], arguments: tuple[object, ...], name: str
) -> BaseProcess:
    """Start a process that has the libraries of steps loaded, but no state of this process.

    Raises:
        StepFailedError: this machine cannot start another process.
    """
    context = multiprocessing.get_context("forkserver")
    failure: Exception | None = None
    with _starting, _start_conditions():
        context.set_forkserver_preload(PRELOADED)
        # If the server was killed, starting a process fails once, and the second attempt starts a
        # new server.
        for _ in range(2):
            process = context.Process(target=target, args=arguments, name=name)
            try:
                process.start()
            except (OSError, EOFError) as error:
                failure = error
            else:
                return process
    raise StepFailedError(
        f"{one_line(failure) or type(failure).__name__}; close other programs, or increase the "
        "limits on open files and processes (`ulimit`)"
    ) from failure


@contextmanager
def _start_conditions() -> Iterator[None]:
    """Adjust the state that `multiprocessing` passes on to a new process.

    Without this, `multiprocessing` would run a script that calls `orthoflow.run` again in each
    step, and Dask workers, which are daemons, could not start child processes.
    """
    variables = {**_AT_START, "MPLCONFIGDIR": str(private_folder("matplotlib"))}
    before = {name: os.environ.get(name) for name in variables}
    main, this = sys.modules["__main__"], multiprocessing.current_process()
    is_daemon = this.daemon
    os.environ.update(variables)
    sys.modules["__main__"] = ModuleType("__main__")
    if is_daemon:
        this.daemon = False
    try:
        yield
    finally:
        if is_daemon:
            this.daemon = True
        sys.modules["__main__"] = main
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _variables(task: Task) -> Mapping[str, str]:
    variables = dict(os.environ)
    # This variable serves only to debug kernels, which requires `--executor inline`.
    variables.pop("NUMBA_DISABLE_JIT", None)
    return variables | {
        **dict.fromkeys(_THREAD_VARIABLES, str(task.cores)),
        "PYTHONHASHSEED": "0",
        VARIABLE: str(kernel_folder(task.kernels)),
        "MPLBACKEND": "Agg",
        "MPLCONFIGDIR": str(private_folder("matplotlib")),
        "TMPDIR": str(task.scratch),
    }


class _Step:
    """A task, and the process that runs it in a session of its own.

    Attributes:
        pipe: receives the messages of the process, see `worker.run_step`.
        clock: start time in seconds of the monotonic clock.
        reason: why the executor stopped the process; None if it did not.
        is_victim: whether the process was stopped because memory was short.
        kill_at: end of the grace period in seconds of the monotonic clock.
        peak_bytes: peak memory of the process, measured by the executor.
        result: result that the process sent.
    """

    def __init__(self, task: Task) -> None:
        """Start the process of a task.

        Raises:
            StepFailedError: this machine cannot start another process.
            StoreError: the files of the task cannot be written.
        """
        with writing_to(Path(task.folder).parent):
            task.scratch.mkdir(parents=True, exist_ok=True)
        self.task = task
        # Truncate an existing log, but do not follow a symbolic link.
        opened = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW
        with writing_to(Path(task.log).parent):
            os.close(os.open(task.log, opened, 0o666))
        self._started = now()
        self.clock = time.monotonic()
        self.reason: OrthoflowError | None = None
        self.is_victim = False
        self.kill_at: float | None = None
        self.peak_bytes = 0
        self.result: CellResult | None = None
        self.pipe, theirs = multiprocessing.Pipe(duplex=False)
        with theirs:
            try:
                arguments = (task, theirs, _variables(task))
                self.process = start_process(run_step, arguments, task.address)
            except StepFailedError as error:
                self.pipe.close()
                raise StepFailedError(
                    f"no process could be started for {task.who}: {error}"
                ) from error

    @property
    def pid(self) -> int:
        assert self.process.pid is not None  # noqa: S101 - it was started
        return self.process.pid

    def stop(self, reason: OrthoflowError) -> None:
        """Ask the process to stop, and start the grace period; later calls have no effect."""
        if self.reason is None:
            self.reason = reason
            self.kill_at = time.monotonic() + GRACE_S
            with suppress(OSError):
                self.process.terminate()

    def kill(self) -> None:
        self.kill_at = time.monotonic() + GRACE_S
        _kill(_with_descendants(self.pid))
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)

    def close(self) -> None:
        self.pipe.close()
        if not self.process.is_alive():
            self.process.close()

    def outcome(self) -> CellResult:
        """Return the result; the process must have ended."""
        peak_mib, log = round(self.peak_bytes / MIB, 1), _log_text(Path(self.task.log))
        if self.reason is None and self.result is not None:
            peak_mib = max(self.result.peak_rss_mib, peak_mib)
            return dataclasses.replace(self.result, peak_rss_mib=peak_mib, log=log)
        return dataclasses.replace(
            failed_result(self.task, self.reason or self._reason_of_silence(log)),
            started=self._started,
            ended=now(),
            wall_s=round(time.monotonic() - self.clock, 4),
            peak_rss_mib=peak_mib,
            log=log,
        )

    def _reason_of_silence(self, log: str) -> OrthoflowError:
        code = self.process.exitcode or 0
        tail = one_line(log.strip().rpartition("\n")[2], _LONGEST_LAST_LINE)
        if code >= 0:
            last = f"; its log ends with: {tail}" if tail else ""
            how = f"ended without a result (exit status {code}){last}"
        else:
            kind = "was killed by the system or a user" if -code in _FROM_OUTSIDE else "crashed"
            reason = signal.strsignal(-code) or f"signal {-code}"
            memory = f"{self.peak_bytes / GIB:.1f} GiB of memory"
            how = f"{kind} ({reason.lower()}) while using {memory}"
        return StepFailedError(f"{self.task.who} {how}")


# Process id -> task, for all executors in this process; each Dask worker thread has its own
# executor.
_all_running: Final[dict[int, _Step]] = {}


@dataclass
class LocalExecutor:
    """Runs each task in its own process."""

    capacity: Capacity
    listen: StepListener
    _running: dict[str, _Step] = field(default_factory=dict)
    _unstarted: dict[str, CellResult] = field(default_factory=dict)

    def start(self, task: Task) -> None:
        """Start the process of a task.

        Raises:
            StoreError: the files of the task cannot be written.
        """
        try:
            step = _Step(task)
        except StepFailedError as error:
            self._unstarted[task.address] = failed_result(task, error)
            return
        self._running[task.address] = _all_running[step.pid] = step

    def poll(self, timeout_s: float) -> dict[str, CellResult]:
        """Wait for tasks to end, up to a time limit; forward messages of running tasks."""
        ends, self._unstarted = self._unstarted, {}
        steps = self._running.values()
        pipes = [step.pipe for step in steps if not step.pipe.closed]
        timeout_s = 0.0 if ends else timeout_s
        wait([*pipes, *(step.process.sentinel for step in steps)], timeout_s)
        # Determine first which processes have ended, so that their last messages are read below.
        ended = [step for step in steps if not step.process.is_alive()]
        for step in steps:
            self._read(step)
        ends |= {step.task.address: self._end(step) for step in ended}
        self._watch()
        return ends

    def cancel(self) -> None:
        """Send SIGTERM to all tasks, and SIGKILL 5 s later to those still running."""
        for step in self._running.values():
            step.stop(CancelledStepError(f"step {step.task.address} was interrupted"))

    def close(self) -> None:
        """Kill all processes still running."""
        for step in list(self._running.values()):
            step.kill()
            step.process.join(GRACE_S)
            self._forget(step)

    def _read(self, step: _Step) -> None:
        for _ in range(_MOST_MESSAGES):
            if step.pipe.closed:
                return
            try:
                if not step.pipe.poll(0):
                    return
                message = step.pipe.recv_bytes(_LARGEST_MESSAGE)
            except (EOFError, OSError):
                # The process has ended, or its message was invalid.
                step.pipe.close()
                return
            self._take(step, message)

    def _take(self, step: _Step, message: bytes) -> None:
        # Ignore invalid messages: a method may write to the pipe by mistake.
        with suppress(ValueError, StoreError, RecursionError):
            if message.startswith(RESULT):
                text = message.removeprefix(RESULT).decode()
                result = result_from_json(text, f"the result of {step.task.address}")
                step.result = result if result.key == step.task.key else None
            elif message.startswith(EVENT):
                event = EVENTS.validate_json(message.removeprefix(EVENT), strict=True)
                self.listen(step.task.address, event)

    def _watch(self) -> None:
        time_now = time.monotonic()
        for step in self._running.values():
            step.peak_bytes = max(step.peak_bytes, process_memory(step.pid))
            limit = step.task.timeout_s
            if step.kill_at is not None and time_now > step.kill_at:
                step.kill()
            elif limit is not None and time_now - step.clock > limit:
                late = f"{step.task.who} exceeded its timeout of {limit:g} s and was stopped"
                step.stop(StepFailedError(late))
        self._guard_memory()

    def _guard_memory(self) -> None:
        """If the machine is running out of memory, kill the step that uses the most memory."""
        floor, steps = memory_shortage(), _all_running.copy()
        # Kill one step at a time, because a killed process does not release its memory
        # immediately.
        if not floor or any(step.is_victim for step in steps.values()):
            return
        held = {pid: tree_memory(pid) for pid in steps}
        largest = max(held, key=held.__getitem__, default=0)
        # If even the largest step uses less than the required free memory, killing it would not
        # help, because another program is the cause. Each executor kills only its own steps.
        if not largest or held[largest] < floor or steps[largest] not in self._running.values():
            return
        step = steps[largest]
        step.is_victim = True
        step.reason = StepFailedError(
            f"{step.task.who} needed more memory than the machine has ({held[largest] / GIB:.1f} "
            "GiB when stopped); use fewer points or photos, or a coarser resolution"
        )
        step.peak_bytes = max(step.peak_bytes, held[largest])
        step.kill()

    def _end(self, step: _Step) -> CellResult:
        step.kill()
        result = step.outcome()
        self._forget(step)
        return result

    def _forget(self, step: _Step) -> None:
        del _all_running[step.pid]
        del self._running[step.task.address]
        step.close()
