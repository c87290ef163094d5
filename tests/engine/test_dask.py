"""On the workers of a cluster the same steps come out with the same digests, whatever is lost."""

from __future__ import annotations

import dataclasses
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import dask
import pytest
from distributed import Client, LocalCluster

from orthoflow.engine import dask as engine_dask
from orthoflow.engine.dask import CORES
from orthoflow.engine.journal import CellReported, RunEvent, RunListener
from orthoflow.engine.keys import methods_text, misfit
from orthoflow.engine.plan import RunPlan
from orthoflow.engine.scheduler import RunOutcome, execute
from orthoflow.errors import ArgumentError, CancelledStepError, ClusterError, PluginError
from tests.engine_world import World, digests, preload_for_toys, start_fork_server, toy_world
from tests.long_loops import long_only

STEPS = """
steps:
  first: {use: make.range, params: {count: 2000}}
  second: {use: work.slow, in: {numbers: first.numbers}, params: {steps: 20}}
  other: {use: work.noise, in: {numbers: first.numbers}}
  third: {use: work.noise, in: {numbers: second.numbers}}
"""


@contextmanager
def cluster(
    n_workers: int, *, processes: bool = True, **resources: float
) -> Iterator[LocalCluster]:
    """Open a cluster of processes or threads."""
    # Those of processes are forked from one that has loaded dask, as are those after killed ones.
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
        LocalCluster(  # type: ignore[no-untyped-call]
            n_workers=n_workers,
            processes=processes,
            threads_per_worker=1,
            resources=resources,
            memory_limit=0,
            dashboard_address="127.0.0.1:0",
            silence_logs=50,
        ) as opened,
    ):
        yield opened


@dataclasses.dataclass
class Office:
    """The toys, a cluster whose workers have them too, and what a local run gives."""

    world: World
    cluster: LocalCluster
    quiet: dict[str, str]
    n_runs: int = 0

    def plan(self, *, own: bool = False, sets: Sequence[str] = (), **options: object) -> RunPlan:
        """Plan a run, on workers of its own or these; its second step always runs."""
        address = "" if own else self.cluster.scheduler_address
        return self.world.plan(
            STEPS, sets=sets, executor="dask", scheduler=address, force=("second",), **options
        )

    def run(self, steps: str = STEPS) -> tuple[RunOutcome, list[RunEvent]]:
        """Run on the cluster with a store that nobody used before."""
        self.n_runs += 1
        fresh = World(folder=self.world.folder / f"office{self.n_runs}", site=self.world.site)
        fresh.folder.mkdir()
        address = self.cluster.scheduler_address
        return fresh.run(steps, executor="dask", scheduler=address), fresh.events

    def killer(self) -> tuple[RunListener, set[int]]:
        """What kills all workers as soon as the second step says something, once; and whom."""
        killed: set[int] = set()

        def listen(event: RunEvent) -> None:
            if is_under_way(event) and not killed:
                killed.update(worker.pid for worker in self.cluster.workers.values())
                for process in killed:
                    os.kill(process, signal.SIGKILL)

        return listen, killed


def is_under_way(event: RunEvent) -> bool:
    is_progress = isinstance(event, CellReported) and event.event.kind == "progress"
    return is_progress and event.address == "second"


@pytest.fixture(scope="module")
def office(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Office]:
    start_fork_server("orthoflow.engine.dask")
    with toy_world(tmp_path_factory.mktemp("office")) as world:
        quiet = digests(world.run(STEPS, executor="inline"))
        with cluster(2, **{CORES: 1}) as opened:
            with Client(opened, set_as_default=False) as client:  # type: ignore[no-untyped-call]
                client.run(preload_for_toys)
            yield Office(world, opened, quiet)


def test_a_cluster_gives_the_same_digests_and_says_how_far_it_is(office: Office) -> None:
    outcome, events = office.run()
    assert digests(outcome) == office.quiet
    fractions = [event.event.fraction for event in events if isinstance(event, CellReported)]
    assert max(fractions) == 1.0
    assert any(0.0 < fraction < 1.0 for fraction in fractions)


def test_steps_fail_on_workers_as_they_do_here(office: Office) -> None:
    steps = """
steps:
  first: {use: make.range}
  crash: {use: work.does, in: {numbers: first.numbers}, params: {code: ctypes.string_at(0)}}
  late: {use: work.slow, in: {numbers: first.numbers}, params: {steps: 600}, timeout: 1s}
  wrong: {use: work.does, in: {numbers: first.numbers}, params: {code: 1 / 0}}
  last: {use: work.add, in: {numbers: wrong.numbers}}
"""
    outcome, _ = office.run(steps)
    said = {address: result.error_message for address, result in outcome.results.items()}
    assert "crashed (segmentation fault)" in said["crash"]
    assert "exceeded its timeout of 1 s and was stopped" in said["late"]
    assert "failed unexpectedly: " in said["wrong"]
    assert outcome.results["last"].status == "skipped"
    assert outcome.results["wrong"].is_bug
    assert outcome.results["wrong"].environment is not None


