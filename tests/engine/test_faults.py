"""Disks that are full or broken, and power that goes: nothing is lost, nothing wrong is sealed."""

from __future__ import annotations

import itertools
import os
import random
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from orthoflow.engine.cleaning import check_store
from orthoflow.engine.store import Store
from tests.faulty_files import FAULTS
from tests.long_loops import IS_LONG
from tests.stored_runs import StoredRuns, stored_runs

# Small, for the sake of the many: an input file, a mapped product that is in no record, and what
# reads it and gives a published file, a figure, a metric and a warning.
WORKFLOW = """
orthoflow: 1
name: toy
seed: 7
inputs:
  numbers: {files: numbers.txt}
steps:
  scan: {use: make.survey, in: {files: inputs.numbers}}
  means: {use: thin.means, in: {scan: scan.scan}}
  dots: {use: work.draws, in: {numbers: means.numbers}}
"""
# What one of each kind of fault befalls: a first run, one that goes on, exports, a clean-up.
RUN = ("run", "toy.yaml", "--executor", "inline")
COMMANDS = {
    "run": RUN,
    "resume": RUN,
    "export": ("export", "quiet", "--embed"),
    "gc": ("cache", "gc"),
    "replay": ("replay", "quiet", "--executor", "inline", "--input", "numbers=numbers.txt"),
}
SCENES = tuple(COMMANDS)
# Where a case works: a folder of its own, so that making and renaming the run's counts as well.
CASE = "case/run"
MEMORY = Path("/dev/shm")
EVERY = tuple(itertools.product(SCENES, FAULTS))
REASONS = (
    *("no space left", "input/output error", "stale file handle", "disk is read-only"),
    "read-only file system",
)
FEW = (
    *(("run", "power loss"), ("resume", "full disk"), ("export", "bad disk")),
    *(("gc", "kill"), ("replay", "bad disk")),
)


