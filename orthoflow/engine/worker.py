"""Execution of one task: reads the inputs, calls the method and stores the outputs.

`run_step` is the main function of a step's process; `run_task` runs a task in any process.
"""

from __future__ import annotations

import ctypes
import dataclasses
import errno
import faulthandler
import io
import json
import multiprocessing
import os
import pkgutil
import resource
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

import numpy as np
import psutil
import threadpoolctl
from pydantic import JsonValue, ValidationError

from orthoflow.diagnostics import Diagnostic, warning_texts
from orthoflow.engine.durability import is_broken, store_error, writing_to
from orthoflow.engine.environment import now
from orthoflow.engine.file_digests import FileRef, file_identity, file_sha256
from orthoflow.engine.kernels import reload_numba_config
from orthoflow.engine.measuring import MIB, LoadingMeter, is_for_want_of_memory, process_memory
from orthoflow.engine.results import (
    CellResult,
    Costs,
    Figure,
    FigureRef,
    MethodIdentity,
    ProductRef,
    ProductTarget,
    RecordedEnvironment,
    result_to_json,
    shared_fields,
)
from orthoflow.engine.store import Store
from orthoflow.errors import (
    InputError,
    MethodError,
    OrthoflowError,
    PluginError,
    ProductError,
    StepFailedError,
)
from orthoflow.geometry.compile_events import on_compiling
from orthoflow.products.input_files import InputFiles
from orthoflow.products.product import Product
from orthoflow.sdk.context import StepContext, StepEvent
from orthoflow.sdk.lines import describe_error, one_line
from orthoflow.sdk.methods import Method, labelled
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    from orthoflow.catalog.catalog import Publisher

# Maximum length of an error message, which contains the method's own message (truncated earlier)
# and text around it.
_LONGEST_ERROR: Final = 4000
_LONGEST_TRACE: Final = 64 << 10
_OOM_SCORE: Final = "900"
_PROGRESS_EVERY_S: Final = 0.1
_PR_SET_CHILD_SUBREAPER: Final = 36


@dataclass(frozen=True, kw_only=True)
class TaskInput:
    """A product on an input port.

    Attributes:
        ref: reference to the product.
        target: import string of the product class; empty for the files of a workflow input.
        input_name: name of the workflow input; empty for products.
        files: files of the workflow input.
    """

    ref: ProductRef
    target: str = ""
    input_name: str = ""
    files: tuple[FileRef, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Task(MethodIdentity):
    """One method call, with everything that its process needs.

    Attributes:
        address: address of the cell.
        run_id: id of the run.
        target: import string of the method's class.
        key: cache key.
        key_preimage: text whose digest is the key.
        params: resolved parameters, as JSON.
        seed: seed of the random generator.
        inputs: port -> product.
        outputs: port -> expected type.
        cores: maximum number of threads.
        timeout_s: time limit in seconds; None if there is none.
        store: folder of the store.
        folder: folder of the task, on the store's file system, for scratch files and unfinished
            objects.
        log: file for stdout and stderr.
        kernels: name of the folder for compiled kernels.
        environment: environment in which the task will run.
    """

    address: str
    run_id: str
    target: str
    key: str
    key_preimage: str
    params: Mapping[str, JsonValue]
    seed: int
    inputs: Mapping[str, TaskInput]
    outputs: Mapping[str, ProductTarget]
    cores: int
    timeout_s: float | None
    store: str
    folder: str
    log: str
    kernels: str
    environment: RecordedEnvironment | None = None

    @property
    def who(self) -> str:
        """Name of the method and its distribution, for error messages."""
        brought = (
            f" of {self.distribution} {self.distribution_version}" if self.distribution else ""
        )
        return f"method {self.method}{brought}"

    @property
    def scratch(self) -> Path:
        """Return the folder that the method may write to."""
        return Path(self.folder) / "scratch"


Listener = Callable[[StepEvent], None]


# A message from the process of a step consists of one of these prefixes, followed by JSON.
EVENT: Final = b"event "
RESULT: Final = b"result "


def run_step(task: Task, pipe: Connection, variables: Mapping[str, str]) -> None:
    """Run a task as the main function of a step's process, and send messages and the result.

    Args:
        task: the task.
        pipe: receives `EVENT` and `RESULT` messages.
        variables: all environment variables of the step.
    """
    _move_to(task, variables)
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    # From now on, only the method itself can raise KeyboardInterrupt.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_coordinator, daemon=True).start()
    events = _EventPipe(pipe)
    result = run_task(task, events.listen, stop.is_set)
    events.send(RESULT + result_to_json(result).encode())
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):
            stream.flush()
    _kill_children()
    # Skip the shutdown of the interpreter: libraries crash there, and threads may never end.
    os._exit(0)


