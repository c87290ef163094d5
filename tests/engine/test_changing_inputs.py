"""An input that changes while a run reads it is noticed; nothing stays under its old digest."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from orthoflow.engine.journal import CellStarted, RunEvent
from orthoflow.engine.scheduler import execute
from orthoflow.engine.store import Store
from orthoflow.errors import ArgumentError, InputError
from tests.engine_world import World, toy_world

STEPS = """
inputs: {numbers: {files: numbers.txt}}
steps: {read: {use: make.file, in: {files: inputs.numbers}}}
"""


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with toy_world(tmp_path) as opened:
        (tmp_path / "numbers.txt").write_text("1 2 3")
        yield opened


def rewrite_in_secret(path: Path) -> None:
    """Change the content, and nothing of what one usually looks at."""
    before = path.stat()
    path.write_text("3 2 1")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def exchange(path: Path) -> None:
    other = path.with_name("other.txt")
    other.write_text("3 2 1")
    shutil.copystat(path, other)
    other.replace(path)


def append(path: Path) -> None:
    with path.open("a") as file:
        file.write(" 4")


def touch(path: Path) -> None:
    os.utime(path, ns=(1, 1))


def run_while(world: World, change: Callable[[Path], object]) -> tuple[str, str]:
    """Status and reason of a step whose input changes as soon as it has begun."""
    plan = world.plan(STEPS, executor="inline")

    def listen(event: RunEvent) -> None:
        if isinstance(event, CellStarted):
            change(world.folder / "numbers.txt")

    result = execute(plan, world.folder / "run", world.store, listen).results["read"]
    return result.status, result.error_message


def test_an_input_may_be_touched(world: World) -> None:
    assert run_while(world, touch) == ("ok", "")


@pytest.mark.parametrize("change", [rewrite_in_secret, exchange, append])
def test_a_changed_input_fails_its_step(world: World, change: Callable[[Path], object]) -> None:
    path = world.folder / "numbers.txt"
    assert run_while(world, change) == (
        "failed",
        f"the input file {path} changed while it was read; run again",
    )
    outcome = world.run(STEPS, into="again", executor="inline")
    assert outcome.results["read"].status == "ok"
    assert not outcome.cached


def test_an_input_that_is_no_file_is_refused_without_waiting_for_it(world: World) -> None:
    path = world.folder / "numbers.txt"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(InputError, match=r"numbers\.txt must be a regular file, because"):
        world.plan(STEPS)


def test_paths_that_are_no_text_are_refused_before_anything_runs(world: World) -> None:
    odd = Path(os.fsdecode(os.fsencode(world.folder) + b"/\xff\xfe"))
    plan = world.plan("steps: {a: {use: make.range}}")
    with pytest.raises(ArgumentError, match=r"^the run folder .*\\udcff.* is not UTF-8: rename it"):
        execute(plan, odd / "run", world.store)
    with pytest.raises(ArgumentError, match=r"^the store .*\\udcff.* is not UTF-8: rename it"):
        execute(plan, world.folder / "run", Store(odd))
    assert not odd.exists()
    odd.mkdir()
    (odd / "numbers.txt").write_text("1")
    with pytest.raises(InputError, match=r"^the input file .*\\udcff.* is not UTF-8: rename it"):
        world.store.file_digests().digest(odd / "numbers.txt")
