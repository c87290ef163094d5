"""Execution of a plan: starts each cell when its inputs are known, and continues after failures."""

from __future__ import annotations

import dataclasses
import signal
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Final, Literal

from orthoflow.diagnostics import Diagnostic, DiagnosticSpec, placement, warning_texts
from orthoflow.engine.durability import exclusive_lock, is_locked, remove_tree, writing_to
from orthoflow.engine.environment import environment, now
from orthoflow.engine.journal import (
    LOGS,
    CellFinished,
    CellReported,
    CellStarted,
    Journal,
    RunListener,
    RunStarted,
    cell_file_name,
    ignore,
)
from orthoflow.engine.keys import CellKey, cell_key
from orthoflow.engine.local import (
    Capacity,
    Executor,
    InlineExecutor,
    LocalExecutor,
    StepListener,
)
from orthoflow.engine.plan import (
    PlannedInput,
    RunPlan,
    known_inputs,
    remember_places,
)
from orthoflow.engine.results import CellResult, MethodIdentity, ProductRef, shared_fields
from orthoflow.engine.store import Store
from orthoflow.engine.worker import Task, TaskInput
from orthoflow.errors import (
    ArgumentError,
    CancelledStepError,
    DamageError,
    PluginError,
)
from orthoflow.geometry.threads import usable_cores
from orthoflow.sdk.context import StepEvent
from orthoflow.sdk.lines import one_line, text_of_path
from orthoflow.workflow.expand import Cell, CellOutput, WorkflowInput

_POLL_S: Final = 0.1
_CODE_CHANGED: Final = DiagnosticSpec(
    code="code-changed-while-running",
    severity="warning",
    text="the code of the method changed during the run: the result is not stored",
)
_STORED_RESULT_DAMAGED: Final = DiagnosticSpec(
    code="stored-result-damaged",
    severity="warning",
    text="the stored result was damaged ({damage}) and is recomputed",
)


@dataclass(frozen=True, kw_only=True)
class RunOutcome:
    """A finished run.

    Attributes:
        run_id: id of the run.
        started: start of the first attempt, ISO 8601, UTC.
        ended: end of the run, ISO 8601, UTC.
        results: address -> result, in the order of the plan.
        cached: address -> id of the run that computed the result, for results of other runs.
        resumed: addresses of cells that this run computed before it was interrupted.
        inputs: workflow input -> files; None for an optional input that was not given.
    """

    run_id: str
    started: str
    ended: str
    results: Mapping[str, CellResult]
    cached: Mapping[str, str] = field(default_factory=dict)
    resumed: frozenset[str] = frozenset()
    inputs: Mapping[str, PlannedInput | None] = field(default_factory=dict)

    @property
    def failed(self) -> Mapping[str, CellResult]:
        """Return the failed cells, without cells skipped because another cell failed."""
        return {
            address: result for address, result in self.results.items() if result.status == "failed"
        }

    @property
    def status(self) -> Literal["ok", "failed"]:
        """`failed` if any cell failed, otherwise `ok`."""
        return "failed" if self.failed else "ok"

    @property
    def exit_code(self) -> int:
        """Return 0 if no cell failed; 2 or 4 if all failed cells have this code; otherwise 1."""
        codes = {result.exit_code for result in self.failed.values()}
        if not codes:
            return 0
        return codes.pop() if len(codes) == 1 else 1


