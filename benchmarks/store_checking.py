"""Measure the time for checking stored data, as a share of the whole run.

    python benchmarks/store_checking.py [WORKFLOW] [--set STEP.PARAM=VALUE ...] [--force STEP ...]

A workflow is run in this process, in a temporary folder of the working directory: once computed,
twice from the cache, and once with the steps of --force recomputed from cached inputs, which are
then checked. Checks include looking up results and objects, reading their bytes, and recording the
digests of stored data; `synced` is the time for flushing the run folder to disk.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine import store
from orthoflow.engine.durability import folder_size
from orthoflow.engine.plan import RunOptions, plan_run
from orthoflow.engine.scheduler import RunOutcome, execute
from orthoflow.engine.store import Store
from orthoflow.records import write as record_writing
from orthoflow.records.runs import Run
from orthoflow.records.write import executed_and_written, write_run
from orthoflow.report import write_page
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import expand_cells
from orthoflow.workflow.model import Workflow

CHECKING = ((Store, "damage"), (Store, "take"), (Store, "blob"), (store, "describe_product"))
SYNCING = ((record_writing, "sync_tree"),)


class Clock:
    """Sums up the times of calls; nested calls count once."""

    def __init__(self, *places: tuple[Any, str]) -> None:
        self.wall_s = self.cpu_s = 0.0
        self._is_running = False
        for owner, name in places:
            setattr(owner, name, self._timed(getattr(owner, name)))

    def _timed(self, call: Callable[..., object]) -> Callable[..., object]:
        def timed(*arguments: object, **more: object) -> object:
            if self._is_running:
                return call(*arguments, **more)
            self._is_running = True
            wall, cpu = time.perf_counter(), time.process_time()
            try:
                return call(*arguments, **more)
            finally:
                self._is_running = False
                self.wall_s += time.perf_counter() - wall
                self.cpu_s += time.process_time() - cpu

        return timed


def run(workflow: Workflow, folder: Path, into: str, *, force: tuple[str, ...]) -> None:
    """Plan, execute and record in this process, as the command line does."""
    catalog = discover_catalog()
    opened = Store(folder / "store")
    options = RunOptions(executor="inline", force=force)
    plan = plan_run(expand_cells(workflow, catalog), workflow, catalog, opened, options)

    def write(outcome: RunOutcome) -> Run:
        page = folder / into / "report.html"
        return write_run(
            outcome,
            plan,
            workflow,
            folder / into,
            opened,
            before_finish=lambda made: write_page(made, page),
        )

    with opened.in_use():
        made = executed_and_written(lambda: execute(plan, folder / into, opened), write)
    for address, failed in made.outcome.failed.items():
        print(f"{address} failed: {failed.error_message}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("workflow", nargs="?", default="quickstart.yaml")
    parser.add_argument("--set", dest="sets", action="append", default=[])
    parser.add_argument("--force", action="append", default=[])
    given = parser.parse_args()
    workflow = load_workflow(given.workflow, discover_catalog(), sets=given.sets)
    checking, syncing = Clock(*CHECKING), Clock(*SYNCING)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as name:
        folder = Path(name)
        forced = tuple(given.force)
        runs = {"computed": (), "cached": (), "cached, again": ()}
        for into, force in (runs | ({"forced": forced} if forced else {})).items():
            checking.wall_s = checking.cpu_s = syncing.wall_s = syncing.cpu_s = 0.0
            wall, cpu = time.perf_counter(), time.process_time()
            run(workflow, folder, into, force=force)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            print(
                f"{into:14} {wall:7.2f} s, processor {cpu:7.2f} s; "
                f"checking {checking.wall_s:.3f} s = {checking.wall_s / wall:.1%}, "
                f"processor {checking.cpu_s:.3f} s = {checking.cpu_s / cpu:.1%}; "
                f"synced in {syncing.wall_s:.3f} s"
            )
        print(f"store: {folder_size(folder / 'store' / 'objects') / 1e6:.0f} MB in objects")


if __name__ == "__main__":
    main()
