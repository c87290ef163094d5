"""Kernels that methods need, with the types of their arguments, as `compiling_ahead` reads them.

python benchmarks/foretell_kernels.py [--write] [RECIPE ...]

Runs the recipes of `orthoflow warm`, or those named, each step in a process of its own, without
repeats and others that need the same kernels, and writes down which kernels it loads or compiles.
With `--write` they go into the plugins' `kernels.json` beside what stands there and is still so;
else it says what is missing there.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from inspect import signature
from pathlib import Path
from typing import Any

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.cli.warm import _RECIPES, _new_cells
from orthoflow.engine import executors
from orthoflow.engine.compiling_ahead import FORETOLD
from orthoflow.engine.plan import RunOptions, plan_run
from orthoflow.engine.results import CellResult, result_from_json, result_to_json
from orthoflow.engine.running import run_task
from orthoflow.engine.scheduling import execute
from orthoflow.engine.store import Store
from orthoflow.engine.tasks import Task
from orthoflow.workflow.cells import expand_cells
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.recipes import shipped_workflow

Kernel = tuple[str, str, str]
found: dict[str, dict[Kernel, None]] = {}


def run_apart(task: Task, listen: Callable[..., None], is_cancelled: Callable[[], bool]) -> Any:
    """Run a task in a forked process; remember its kernels."""
    left = Path(task.folder) / "left.json"
    left.parent.mkdir(parents=True, exist_ok=True)
    pid = os.fork()
    if pid == 0:
        kernels: list[Kernel] = []
        hear_kernels(kernels)
        result = run_task(task, lambda _: None, is_cancelled)
        left.write_text(json.dumps([result_to_json(result), kernels]))
        os._exit(0)
    os.waitpid(pid, 0)
    text, kernels = json.loads(left.read_text())
    result: CellResult = result_from_json(text, "left")
    assert result.status == "ok", result.error_message  # noqa: S101
    method = found.setdefault(task.method, {})
    method.update(dict.fromkeys((m, name, json.dumps(types)) for m, name, types in kernels))
    print(task.address, task.method, len(kernels), file=sys.stderr)
    return result


def hear_kernels(kernels: list[Any]) -> None:
    """Note each kernel that is looked up and that Python may call."""
    from orthoflow.geometry.kept_kernels import KeptKernels
    from orthoflow.geometry.kernel_types import text_of

    load = KeptKernels.load_overload

    def load_and_note(self: Any, signature: Any, context: Any) -> Any:
        function = self._py_func
        kernel = getattr(sys.modules[function.__module__], function.__qualname__, None)
        # Those that only kernels call are compiled with these.
        if kernel is not None and not kernel.targetoptions.get("no_cpython_wrapper"):
            # What takes records is left to its step.
            with suppress(TypeError):
                kernels.append(
                    (function.__module__, function.__qualname__, list(map(text_of, signature)))
                )
        return load(self, signature, context)

    KeptKernels.load_overload = load_and_note  # type: ignore[method-assign]


def main() -> None:
    """Run the recipes, then write or compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recipes", nargs="*", default=list(_RECIPES))
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    executors.run_task = run_apart
    with tempfile.TemporaryDirectory(prefix="orthoflow-foretell-") as folder:
        catalog, store, seen = discover_catalog(), Store(Path(folder) / "store"), set()
        for name in asked.recipes:
            loaded = load_workflow(shipped_workflow(name), catalog, sets=_RECIPES.get(name, ()))
            cells = _new_cells(expand_cells(loaded, catalog), None, seen)
            plan = plan_run(cells, loaded, catalog, store, RunOptions(executor="inline"))
            execute(plan, Path(folder) / name, store)
    spec = importlib.util.find_spec("orthoflow_plugins")
    path = Path(spec.submodule_search_locations[0]) / FORETOLD  # type: ignore[index, union-attr]
    known = still_there(read(path)) if path.exists() else {}
    for method, kernels in sorted(found.items()):
        for kernel in kernels:
            if kernel not in known.get(method, {}):
                print(method, *kernel)
    if asked.write:
        write(path, {m: {**known.get(m, {}), **found.get(m, {})} for m in {*known, *found}})


def read(path: Path) -> dict[str, dict[Kernel, None]]:
    """Give method -> kernels."""
    told = json.loads(path.read_bytes())
    kernels = [(module, name, json.dumps(types)) for module, name, types in told["kernels"]]
    return {m: dict.fromkeys(kernels[k] for k in ks) for m, ks in told["methods"].items()}


def still_there(methods: dict[str, dict[Kernel, None]]) -> dict[str, dict[Kernel, None]]:
    """Leave out kernels that are gone or take other arguments now."""

    def is_there(kernel: Kernel) -> bool:
        module, name, types = kernel
        found = getattr(importlib.import_module(module), name, None)
        return found is not None and len(signature(found.py_func).parameters) == len(
            json.loads(types)
        )

    return {m: {k: None for k in kernels if is_there(k)} for m, kernels in methods.items()}


def write(path: Path, methods: dict[str, dict[Kernel, None]]) -> None:
    """Write each kernel once, and the numbers of those that a method needs."""
    kernels = sorted({kernel for needed in methods.values() for kernel in needed})
    number = {kernel: k for k, kernel in enumerate(kernels)}
    lines = [json.dumps([module, name, json.loads(types)]) for module, name, types in kernels]
    needs = [
        f"{json.dumps(method)}: {[number[kernel] for kernel in methods[method]]}"
        for method in sorted(methods)
        if methods[method]
    ]
    join = ",\n".join
    path.write_text(f'{{"kernels": [\n{join(lines)}\n],\n"methods": {{\n{join(needs)}\n}}}}\n')


if __name__ == "__main__":
    main()