def _move_to(task: Task, variables: Mapping[str, str]) -> None:
    os.setsid()
    # If the parent of a descendant ends, make the descendant a child of this process, even if it is
    # in another session.
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    log = os.open(task.log, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW)
    for descriptor in (1, 2):
        os.dup2(log, descriptor)
    os.close(log)
    sys.stdout, sys.stderr = (
        io.TextIOWrapper(
            io.FileIO(descriptor, "w", closefd=False),
            encoding="utf-8",
            errors="backslashreplace",
            write_through=True,
        )
        for descriptor in (1, 2)
    )
    faulthandler.enable()
    os.environ.clear()
    os.environ.update(variables)
    task.scratch.mkdir(parents=True, exist_ok=True)
    os.chdir(task.scratch)
    tempfile.tempdir = None
    # Let the kernel kill this process before the coordinator when memory runs out.
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_OOM_SCORE, encoding="ascii")
    # Libraries that are already loaded have read their thread limits, so set the limits again.
    reload_numba_config()
    threadpoolctl.threadpool_limits(task.cores)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(task.cores)


def _end_with_coordinator() -> None:
    coordinator = multiprocessing.parent_process()
    if coordinator is not None:
        coordinator.join()
        _kill_children()
        os.killpg(0, signal.SIGKILL)


def _kill_children() -> None:
    with suppress(psutil.Error):
        for child in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):
                child.kill()


class _EventPipe:
    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._lock = threading.Lock()
        self._sent_s = 0.0
        self._sent = StepEvent(kind="progress", text="", fraction=0.0)

    def listen(self, event: StepEvent) -> None:
        """Send an event; events other than progress are also written to the log.

        Progress events are sent at most ten times a second, except those that start a new activity
        (a new text without a higher fraction), which are always sent.
        """
        if event.kind == "progress":
            is_soon = time.monotonic() - self._sent_s < _PROGRESS_EVERY_S
            is_same = event.text == self._sent.text or event.fraction > self._sent.fraction
            if is_soon and is_same and event.fraction < 1.0:
                return
            self._sent_s, self._sent = time.monotonic(), event
        else:
            # The method may have closed or replaced `sys.stderr`.
            with suppress(AttributeError, OSError, ValueError):
                sys.stderr.write(shown(event.text, keep="\n") + "\n")
        self.send(EVENT + json.dumps(dataclasses.asdict(event)).encode())

    def send(self, message: bytes) -> None:
        """Send a message, unless the method has closed the pipe."""
        with self._lock, suppress(OSError):
            self._pipe.send_bytes(message)


def run_task(task: Task, listen: Listener, is_cancelled: Callable[[], bool]) -> CellResult:
    """Run a task; a failure is returned as a failed result and never raised as an exception.

    Args:
        task: the task; its folder must exist.
        listen: called with progress, log lines and diagnostics.
        is_cancelled: returns whether the task should stop.
    """
    started = now()
    meter, progress = LoadingMeter(), _ProgressWithCompiling(listen)
    call = _Call(task, progress.listen, is_cancelled, meter)
    try:
        with meter, on_compiling(progress.compiling):
            result = call.run()
    except BaseException as error:
        # In a process that ignores Ctrl-C, only the method can have raised KeyboardInterrupt.
        is_users = signal.getsignal(signal.SIGINT) is not signal.SIG_IGN
        if isinstance(error, KeyboardInterrupt) and is_users:
            raise
        result = failed_result(task, explain_failure(task, error))
        if not isinstance(error, OrthoflowError):
            # Write the traceback to the log, which becomes part of the record, for the author of
            # the method.
            progress.listen(StepEvent(kind="log", text=_trace(error)))
            result = dataclasses.replace(result, is_bug=True)
    return dataclasses.replace(
        result,
        started=started,
        ended=now(),
        warnings=warning_texts(call.diagnostics),
        diagnostics=tuple(call.diagnostics),
        **shared_fields(call.costs(), Costs),
    )