def execute(
    plan: RunPlan,
    run_folder: Path,
    store: Store,
    listen: RunListener = ignore,
    *,
    run_id: str = "",
) -> RunOutcome:
    """Execute a plan.

    If a cell fails, only the cells that depend on it are skipped. If the process is killed, the
    same call with the same folder resumes the run.

    Args:
        plan: plan from `plan_run`; its options control the execution.
        run_folder: folder for the journal and the logs; created if missing.
        store: store for products and results.
        listen: called with each event of the run.
        run_id: id of a new run, generated if empty; a resumed run keeps its id.

    Raises:
        ArgumentError: the run folder is in use by another run or contains a finished run or other
            files, or a path is not valid UTF-8.
        StoreError: the disk cannot be written to.
        DamageError: a product that a step needs was damaged in the store and has been removed; the
            same call recomputes this product.
        CancelledStepError: the run was interrupted by Ctrl-C or SIGTERM.
        ClusterError: the scheduler was lost or does not respond.
        PluginError: Dask is not installed, or a worker has another version of a method or library.
    """
    folder = Path(run_folder).absolute()
    for what, path in (("run folder", folder), ("store", store.folder)):
        if text_of_path(path) is None:
            raise ArgumentError(
                f"the {what} {one_line(path)} has a path that is not UTF-8: rename it"
            )
    with store.in_use(), Journal(folder, plan.name, run_id=run_id) as journal:
        with writing_to(folder):
            (folder / LOGS).mkdir(exist_ok=True)
        remember_places(plan.inputs, store)
        listen(
            RunStarted(
                run_id=journal.run_id, n_cells=len(plan.cells), is_resumed=journal.is_resumed
            )
        )
        with _scratch(store, journal.run_id) as scratch, _watching_interruptions() as interruption:
            run = _Run(plan, store, journal, listen, scratch=scratch, logs=folder / LOGS)
            executor = _executor_of(plan, scratch, run.report, lambda: interruption.is_asked)
            with closing(executor):
                run.go(executor, interruption)
        return run.outcome()


