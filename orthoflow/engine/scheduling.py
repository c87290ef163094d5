"""Executes a plan: starts cells as their inputs become known, keeps going past failures."""

from __future__ import annotations

import dataclasses
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.engine.durability import remove_tree, writing_to
from orthoflow.engine.events import (
    CellFinished,
    CellLogged,
    CellProgress,
    CellStarted,
    CellWarned,
    RunListener,
    RunStarted,
    ignore,
)
from orthoflow.engine.executors import Executor, InlineExecutor, TaskEnd, Tell
from orthoflow.engine.interruption import Interruption, watching_interruptions
from orthoflow.engine.journal import Journal
from orthoflow.engine.keys import CellKey, cell_key
from orthoflow.engine.local_executor import LocalExecutor
from orthoflow.engine.locks import exclusive_lock, is_locked
from orthoflow.engine.options import ExecutorName
from orthoflow.engine.outcome import RunOutcome
from orthoflow.engine.plan import (
    RunPlan,
    known_inputs,
    needed_addresses,
)
from orthoflow.engine.results import CellResult, ProductRef
from orthoflow.engine.running import now
from orthoflow.engine.store import Store
from orthoflow.engine.task_making import TaskMaker
from orthoflow.engine.tasks import Task
from orthoflow.errors import CancelledStepError
from orthoflow.sdk.context import StepEvent
from orthoflow.workflow.cells import Cell

_POLL_S: Final = 0.25
_CODE_CHANGED: Final = (
    "the code of the method changed during the run: the result is not kept for other runs"
)


def execute(
    plan: RunPlan,
    run_folder: Path,
    store: Store,
    listen: RunListener = ignore,
    *,
    run_id: str = "",
) -> RunOutcome:
    """Run a plan to its end.

    A failed cell prunes only what needs it. After a kill at any instant the same call with the
    same folder resumes.

    Args:
        plan: from `plan_run`; its options say how to run it.
        run_folder: takes the journal and the logs; made when missing.
        store: where products and results go.
        listen: gets events as they happen.
        run_id: id of a new run, made up when empty; a resumed run keeps its own.

    Raises:
        ArgumentError: the run folder holds a finished run or other files.
        StoreError: the disk refuses, or the run folder is in use.
        CancelledStepError: interrupted by Ctrl-C or SIGTERM.
    """
    folder = Path(run_folder).absolute()
    with store.in_use(), Journal(folder, plan.name, run_id=run_id) as journal:
        with writing_to(folder):
            (folder / "logs").mkdir(exist_ok=True)
        listen(
            RunStarted(
                run_id=journal.run_id, n_cells=len(plan.cells), is_resumed=journal.is_resumed
            )
        )
        with _scratch(store, journal.run_id) as scratch, watching_interruptions() as interruption:
            tasks = TaskMaker(
                plan=plan,
                store=store,
                scratch=scratch,
                logs=folder / "logs",
                run_id=journal.run_id,
            )
            executor = _executor(plan.options.executor, _passing_on(listen), interruption)
            run = _Run(tasks, journal, listen)
            try:
                run.go(executor, interruption)
            finally:
                executor.close()
        return run.outcome()


@dataclass(frozen=True, kw_only=True)
class _Ready:
    """Key and inputs of a cell that only waits for room."""

    key: CellKey
    refs: Mapping[str, ProductRef]


