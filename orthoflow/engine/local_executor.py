"""The executor for one machine: a child process per task, guarded against everything it may do."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import selectors
import signal
import time
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final, Literal

from pydantic import TypeAdapter

from orthoflow.engine.clock import now
from orthoflow.engine.durability import read_whole, writing_to
from orthoflow.engine.executors import Capacity, TaskEnd, Tell
from orthoflow.engine.keeper import END_ALL
from orthoflow.engine.memory import GIB, MIB, MemoryGuard, oom_kills, process_memory
from orthoflow.engine.process_trees import descendants
from orthoflow.engine.results import CellResult, result_from_json
from orthoflow.engine.running import failed_result
from orthoflow.engine.step_logs import StepLog
from orthoflow.engine.step_processes import StepProcess, start_step
from orthoflow.engine.tasks import Task, write_task
from orthoflow.errors import CancelledStepError, OrthoflowError, StepFailedError, StoreError
from orthoflow.sdk.context import StepEvent
from orthoflow.sdk.lines import one_line
from orthoflow.system import address_space

_GRACE_S: Final = 5.0
_READ_BYTES: Final = 1 << 16
# So much is heard at once: a step that never stops talking must not keep us from its timeout.
_READS_AT_ONCE: Final = 16
_LONGEST_LINE: Final = 1 << 20
_LARGEST_RESULT: Final = 64 << 20
_LONGEST_LAST_LINE: Final = 300
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
        process: its keeper, which ends as the step has ended.
        log: what it prints.
        pipe: reading end of the progress pipe.
        started: ISO 8601 UTC.
        clock: monotonic seconds at the start.
        oom_kills: the kernel's counter at the start.
        reason: why we stopped it; None as long as we did not.
        is_victim: stopped for want of memory.
        kill_at: when it has had its time to end by itself, monotonic seconds.
        is_killed: the keeper was asked to end the step, and had no time before.
        step: process id of the step itself, None before it is known.
        peak_bytes: largest own memory seen from outside.
        said: what is unread of its last line.
        last_words: a failure it could not write to the disk.
    """

    task: Task
    process: StepProcess
    log: StepLog
    pipe: int
    started: str
    clock: float
    oom_kills: int
    reason: OrthoflowError | None = None
    is_victim: bool = False
    kill_at: float | None = None
    is_killed: bool = False
    step: int | None = None
    peak_bytes: int = 0
    said: bytes = b""
    last_words: str = ""


# Keeper -> what runs, of all executors of this process: a cluster's workers in it have one each.
_all_running: Final[dict[int, _Running]] = {}


