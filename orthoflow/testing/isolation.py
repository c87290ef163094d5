"""Running a method in a process of its own, in an empty world, to see what it leaves behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from orthoflow.catalog import discover_catalog
from orthoflow.engine.store import Store
from orthoflow.products import InputFiles, Product
from orthoflow.testing.trials import Trial, run_trial

_LIMIT_S = 600


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
    """Run a trial in a new process with its own working directory, home and hash seed.

    Raises:
        AssertionError: the process failed; the sentence ends with what it said last.
    """
    world = folder / "elsewhere"
    places = {name: world / name for name in ("cwd", "home", "tmp")}
    for place in places.values():
        place.mkdir(parents=True, exist_ok=True)
    task = world / "task.json"
    task.write_text(json.dumps(_task(trial, world)))
    completed = subprocess.run(
        [sys.executable, "-m", "orthoflow.testing.isolation", str(task)],
        cwd=places["cwd"],
        env=_environment(places, folder),
        capture_output=True,
        text=True,
        timeout=_LIMIT_S,
        check=False,
    )
    if completed.returncode != 0:
        last = completed.stderr.strip().splitlines()[-1:] or ["nothing"]
        raise AssertionError(
            f"in a new process the method ended with exit code {completed.returncode}: {last[0]}"
        )
    strays = tuple(
        f"{name}/{path.relative_to(place)}"
        for name, place in places.items()
        for path in sorted(place.rglob("*"))
        if path.is_file()
    )
    return ElsewhereRun(digests=json.loads((world / "digests.json").read_text()), strays=strays)


def _environment(places: Mapping[str, Path], folder: Path) -> dict[str, str]:
    # The parent's import path, so that an uninstalled checkout tests itself and nothing else.
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    numba_cache = os.environ.get("NUMBA_CACHE_DIR", str(folder / "numba"))
    return {
        **kept,
        "HOME": str(places["home"]),
        "TMPDIR": str(places["tmp"]),
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "PYTHONHASHSEED": "12345",
        "NUMBA_CACHE_DIR": numba_cache,
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
    }


def _main(task_file: Path) -> None:
    world = task_file.parent
    task = json.loads(task_file.read_text())
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
    run = run_trial(trial, world / "scratch")
    (world / "digests.json").write_text(json.dumps(dict(run.digests)))


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