class _Run:
    def __init__(
        self,
        plan: RunPlan,
        store: Store,
        journal: Journal,
        listen: RunListener,
        *,
        scratch: Path,
        logs: Path,
    ) -> None:
        self._plan = plan
        self._store = store
        self._scratch = scratch
        self._logs = logs
        self._journal = journal
        self._listen = listen
        self._results: dict[str, CellResult] = {}
        self._cached: dict[str, str] = {}
        self._resumed: set[str] = set()
        self._made: set[str] = set()
        self._waiting = {item.cell.address: item for item in self._plan.cells}
        # Keys and inputs of cells that wait for free cores.
        self._ready: dict[str, tuple[CellKey, Mapping[str, ProductRef]]] = {}
        self._running: dict[str, Task] = {}
        self._settings = {item.cell.address: item.cell.setting for item in self._plan.cells}
        self._named = placement((item.cell.step, item.cell.method) for item in self._plan.cells)

    def go(self, executor: Executor, interruption: Interruption) -> None:
        while self._waiting or self._running:
            if interruption.is_asked:
                self._interrupt(executor)
            self._advance(executor)
            self._poll(executor)

    def report(self, address: str, event: StepEvent) -> None:
        """Pass on an event of a cell, with the step names that this workflow uses."""
        if event.diagnostic is not None:
            named = self._named(event.diagnostic, self._settings[address])
            event = dataclasses.replace(event, text=named.text, diagnostic=named)
        self._listen(CellReported(address=address, event=event))

    def _poll(self, executor: Executor) -> None:
        ends = executor.poll(_POLL_S) if self._running else {}
        for address, result in ends.items():
            self._take(self._running.pop(address), result)

    def outcome(self) -> RunOutcome:
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

    def _interrupt(self, executor: Executor) -> None:
        executor.cancel()
        while self._running:
            self._poll(executor)
        self._journal.write("interrupted")
        raise CancelledStepError(
            "the run was interrupted; to continue it, repeat the command with -o "
            f"{self._logs.parent.name}"
        )

    def _advance(self, executor: Executor) -> None:
        for address, planned in list(self._waiting.items()):
            if address not in self._ready:
                self._prepare(planned.cell)
        for address, planned in list(self._waiting.items()):
            ready = self._ready.get(address)
            if ready is None or self._is_under_way(ready[0]):
                continue
            key, refs = ready
            # Another cell of this run with the same key may have finished in the meantime.
            known = self._known(planned.cell, key) if key.key in self._made else None
            if known is not None:
                self._settle(planned.cell, known, is_cached=True)
            elif self._has_room(planned.cell, executor.capacity):
                self._require_sound(planned.cell, refs)
                self._start(planned.cell, key, refs, executor)

    def _prepare(self, cell: Cell) -> None:
        needed = cell.sources
        if not all(address in self._results for address in needed):
            return
        if cell.skip_reason:
            self._settle(cell, self._skipped(cell, cell.skip_reason, cell.skip_type))
            return
        if reason := self._missing(needed):
            self._settle(cell, self._skipped(cell, reason))
            return
        refs = known_inputs(cell, self._plan.inputs, self._results)
        key = cell_key(cell, self._plan.methods[cell.method], refs)
        known = self._known(cell, key)
        if known is not None:
            self._settle(cell, known, is_cached=True)
        else:
            self._ready[cell.address] = (key, refs)

    def _missing(self, needed: tuple[str, ...]) -> str:
        for address in needed:
            if self._results[address].status != "ok":
                verb = "failed" if self._results[address].status == "failed" else "was skipped"
                return f"needs {address}, which {verb}"
        return ""

    def _skipped(self, cell: Cell, reason: str, why: str = "") -> CellResult:
        facts = self._plan.methods.get(cell.method) or MethodIdentity(method=cell.method)
        return CellResult(
            status="skipped",
            run_id=self._journal.run_id,
            error_type=why,
            error_message=reason,
            **shared_fields(facts, MethodIdentity),
        )

    def _known(self, cell: Cell, key: CellKey) -> CellResult | None:
        # Do not recompute a forced cell that this run finished before it was interrupted.
        is_done = key.key in self._journal.finished_keys or key.key in self._made
        if cell.step in self._plan.options.force and not is_done:
            return None
        result, damage = self._store.take(key.key)
        if damage:
            damaged = _STORED_RESULT_DAMAGED.of("", {"damage": damage})
            self.report(cell.address, _event_of(damaged))
        return result

    def _require_sound(self, cell: Cell, refs: Mapping[str, ProductRef]) -> None:
        for port, ref in refs.items():
            if isinstance(cell.inputs[port], CellOutput) and not self._store.is_sound(ref.digest):
                raise DamageError(f"{cell.inputs[port]}, which {cell.address} uses, was damaged")

    def _is_under_way(self, key: CellKey) -> bool:
        """Whether another cell with the same key is running; this cell will share its result."""
        return any(task.key == key.key for task in self._running.values())

    def _has_room(self, cell: Cell, capacity: Capacity) -> bool:
        if not self._running:
            return True
        taken = sum(task.cores for task in self._running.values())
        is_fitting = taken + _cores(cell, capacity) <= capacity.n_cores
        return len(self._running) < capacity.n_tasks and is_fitting

    def _start(
        self, cell: Cell, key: CellKey, refs: Mapping[str, ProductRef], executor: Executor
    ) -> None:
        task = self._task(cell, key, refs, _cores(cell, executor.capacity))
        del self._waiting[cell.address]
        self._journal.write("started", address=cell.address, key=task.key)
        self._listen(CellStarted(address=cell.address))
        self._running[task.address] = task
        executor.start(task)

    def _task(self, cell: Cell, key: CellKey, refs: Mapping[str, ProductRef], cores: int) -> Task:
        facts, products = self._plan.methods[cell.method], self._plan.products

        def given(port: str, ref: ProductRef) -> TaskInput:
            source = cell.inputs[port]
            if not isinstance(source, WorkflowInput):
                return TaskInput(ref=ref, target=products[ref.type_name].target)
            planned = self._plan.inputs[source.name]
            return TaskInput(
                ref=ref, input_name=source.name, files=planned.files if planned else ()
            )

        return Task(
            address=cell.address,
            run_id=self._journal.run_id,
            target=facts.target,
            key=key.key,
            key_preimage=key.preimage,
            params=cell.params,
            seed=cell.seed,
            inputs={port: given(port, ref) for port, ref in refs.items()},
            outputs={port: products[type_name] for port, type_name in facts.outputs.items()},
            cores=cores,
            timeout_s=cell.timeout_s,
            store=str(self._store.folder),
            folder=str(self._scratch / uuid.uuid4().hex[:12]),
            log=str(self._logs / f"{cell_file_name(cell.address)}.log"),
            kernels=facts.kernels,
            environment=environment(cores),
            **shared_fields(facts, MethodIdentity),
        )

    def _take(self, task: Task, result: CellResult) -> None:
        remove_tree(Path(task.folder))
        cell = next(one.cell for one in self._plan.cells if one.cell.address == task.address)
        if result.error_type == DamageError.__name__:
            # The inputs were damaged after they had been checked, so the method is not at fault.
            self._require_sound(cell, {port: given.ref for port, given in task.inputs.items()})
            raise DamageError(result.error_message)
        if result.status == "ok" and self._plan.methods[cell.method].is_code_unchanged():
            self._made.add(task.key)
            self._store.put_result(task.key, result)
            self._store.trust(result)
        elif result.status == "ok":
            # Do not store the result: its key contains the digest of the code before the change.
            changed = _CODE_CHANGED.of("", {})
            self.report(cell.address, _event_of(changed))
            result = _reporting(result, changed)
        self._settle(cell, result)

    def _settle(self, cell: Cell, result: CellResult, *, is_cached: bool = False) -> None:
        self._waiting.pop(cell.address, None)
        # A stored result may come from another workflow, so replace its step names by those of
        # this workflow.
        named = (self._named(one, self._settings[cell.address]) for one in result.diagnostics)
        result = _reporting(dataclasses.replace(result, diagnostics=()), *named)
        self._results[cell.address] = result
        # A result that another cell of this run has just computed counts as new.
        if is_cached and result.run_id != self._journal.run_id:
            self._cached[cell.address] = result.run_id
        elif is_cached and result.key not in self._made:
            self._resumed.add(cell.address)
        self._journal.write(
            "finished",
            address=cell.address,
            key=result.key,
            status=result.status,
            cached=is_cached,
            error=result.error_message,
            error_type=result.error_type,
        )
        self._listen(CellFinished(address=cell.address, result=result, cached=is_cached))


