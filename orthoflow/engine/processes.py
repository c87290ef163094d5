"""Starting the process of a step, and ending it with all that it started.

Processes come from `multiprocessing`: forked from a server that has loaded `engine.preload` where
the system has that, spawned elsewhere.
"""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
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


def start_step(task: Task) -> tuple[BaseProcess, Connection]:
    """Start the process of a task; its log and its folder exist.

    Returns:
        The process, and what it says as in `worker.run_step`.

    Raises:
        StepFailedError: this machine gives no process more.
    """
    context = (
        multiprocessing.get_context("forkserver")
        if _HAS_SERVER
        else multiprocessing.get_context("spawn")
    )
    ours, theirs = context.Pipe(duplex=False)
    arguments = (task, theirs, _variables(task))
    failure: Exception | None = None
    with theirs, _starting, _start_conditions():
        context.set_forkserver_preload(PRELOADED)
        # A server that somebody killed is noticed by its silence, and started anew.
        for _ in range(2):
            process = context.Process(target=run_step, args=arguments, name=task.address)
            try:
                process.start()
            except (OSError, EOFError) as error:
                failure = error
            else:
                return process, ours
    ours.close()
    is_of_files = isinstance(failure, OSError) and failure.errno in (errno.EMFILE, errno.ENFILE)
    why = (
        "too many files are open: raise the limit (`ulimit -n`)"
        if is_of_files
        else "the machine has too little memory or allows too few processes"
    )
    raise StepFailedError(f"no process could be started for {task.who}: {why}") from failure


def ask_to_end(process: BaseProcess) -> None:
    """Ask a step to stop by itself."""
    with suppress(OSError):
        process.terminate()


def end_tree(process: BaseProcess) -> None:
    """Kill a step with all that it started, also when it has ended by itself."""
    assert process.pid is not None  # noqa: S101 - it was started
    with suppress(psutil.Error):
        step = psutil.Process(process.pid)
        for one in (*step.children(recursive=True), step):
            with suppress(psutil.Error):
                one.kill()
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)


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
    # A setting of somebody who debugs kernels; for that there is --executor inline.
    variables.pop("NUMBA_DISABLE_JIT", None)
    return variables | {
        **dict.fromkeys(_THREAD_VARIABLES, str(task.cores)),
        "PYTHONHASHSEED": "0",
        VARIABLE: str(kernel_folder(task.kernels)),
        "MPLBACKEND": "Agg",
        "MPLCONFIGDIR": str(private_folder("matplotlib")),
        "TMPDIR": str(task.scratch),
    }
