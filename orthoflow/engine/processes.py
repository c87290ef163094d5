"""Starting the process of a step, and ending it with all its descendants.

Processes come from `multiprocessing`: forked from a server that has loaded `engine.preload` if the
system supports it, otherwise spawned.
"""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Final

import psutil

from orthoflow.engine.kernels import VARIABLE, kernel_folder, private_folder
from orthoflow.engine.worker import Task, run_step
from orthoflow.errors import StepFailedError

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
