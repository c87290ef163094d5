"""Killed or interrupted at any instant, the same run goes on and ends with the same digests."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from orthoflow.engine.cleaning import collect_garbage
from orthoflow.engine.journal import is_running
from orthoflow.engine.scheduler import execute
from orthoflow.errors import ArgumentError, CancelledStepError, StoreError
from orthoflow.records.runs import find_record
from tests.engine_world import World, digests, has_ended, start_coordinator, toy_world
from tests.long_loops import long_only

STEPS = """
steps:
  first: {use: make.range, params: {count: 20000}}
  second: {use: work.slow, in: {numbers: first.numbers}, params: {steps: 6}}
  third: {use: work.noise, in: {numbers: second.numbers}}
  fourth: {use: work.draws, in: {numbers: third.numbers}}
"""
WAITS = """
child = subprocess.Popen(["sleep", "600"], start_new_session=True)
ctx.log(f"{child.pid}")
child.wait()
"""
SLOW = "work.slow, in: {numbers: first.numbers}, params: {steps: 6}"
WAITING = STEPS.replace(
    SLOW, f"work.does, in: {{numbers: first.numbers}}, params: {{code: {json.dumps(WAITS)}}}"
)


def events(world: World) -> list[dict[str, object]]:
    path = world.folder / "run" / "journal.jsonl"
    whole = path.read_text().rpartition("\n")[0] if path.exists() else ""
    return [json.loads(line) for line in whole.splitlines()]


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Digests of an undisturbed run."""
    with toy_world(tmp_path_factory.mktemp("quiet")) as world:
        return digests(world.run(STEPS, executor="inline"))


@pytest.mark.parametrize(
    "number", [signal.SIGINT, *long_only(signal.SIGTERM)], ids=lambda s: s.name
)
def test_an_interrupted_run_says_so(world: World, number: signal.Signals) -> None:
    long = STEPS.replace("steps: 6", "steps: 2000")
    process = start_coordinator(world, long, "run")
    wait_for(lambda: any(one.get("address") == "second" for one in events(world)))
    time.sleep(0.5)
    os.kill(process.pid or 0, number)
    process.join(30)
    assert process.exitcode == 130
    said = (world.folder / "run.said").read_text()
    assert "CancelledStepError: the run was interrupted; to continue it, repeat the command" in said
    assert "Traceback" not in said
    assert events(world)[-1]["event"] == "interrupted"


def test_an_inline_run_can_be_interrupted_too(world: World) -> None:
    steps = STEPS.replace("steps: 6", "steps: 2000")
    plan = world.plan(steps, executor="inline")
    before = signal.getsignal(signal.SIGINT)

    def interrupt(event: object) -> None:
        if type(event).__name__ == "CellReported":
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(CancelledStepError, match="the run was interrupted"):
        execute(plan, world.folder / "run", world.store, interrupt)
    assert events(world)[-1]["event"] == "interrupted"
    assert signal.getsignal(signal.SIGINT) is before


def test_two_runs_share_a_store_at_once(world: World, quiet: dict[str, str]) -> None:
    processes = [start_coordinator(world, STEPS, name) for name in ("one", "two")]
    for process in processes:
        process.join(120)
        assert process.exitcode == 0
    outcome = world.run(STEPS, into="three")
    assert len(outcome.cached) == 4
    assert digests(outcome) == quiet


def test_a_run_in_progress_is_left_alone_and_goes_on_after_a_kill(
    world: World, quiet: dict[str, str]
) -> None:
    process = start_coordinator(world, WAITING, "run")
    log = world.folder / "run" / "logs" / "second.log"
    wait_for(lambda: log.exists() and log.read_text().endswith("\n"))
    grandchild = int(log.read_text())
    step = int(Path(f"/proc/{grandchild}/stat").read_text().rpartition(")")[2].split()[1])
    try:
        with pytest.raises(ArgumentError, match="is in use by another run; wait until it has"):
            world.run(STEPS)
        assert is_running(world.folder / "run")
        with pytest.raises(ArgumentError, match=r"contains no run\.h5"):
            find_record(world.folder / "run")
        with pytest.raises(StoreError, match="is in use by a run"):
            collect_garbage(world.store)
    finally:
        process.kill()
        process.join()
    assert not is_running(world.folder / "run")
    # Steps and what they started end with their coordinator.
    assert has_ended(step)
    assert has_ended(grandchild)
    # What had ended is not computed again.
    again = world.run(STEPS)
    assert again.resumed == {"first"}
    assert digests(again) == quiet
    assert [event["event"] for event in events(world)].count("resumed") == 1