@dataclass
class LocalExecutor:
    """Runs each task in a process group of its own."""

    capacity: Capacity
    tell: Tell
    _running: dict[str, _Running] = field(default_factory=dict)
    _selector: selectors.BaseSelector = field(default_factory=selectors.DefaultSelector)
    _guard: MemoryGuard = field(default_factory=MemoryGuard)
    _unstarted: list[TaskEnd] = field(default_factory=list)

    def start(self, task: Task) -> None:
        """Spawn the process of a task.

        Raises:
            StoreError: its files cannot be written.
        """
        with writing_to(Path(task.folder).parent):
            task.scratch.mkdir(parents=True, exist_ok=True)
        write_task(task)
        log = StepLog(Path(task.log))
        reading, writing = os.pipe()
        os.set_blocking(reading, False)
        try:
            process = start_step(task, writing, log.descriptor)
        except StepFailedError as error:
            log.close()
            os.close(reading)
            result = failed_result(task, error)
            self._unstarted.append(TaskEnd(address=task.address, result=result))
            return
        finally:
            os.close(writing)
        run = _Running(
            task=task,
            process=process,
            log=log,
            pipe=reading,
            started=now(),
            clock=time.monotonic(),
            oom_kills=oom_kills(),
        )
        self._running[task.address] = _all_running[process.pid] = run
        self._selector.register(run.pipe, selectors.EVENT_READ, run)
        self._selector.register(run.process.descriptor, selectors.EVENT_READ, run)

    def poll(self, timeout_s: float) -> tuple[TaskEnd, ...]:
        """Wait up to a time for tasks to end; passes on what running tasks say meanwhile."""
        unstarted, self._unstarted = tuple(self._unstarted), []
        longest_s = 0.0 if unstarted else min(timeout_s, self._guard.interval_s)
        for key, _ in self._selector.select(longest_s):
            if key.fd == key.data.pipe:
                self._hear(key.data)
        ended = [run for run in self._running.values() if run.process.has_ended()]
        ends = tuple(self._end(run) for run in ended)
        self._watch()
        return unstarted + ends

    def cancel(self) -> None:
        """Ask all tasks to stop: SIGTERM, and SIGKILL when they do not within 5 s."""
        for run in self._running.values():
            self._stop(run, CancelledStepError(f"step {run.task.address} was interrupted"))

    def close(self) -> None:
        """Kill whatever still runs."""
        for run in self._running.values():
            _end_all(run)
        for run in list(self._running.values()):
            if not run.process.wait(_GRACE_S):
                run.process.signal_group(signal.SIGKILL)
            self._forget(run)
        self._selector.close()

    def _hear(self, run: _Running) -> None:
        for _ in range(_READS_AT_ONCE):
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
            # No event is that long.
            if len(run.said) > _LONGEST_LINE:
                run.said = b""

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
            run.peak_bytes = max(run.peak_bytes, _memory_of_step(run))
            run.log.shorten()
            limit = run.task.timeout_s
            if run.kill_at is not None and time_now > run.kill_at:
                self._kill(run)
            elif limit is not None and run.reason is None and time_now - run.clock > limit:
                self._stop(run, describe_timeout(run.task.who, limit))
        self._guard_memory()

    def _guard_memory(self) -> None:
        runs = {str(keeper): run for keeper, run in _all_running.copy().items()}
        victim = self._guard.check({name: run.process.pid for name, run in runs.items()})
        # One at a time: the memory of a dying process is not free at once.
        if victim is None or any(run.is_victim for run in runs.values()):
            return
        run = runs[victim.address]
        if self._running.get(run.task.address) is not run:
            # Its own executor stops it.
            return
        run.is_victim = True
        run.reason = describe_memory(run.task.who, victim.n_bytes)
        run.peak_bytes = max(run.peak_bytes, victim.n_bytes)
        self._kill(run)

    def _kill(self, run: _Running) -> None:
        """Let the keeper end all that the step started; one that cannot any more goes with it."""
        if run.is_killed:
            run.process.signal_group(signal.SIGKILL)
        else:
            _end_all(run)
        run.is_killed = True
        run.kill_at = time.monotonic() + _GRACE_S

    def _stop(self, run: _Running, reason: OrthoflowError) -> None:
        if run.reason is None:
            run.reason = reason
            run.kill_at = time.monotonic() + _GRACE_S
            run.process.signal_group(signal.SIGTERM)

    def _end(self, run: _Running) -> TaskEnd:
        self._hear(run)
        # Somebody may have killed the keeper. Before it is reaped, so that its number cannot belong
        # to strangers already.
        run.process.signal_group(signal.SIGKILL)
        run.log.shorten()
        result = dataclasses.replace(self._result(run), log=run.log.text())
        self._forget(run)
        return TaskEnd(address=run.task.address, result=result)

    def _forget(self, run: _Running) -> None:
        run.log.close()
        for descriptor in (run.pipe, run.process.descriptor):
            with contextlib.suppress(KeyError):
                self._selector.unregister(descriptor)
        os.close(run.pipe)
        del _all_running[run.process.pid]
        run.process.close()
        del self._running[run.task.address]

    def _result(self, run: _Running) -> CellResult:
        task = run.task
        error = run.reason
        if error is None:
            try:
                text = read_whole(task.result_file, _LARGEST_RESULT)
                result = result_from_json(text, task.result_file.name)
                if result.key != task.key:
                    raise StoreError(f"{task.result_file.name} is not the result of this task")
                peak = max(result.peak_rss_mib, round(run.peak_bytes / (1 << 20), 1))
                return dataclasses.replace(result, peak_rss_mib=peak)
            except (OSError, RecursionError, UnicodeDecodeError):
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
        return StoreError(one_line(run.last_words))
    code = run.process.returncode or 0
    if code == -signal.SIGKILL and oom_kills() > run.oom_kills:
        return describe_memory(run.task.who, run.peak_bytes)
    tail = one_line(run.log.text().strip().rpartition("\n")[2], _LONGEST_LAST_LINE)
    return StepFailedError(describe_exit(run.task.who, code, run.peak_bytes, tail))


def _memory_of_step(run: _Running) -> int:
    """Anonymous bytes of the step itself, the one process that its keeper forks."""
    if run.step is None:
        run.step = next(iter(descendants(run.process.pid)), None)
    memory = process_memory(run.step) if run.step is not None else None
    return memory.anonymous if memory else 0


def _end_all(run: _Running) -> None:
    for number in (END_ALL, signal.SIGCONT):
        run.process.send_signal(number)


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
        limit = address_space()
        room = f"; a process may take {limit / MIB:.0f} MiB of memory here" if limit else ""
        return f"{who} crashed ({_CRASHES[signal.Signals(-code)]}, {name}){room}"
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
