"""A small plugin of toy methods, installed as a real distribution in a temporary folder."""

from __future__ import annotations

import importlib
import multiprocessing.util
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PathDistribution
from importlib.util import cache_from_source
from multiprocessing import forkserver
from multiprocessing.context import ForkServerProcess
from multiprocessing.reduction import DupFd
from pathlib import Path
from typing import Any, BinaryIO, cast

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
from tests.engine_mischief import MISCHIEF, NAMES
from tests.engine_toys import HOOKS, MAKES, PRODUCTS, WORKS


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
    try:
        yield World(folder=folder, site=site)
    finally:
        sys.path.remove(str(site))
        forget_toys()


def digests(outcome: RunOutcome) -> dict[str, str]:
    """Digests of the products of a run that came to its end, by `cell.port`."""
    assert outcome.status == "ok", {a: r.error_message for a, r in outcome.failed.items()}
    return {
        f"{address}.{port}": ref.digest
        for address, result in outcome.results.items()
        for port, ref in result.outputs.items()
    }


@dataclass
class Coordinator:
    """A process that runs a workflow, which tests may stop.

    Attributes:
        process: it, forked from one that has loaded all that it needs.
        stdout: what it says, "ready" before the run.
    """

    process: ForkServerProcess
    stdout: BinaryIO

    @property
    def pid(self) -> int:
        assert self.process.pid is not None
        return self.process.pid

    @property
    def returncode(self) -> int | None:
        return self.process.exitcode

    def kill(self) -> None:
        self.process.kill()

    def send_signal(self, number: signal.Signals) -> None:
        os.kill(self.pid, number)

    def communicate(self, timeout: float | None = None) -> str:
        """Wait for its end; what it said since it was read last."""
        self.process.join(timeout)
        assert self.process.exitcode is not None
        with self.stdout:
            return self.stdout.read().decode()


def start_coordinator(world: World, steps: str, into: str) -> Coordinator:
    """Run a workflow in a process of its own, which tests may kill."""
    start_fork_server()
    context = multiprocessing.get_context("forkserver")
    reading, writing = os.pipe()
    with os.fdopen(writing, "wb") as said:
        process = context.Process(
            target=_coordinate, args=(world.folder, steps, into, DupFd(said.fileno()))
        )
        process.start()
    return Coordinator(process, os.fdopen(reading, "rb"))


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
    package = site / "toy_plugin"
    package.mkdir(parents=True)
    files = {"hooks": HOOKS, "products": PRODUCTS, "makes": MAKES, "works": WORKS, "__init__": ""}
    files |= {"mischief": MISCHIEF, "mischief_names": f"MISCHIEF = {NAMES}"}
    for name, text in files.items():
        (package / f"{name}.py").write_text(text)
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


# Any: what multiprocessing hands descriptors over with has no public type.
def _coordinate(folder: Path, steps: str, into: str, said: Any) -> None:
    """Run a workflow as a process of its own that has started in its own session."""
    os.setsid()
    # Toys need no compiler.
    local.PRELOADED[:] = ["orthoflow.engine.worker"]
    descriptor = said.detach()
    for stream in (1, 2):
        os.dup2(descriptor, stream)
    os.close(descriptor)
    with toy_world(folder) as world:
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        try:
            outcome = world.run(steps, into=into)
        except OrthoflowError as error:
            sys.stdout.write(f"{type(error).__name__}: {error}\n")
            sys.exit(error.exit_code)
        for address, result in outcome.failed.items():
            sys.stdout.write(f"{address}: {result.error_message}\n{result.log}\n")
        sys.exit(outcome.exit_code)
