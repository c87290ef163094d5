"""What runs tasks: the interface, and the executor that runs them in this very process."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from orthoflow.engine.durability import write_whole
from orthoflow.engine.kernels import kernel_folder, kernels_in
from orthoflow.engine.results import CellResult
from orthoflow.engine.running import failed_result, run_task
from orthoflow.engine.tasks import Task
from orthoflow.errors import CancelledStepError
from orthoflow.foreign_text import shown
from orthoflow.sdk.context import StepEvent

Tell = Callable[[str, StepEvent], None]
# Of a long log the end is kept.
_MOST_LINES: Final = 2000


@dataclass(frozen=True, kw_only=True)
class TaskEnd:
    """A task that ended.

    Attributes:
        address: of its cell.
        result: ok or failed, never skipped.
    """

    address: str
    result: CellResult


@dataclass(frozen=True, kw_only=True)
class Capacity:
    """What may run at the same time.

    Attributes:
        n_tasks: tasks.
        n_cores: cores of all of them.
        cores_of_one: the most that one may have.
        share: what one gets that asks for nothing.
    """

    n_tasks: int
    n_cores: int
    cores_of_one: int
    share: int

    @classmethod
    def of_jobs(cls, jobs: int, n_cores: int) -> Capacity:
        """So many jobs that share the cores of one machine."""
        share = max(1, n_cores // jobs)
        return cls(n_tasks=jobs, n_cores=n_cores, cores_of_one=n_cores, share=share)


class Executor(Protocol):
    """Runs tasks; used from one thread.

    Nothing here assumes one machine: a task is JSON, its results lie in the store.
    """

    @property
    def capacity(self) -> Capacity:
        """What may run at the same time, now."""

    def start(self, task: Task) -> None:
        """Begin a task, or put it in line.

        Raises:
            StoreError: its files cannot be written.
        """

    def poll(self, timeout_s: float) -> tuple[TaskEnd, ...]:
        """Wait up to a time for tasks to end; passes on what running tasks say meanwhile."""

    def cancel(self) -> None:
        """Ask all tasks to stop; they still end through `poll`, after a grace period by force."""

    def close(self) -> None:
        """Stop whatever still runs, at once."""


class InlineExecutor:
    """Runs tasks one by one in this process, for debugging: no timeout, no crash protection."""

    def __init__(self, capacity: Capacity, tell: Tell, is_interrupted: Callable[[], bool]) -> None:
        """Make one.

        Args:
            capacity: what a task may have.
            tell: gets the address of a task and what it says.
            is_interrupted: whether the user asked to stop, also while a task runs.
        """
        self.capacity = capacity
        self._tell = tell
        self._is_interrupted = is_interrupted
        self._waiting: deque[Task] = deque()
        self._is_cancelled = False

    def start(self, task: Task) -> None:
        """Put a task in line."""
        self._waiting.append(task)

    def poll(self, timeout_s: float) -> tuple[TaskEnd, ...]:
        """Run the next task to its end; the timeout means nothing here."""
        if not self._waiting:
            return ()
        task = self._waiting.popleft()
        if self._is_cancelled:
            reason = CancelledStepError(f"step {task.address} was interrupted")
            return (TaskEnd(address=task.address, result=failed_result(task, reason)),)
        log: deque[str] = deque(maxlen=_MOST_LINES)

        def listen(event: StepEvent) -> None:
            if event.kind != "progress":
                log.append(shown(event.text, keep="\n"))
            self._tell(task.address, event)

        with kernels_in(kernel_folder(task.kernels)):
            result = run_task(task, listen, self._is_interrupted)
        text = "".join(f"{line}\n" for line in log)
        write_whole(Path(task.log), text.encode())
        return (TaskEnd(address=task.address, result=dataclasses.replace(result, log=text)),)

    def cancel(self) -> None:
        """Let the tasks in line end without running; none runs while this is called."""
        self._is_cancelled = True

    def close(self) -> None:
        """Forget the tasks in line."""
        self._waiting.clear()
