"""Executors of one machine: a guarded process per task, or none.

Processes come from `multiprocessing`: forked from a server that has loaded `engine.preload` if the
system supports it, otherwise spawned.
"""

from __future__ import annotations

import dataclasses
import errno
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
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Final, Protocol

import psutil
from pydantic import TypeAdapter

from orthoflow.engine.durability import write_whole, writing_to
from orthoflow.engine.environment import now
from orthoflow.engine.kernels import VARIABLE, kernel_folder, kernels_in, private_folder
from orthoflow.engine.measuring import GIB, MIB, MemoryGuard, oom_kills, process_memory
from orthoflow.engine.results import CellResult, result_from_json
from orthoflow.engine.worker import EVENT, RESULT, Task, failed_result, run_step, run_task
from orthoflow.errors import CancelledStepError, OrthoflowError, StepFailedError, StoreError
from orthoflow.geometry.threads import address_space
from orthoflow.sdk.context import StepEvent
from orthoflow.sdk.lines import one_line
from orthoflow.untrusted_text import shown

PRELOADED: Final = ["orthoflow.engine.preload"]
_HAS_SERVER: Final = "forkserver" in multiprocessing.get_all_start_methods()
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
# Read by the interpreter, or by libraries that the server loads. A module that lies in the working
# folder must not take the place of one of Python's. Threads of OpenBLAS spin for 2**26 turns of the
# clock when they begin and after each product, some 0.05 s of processor time; 2**20 are below 1 ms.
_AT_START: Final = {
    "PYTHONSAFEPATH": "1",
    "PYTHONHASHSEED": "0",
    "OPENBLAS_THREAD_TIMEOUT": "20",
}
_starting: Final = threading.Lock()

Tell = Callable[[str, StepEvent], None]
EVENTS: Final = TypeAdapter(StepEvent)
_GRACE_S: Final = 5.0
# Maximum number of messages per poll: a step that never stops must not delay its timeout.
_MOST_MESSAGES: Final = 256
_LARGEST_MESSAGE: Final = 64 << 20
_LONGEST_LAST_LINE: Final = 300
# The end of a long log is kept: errors are at the end.
_KEPT_BYTES: Final = 256 << 10
_LARGEST_LOG: Final = 8 << 20
_MOST_LINES: Final = 2000
_CRASHES: Final = {
    signal.SIGSEGV: "segmentation fault",
    signal.SIGBUS: "bus error, as when the disk is full under a memory-mapped file",
    signal.SIGABRT: "abort",
    signal.SIGFPE: "arithmetic error",
    signal.SIGILL: "illegal instruction",
}


