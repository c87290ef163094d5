"""A small plugin of toy methods, installed as a real distribution in a temporary folder."""

from __future__ import annotations

import importlib
import multiprocessing.util
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PathDistribution
from importlib.util import cache_from_source
from multiprocessing import forkserver
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import cast

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine import local
from orthoflow.engine.journal import RunEvent, RunListener
from orthoflow.engine.plan import RunOptions, RunPlan, plan_run
from orthoflow.engine.scheduler import RunOutcome, execute
from orthoflow.engine.store import Store
from orthoflow.errors import OrthoflowError
from orthoflow.records.runs import Run
from orthoflow.records.write import executed_and_written
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import expand_cells

TOYS = Path(__file__).parent / "toys"


@dataclass
class World:
    """A working folder with toy methods, a store and a workflow that tests rewrite."""

    folder: Path
    site: Path
    events: list[RunEvent] = field(default_factory=list)

    @property
    def store(self) -> Store:
        return Store(self.folder / "store")

    def catalog(self) -> Catalog:
        importlib.invalidate_caches()
        distribution = PathDistribution(self.site / "toy_plugin-1.0.dist-info")
        (entry_point,) = distribution.entry_points
        return discover_catalog([entry_point])

    def plan(self, steps: str, *, sets: Sequence[str] = (), **options: object) -> RunPlan:
        path = self.folder / "toy.yaml"
        # Two processes plan at once: neither must read what the other has begun to write.
        written = self.folder / f"toy.{os.getpid()}.yaml"
        written.write_text(f"orthoflow: 1\nname: toy\nseed: 7\n{steps}")
        written.replace(path)
        catalog = self.catalog()
        workflow = load_workflow(path, catalog, sets=sets)
        cells = expand_cells(workflow, catalog)
        return plan_run(cells, workflow, catalog, self.store, RunOptions(**options))  # type: ignore[arg-type]

    def run(
        self,
        steps: str,
        *,
        into: str = "run",
        sets: Sequence[str] = (),
        store: Store | None = None,
        **options: object,
    ) -> RunOutcome:
        plan = self.plan(steps, sets=sets, **options)
        self.events.clear()
        return self.execute(plan, into, store or self.store)

    def execute(
        self,
        plan: RunPlan,
        into: str,
        store: Store | None = None,
        listen: RunListener | None = None,
    ) -> RunOutcome:
        """Execute a plan; what turns out to be damaged is computed again, as commands do."""
        store = store or self.store
        outcome, _ = executed_and_written(
            lambda: execute(plan, self.folder / into, store, listen or self.events.append),
            lambda outcome: cast("Run", outcome),
        )
        return outcome

    def status(self, steps: str, **options: object) -> dict[str, tuple[str, str]]:
        plan = self.plan(steps, **options)  # type: ignore[arg-type]
        return {item.cell.address: (item.status, item.reason) for item in plan.cells}

    def values(self, outcome: RunOutcome, address: str) -> list[float]:
        from toy_plugin.products import Numbers

        digest = outcome.results[address].outputs["numbers"].digest
        return [float(x) for x in self.store.get_product(digest, Numbers).values]


@contextmanager
def toy_world(folder: Path) -> Iterator[World]:
    """Install the toys below a folder and make them importable while the block runs."""
    site = folder / "site"
    if not site.exists():
        install_toys(site)
    sys.path.insert(0, str(site))
    forget_toys()
    preload_for_toys()
    try:
        yield World(folder=folder, site=site)
    finally:
        sys.path.remove(str(site))
        forget_toys()


def preload_for_toys() -> None:
    """Let servers of steps that this process starts load what toys need, which is no compiler."""
    local.PRELOADED[:] = ["orthoflow.engine.worker"]


def digests(outcome: RunOutcome) -> dict[str, str]:
    """Digests of the products of a run that came to its end, by `cell.port`."""
    assert outcome.status == "ok", {a: r.error_message for a, r in outcome.failed.items()}
    return {
        f"{address}.{port}": ref.digest
        for address, result in outcome.results.items()
        for port, ref in result.outputs.items()
    }


def start_coordinator(world: World, steps: str, into: str) -> BaseProcess:
    """Run a workflow in a process of its own, which tests may stop; it writes to `<into>.said`."""
    start_fork_server()
    context = multiprocessing.get_context("forkserver")
    process = context.Process(target=_coordinate, args=(world.folder, steps, into))
    process.start()
    return process


def start_fork_server(*modules: str) -> None:
    """Start the server that `multiprocessing` forks from, with what it loads; once in a process.

    What belongs to it lies outside the tests' folder: it is removed when this process ends, and by
    then the folder, with all in it, is gone.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("TMPDIR", raising=False)
        patch.setattr(tempfile, "tempdir", None)
        multiprocessing.util.get_temp_dir()
    forkserver.set_forkserver_preload([*modules, "tests.engine_world"])
    forkserver.ensure_running()


def install_toys(site: Path) -> None:
    """Write the toy plugin with its metadata, as an installer does."""
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(TOYS / "toy_plugin", site / "toy_plugin", ignore=ignored)
    info = site / "toy_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[orthoflow.plugins]\ntoys = toy_plugin.hooks\n")


def forget_toys() -> None:
    """Let the next import see the plugin as it lies on the disk.

    Bytecode is taken for that of a source of the same length that was rewritten within a second.
    """
    for path in sys.path:
        for source in (Path(path) / "toy_plugin").glob("*.py"):
            Path(cache_from_source(str(source))).unlink(missing_ok=True)
    for name in [name for name in sys.modules if name.partition(".")[0] == "toy_plugin"]:
        del sys.modules[name]


def has_ended(process_id: int) -> bool:
    """Whether a process ends within a while."""
    for _ in range(100):
        try:
            state = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0]
        except FileNotFoundError:
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


def _coordinate(folder: Path, steps: str, into: str) -> None:
    """Run a workflow as a process of its own that has started in its own session."""
    os.setsid()
    with (folder / f"{into}.said").open("wb") as said:
        for stream in (1, 2):
            os.dup2(said.fileno(), stream)
    with toy_world(folder) as world:
        try:
            outcome = world.run(steps, into=into)
        except OrthoflowError as error:
            sys.stdout.write(f"{type(error).__name__}: {error}\n")
            sys.exit(error.exit_code)
        sys.exit(outcome.exit_code)
