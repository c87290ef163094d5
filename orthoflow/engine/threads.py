"""The environment of a step's process: thread counts fixed before any library loads."""

from __future__ import annotations

import os
import sys
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
        "NUMBA_CACHE_DIR": task.numba_folder,
        "MPLBACKEND": "Agg",
        "MPLCONFIGDIR": str(Path(task.store) / "matplotlib"),
        "TMPDIR": str(task.scratch),
    }