@pytest.fixture(scope="module")
def laboratory() -> Iterator[StoredRuns]:
    # In memory, where that is a folder: what a disk keeps is the layer's to say, not the disk's.
    place = MEMORY if os.access(MEMORY, os.W_OK) else None
    with (
        tempfile.TemporaryDirectory(prefix="orthoflow-faults-", dir=place) as folder,
        stored_runs(Path(folder), WORKFLOW) as found,
    ):
        # Loads what the other commands need, so that forks begin with it.
        for scene in ("export", "gc", "replay"):
            assert found.server(*prepared(found, scene), here=True).code == 0
        half = [*COMMANDS["resume"], "-o", "half/run", "--store", "half/run.store"]
        assert found.server(*half, event=found.n_events // 2).code == -9
        yield found


def prepared(laboratory: StoredRuns, scene: str) -> list[str]:
    """Make what a scene needs in the folder `case`; give the command that the fault befalls."""
    case = laboratory.folder / "case"
    shutil.rmtree(case, ignore_errors=True)
    if scene == "resume":
        shutil.copytree(laboratory.folder / "half", case)
    elif scene in ("export", "gc"):
        store = laboratory.copy_store(CASE)
        if scene == "gc":
            shutil.rmtree(next(iter((store / "objects").iterdir())))
    output = () if scene == "gc" else ("-o", CASE)
    return [*COMMANDS[scene], *output, "--store", f"{CASE}.store"]


def check_end(laboratory: StoredRuns, scene: str, command: list[str]) -> None:
    """The same command goes on, and what is there in the end is right."""
    record = laboratory.folder / CASE / "run.h5"
    finished = record.read_bytes() if record.exists() else b""
    if finished:
        assert laboratory.sealed(CASE) == laboratory.expected
    again = laboratory.server(*command)
    # A finished run, or a finished export, is refused.
    assert again.code == (2 if finished else 0), again.said
    if scene == "gc":
        assert laboratory.run(CASE, CASE).code == 0
    if finished:
        assert record.read_bytes() == finished
    else:
        assert laboratory.sealed(CASE) == laboratory.expected
    store = Store(laboratory.folder / f"{CASE}.store")
    check_store(store)
    assert check_store(store).damaged == ()


def befall(laboratory: StoredRuns, scene: str, fault: str, operation: int) -> int:
    """Let a fault befall an operation of a scene; give how many operations there were."""
    command = prepared(laboratory, scene)
    answer = laboratory.server(*command, fault=fault, operation=operation, seed=operation)
    what = f"{fault} at operation {operation} of {scene}: {answer.said}"
    assert "Traceback" not in answer.said, what
    assert "orthoflow itself failed" not in answer.said, what
    assert answer.code in ((-9, 0) if fault in ("kill", "power loss") else (0, 1, 2, 3)), what
    if answer.code > 0:
        assert any(reason in answer.said.lower() for reason in REASONS), what
    try:
        check_end(laboratory, scene, command)
    except AssertionError as error:
        raise AssertionError(f"{what}: {error}") from error
    return answer.events


@pytest.mark.parametrize(("scene", "fault"), EVERY if IS_LONG else FEW)
@pytest.mark.longer
def test_a_fault_at_any_operation_loses_nothing_and_seals_nothing_wrong(
    laboratory: StoredRuns, scene: str, fault: str
) -> None:
    # The last one comes when all is done: what was not brought to the disk is lost even then.
    n_operations = befall(laboratory, scene, fault, 1 << 30)
    operations = list(range(1, n_operations + 1))
    if not IS_LONG:
        operations = random.Random(f"{scene} {fault}").sample(operations, 1)
    found = []
    for operation in operations:
        try:
            befall(laboratory, scene, fault, operation)
        except AssertionError as error:
            found.append(f"{error}")
    assert not found, "\n".join([f"{len(found)} of {len(operations)}", *found[:20]])


@pytest.mark.longer
def test_kills_at_random_moments_lose_nothing(laboratory: StoredRuns) -> None:
    rng = random.Random(20261123)
    for number in range(500 if IS_LONG else 2):
        scene = SCENES[number % len(SCENES)]
        command = prepared(laboratory, scene)
        seconds = rng.uniform(0.0, laboratory.duration_s)
        assert laboratory.server(*command, seconds=seconds).code in (-9, 0, 2)
        check_end(laboratory, scene, command)


# Whatever is damaged in a store, no run takes it for good: it is computed again, and reported -----


DAMAGES = 300 if IS_LONG else 7


# Kinds of damage ----------------------------------------------------------------------------------


def flip(path: Path, rng: random.Random) -> None:
    before, content = path.stat(), bytearray(path.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def truncate(path: Path, rng: random.Random) -> None:
    os.truncate(path, rng.randrange(path.stat().st_size))


def lengthen(path: Path, _: random.Random) -> None:
    with path.open("ab") as stream:
        stream.write(bytes(512))


def remove(path: Path, _: random.Random) -> None:
    path.unlink()


def make_a_folder_of_it(path: Path, _: random.Random) -> None:
    path.unlink()
    path.mkdir()


def link_elsewhere(path: Path, rng: random.Random) -> None:
    elsewhere = path.parents[2] / "elsewhere"
    shutil.copy(path, elsewhere)
    flip(elsewhere, rng)
    path.unlink()
    path.symlink_to(elsewhere)


def swap_with_another(path: Path, rng: random.Random) -> None:
    store = next(folder for folder in path.parents if folder.suffix == ".store")
    like = [p for p in store.rglob(f"*{path.suffix}") if p.is_file() and p != path]
    other = rng.choice(sorted(like) or [store / "digests.json"])
    content = path.read_bytes()
    path.write_bytes(other.read_bytes())
    other.write_bytes(content)


KINDS: tuple[Callable[[Path, random.Random], None], ...] = (
    *(flip, truncate, lengthen, remove, make_a_folder_of_it, link_elsewhere, swap_with_another),
)
CLASSES = {
    "product": "objects/*/product.h5",
    "description": "objects/*/object.json",
    "published file": "objects/*/files/*",
    "figure": "objects/*/blob",
    "result": "results/*.json",
    "memory of digests": "digests.json",
    "lock": "lock",
}


@pytest.mark.longer
def test_no_damage_of_a_store_is_sealed_as_good(laboratory: StoredRuns) -> None:
    rng = random.Random(20150808)
    expected = laboratory.sealed("quiet")
    quiet = laboratory.run("sound", "again")
    assert (quiet.code, "damaged" in quiet.said) == (0, False)
    n_said = 0
    for number in range(DAMAGES):
        name = f"damage{number}"
        store = laboratory.copy_store(name)
        kind = list(CLASSES)[number % len(CLASSES)]
        files = sorted(path for path in store.glob(CLASSES[kind]) if path.stat().st_size)
        path = rng.choice(files or [store / "digests.json"])
        harm = rng.choice(KINDS)
        if harm is make_a_folder_of_it and kind == "result":
            harm = truncate
        harm(path, rng)
        what = f"{harm.__name__} of {path.relative_to(store)}"
        answer = laboratory.run(name, name)
        assert answer.code == 0, f"{what}: {answer.said}"
        assert laboratory.sealed(name) == expected, what
        n_said += "damaged" in answer.said
        # What no run needed, such as a scan that nothing reads any more, is found by looking.
        check_store(Store(store))
        assert check_store(Store(store)).damaged == (), what
        shutil.rmtree(store)
        shutil.rmtree(laboratory.folder / name)
    assert n_said > DAMAGES / 3
