"""Killed or interrupted at any instant, the same run goes on and ends with the same digests."""

from __future__ import annotations

import json
import os
import random
import signal
import time
from pathlib import Path

import pytest

from orthoflow.engine.cleaning import collect_garbage
from orthoflow.engine.journal import is_running
from orthoflow.engine.scheduler import execute
from orthoflow.errors import ArgumentError, CancelledStepError, StoreError
from orthoflow.records.runs import find_record
from tests.engine_world import World, digests, has_ended, start_coordinator, toy_world
from tests.long_loops import IS_LONG, long_only

STEPS = """
steps:
  first: {use: make.range, params: {count: 20000}}
  second: {use: work.slow, in: {numbers: first.numbers}, params: {steps: 6}}
  third: {use: work.noise, in: {numbers: second.numbers}}
  fourth: {use: work.draws, in: {numbers: third.numbers}}
"""


def events(world: World, folder: str) -> list[dict[str, object]]:
    path = world.folder / folder / "journal.jsonl"
    if not path.exists():
        return []
    whole = path.read_text().rpartition("\n")[0]
    return [json.loads(line) for line in whole.splitlines()]


def wait_for(world: World, folder: str, event: str, address: str) -> None:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        for found in events(world, folder):
            if (found["event"], found.get("address")) == (event, address):
                return
        time.sleep(0.01)
    pytest.fail(f"{address} never {event}")


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Digests of an undisturbed run."""
    with toy_world(tmp_path_factory.mktemp("quiet")) as world:
        return digests(world.run(STEPS, executor="inline"))


@pytest.mark.longer
@pytest.mark.parametrize("attempt", range(10 if IS_LONG else 1))
def test_a_run_killed_at_any_moment_resumes_with_the_same_digests(
    world: World, quiet: dict[str, str], attempt: int
) -> None:
    rng = random.Random(attempt)
    for _ in range(2 if IS_LONG else 1):
        process = start_coordinator(world, STEPS, "run")
        process.stdout.readline()
        time.sleep(rng.uniform(0.1, 4.0))
        process.kill()
        process.communicate()
    outcome = world.run(STEPS)
    assert digests(outcome) == quiet
    assert [event["event"] for event in events(world, "run")].count("run") == 1
    assert set(outcome.cached) == set()
    assert list(world.store.scratch.iterdir()) == []
    collect_garbage(world.store)
    assert len(world.run(STEPS, into="after").cached) == 4


@pytest.mark.parametrize(
    "number", [signal.SIGINT, *long_only(signal.SIGTERM)], ids=lambda s: s.name
)
def test_an_interrupted_run_says_so(world: World, number: signal.Signals) -> None:
    long = STEPS.replace("steps: 6", "steps: 2000")
    process = start_coordinator(world, long, "run")
    wait_for(world, "run", "started", "second")
    time.sleep(0.7)
    process.send_signal(number)
    said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "CancelledStepError: the run was interrupted; the same command continues" in said
    assert "Traceback" not in said
    assert events(world, "run")[-1]["event"] == "interrupted"


def test_an_inline_run_can_be_interrupted_too(world: World) -> None:
    steps = STEPS.replace("steps: 6", "steps: 2000")
    plan = world.plan(steps, executor="inline")
    before = signal.getsignal(signal.SIGINT)

    def interrupt(event: object) -> None:
        if type(event).__name__ == "CellReported":
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(CancelledStepError, match="the run was interrupted"):
        execute(plan, world.folder / "run", world.store, interrupt)
    assert events(world, "run")[-1]["event"] == "interrupted"
    assert signal.getsignal(signal.SIGINT) is before


def test_two_runs_share_a_store_at_once(world: World, quiet: dict[str, str]) -> None:
    processes = [start_coordinator(world, STEPS, name) for name in ("one", "two")]
    for process in processes:
        said = process.communicate(timeout=120)
        assert process.returncode == 0, said
    outcome = world.run(STEPS, into="three")
    assert len(outcome.cached) == 4
    assert digests(outcome) == quiet


def test_a_run_in_progress_is_left_alone_and_goes_on_after_a_kill(world: World) -> None:
    process = start_coordinator(world, STEPS.replace("work.slow", "work.spawns_and_waits"), "run")
    log = world.folder / "run" / "logs" / "second.log"
    deadline = time.monotonic() + 60
    while not (log.exists() and log.read_text().endswith("\n")) and time.monotonic() < deadline:
        time.sleep(0.01)
    grandchild = int(log.read_text().removeprefix("started "))
    step = int(Path(f"/proc/{grandchild}/stat").read_text().rpartition(")")[2].split()[1])
    try:
        with pytest.raises(ArgumentError, match="is in use by another run; wait until it has"):
            world.run(STEPS)
        assert is_running(world.folder / "run")
        with pytest.raises(ArgumentError, match=r"contains no run\.h5 yet: its run has not ended"):
            find_record(world.folder / "run")
        with pytest.raises(StoreError, match="is in use by a run"):
            collect_garbage(world.store)
    finally:
        process.kill()
        process.communicate()
    assert not is_running(world.folder / "run")
    # Steps and what they started end with their coordinator.
    assert has_ended(step)
    assert has_ended(grandchild)
    # What had ended is not computed again.
    assert world.run(STEPS).resumed == {"first"}
    assert [event["event"] for event in events(world, "run")].count("resumed") == 1
