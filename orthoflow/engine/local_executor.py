"""The executor for one machine: a child process per task, guarded against everything it may do."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import selectors
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final, Literal

from pydantic import TypeAdapter

from orthoflow.engine.clock import now
from orthoflow.engine.durability import writing_to
from orthoflow.engine.executors import COMPILED_CODE, TaskEnd, Tell
from orthoflow.engine.group_guard import GroupGuard
from orthoflow.engine.memory import GIB, MemoryGuard, oom_kills, process_memory
from orthoflow.engine.results import CellResult, result_from_json
from orthoflow.engine.running import failed_result
from orthoflow.engine.tasks import Task, write_task
from orthoflow.errors import CancelledStepError, OrthoflowError, StepFailedError, StoreError
from orthoflow.sdk.context import StepEvent

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
_GRACE_S: Final = 5.0
_LOG_BYTES: Final = 256 << 10
_READ_BYTES: Final = 1 << 16
_CRASHES: Final = {
    signal.SIGSEGV: "segmentation fault",
    signal.SIGBUS: "bus error, as when the disk is full under a memory-mapped file",
    signal.SIGABRT: "abort",
    signal.SIGFPE: "arithmetic error",
    signal.SIGILL: "illegal instruction",
}


@dataclass(frozen=True, kw_only=True)
class _LastWords:
    """The failure of a process that could not write its result."""

    kind: Literal["failed"]
    text: str


@dataclass(kw_only=True)
class _Running:
    """A task and its process.

    Attributes:
        task: the task.
        process: its leader.
        pipe: reading end of the progress pipe.
        process_descriptor: becomes readable when the process ends.
        started: ISO 8601 UTC.
        clock: monotonic seconds at the start.
        oom_kills: the kernel's counter at the start.
        reason: why we stopped it; None as long as we did not.
        is_victim: stopped for want of memory.
        kill_at: when SIGTERM has had its time, monotonic seconds.
        peak_bytes: largest own memory seen from outside.
        said: what is unread of its last line.
        last_words: a failure it could not write to the disk.
    """

    task: Task
    process: subprocess.Popen[bytes]
    pipe: int
    process_descriptor: int
    started: str
    clock: float
    oom_kills: int
    reason: OrthoflowError | None = None
    is_victim: bool = False
    kill_at: float | None = None
    peak_bytes: int = 0
    said: bytes = b""
    last_words: str = ""


@dataclass
class LocalExecutor:
    """Runs each task in a process group of its own.

    Call it from the main thread: the kernel kills a child together with the thread that spawned it.
    """

    tell: Tell
    _running: dict[str, _Running] = field(default_factory=dict)
    _selector: selectors.BaseSelector = field(default_factory=selectors.DefaultSelector)
    _guard: MemoryGuard = field(default_factory=MemoryGuard)
    _group_guard: GroupGuard = field(default_factory=GroupGuard)

    def start(self, task: Task) -> None:
        """Spawn the process of a task.

        Raises:
            StoreError: its files cannot be written.
        """
        with writing_to(Path(task.folder).parent):
            task.scratch.mkdir(parents=True, exist_ok=True)
        write_task(task)
        with writing_to(Path(task.log).parent):
            log = os.open(task.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o666)
        reading, writing = os.pipe()
        os.set_blocking(reading, False)
        try:
            process = self._spawn(task, writing, log)
        finally:
            os.close(writing)
            os.close(log)
        run = _Running(
            task=task,
            process=process,
            pipe=reading,
            process_descriptor=os.pidfd_open(process.pid),
            started=now(),
            clock=time.monotonic(),
            oom_kills=oom_kills(),
        )
        self._running[task.address] = run
        self._group_guard.watch(process.pid)
        self._selector.register(run.pipe, selectors.EVENT_READ, run)
        self._selector.register(run.process_descriptor, selectors.EVENT_READ, run)

    def poll(self, timeout_s: float) -> tuple[TaskEnd, ...]:
        """Wait up to a time for tasks to end; passes on what running tasks say meanwhile."""
        for key, _ in self._selector.select(min(timeout_s, self._guard.interval_s)):
            if key.fd == key.data.pipe:
                self._hear(key.data)
        ended = [run for run in self._running.values() if _has_ended(run)]
        ends = tuple(self._end(run) for run in ended)
        self._watch()
        return ends

    def cancel(self) -> None:
        """Ask all tasks to stop: SIGTERM, and SIGKILL when they do not within 5 s."""
        for run in self._running.values():
            self._stop(run, CancelledStepError(f"step {run.task.address} was interrupted"))

    def close(self) -> None:
        """Kill whatever still runs."""
        for run in list(self._running.values()):
            _signal_group(run, signal.SIGKILL)
            self._forget(run)
        self._selector.close()
        self._group_guard.close()

    def _spawn(self, task: Task, pipe: int, log: int) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [
                sys.executable,
                "-P",
                "-m",
                "orthoflow.engine.child",
                str(task.task_file),
                str(pipe),
                str(os.getpid()),
            ],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            cwd=task.scratch,
            env=_child_environment(task),
            pass_fds=(pipe,),
            start_new_session=True,
        )

    def _hear(self, run: _Running) -> None:
        while True:
            try:
                block = os.read(run.pipe, _READ_BYTES)
            except BlockingIOError:
                return
            if not block:
                with contextlib.suppress(KeyError):
                    self._selector.unregister(run.pipe)
                return
            *lines, run.said = (run.said + block).split(b"\n")
            for line in lines:
                self._pass_on(run, line)

    def _pass_on(self, run: _Running, line: bytes) -> None:
        # A method may write into the pipe by mistake: what is not an event is not passed on.
        with contextlib.suppress(ValueError):
            message = _messages().validate_json(line, strict=True)
            if isinstance(message, _LastWords):
                run.last_words = message.text
            else:
                self.tell(run.task.address, message)

    def _watch(self) -> None:
        time_now = time.monotonic()
        for run in self._running.values():
            memory = process_memory(run.process.pid)
            run.peak_bytes = max(run.peak_bytes, memory.anonymous if memory else 0)
            limit = run.task.timeout_s
            if run.kill_at is not None and time_now > run.kill_at:
                _signal_group(run, signal.SIGKILL)
            elif limit is not None and run.reason is None and time_now - run.clock > limit:
                self._stop(run, describe_timeout(run.task.who, limit))
        self._guard_memory()

    def _guard_memory(self) -> None:
        groups = {run.task.address: run.process.pid for run in self._running.values()}
        victim = self._guard.check(groups)
        # One at a time: the memory of a dying process is not free at once.
        if victim is None or any(run.is_victim for run in self._running.values()):
            return
        run = self._running[victim.address]
        run.is_victim = True
        run.reason = describe_memory(run.task.who, victim.n_bytes)
        run.peak_bytes = max(run.peak_bytes, victim.n_bytes)
        _signal_group(run, signal.SIGKILL)

    def _stop(self, run: _Running, reason: OrthoflowError) -> None:
        if run.reason is None:
            run.reason = reason
            run.kill_at = time.monotonic() + _GRACE_S
            _signal_group(run, signal.SIGTERM)

    def _end(self, run: _Running) -> TaskEnd:
        self._hear(run)
        # Before the leader is reaped, so that its number cannot belong to strangers already.
        _signal_group(run, signal.SIGKILL)
        self._forget(run)
        result = self._result(run)
        return TaskEnd(
            address=run.task.address,
            result=dataclasses.replace(result, log=_read_log(Path(run.task.log))),
        )

    def _forget(self, run: _Running) -> None:
        self._group_guard.forget(run.process.pid)
        run.process.wait()
        for descriptor in (run.pipe, run.process_descriptor):
            with contextlib.suppress(KeyError):
                self._selector.unregister(descriptor)
            os.close(descriptor)
        del self._running[run.task.address]

    def _result(self, run: _Running) -> CellResult:
        task = run.task
        error = run.reason
        if error is None:
            try:
                text = task.result_file.read_text(encoding="utf-8")
                result = result_from_json(text, task.result_file.name)
                peak = max(result.peak_rss_mib, round(run.peak_bytes / (1 << 20), 1))
                return dataclasses.replace(result, peak_rss_mib=peak)
            except (OSError, StoreError):
                error = _reason_of_silence(run)
        return dataclasses.replace(
            failed_result(task, error),
            started=run.started,
            ended=now(),
            wall_s=round(time.monotonic() - run.clock, 4),
            peak_rss_mib=round(run.peak_bytes / (1 << 20), 1),
        )


@cache
def _messages() -> TypeAdapter[StepEvent | _LastWords]:
    """What the process of a step says on its pipe, a line of JSON each."""
    return TypeAdapter(StepEvent | _LastWords)


def _reason_of_silence(run: _Running) -> OrthoflowError:
    if run.last_words:
        return StoreError(run.last_words)
    code = run.process.returncode
    if code == -signal.SIGKILL and oom_kills() > run.oom_kills:
        return describe_memory(run.task.who, run.peak_bytes)
    tail = _read_log(Path(run.task.log)).strip().rpartition("\n")[2]
    return StepFailedError(describe_exit(run.task.who, code, run.peak_bytes, tail))


def _has_ended(run: _Running) -> bool:
    info = os.waitid(os.P_PIDFD, run.process_descriptor, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    return info is not None


def _signal_group(run: _Running, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(run.process.pid, number)


def _read_log(path: Path) -> str:
    """The end of a log, without the NUL characters that no text in a record may have."""
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            stream.seek(max(0, size - _LOG_BYTES))
            text = stream.read().decode("utf-8", errors="replace").replace("\0", "")
    except OSError:
        return ""
    return text if size <= _LOG_BYTES else f"... ({size - _LOG_BYTES} bytes before)\n{text}"


def _child_environment(task: Task) -> dict[str, str]:
    """Environment variables for the process of a task."""
    variables = dict(os.environ)
    variables |= dict.fromkeys(_THREAD_VARIABLES, str(task.cores))
    # The child imports what this process would, wherever that came from.
    paths = [str(Path(path).absolute()) for path in sys.path]
    return variables | {
        "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths)),
        "PYTHONHASHSEED": "0",
        "PYTHONUNBUFFERED": "1",
        COMPILED_CODE: task.numba_folder,
        "MPLBACKEND": "Agg",
        "MPLCONFIGDIR": str(Path(task.store) / "matplotlib"),
        "TMPDIR": str(task.scratch),
    }


def describe_exit(who: str, code: int, n_bytes: int, tail: str) -> str:
    """Say how a process ended that left no result.

    Args:
        who: method and distribution, as `Task.who` has them.
        code: as `subprocess` has it, negative for signals.
        n_bytes: largest memory seen.
        tail: last line of its log.
    """
    if code >= 0:
        last = f"; its log ends with: {tail}" if tail else ""
        return f"{who} ended its process without a result (exit status {code}){last}"
    name = _signal_name(-code)
    if -code in _CRASHES:
        return f"{who} crashed ({_CRASHES[signal.Signals(-code)]}, {name})"
    return f"{who} was killed from outside ({name}) while it held {n_bytes / GIB:.1f} GiB of memory"


def describe_memory(who: str, n_bytes: int) -> StepFailedError:
    """Say that a step was stopped for want of memory."""
    return StepFailedError(
        f"{who} needed more memory than the machine has ({n_bytes / GIB:.1f} GiB when "
        f"stopped); give it less data or coarser parameters"
    )


def describe_timeout(who: str, limit_s: float) -> StepFailedError:
    """Say that a step took longer than its workflow allows."""
    return StepFailedError(f"{who} ran past its timeout of {duration(limit_s)} and was stopped")


def duration(seconds: float) -> str:
    """Write a duration as people say it.

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