class _Run:
    """The state of one run; used from one thread."""

    def __init__(self, tasks: TaskMaker, journal: Journal, listen: RunListener) -> None:
        self._tasks = tasks
        self._plan = tasks.plan
        self._store = tasks.store
        self._journal = journal
        self._listen = listen
        self._results: dict[str, CellResult] = {}
        self._cached: dict[str, str] = {}
        self._resumed: set[str] = set()
        self._made: set[str] = set()
        self._waiting = {item.cell.address: item for item in self._plan.cells}
        self._ready: dict[str, _Ready] = {}
        self._running: dict[str, Task] = {}

    def go(self, executor: Executor, interruption: Interruption) -> None:
        """Run until every cell has a result.

        Raises:
            CancelledStepError: interrupted.
        """
        while self._waiting or self._running:
            if interruption.is_asked:
                self._break_off(executor)
            self._advance(executor)
            for end in executor.poll(_POLL_S) if self._running else ():
                self._take(end)

    def outcome(self) -> RunOutcome:
        """Give what the run left, in the order of the plan."""
        self._journal.write("ended")
        order = [item.cell.address for item in self._plan.cells]
        return RunOutcome(
            run_id=self._journal.run_id,
            started=self._journal.started,
            ended=now(),
            results={address: self._results[address] for address in order},
            cached={a: self._cached[a] for a in order if a in self._cached},
            resumed=frozenset(self._resumed),
            inputs=self._plan.inputs,
        )

    def _break_off(self, executor: Executor) -> None:
        executor.cancel()
        while self._running:
            for end in executor.poll(_POLL_S):
                self._take(end)
        self._journal.write("interrupted")
        raise CancelledStepError(
            f"the run was interrupted; the same command goes on where it stopped, given "
            f"-o {self._tasks.logs.parent.name}"
        )

    def _advance(self, executor: Executor) -> None:
        """Settle or start every cell whose inputs are known, as far as the cores go."""
        for address, planned in list(self._waiting.items()):
            if address not in self._ready:
                self._prepare(planned.cell)
            ready = self._ready.get(address)
            if ready is None or self._is_under_way(ready.key):
                continue
            # An equal cell of this run may have ended meanwhile.
            known = self._store.result(ready.key.key) if ready.key.key in self._made else None
            if known is not None:
                self._settle(planned.cell, known, is_cached=True)
            elif self._has_room(planned.cell):
                self._start(planned.cell, ready, executor)

    def _prepare(self, cell: Cell) -> None:
        """Settle a cell from the store, or make it ready, as soon as its inputs are known."""
        needed = needed_addresses(cell)
        if not all(address in self._results for address in needed):
            return
        reason = cell.skip_reason or self._missing(needed)
        if reason:
            self._settle(cell, self._skipped(cell, reason))
            return
        refs = known_inputs(cell, self._plan.inputs, self._results)
        key = cell_key(cell, self._plan.methods[cell.method], refs)
        known = self._known(cell, key)
        if known is not None:
            self._settle(cell, known, is_cached=True)
        else:
            self._ready[cell.address] = _Ready(key=key, refs=refs)

    def _missing(self, needed: tuple[str, ...]) -> str:
        for address in needed:
            if self._results[address].status != "ok":
                verb = "failed" if self._results[address].status == "failed" else "was skipped"
                return f"needs {address}, which {verb}"
        return ""

    def _skipped(self, cell: Cell, reason: str) -> CellResult:
        facts = self._plan.methods.get(cell.method)
        return CellResult(
            status="skipped",
            run_id=self._journal.run_id,
            method=cell.method,
            distribution=facts.distribution if facts else "",
            distribution_version=facts.distribution_version if facts else "",
            result_version=facts.result_version if facts else 0,
            determinism=facts.determinism if facts else "",
            error_message=reason,
        )

    def _known(self, cell: Cell, key: CellKey) -> CellResult | None:
        # A forced cell that this run computed before it was interrupted is not computed twice.
        is_done = key.key in self._journal.finished_keys or key.key in self._made
        if cell.step in self._plan.options.force and not is_done:
            return None
        result = self._store.result(key.key)
        if result is not None:
            self._store.touch(key.key)
        return result

    def _is_under_way(self, key: CellKey) -> bool:
        """Whether an equal cell runs already; its result will then serve both."""
        return any(task.key == key.key for task in self._running.values())

    def _cores(self, cell: Cell) -> int:
        everything = self._plan.options.all_cores
        share = max(1, everything // self._plan.options.jobs)
        return min(cell.cores or share, everything)

    def _has_room(self, cell: Cell) -> bool:
        if not self._running:
            return True
        taken = sum(task.cores for task in self._running.values())
        is_fitting = taken + self._cores(cell) <= self._plan.options.all_cores
        return len(self._running) < self._plan.options.jobs and is_fitting

    def _start(self, cell: Cell, ready: _Ready, executor: Executor) -> None:
        task = self._tasks.make(cell, ready.key, ready.refs, self._cores(cell))
        del self._waiting[cell.address]
        self._running[cell.address] = task
        self._journal.write("started", address=cell.address, key=task.key)
        self._listen(CellStarted(address=cell.address))
        executor.start(task)

    def _take(self, end: TaskEnd) -> None:
        task = self._running.pop(end.address)
        cell = next(item.cell for item in self._plan.cells if item.cell.address == end.address)
        result = end.result
        if result.status == "ok" and self._plan.methods[cell.method].is_code_unchanged():
            self._made.add(task.key)
            self._store.put_result(task.key, result, cell.step)
        elif result.status == "ok":
            # Kept under its key it would pass for what the code of that key computes.
            self._listen(CellWarned(address=cell.address, text=_CODE_CHANGED))
            result = dataclasses.replace(result, warnings=(*result.warnings, _CODE_CHANGED))
        remove_tree(Path(task.folder))
        self._settle(cell, result)

    def _settle(self, cell: Cell, result: CellResult, *, is_cached: bool = False) -> None:
        self._waiting.pop(cell.address, None)
        self._results[cell.address] = result
        if is_cached and result.run_id == self._journal.run_id:
            self._resumed.add(cell.address)
        elif is_cached:
            self._cached[cell.address] = result.run_id
        self._journal.write(
            "finished",
            address=cell.address,
            key=result.key,
            status=result.status,
            cached=is_cached,
            error=result.error_message,
        )
        self._listen(CellFinished(address=cell.address, result=result, cached=is_cached))


def _executor(name: ExecutorName, tell: Tell, interruption: Interruption) -> Executor:
    if name == "inline":
        return InlineExecutor(tell, lambda: interruption.is_asked)
    return LocalExecutor(tell)


def _passing_on(listen: RunListener) -> Tell:
    def tell(address: str, event: StepEvent) -> None:
        if event.kind == "progress":
            listen(CellProgress(address=address, fraction=event.fraction, text=event.text))
        elif event.kind == "warning":
            listen(CellWarned(address=address, text=event.text))
        else:
            listen(CellLogged(address=address, text=event.text))

    return tell


@contextmanager
def _scratch(store: Store, run_id: str) -> Iterator[Path]:
    """A folder for work in progress; those that killed runs left are removed first."""
    with writing_to(store.folder):
        for old in store.scratch.iterdir():
            if old.is_dir() and old.name != "loose" and not is_locked(_lock_of(old)):
                remove_tree(old)
                _lock_of(old).unlink(missing_ok=True)
    folder = store.scratch / f"{run_id}-{uuid.uuid4().hex[:6]}"
    # Locked before it exists, so that no other run ever takes it for a left-over.
    with exclusive_lock(_lock_of(folder), f"the scratch folder {folder} is in use"):
        with writing_to(store.folder):
            folder.mkdir(parents=True)
        try:
            yield folder
        finally:
            remove_tree(folder)
            _lock_of(folder).unlink(missing_ok=True)


def _lock_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.lock")