def failed_result(task: Task, error: OrthoflowError) -> CellResult:
    """Return the result of a cell that failed."""
    # The message of an InputError may list several problems, one per line.
    message = "; ".join(str(error).splitlines()) if type(error) is InputError else error
    return dataclasses.replace(
        blank_result(task),
        status="failed",
        error_type=type(error).__name__,
        error_message=one_line(message, _LONGEST_ERROR) or f"{task.who} failed without a message",
        exit_code=error.exit_code,
    )


def blank_result(task: Task) -> CellResult:
    """Return a result that contains everything that is known before the task runs."""
    return CellResult(
        status="ok",
        key=task.key,
        key_preimage=task.key_preimage,
        run_id=task.run_id,
        **shared_fields(task, MethodIdentity),
        seed=None if task.determinism == "exact" else task.seed,
        environment=task.environment,
        inputs={port: given.ref for port, given in task.inputs.items()},
    )


def explain_failure(task: Task, error: BaseException) -> OrthoflowError:
    """Convert any exception of a method into an OrthoflowError with a one-sentence message."""
    if isinstance(error, OrthoflowError):
        return error
    if is_for_want_of_memory(error):
        return StepFailedError(
            f"{task.who} needed more memory than was available: "
            f"{one_line(error) or 'an allocation failed'}"
        )
    if isinstance(error, ImportError):
        missing = error.name or "a library"
        return PluginError(
            f"{task.who} needs {missing}, which is missing or fails to import: {one_line(error)}"
        )
    if isinstance(error, OSError) and (refused := _disk_failure(error, Path(task.store))):
        return refused
    return MethodError(f"{task.who} failed unexpectedly: {describe_error(error)}")


def _disk_failure(error: OSError, store: Path) -> OrthoflowError | None:
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        # Do not return a StoreError, which would end the run: the method needed more disk space
        # than is available.
        return StepFailedError(str(store_error(error, store)))
    return store_error(error, store) if is_broken(error, store) else None


class _ProgressWithCompiling:
    def __init__(self, listen: Listener) -> None:
        self._listen = listen
        self._last = StepEvent(kind="progress", text="", fraction=0.0)

    def listen(self, event: StepEvent) -> None:
        if event.kind == "progress":
            self._last = event
        self._listen(event)

    def compiling(self, text: str) -> None:
        """Report which kernel is compiled; repeat the previous message at the end."""
        self._listen(dataclasses.replace(self._last, text=text or self._last.text))


