"""Running a method in a separate process with empty folders, to find files that it leaves."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.engine.kernels import VARIABLE
from orthoflow.testing.trials import Trial

# Environment variables that make libraries use other instructions, and so give other bits.
_INSTRUCTION_SWITCHES: Final = (
    "NPY_DISABLE_CPU_FEATURES",
    "NUMBA_CPU_FEATURES",
    "NUMBA_CPU_NAME",
    "OPENBLAS_CORETYPE",
    "OPENCV_CPU_DISABLE",
)
_LIMIT_S: Final = 600
_PROGRAM: Final = """
import json, pickle, sys
from pathlib import Path
from orthoflow.testing.trials import run_trial
world = Path(sys.argv[1])
run = run_trial(pickle.loads((world / "trial").read_bytes()), world / "scratch", draws=False)
(world / "digests.json").write_text(json.dumps(dict(run.digests)))
"""


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
    (world / "trial").write_bytes(pickle.dumps(trial))
    kept = ("PATH", "LD_LIBRARY_PATH", VARIABLE, *_INSTRUCTION_SWITCHES)
    environment = {
        **{name: os.environ[name] for name in kept if name in os.environ},
        "PYTHONPATH": os.pathsep.join(sys.path),
        "HOME": str(places["home"]),
        "TMPDIR": str(places["tmp"]),
        # As for steps of the engine: matplotlib's font cache does not belong to the method.
        "MPLCONFIGDIR": str(world / "matplotlib"),
        # Two threads if this session uses one, otherwise one.
        "OPENBLAS_NUM_THREADS": "2" if os.environ.get("OPENBLAS_NUM_THREADS") == "1" else "1",
    }
    environment.setdefault(VARIABLE, str(world / "numba"))
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(world)],
        cwd=places["cwd"],
        env=environment,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=_LIMIT_S,
        check=False,
    )
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise AssertionError(
            f"in a new process the method ended with exit code {done.returncode}: {last}"
        )
    strays = tuple(
        f"{name}/{path.relative_to(place)}"
        for name, place in places.items()
        for path in sorted(place.rglob("*"))
        if path.is_file()
    )
    return ElsewhereRun(digests=json.loads((world / "digests.json").read_text()), strays=strays)