@dataclass(frozen=True, kw_only=True)
class Capacity:
    """Limits for concurrent tasks.

    Attributes:
        n_tasks: tasks.
        n_cores: total number of cores.
        cores_of_one: maximum for one task.
        share: default for one task.
    """

    n_tasks: int
    n_cores: int
    cores_of_one: int
    share: int

    @classmethod
    def of_jobs(cls, jobs: int, n_cores: int) -> Capacity:
        """A number of jobs that share the cores of one machine."""
        share = max(1, n_cores // jobs)
        return cls(n_tasks=jobs, n_cores=n_cores, cores_of_one=n_cores, share=share)


class Executor(Protocol):
    """Runs tasks; used from one thread.

    Nothing here assumes one machine: a task is JSON, its results are in the store.
    """

    @property
    def capacity(self) -> Capacity:
        """Return the current limits for concurrent tasks."""

    def start(self, task: Task) -> None:
        """Start a task, or queue it.

        Raises:
            StoreError: its files cannot be written.
        """

    def poll(self, timeout_s: float) -> dict[str, CellResult]:
        """Wait for tasks to end, up to a time; forwards messages of running tasks.

        Returns:
            Address -> result of the tasks that ended: ok or failed, never skipped.
        """

    def cancel(self) -> None:
        """Ask all tasks to stop; they still end through `poll`, after a grace period by force."""

    def close(self) -> None:
        """Stop whatever still runs, at once."""


class InlineExecutor:
    """Runs tasks one by one in this process, for debugging: no timeout, no crash protection."""

    def __init__(self, capacity: Capacity, tell: Tell, is_interrupted: Callable[[], bool]) -> None:
        """Make one.

        Args:
            capacity: limits for a task.
            tell: called with the address of a task and its message.
            is_interrupted: whether the user asked to stop, even while a task runs.
        """
        self.capacity = capacity
        self._tell = tell
        self._is_interrupted = is_interrupted
        self._waiting: deque[Task] = deque()
        self._is_cancelled = False

    def start(self, task: Task) -> None:
        """Queue a task."""
        self._waiting.append(task)

    def poll(self, timeout_s: float) -> dict[str, CellResult]:
        """Run the next task to its end; timeouts are ignored."""
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
            self._tell(task.address, event)

        with kernels_in(kernel_folder(task.kernels)):
            result = run_task(task, listen, self._is_interrupted)
        text = "".join(f"{line}\n" for line in log)
        write_whole(Path(task.log), text.encode())
        return {task.address: dataclasses.replace(result, log=text)}

    def cancel(self) -> None:
        """End the queued tasks without running them; none runs while this is called."""
        self._is_cancelled = True

    def close(self) -> None:
        """Remove the queued tasks."""
        self._waiting.clear()


class StepLog:
    """An open log that another process appends to, while this one limits its size.

    It stays open, because its name may refer to anything by the time that the step has ended.

    Attributes:
        path: path under which the other process opens it.
    """

    def __init__(self, path: Path) -> None:
        """Begin an empty log.

        Raises:
            StoreError: it cannot be written.
        """
        self.path = path
        opened = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_NOFOLLOW
        with writing_to(path.parent):
            self._descriptor = os.open(path, opened, 0o666)
        self._n_dropped = 0
        self._notice = b""

    def shorten(self) -> None:
        """Drop all but the end of a log that has grown too long; the writer continues after it."""
        size = os.fstat(self._descriptor).st_size
        if size <= _LARGEST_LOG:
            return
        # What is written before the file is truncated is lost with the rest.
        tail = self._tail(size)
        self._n_dropped += size - len(self._notice) - len(tail)
        self._notice = f"... ({self._n_dropped} bytes before)\n".encode()
        # A full disk affects the log, not the run.
        with suppress(OSError):
            os.ftruncate(self._descriptor, 0)
            os.write(self._descriptor, self._notice + tail)

    def text(self) -> str:
        """End of the log, without NUL characters, which no text in a record may contain."""
        size = os.fstat(self._descriptor).st_size
        tail = self._tail(size)
        text = tail.decode("utf-8", errors="replace").replace("\0", "")
        n_before = self._n_dropped + size - len(self._notice) - len(tail)
        return text if size == len(tail) else f"... ({n_before} bytes before)\n{text}"

    def close(self) -> None:
        """Close it; no further reads are possible."""
        os.close(self._descriptor)

    def _tail(self, size: int) -> bytes:
        return os.pread(self._descriptor, _KEPT_BYTES, max(0, size - _KEPT_BYTES))


@dataclass(frozen=True, kw_only=True)
class StepProcess:
    """The process of a step, in a session of its own.

    Attributes:
        process: of the step.
        pipe: what it sends, as in `worker.run_step`.
        scratch: what it starts knows this folder as `TMPDIR`, or works there.
    """

    process: BaseProcess
    pipe: Connection
    scratch: Path

    @property
    def pid(self) -> int:
        """Its number."""
        assert self.process.pid is not None  # noqa: S101 - it was started
        return self.process.pid

    def ask_to_end(self) -> None:
        """Ask it to stop by itself."""
        with suppress(OSError):
            self.process.terminate()

    def end_tree(self) -> None:
        """Kill it with all that it started, also when it has ended by itself."""
        _kill(_with_descendants(self.pid))
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        if self.process.exitcode:
            # What a step that crashed had started has another parent now.
            _kill(one for one in psutil.process_iter() if _is_at_work_in(one, self.scratch))

    def close(self) -> None:
        """Let go of it."""
        self.pipe.close()
        if not self.process.is_alive():
            self.process.close()


def _with_descendants(process_id: int) -> list[psutil.Process]:
    with suppress(psutil.Error):
        root = psutil.Process(process_id)
        return [*root.children(recursive=True), root]
    return []


def _kill(processes: Iterable[psutil.Process]) -> None:
    for one in processes:
        with suppress(psutil.Error):
            one.kill()


def _is_at_work_in(process: psutil.Process, scratch: Path) -> bool:
    with suppress(psutil.Error):
        if process.environ().get("TMPDIR") == str(scratch):
            return True
        # A user's shell that looks at the folder has a terminal; a step has none.
        return process.terminal() is None and Path(process.cwd()).is_relative_to(scratch)
    return False


def start_step(task: Task) -> StepProcess:
    """Start the process of a task; its log and its folder exist.

    Raises:
        StepFailedError: this machine cannot start another process.
    """
    ours, theirs = multiprocessing.Pipe(duplex=False)
    with theirs:
        try:
            process = start_process(run_step, (task, theirs, _variables(task)), task.address)
        except StepFailedError as error:
            ours.close()
            raise StepFailedError(f"no process could be started for {task.who}: {error}") from error
    return StepProcess(process=process, pipe=ours, scratch=task.scratch)


def start_process(
    target: Callable[..., object], arguments: tuple[object, ...], name: str
) -> BaseProcess:
    """Start a process with the libraries of steps loaded, and nothing else of this process.

    Raises:
        StepFailedError: this machine cannot start another process.
    """
    context = (
        multiprocessing.get_context("forkserver")
        if _HAS_SERVER
        else multiprocessing.get_context("spawn")
    )
    failure: Exception | None = None
    with _starting, _start_conditions():
        context.set_forkserver_preload(PRELOADED)
        # A killed server is detected by its silence, and started again.
        for _ in range(2):
            process = context.Process(target=target, args=arguments, name=name)
            try:
                process.start()
            except (OSError, EOFError) as error:
                failure = error
            else:
                return process
    is_of_files = isinstance(failure, OSError) and failure.errno in (errno.EMFILE, errno.ENFILE)
    why = (
        "too many files are open: raise the limit (`ulimit -n`)"
        if is_of_files
        else "the machine has too little memory or allows too few processes"
    )
    raise StepFailedError(why) from failure


@contextmanager
def _start_conditions() -> Iterator[None]:
    """Set what `multiprocessing` takes over from this process when it starts another.

    A script that calls `orthoflow.run` must not run again in each step, as its main module would
    be imported there; and workers of dask, which are daemons, must be allowed to have children.
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
    """Environment variables for the process of a task."""
    variables = dict(os.environ)
    # A setting for debugging kernels; use --executor inline for that.
    variables.pop("NUMBA_DISABLE_JIT", None)
    return variables | {
        **dict.fromkeys(_THREAD_VARIABLES, str(task.cores)),
        "PYTHONHASHSEED": "0",
        VARIABLE: str(kernel_folder(task.kernels)),
        "MPLBACKEND": "Agg",
        "MPLCONFIGDIR": str(private_folder("matplotlib")),
        "TMPDIR": str(task.scratch),
    }


@dataclass(kw_only=True)
class _Running:
    """A task and its process.

    Attributes:
        task: the task.
        step: its process.
        log: its output.
        started: ISO 8601 UTC.
        clock: monotonic seconds at the start.
        oom_kills: the kernel's counter at the start.
        reason: why we stopped it; None otherwise.
        is_victim: stopped because of lack of memory.
        kill_at: end of the grace period, monotonic seconds.
        peak_bytes: largest own memory measured from outside.
        result: the result that it sent.
    """

    task: Task
    step: StepProcess
    log: StepLog
    started: str
    clock: float
    oom_kills: int
    reason: OrthoflowError | None = None
    is_victim: bool = False
    kill_at: float | None = None
    peak_bytes: int = 0
    result: CellResult | None = None


# By process, the tasks of all executors here: a cluster's workers in this process have one each.
_all_running: Final[dict[int, _Running]] = {}


@dataclass
class LocalExecutor:
    """Runs each task in a process of its own."""

    capacity: Capacity
    tell: Tell
    _running: dict[str, _Running] = field(default_factory=dict)
    _guard: MemoryGuard = field(default_factory=MemoryGuard)
    _unstarted: dict[str, CellResult] = field(default_factory=dict)

    def start(self, task: Task) -> None:
        """Start the process of a task.

        Raises:
            StoreError: its files cannot be written.
        """
        with writing_to(Path(task.folder).parent):
            task.scratch.mkdir(parents=True, exist_ok=True)
        log, kills = StepLog(Path(task.log)), oom_kills()
        try:
            step = start_step(task)
        except StepFailedError as error:
            log.close()
            self._unstarted[task.address] = failed_result(task, error)
            return
        run = _Running(
            task=task,
            step=step,
            log=log,
            started=now(),
            clock=time.monotonic(),
            oom_kills=kills,
        )
        self._running[task.address] = _all_running[run.step.pid] = run

    def poll(self, timeout_s: float) -> dict[str, CellResult]:
        """Wait for tasks to end, up to a time; forwards messages of running tasks."""
        ends, self._unstarted = self._unstarted, {}
        waited = [run.step.process.sentinel for run in self._running.values()]
        heard = [run.step.pipe for run in self._running.values() if not run.step.pipe.closed]
        wait([*heard, *waited], 0.0 if ends else min(timeout_s, self._guard.interval_s))
        # Checked before the last messages are read: nothing is sent after the end.
        ended = [run for run in self._running.values() if not run.step.process.is_alive()]
        for run in self._running.values():
            self._hear(run)
        ends |= {run.task.address: self._end(run) for run in ended}
        self._watch()
        return ends

    def cancel(self) -> None:
        """Ask all tasks to stop: SIGTERM, and SIGKILL after 5 s."""
        for run in self._running.values():
            self._stop(run, CancelledStepError(f"step {run.task.address} was interrupted"))

    def close(self) -> None:
        """Kill whatever still runs."""
        for run in list(self._running.values()):
            run.step.end_tree()
            run.step.process.join(_GRACE_S)
            self._forget(run)

    def _hear(self, run: _Running) -> None:
        for _ in range(_MOST_MESSAGES):
            if run.step.pipe.closed:
                return
            try:
                if not run.step.pipe.poll(0):
                    return
                message = run.step.pipe.recv_bytes(_LARGEST_MESSAGE)
            except (EOFError, OSError):
                # Ended, or sent an invalid message.
                run.step.pipe.close()
                return
            self._take(run, message)

    def _take(self, run: _Running, message: bytes) -> None:
        # A method may write into the pipe by mistake: invalid messages are ignored.
        with suppress(ValueError, StoreError, RecursionError):
            if message.startswith(RESULT):
                text = message.removeprefix(RESULT).decode()
                result = result_from_json(text, f"the result of {run.task.address}")
                run.result = result if result.key == run.task.key else None
            elif message.startswith(EVENT):
                event = EVENTS.validate_json(message.removeprefix(EVENT), strict=True)
                self.tell(run.task.address, event)

    def _watch(self) -> None:
        time_now = time.monotonic()
        for run in self._running.values():
            run.peak_bytes = max(run.peak_bytes, process_memory(run.step.pid))
            run.log.shorten()
            limit = run.task.timeout_s
            if run.kill_at is not None and time_now > run.kill_at:
                run.step.end_tree()
                run.kill_at = time_now + _GRACE_S
            elif limit is not None and run.reason is None and time_now - run.clock > limit:
                self._stop(run, describe_timeout(run.task.who, limit))
        self._guard_memory()

    def _guard_memory(self) -> None:
        runs = _all_running.copy()
        victim = self._guard.check(runs)
        # One at a time: the memory of a dying process is not released at once.
        if victim is None or any(run.is_victim for run in runs.values()):
            return
        run, n_bytes = runs[victim[0]], victim[1]
        if self._running.get(run.task.address) is not run:
            # Its own executor stops it.
            return
        run.is_victim = True
        run.reason = describe_memory(run.task.who, n_bytes)
        run.peak_bytes = max(run.peak_bytes, n_bytes)
        run.step.end_tree()
        run.kill_at = time.monotonic() + _GRACE_S

    def _stop(self, run: _Running, reason: OrthoflowError) -> None:
        if run.reason is None:
            run.reason = reason
            run.kill_at = time.monotonic() + _GRACE_S
            run.step.ask_to_end()

    def _end(self, run: _Running) -> CellResult:
        run.step.end_tree()
        run.log.shorten()
        result = dataclasses.replace(_result(run), log=run.log.text())
        self._forget(run)
        return result

    def _forget(self, run: _Running) -> None:
        run.log.close()
        del _all_running[run.step.pid]
        del self._running[run.task.address]
        run.step.close()


def _result(run: _Running) -> CellResult:
    peak_mib = round(run.peak_bytes / MIB, 1)
    if run.reason is None and run.result is not None:
        peak_mib = max(run.result.peak_rss_mib, peak_mib)
        return dataclasses.replace(run.result, peak_rss_mib=peak_mib)
    return dataclasses.replace(
        failed_result(run.task, run.reason or _reason_of_silence(run)),
        started=run.started,
        ended=now(),
        wall_s=round(time.monotonic() - run.clock, 4),
        peak_rss_mib=peak_mib,
    )


def _reason_of_silence(run: _Running) -> OrthoflowError:
    code = run.step.process.exitcode or 0
    if code == -signal.SIGKILL and oom_kills() > run.oom_kills:
        return describe_memory(run.task.who, run.peak_bytes)
    tail = one_line(run.log.text().strip().rpartition("\n")[2], _LONGEST_LAST_LINE)
    return StepFailedError(describe_exit(run.task.who, code, run.peak_bytes, tail))


def describe_exit(who: str, code: int, n_bytes: int, tail: str) -> str:
    """Return an error for a process that ended without a result.

    Args:
        who: method and distribution, from `Task.who`.
        code: as in `subprocess`, negative for signals.
        n_bytes: largest measured memory.
        tail: last line of its log.
    """
    if code >= 0:
        last = f"; its log ends with: {tail}" if tail else ""
        return f"{who} ended its process without a result (exit status {code}){last}"
    name = _signal_name(-code)
    if -code in _CRASHES:
        limit = address_space()
        room = f"; a process may take {limit / MIB:.0f} MiB of memory here" if limit else ""
        return f"{who} crashed ({_CRASHES[signal.Signals(-code)]}, {name}){room}"
    return f"{who} was killed from outside ({name}) while it held {n_bytes / GIB:.1f} GiB of memory"


def describe_memory(who: str, n_bytes: int) -> StepFailedError:
    """Return an error for a step stopped because of lack of memory."""
    return StepFailedError(
        f"{who} needed more memory than the machine has ({n_bytes / GIB:.1f} GiB when "
        f"stopped); give it less data or coarser parameters"
    )


def describe_timeout(who: str, limit_s: float) -> StepFailedError:
    """Return an error for a step that exceeded its timeout."""
    return StepFailedError(f"{who} ran past its timeout of {duration(limit_s)} and was stopped")


def duration(seconds: float) -> str:
    """Format a duration for people.

    >>> [duration(s) for s in (0.5, 90, 1800, 7200)]
    ['0.5 s', '90 s', '30 min', '2 h']
    """
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= length and seconds % length == 0:
            return f"{seconds / length:g} {unit}"
    return f"{seconds:g} s"


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
