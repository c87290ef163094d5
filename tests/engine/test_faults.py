"""Disks that are full or broken, and power that goes: nothing is lost, nothing wrong is sealed."""

from __future__ import annotations

import itertools
import random
import shutil
from collections.abc import Iterator

import pytest

from orthoflow.engine import Store, check_store
from orthoflow.records import verify_run
from tests.faulty_files import FAULTS
from tests.long_loops import IS_LONG
from tests.stored_runs import StoredRuns, stored_runs

# What one of each kind of fault befalls: a first run, one that goes on, exports, a clean-up.
SCENES = ("run", "resume", "export", "gc", "replay")
EVERY = tuple(itertools.product(SCENES, FAULTS))
REASONS = (
    *("no space left", "input/output error", "stale file handle", "disk is read-only"),
    "read-only file system",
)
FEW = (("run", "power loss"), ("resume", "full disk"), ("export", "bad disk"))


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StoredRuns]:
    with stored_runs(tmp_path_factory.mktemp("faults")) as found:
        yield found


def prepared(laboratory: StoredRuns, scene: str, name: str) -> list[str]:
    """Make what a scene needs under a name; give the command that the fault befalls."""
    store = f"{name}.store"
    run = ["run", "toy.yaml", "-o", name, "--executor", "inline", "--store", store]
    if scene == "run":
        return run
    if scene == "resume":
        assert laboratory.server(*run, event=laboratory.n_events // 2).code == -9
        return run
    if scene == "replay":
        again = ["replay", "quiet", "-o", name, "--executor", "inline", "--store", store]
        return [*again, "--input", "numbers=numbers.txt"]
    laboratory.copy_store(name)
    if scene == "gc":
        shutil.rmtree(next(iter((laboratory.folder / store / "objects").iterdir())))
        return ["cache", "gc", "--store", store]
    return ["export", "quiet", "--embed", "-o", name, "--store", store]


def check_end(laboratory: StoredRuns, scene: str, name: str, command: list[str]) -> None:
    """The same command goes on, and what is there in the end is right."""
    record = laboratory.folder / name / "run.h5"
    was_finished = record.exists()
    if was_finished:
        assert verify_run(record).findings == ()
    again = laboratory.server(*command)
    # A finished run, or a finished export, is refused.
    assert again.code == (2 if was_finished else 0), again.said
    if scene == "gc":
        assert laboratory.run(name, name).code == 0
    assert laboratory.sealed(name) == laboratory.sealed("quiet")
    store = Store(laboratory.folder / f"{name}.store")
    check_store(store)
    assert check_store(store).damaged == ()


def befall(laboratory: StoredRuns, scene: str, fault: str, operation: int, name: str) -> int:
    """Let a fault befall an operation of a scene; give how many operations there were."""
    command = prepared(laboratory, scene, name)
    answer = laboratory.server(*command, fault=fault, operation=operation, seed=operation)
    what = f"{fault} at operation {operation} of {scene}: {answer.said}"
    assert "Traceback" not in answer.said, what
    assert "orthoflow itself failed" not in answer.said, what
    assert answer.code in ((-9, 0) if fault in ("kill", "power loss") else (0, 1, 2, 3)), what
    if answer.code > 0:
        assert any(reason in answer.said.lower() for reason in REASONS), what
    try:
        check_end(laboratory, scene, name, command)
    except AssertionError as error:
        raise AssertionError(f"{what}: {error}") from error
    for path in (laboratory.folder / name, laboratory.folder / f"{name}.store"):
        shutil.rmtree(path)
    return answer.events


@pytest.mark.parametrize(("scene", "fault"), EVERY if IS_LONG else FEW)
@pytest.mark.long  # one operation of a few in a normal run
def test_a_fault_at_any_operation_loses_nothing_and_seals_nothing_wrong(
    laboratory: StoredRuns, scene: str, fault: str
) -> None:
    # The last one comes when all is done: what was not brought to the disk is lost even then.
    name = f"{scene}-{fault.replace(' ', '-')}"
    n_operations = befall(laboratory, scene, fault, 1 << 30, f"{name}-all")
    operations = list(range(1, n_operations + 1))
    if not IS_LONG:
        operations = random.Random(name).sample(operations, 1)
    for operation in operations:
        befall(laboratory, scene, fault, operation, f"{name}-{operation}")


@pytest.mark.skipif(not IS_LONG, reason="500 kills: .ci/run --long")
@pytest.mark.long
def test_five_hundred_kills_at_random_moments_lose_nothing(laboratory: StoredRuns) -> None:
    rng = random.Random(20261123)
    for number in range(500):
        scene = SCENES[number % len(SCENES)]
        name = f"{scene}-{number}"
        command = prepared(laboratory, scene, name)
        seconds = rng.uniform(0.0, laboratory.duration_s)
        assert laboratory.server(*command, seconds=seconds).code in (-9, 0, 2)
        check_end(laboratory, scene, name, command)
        for path in (laboratory.folder / name, laboratory.folder / f"{name}.store"):
            shutil.rmtree(path)
