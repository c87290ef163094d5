"""Measure the processor time of compiling each kernel, in a run without compiled kernels.

python benchmarks/compile_times.py WORKFLOW [--set STEP.PARAM=VALUE ...] [--top 25]

All steps run in this process, so numba's own functions, which it does not cache, are compiled once;
in a normal run, each process of a step compiles those that it needs.
"""

from __future__ import annotations

import argparse
import atexit
import os
import shutil
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

kernels = tempfile.mkdtemp(prefix="orthoflow-compile-times-")
atexit.register(shutil.rmtree, kernels, ignore_errors=True)
os.environ["NUMBA_CACHE_DIR"] = kernels

from numba.core import event  # noqa: E402 - it reads the variable

from orthoflow.catalog.discovery import discover_catalog  # noqa: E402
from orthoflow.engine.plan import RunOptions, plan_run  # noqa: E402
from orthoflow.engine.scheduler import execute  # noqa: E402
from orthoflow.engine.store import Store  # noqa: E402
from orthoflow.workflow.document import load_workflow  # noqa: E402
from orthoflow.workflow.expand import expand_cells  # noqa: E402
from orthoflow.workflow.source import shipped_workflow  # noqa: E402


@dataclass
class Compilations(event.Listener):
    """Records which kernels numba compiles.

    Attributes:
        cpu_s: processor time by kernel, without that of the kernels that it calls.
        versions: number of compilations by kernel.
    """

    cpu_s: Counter[str] = field(default_factory=Counter)
    versions: Counter[str] = field(default_factory=Counter)
    _begun: list[tuple[float, float]] = field(default_factory=list)

    def on_start(self, event: event.Event) -> None:
        """Record the start time."""
        self._begun.append((time.thread_time(), 0.0))

    def on_end(self, event: event.Event) -> None:
        """Add the elapsed time, and subtract it from the calling kernel."""
        begun, inner_s = self._begun.pop()
        whole_s = time.thread_time() - begun
        if self._begun:
            outer, outer_inner_s = self._begun[-1]
            self._begun[-1] = (outer, outer_inner_s + whole_s)
        function = event.data["dispatcher"].py_func
        name = f"{function.__module__}.{function.__qualname__}"
        self.cpu_s[name] += whole_s - inner_s
        self.versions[name] += 1


def run(workflow: str, sets: list[str]) -> float:
    """Run a workflow in a temporary store; return its processor time in seconds."""
    before = time.process_time()
    with tempfile.TemporaryDirectory(prefix="orthoflow-compile-times-") as folder:
        catalog, store = discover_catalog(), Store(Path(folder) / "store")
        path = Path(workflow) if Path(workflow).exists() else shipped_workflow(workflow)
        loaded = load_workflow(path, catalog, sets=sets)
        cells = expand_cells(loaded, catalog)
        plan = plan_run(cells, loaded, catalog, store, RunOptions(executor="inline"))
        outcome = execute(plan, Path(folder) / "run", store, lambda _: None)
        assert outcome.exit_code == 0, "the run failed"  # noqa: S101
    return time.process_time() - before


def main() -> None:
    """Run a workflow and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workflow")
    parser.add_argument("--set", action="append", default=[], dest="sets")
    parser.add_argument("--top", type=int, default=25)
    asked = parser.parse_args()
    heard = Compilations()
    event.register("numba:compile", heard)
    cpu_s = run(asked.workflow, asked.sets)
    own = {name for name in heard.cpu_s if name.startswith("numba.")}
    rows = [
        (name, heard.cpu_s[name], heard.versions[name]) for name in heard.cpu_s if name not in own
    ]
    rows += [
        (
            "numba's own functions",
            sum(heard.cpu_s[n] for n in own),
            sum(heard.versions[n] for n in own),
        )
    ]
    rows.sort(key=lambda row: -row[1])
    print(f"run {cpu_s:.1f} s of processor time, {sum(heard.cpu_s.values()):.1f} s compiling")
    print("| kernel | versions | compile, CPU s |\n|---|---|---|")
    for name, own_s, versions in rows[: asked.top]:
        print(f"| {name} | {versions} | {own_s:.2f} |")


if __name__ == "__main__":
    main()
