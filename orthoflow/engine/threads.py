"""The environment of a step: thread counts fixed before any library loads, compiled code kept."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from orthoflow.engine.tasks import Task

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
_COMPILED: Final = "NUMBA_CACHE_DIR"


def child_environment(task: Task) -> dict[str, str]:
    """Environment variables for the process of a task."""
    environment = dict(os.environ)
    environment |= dict.fromkeys(_THREAD_VARIABLES, str(task.cores))
    # The child imports what this process would, wherever that came from.
    paths = [str(Path(path).absolute()) for path in sys.path]
    return environment | {
        "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths)),
        "PYTHONHASHSEED": "0",
        "PYTHONUNBUFFERED": "1",
        _COMPILED: task.numba_folder,
        "MPLBACKEND": "Agg",
        "MPLCONFIGDIR": str(Path(task.store) / "matplotlib"),
        "TMPDIR": str(task.scratch),
    }


@contextmanager
def compiled_code_in(folder: str) -> Iterator[None]:
    """Let numba keep what it compiles in a folder, in this process, for as long as a step runs."""
    before = os.environ.get(_COMPILED)
    os.environ[_COMPILED] = folder
    _tell_numba()
    try:
        yield
    finally:
        if before is None:
            del os.environ[_COMPILED]
        else:
            os.environ[_COMPILED] = before
        _tell_numba()


def _tell_numba() -> None:
    # It reads the environment once, when it is imported.
    if "numba" in sys.modules:
        from numba.core import config  # noqa: PLC0415 - only where it is loaded anyway

        config.reload_config()  # type: ignore[no-untyped-call]