class _Call:
    """One call of a method; its measurements are available even if the call fails."""

    def __init__(
        self,
        task: Task,
        listen: Listener,
        is_cancelled: Callable[[], bool],
        meter: LoadingMeter,
    ) -> None:
        self.task = task
        self._meter = meter
        self._wall_s = self._processor_s = 0.0
        self._stored_mib: float | None = None
        self._store = Store(Path(task.store), workspace=Path(task.folder))
        with writing_to(self._store.folder):
            task.scratch.mkdir(parents=True, exist_ok=True)
        self._context = StepContext(
            rng=np.random.default_rng(task.seed),
            cores=task.cores,
            scratch=task.scratch,
            listen=listen,
            is_cancelled=is_cancelled,
            clock_s=meter.clock_s,
            processor_s=self._cpu_s,
        )

    @property
    def diagnostics(self) -> list[Diagnostic]:
        return self._context.diagnostics

    def costs(self) -> Costs:
        return Costs(
            wall_s=self._wall_s,
            cpu_s=self._processor_s,
            # If the step runs in its own process, the executor also samples the memory of this
            # process.
            peak_rss_mib=round(process_memory() / MIB, 1),
            stored_mib=self._stored_mib,
            compile_s=round(self._meter.total_s, 4),
        )

    def run(self) -> CellResult:
        cls = cast("type[Method]", pkgutil.resolve_name(self.task.target))
        inputs = {port: self._read(given) for port, given in self.task.inputs.items()}
        params = self._params(cls)
        wall_s, cpu_s, process = self._meter.clock_s(), self._cpu_s(), os.getpid()
        try:
            outputs = cast("object", cls().run(cls.In(**inputs), params, self._context))
        finally:
            if os.getpid() != process:
                # This process was forked by the method, so it has no result to return.
                os._exit(1)
            drawing_s, drawing_cpu_s = self._context.drawing_s
            self._wall_s = round(self._meter.clock_s() - wall_s - drawing_s, 4)
            # The clock of a thread can be a few ticks ahead of the clock of its process.
            self._processor_s = max(0.0, round(self._cpu_s() - cpu_s - drawing_cpu_s, 4))
        # Do not use `progress`, which would raise an error if the run is cancelled: a finished
        # step keeps its result.
        self._context.listen(StepEvent(kind="progress", text="storing the results", fraction=1.0))
        for given in self.task.inputs.values():
            for file in given.files:
                _check_file(file)
        result = dataclasses.replace(
            blank_result(self.task),
            outputs=self._keep(self._products(cls, outputs, inputs)),
            metrics=labelled(cls, self._context.metrics),
            figures=self._keep_figures(),
        )
        self._stored_mib = round(self._store.size_bytes(result) / MIB, 3)
        return result

    def _cpu_s(self) -> float:
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        own_s = time.process_time() - self._meter.processor_s
        return own_s + children.ru_utime + children.ru_stime

    def _read(self, given: TaskInput) -> Product | InputFiles:
        if given.input_name:
            paths = tuple(file.path for file in given.files)
            return InputFiles(name=given.input_name, paths=paths)
        cls = cast("type[Product]", pkgutil.resolve_name(given.target))
        return self._store.get_product(given.ref.digest, cls, is_checked=True)

    def _params(self, cls: type[Method]) -> object:
        try:
            return cls.Params.model_validate_json(json.dumps(dict(self.task.params)), strict=True)
        except ValidationError as error:
            problems = "; ".join(
                f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()
            )
            raise MethodError(f"{self.task.who} has invalid parameters: {problems}") from error

    def _products(
        self, cls: type[Method], outputs: object, inputs: Mapping[str, Product | InputFiles]
    ) -> dict[str, Product]:
        given = {port: one for port, one in inputs.items() if isinstance(one, Product)}
        if not isinstance(outputs, cls.Out):
            raise MethodError(f"{self.task.who} must return an Out, got {type(outputs).__name__}")
        products: dict[str, Product] = {}
        for port, expected in self.task.outputs.items():
            product = getattr(outputs, port)
            if not isinstance(product, Product) or product.type_name != expected.type_name:
                raise MethodError(
                    f"output port {port} of {self.task.who} must be of type {expected.type_name}, "
                    f"got {type(product).__name__}"
                )
            products[port] = product
        for port, product in products.items():
            others = {name: other for name, other in products.items() if name != port}
            try:
                product.check_against(given | others)
            except ProductError as error:
                raise MethodError(f"{self.task.who} returns an invalid {port}: {error}") from error
        return products

    def _keep(self, products: Mapping[str, Product]) -> dict[str, ProductRef]:
        refs: dict[str, ProductRef] = {}
        for port, product in products.items():
            expected = self.task.outputs[port]
            target = expected.publisher
            publisher = cast("Publisher", pkgutil.resolve_name(target)) if target else None
            refs[port] = self._store.put_product(product, publisher)
        return refs

    def _keep_figures(self) -> tuple[FigureRef, ...]:
        return tuple(
            FigureRef(
                sha256=self._store.put_blob(figure.path.read_bytes()),
                **shared_fields(figure, Figure),
            )
            for figure in self._context.figures
        )


def _check_file(file: FileRef) -> None:
    path = file.path
    try:
        # A change in the time stamp alone does not matter.
        is_same = file_identity(path) == file.identity or file_sha256(path) == file.sha256
    except OSError as error:
        raise InputError(f"cannot read the input file {path} any more: {error.strerror}") from error
    if not is_same:
        raise InputError(f"the input file {path} changed while it was read; run again")


def _trace(error: BaseException) -> str:
    try:
        text = "".join(traceback.format_exception(error))
    except Exception:  # noqa: BLE001 - its own text may raise one
        text = ""
    # Keep the end of the traceback, which contains the error.
    return text[-_LONGEST_TRACE:].encode(errors="backslashreplace").decode()
