"""Workers that are killed, cut off or lose the shared folder cost time and no results."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from orthoflow.engine.dask import CORES
from orthoflow.engine.journal import CellReported, RunEvent
from orthoflow.engine.scheduler import RunOutcome, execute
from orthoflow.errors import OrthoflowError
from tests.engine_world import World, digests
from tests.optional import skip

pytestmark = pytest.mark.long
HERE, AWAY = "10.213.77.1", "10.213.77.2"
N_SLOW = 8
N_RUNS, N_KILLS = 10, 5


def steps(n_pauses: int) -> str:
    """A workflow whose steps take so many twentieths of a second; what they make is the same."""
    slow = "{use: work.slow, in: {numbers: first.numbers}, params: {steps: %d}}"
    return "steps:\n  first: {use: make.range, params: {count: 2000}}\n" + "".join(
        f"  slow{index}: {slow % (n_pauses + index)}\n" for index in range(N_SLOW)
    )


@dataclass
class Machines:
    """A scheduler and workers as processes of their own.

    Attributes:
        host: where the scheduler listens.
        address: of the scheduler.
        processes: name -> process.
    """

    host: str
    site: Path
    folder: Path
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    @property
    def address(self) -> str:
        return f"tcp://{self.host}:{self.port}"

    def start(self) -> None:
        self.port = random.Random(os.getpid()).randint(20_000, 30_000)
        arguments = ("--host", self.host, "--port", str(self.port), "--no-dashboard")
        self._spawn("scheduler", [], "dask_scheduler", arguments)

    def work(self, name: str, host: str, inside: Sequence[str] = ()) -> None:
        """Start a worker."""
        arguments = [self.address, "--host", host, "--nthreads", "1", "--memory-limit", "0"]
        arguments += ["--resources", f"{CORES}=1", "--no-dashboard", "--no-nanny"]
        self._spawn(
            name, inside, "dask_worker", [*arguments, "--local-directory", str(self.folder)]
        )

    def kill(self, name: str) -> None:
        """Kill one, and what it runs, as a machine that loses its power."""
        with suppress(ProcessLookupError):
            os.killpg(self.processes[name].pid, signal.SIGKILL)
        self.processes[name].wait()

    def close(self) -> None:
        for name in self.processes:
            self.kill(name)

    def _spawn(self, name: str, inside: Sequence[str], tool: str, rest: Sequence[str]) -> None:
        self.processes[name] = subprocess.Popen(
            [*inside, sys.executable, "-m", f"distributed.cli.{tool}", *rest],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(self.site), *sys.path])},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )


@pytest.fixture
def quiet(world: World) -> dict[str, str]:
    return digests(world.run(steps(1), into="quiet", executor="inline"))


@contextmanager
def machines(world: World, host: str = "127.0.0.1") -> Iterator[Machines]:
    opened = Machines(host=host, site=world.site, folder=world.folder)
    opened.start()
    try:
        yield opened
    finally:
        opened.close()


class Once:
    """Does something in a thread as soon as a slow step says something."""

    def __init__(self, work: Callable[[], None]) -> None:
        self.thread = threading.Thread(target=work)

    def __call__(self, event: RunEvent) -> None:
        if isinstance(event, CellReported) and self.thread.ident is None:
            self.thread.start()


def ended(world: World, machines: Machines, listen: Callable[[RunEvent], None]) -> RunOutcome:
    """Run it, with the same command again when it broke off."""
    folder = world.folder / "run"
    for _ in range(3):
        with suppress(OrthoflowError):
            plan = world.plan(steps(60), executor="dask", scheduler=machines.address, retries=20)
            outcome = execute(plan, folder, world.store, listen)
            if outcome.status == "ok":
                return outcome
        time.sleep(5.0)
    raise AssertionError("three times the same command did not end it")


def test_a_shared_folder_that_goes_away_for_a_while_loses_nothing(
    world: World, quiet: dict[str, str]
) -> None:
    disk, shared = world.folder / "disk", world.folder / "store"
    shutil.rmtree(shared)
    shared.mkdir()
    disk.mkdir()
    mount = ["mount", "--bind", str(disk), str(shared)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        skip("right", "a bind mount")

    def unmount() -> None:
        time.sleep(1.0)
        subprocess.run(["umount", "--lazy", str(shared)], check=True)
        time.sleep(20.0)
        subprocess.run(mount, check=True)

    listen = Once(unmount)
    try:
        with machines(world) as office:
            for name in ("one", "two"):
                office.work(name, "127.0.0.1")
            assert digests(ended(world, office, listen)) == quiet
        listen.thread.join()
    finally:
        subprocess.run(["umount", "--lazy", str(shared)], check=False)


@pytest.mark.parametrize("run", range(N_RUNS))
def test_workers_killed_at_random_cost_no_result(
    world: World, quiet: dict[str, str], run: int
) -> None:
    shutil.rmtree(world.folder / "store")
    chance = random.Random(f"kills {run}")
    with machines(world) as office:
        for index in range(3):
            office.work(f"worker{index}", "127.0.0.1")
        n_killed = 0

        def kill() -> None:
            nonlocal n_killed
            for _ in range(N_KILLS):
                time.sleep(chance.uniform(0.2, 3.0))
                name = f"worker{chance.randrange(3)}"
                office.kill(name)
                n_killed += 1
                office.work(name, "127.0.0.1")

        listen = Once(kill)
        outcome = ended(world, office, listen)
        listen.thread.join()
    assert digests(outcome) == quiet
    assert n_killed == N_KILLS