def _event_of(diagnostic: Diagnostic) -> StepEvent:
    return StepEvent(kind="diagnostic", text=diagnostic.text, diagnostic=diagnostic)


def _reporting(result: CellResult, *more: Diagnostic) -> CellResult:
    reported = (*result.diagnostics, *more)
    return dataclasses.replace(result, diagnostics=reported, warnings=warning_texts(reported))


def _cores(cell: Cell, capacity: Capacity) -> int:
    return min(cell.cores or capacity.share, capacity.cores_of_one)


@contextmanager
def _scratch(store: Store, run_id: str) -> Iterator[Path]:
    """Create a scratch folder for the block, after removing leftovers of killed runs."""
    with writing_to(store.folder):
        for old in store.scratch.iterdir():
            if old.is_dir() and old.name != "loose" and not is_locked(_lock_of(old)):
                remove_tree(old)
                _lock_of(old).unlink(missing_ok=True)
    folder = store.scratch / f"{run_id}-{uuid.uuid4().hex[:6]}"
    # Lock the folder before creating it, so that no other run mistakes it for a leftover.
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


def _executor_of(
    plan: RunPlan, scratch: Path, listen: StepListener, is_asked_to_stop: Callable[[], bool]
) -> Executor:
    options = plan.options
    capacity = Capacity.of_jobs(options.jobs, usable_cores())
    if options.executor == "dask":
        try:
            from orthoflow.engine.dask import DaskExecutor  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise PluginError(
                "--executor dask needs dask: pip install 'orthoflow-tls[dask]'"
            ) from error
        return DaskExecutor(plan, scratch, capacity, listen)
    if options.executor == "inline":
        return InlineExecutor(capacity, listen, is_asked_to_stop)
    return LocalExecutor(capacity, listen)


class Interruption:
    """A signal handler that records whether the run was asked to stop.

    Attributes:
        is_asked: whether a signal was received.
    """

    def __init__(self) -> None:
        self.is_asked = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Record the first signal, and raise an error on the second.

        Raises:
            KeyboardInterrupt: a second signal was received.
        """
        if self.is_asked:
            raise KeyboardInterrupt
        self.is_asked = True


@contextmanager
def _watching_interruptions() -> Iterator[Interruption]:
    """Handle SIGINT and SIGTERM while the block runs, if this is the main thread."""
    interruption = Interruption()
    if threading.current_thread() is not threading.main_thread():
        yield interruption
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, interruption) for number in numbers}
    try:
        yield interruption
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