@pytest.mark.long
def test_a_step_whose_worker_is_killed_runs_again(office: Office) -> None:
    listen, killed = office.killer()
    outcome = execute(office.plan(), office.world.folder / "killed", office.world.store, listen)
    assert len(killed) == 2
    assert digests(outcome) == office.quiet


@pytest.mark.long
def test_a_step_that_loses_its_workers_is_given_up(office: Office) -> None:
    listen, _ = office.killer()
    plan = office.plan(retries=0)
    outcome = execute(plan, office.world.folder / "lost", office.world.store, listen)
    assert outcome.results["second"].status == "failed"
    assert "failed because its worker was lost" in outcome.results["second"].error_message
    assert outcome.results["other"].status == "ok"


@pytest.mark.parametrize("own", [False, *long_only(True)], ids=["workers", "own workers"])
def test_an_interrupted_run_stops_its_workers_and_goes_on_with_any_executor(
    office: Office, own: bool
) -> None:
    asked: list[RunEvent] = []

    def interrupt(event: RunEvent) -> None:
        if is_under_way(event) and not asked:
            asked.append(event)
            os.kill(os.getpid(), signal.SIGINT)

    world, folder = office.world, office.world.folder / f"broken-off-{own}"
    with pytest.raises(CancelledStepError, match="repeat the command"):
        execute(office.plan(own=own), folder, world.store, interrupt)
    outcome = execute(world.plan(STEPS, force=("second",)), folder, world.store)
    assert digests(outcome) == office.quiet


def test_a_lost_scheduler_is_said_and_the_run_goes_on_without(
    office: Office, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_dask, "PATIENCE_S", 1.0)
    world, folder = office.world, office.world.folder / "alone"
    with cluster(1, processes=False, **{CORES: 1}) as lost:
        plan = world.plan(
            STEPS, executor="dask", scheduler=lost.scheduler_address, force=("second",)
        )

        def close(event: RunEvent) -> None:
            if is_under_way(event):
                lost.close(timeout=5)

        with pytest.raises(ClusterError, match="any executor to continue"):
            execute(plan, folder, world.store, close)
    assert digests(execute(world.plan(STEPS), folder, world.store)) == office.quiet


def test_workers_with_other_versions_are_refused_by_name(office: Office) -> None:
    plan = office.plan()
    tools = plan.methods["work.slow"].tools
    for change, said in (
        ({"result_version": 7}, "work.slow has the result version 1 there, but 7 in the plan"),
        ({"tools": {**tools, "far": "2.0"}}, "work.slow has far none there, but 2.0 in the plan"),
        ({"code": {"toy_plugin": "0"}}, "the code of work.slow there differs from the plan"),
    ):
        facts = dataclasses.replace(plan.methods["work.slow"], **change)
        other = dataclasses.replace(plan, methods={**plan.methods, "work.slow": facts})
        with pytest.raises(PluginError, match=f"^worker .*{said}; install "):
            execute(other, office.world.folder / "misfit", office.world.store)
    assert misfit(methods_text(plan.methods)) == ""


def test_workers_that_do_not_see_the_store_are_refused(
    office: Office, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_dask, "write_whole", lambda *_: None)
    with pytest.raises(ArgumentError, match=r"cannot access the store .*No such file"):
        office.run()


def test_an_address_without_scheduler_is_refused(
    office: Office, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_dask, "CONNECT_S", 1.0)
    for address in ("tcp://127.0.0.1:9", "nonsense"):
        plan = office.world.plan(STEPS, executor="dask", scheduler=address)
        with pytest.raises(ArgumentError, match=f"--scheduler {address}: no Dask scheduler"):
            execute(plan, office.world.folder / "nowhere", office.world.store)


def test_workers_that_do_not_say_their_cores_get_no_work(
    office: Office, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_dask, "PATIENCE_S", 1.0)
    with cluster(1, processes=False) as silent:
        plan = office.world.plan(STEPS, executor="dask", scheduler=silent.scheduler_address)
        with pytest.raises(ArgumentError, match="no worker there reports its number of cores"):
            execute(plan, office.world.folder / "silent", office.world.store)
