"""Running a method in a process of its own, in an empty world, to see what it leaves behind.

One server per session imports what methods build on, runs none of them, and forks a process per
trial: a new interpreter and its imports would cost seconds for each.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine.store import Store
from orthoflow.products import InputFiles, Product
from orthoflow.testing.trials import Trial, run_trial

# With these, libraries compute with other instructions than the processor has, and to other bits.
INSTRUCTION_SWITCHES: Final = (
    "NPY_DISABLE_CPU_FEATURES",
    "NUMBA_CPU_FEATURES",
    "NUMBA_CPU_NAME",
    "OPENBLAS_CORETYPE",
    "OPENCV_CPU_DISABLE",
)
# Two where the session has one, else one.
_ALGEBRA_THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_SERVE: Final = "from orthoflow.testing.isolation import serve; serve()"
_LIMIT_S: Final = 600
# Slow to import, harmless to fork after; the server imports them once the session has.
_SHARED_LIBRARIES: Final = ("numba", "scipy.ndimage", "scipy.spatial", "cv2", "matplotlib.figure")


@dataclass(frozen=True, kw_only=True)
class ElsewhereRun:
    """What a run in another process left.

    Attributes:
        digests: port -> digest of the output.
        strays: files found in the working directory, the home or the temporary folder.
    """

    digests: Mapping[str, str]
    strays: tuple[str, ...]


def run_elsewhere(trial: Trial, folder: Path) -> ElsewhereRun:
    """Run a trial in a new process: other working directory, home, hash seed, BLAS threads.

    Raises:
        AssertionError: the process failed; the sentence ends with the last line of its output.
    """
    world = folder / "elsewhere"
    places = {name: world / name for name in ("cwd", "home", "tmp")}
    for place in places.values():
        place.mkdir(parents=True, exist_ok=True)
    task = world / "task.json"
    task.write_text(json.dumps(_task(trial, world)))
    code = _server().run(task)
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


class _Server:
    """The client's end of the process that forks."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="orthoflow-elsewhere-")
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SERVE],
            cwd=self._folder.name,
            env=_environment(Path(self._folder.name)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )

    def run(self, task: Path) -> int:
        """Run a task in a fork; give its exit code."""
        assert self._process.stdin is not None  # noqa: S101 - both are pipes
        assert self._process.stdout is not None  # noqa: S101
        self._process.stdin.write(str(task).encode() + b"\n")
        self._process.stdin.flush()
        ready, _, _ = select.select([self._process.stdout], [], [], _LIMIT_S)
        answer = self._process.stdout.readline() if ready else b""
        if answer:
            return int(answer)
        self.close()
        _server.cache_clear()
        raise AssertionError(f"in a new process the method did not end within {_LIMIT_S} s")

    def close(self) -> None:
        """End the server and whatever it still runs."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._folder.cleanup()


@cache
def _server() -> _Server:
    server = _Server()
    atexit.register(server.close)
    return server


def _environment(folder: Path) -> dict[str, str]:
    # The parent's import path, so that an uninstalled checkout tests itself and nothing else.
    # Bytecode is read where this process has it, or the server would make its own, for seconds.
    names = ("PATH", "LD_LIBRARY_PATH", "PYTHONPYCACHEPREFIX", *INSTRUCTION_SWITCHES)
    kept = {name: os.environ[name] for name in names if name in os.environ}
    threads = {name: "2" if os.environ.get(name) == "1" else "1" for name in _ALGEBRA_THREADS}
    return {
        **kept,
        **threads,
        "HOME": str(folder),
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "PYTHONHASHSEED": "12345",
        "NUMBA_CACHE_DIR": os.environ.get("NUMBA_CACHE_DIR", str(folder / "numba")),
        # As the engine does for its steps: a font cache is matplotlib's, not the method's.
        "MPLCONFIGDIR": str(folder / "matplotlib"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }


def _task(trial: Trial, world: Path) -> dict[str, object]:
    store = Store(world / "store")
    inputs: dict[str, object] = {}
    for name, product in trial.inputs.items():
        if isinstance(product, Product):
            reference = store.put_product(product, None)
            inputs[name] = {"type": reference.type_name, "digest": reference.digest}
        else:
            inputs[name] = {"name": product.name, "paths": [str(path) for path in product.paths]}
    return {
        "method": trial.method.id,
        "inputs": inputs,
        "params": dict(trial.params),
        "seed": trial.seed,
        "cores": trial.cores,
        "path": sys.path,
        "libraries": [name for name in _SHARED_LIBRARIES if name in sys.modules],
    }


def serve() -> None:
    """Fork a process per line of standard input, the path of a task; answer its exit code."""
    for line in sys.stdin:
        task_file = Path(line.rstrip("\n"))
        task = json.loads(task_file.read_text())
        for library in task["libraries"]:
            # The trial itself reports what is wrong with it.
            with suppress(Exception):
                importlib.import_module(library)
        process = os.fork()
        if process == 0:
            _run_forked(task_file.parent, task)
        _, status = os.waitpid(process, 0)
        sys.stdout.write(f"{os.waitstatus_to_exitcode(status)}\n")
        sys.stdout.flush()


# Any below: a task is JSON that this module wrote itself.
def _run_forked(world: Path, task: dict[str, Any]) -> None:
    code = 1
    try:
        output = os.open(world / "output.txt", os.O_WRONLY | os.O_CREAT)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for descriptor, replaced in ((nothing, 0), (output, 1), (output, 2)):
            os.dup2(descriptor, replaced)
        os.environ.update(HOME=str(world / "home"), TMPDIR=str(world / "tmp"))
        tempfile.tempdir = None
        os.chdir(world / "cwd")
        _run_task(world, task)
        code = 0
    except BaseException:  # noqa: BLE001 - it goes to the file that the parent reads
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _run_task(world: Path, task: dict[str, Any]) -> None:
    sys.path[:] = task["path"]
    importlib.invalidate_caches()
    catalog = discover_catalog()
    store = Store(world / "store")
    inputs: dict[str, Product | InputFiles] = {}
    for name, stored in task["inputs"].items():
        if "paths" in stored:
            paths = tuple(Path(path) for path in stored["paths"])
            inputs[name] = InputFiles(name=stored["name"], paths=paths)
        else:
            cls = catalog.product_class(stored["type"])
            inputs[name] = store.get_product(stored["digest"], cls)
    trial = Trial(
        method=catalog.method(task["method"]).load(),
        inputs=inputs,
        params=task["params"],
        seed=task["seed"],
        cores=task["cores"],
    )
    run = run_trial(trial, world / "scratch", draws=False)
    (world / "digests.json").write_text(json.dumps(dict(run.digests)))
