"""Running a method in a separate process with empty folders, to find files that it leaves."""

from __future__ import annotations

import importlib
import json
import os
import pickle
import sys
import tempfile
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import threadpoolctl

from orthoflow.engine.kernels import VARIABLE, reload_numba_config
from orthoflow.engine.local import start_process
from orthoflow.testing.trials import Trial, run_trial

# Environment variables that make libraries use other instructions, and so give other bits.
_INSTRUCTION_SWITCHES: Final = (
    "NPY_DISABLE_CPU_FEATURES",
    "NUMBA_CPU_FEATURES",
    "NUMBA_CPU_NAME",
    "OPENBLAS_CORETYPE",
    "OPENCV_CPU_DISABLE",
)
_LIMIT_S: Final = 600


@dataclass(frozen=True, kw_only=True)
class ElsewhereRun:
    """Result of a run in another process.

    Attributes:
        digests: port -> digest of the output.
        strays: files found in the working, home or temporary folder.
    """

    digests: Mapping[str, str]
    strays: tuple[str, ...]


def run_elsewhere(trial: Trial, folder: Path) -> ElsewhereRun:
    """Run a trial in a new process with other folders, hash seed and number of BLAS threads.

    Raises:
        AssertionError: the process failed; the message ends with the last line of its output.
    """
    world = folder / "elsewhere"
    places = {name: world / name for name in ("cwd", "home", "tmp")}
    for place in places.values():
        place.mkdir(parents=True, exist_ok=True)
    kept = ("PATH", "LD_LIBRARY_PATH", VARIABLE, *_INSTRUCTION_SWITCHES)
    environment = {name: os.environ[name] for name in kept if name in os.environ}
    # Use two threads if this session uses one, otherwise one.
    algebra_threads = 2 if os.environ.get("OPENBLAS_NUM_THREADS") == "1" else 1
    arguments = (world, pickle.dumps(trial), environment, algebra_threads)
    process = start_process(_run_apart, arguments, trial.method.id)
    process.join(_LIMIT_S)
    if process.exitcode is None:
        process.kill()
        process.join()
        raise AssertionError(f"in a new process the method did not end within {_LIMIT_S} s")
    code = process.exitcode
    process.close()
    if code != 0:
        output = (world / "output.txt").read_text(errors="replace").strip().splitlines()
        raise AssertionError(
            f"in a new process the method ended with exit code {code}: "
            f"{output[-1] if output else 'nothing'}"
        )
    strays = tuple(
        f"{name}/{path.relative_to(place)}"
        for name, place in places.items()
        for path in sorted(place.rglob("*"))
        if path.is_file()
    )
    return ElsewhereRun(digests=json.loads((world / "digests.json").read_text()), strays=strays)


def _run_apart(
    world: Path, pickled: bytes, environment: Mapping[str, str], algebra_threads: int
) -> None:
    code = 1
    try:
        output = os.open(world / "output.txt", os.O_WRONLY | os.O_CREAT)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for descriptor, replaced in ((nothing, 0), (output, 1), (output, 2)):
            os.dup2(descriptor, replaced)
        os.environ.clear()
        os.environ.update(environment, HOME=str(world / "home"), TMPDIR=str(world / "tmp"))
        # As for steps of the engine: matplotlib's font cache does not belong to the method.
        os.environ["MPLCONFIGDIR"] = str(world / "matplotlib")
        os.environ.setdefault(VARIABLE, str(world / "numba"))
        reload_numba_config()
        tempfile.tempdir = None
        os.chdir(world / "cwd")
        importlib.invalidate_caches()
        with threadpoolctl.threadpool_limits(algebra_threads):
            # Unpickling also imports the method.
            run = run_trial(pickle.loads(pickled), world / "scratch", draws=False)
        (world / "digests.json").write_text(json.dumps(dict(run.digests)))
        code = 0
    except BaseException:  # noqa: BLE001 - it goes to the file that the parent reads
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)
