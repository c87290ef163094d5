"""Kernels of later steps are compiled beside earlier ones, by nobody who outlives the run."""

from __future__ import annotations

import importlib
import inspect
import json
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine import compiling_ahead
from orthoflow.engine.compiled_code import DONE
from orthoflow.engine.compiling_ahead import FORETOLD, AheadCompiler
from orthoflow.engine.events import CellFinished, RunEvent
from orthoflow.engine.keys import MethodFacts, method_facts
from orthoflow.engine.scheduling import execute
from orthoflow.geometry.kernel_types import type_of
from tests.engine_world import World, toy_world
from tests.workshop_runs import WORKSHOP

_LONGEST_S = 120.0
_KERNELS = Path(__file__).resolve().parents[2] / "plugins" / "orthoflow_plugins" / FORETOLD


@pytest.fixture
def facts(monkeypatch: pytest.MonkeyPatch) -> MethodFacts:
    """Of a method whose package tells which kernel it needs."""
    monkeypatch.syspath_prepend(str(WORKSHOP))
    return method_facts("paint.kernel", discover_catalog())


def wait_for(path: Path) -> None:
    until = time.monotonic() + _LONGEST_S
    while not path.exists():
        assert time.monotonic() < until, f"{path.name} does not come"
        time.sleep(0.05)


def done_file(folder: Path, facts: MethodFacts) -> Path:
    [name] = compiling_ahead._orders(folder, [facts])
    return folder / name


def test_what_a_method_needs_is_compiled_before_it_runs(tmp_path: Path, facts: MethodFacts) -> None:
    done = done_file(tmp_path, facts)
    ahead = AheadCompiler(is_wanted=True)
    ahead.begin({tmp_path: [facts]})
    try:
        wait_for(done)
    finally:
        ahead.close()
    assert {path.name.split("-")[0] for path in tmp_path.rglob("*.nbi")} == {
        "kernels.doubled",
        "kernels.doubled_sum",
    }
    # Nobody is asked again for what is done.
    assert compiling_ahead._orders(tmp_path, [facts]) == {}
    ahead.begin({tmp_path: [facts]})
    assert not ahead._processes


def test_the_compiler_ends_with_its_run(tmp_path: Path, facts: MethodFacts) -> None:
    ahead = AheadCompiler(is_wanted=True)
    ahead.begin({tmp_path: [facts]})
    [process] = ahead._processes
    assert process.poll() is None
    ahead.close()
    assert process.returncode is not None


def test_the_compiler_ends_when_nobody_is_left_who_ordered(
    tmp_path: Path, facts: MethodFacts
) -> None:
    ahead = AheadCompiler(is_wanted=True)
    ahead.begin({tmp_path: [replace(facts, method="paint.endless")]})
    assert not ahead._processes, "it compiles for a method of which nothing is told"
    ahead.begin({tmp_path: [facts]})
    [process] = ahead._processes
    assert process.stdin is not None
    process.stdin.close()
    process.wait(_LONGEST_S)


def test_one_that_is_held_begins_anew(tmp_path: Path, facts: MethodFacts) -> None:
    ahead = AheadCompiler(is_wanted=False)
    ahead.hold()
    assert not ahead.is_wanted, "there is no core for it"
    ahead = AheadCompiler(is_wanted=True)
    ahead.begin({tmp_path: [facts]})
    [process] = ahead._processes
    assert not ahead.is_wanted
    ahead.hold()
    assert process.returncode is not None
    assert ahead.is_wanted
    done = done_file(tmp_path, facts)
    ahead.begin({tmp_path: [facts]})
    try:
        wait_for(done)
    finally:
        ahead.close()


def test_who_comes_from_the_end_meets_the_method_that_begins(
    tmp_path: Path, facts: MethodFacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[list[object]] = []

    def refused(_: Path, orders: dict[str, list[object]]) -> None:
        told.extend(orders.values())
        raise OSError("no process")

    monkeypatch.setattr(compiling_ahead, "_start", refused)
    monkeypatch.setattr(compiling_ahead, "_foretold", lambda _: {facts.method: [1, 2, 3]})
    for is_backwards in (False, True):
        AheadCompiler(is_wanted=True).begin({tmp_path: [facts]}, is_backwards=is_backwards)
    assert told == [[1, 2, 3], [3, 2, 1]]


WAITS = """
import pathlib, time
while not pathlib.Path("GO").exists():
    time.sleep(0.01)
time.sleep(0.2)
"""


def test_what_is_not_begun_of_a_method_is_left_to_its_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "waits.py").write_text(WAITS.replace("GO", str(tmp_path / "go")))
    (tmp_path / "unwanted.py").write_text(f"open({str(tmp_path / 'loaded')!r}, 'w')")
    first, second = (f"{name}.0123abcd{DONE}" for name in ("toy.begun", "toy.later"))
    ahead = AheadCompiler(is_wanted=False)
    orders = {first: [["waits", "f", []], ["unwanted", "f", []]], second: []}
    ahead._processes.append(compiling_ahead._start(tmp_path, orders))
    try:
        ahead.leave("toy.begun")
        (tmp_path / "go").touch()
        wait_for(tmp_path / second)
        ahead._processes[0].wait(_LONGEST_S)
        # Nobody is there to hear it any more.
        ahead.leave("toy.later")
    finally:
        ahead.close()
    assert not (tmp_path / first).exists()
    assert not (tmp_path / "loaded").exists()


COMPARED = """
steps:
  first: {use: make.range}
  second:
    in: {numbers: first.numbers}
    variants: {a: {use: work.add, params: {amount: 2}}, b: {use: work.slow}}
  third: {use: work.add, in: {numbers: first.numbers}, params: {amount: 7}}
  fourth: {use: work.add, in: {numbers: third.numbers}, params: {amount: 8}}
compare: {design: product}
"""


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with toy_world(tmp_path) as opened:
        yield opened


def test_nothing_is_compiled_beside_steps_whose_times_are_compared(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    compilers: list[subprocess.Popen[bytes]] = []

    def start(*_: object) -> subprocess.Popen[bytes]:
        compilers.append(subprocess.Popen(["sleep", "600"], stdin=subprocess.PIPE))
        return compilers[-1]

    living: dict[str, list[bool]] = {}

    def listen(event: RunEvent) -> None:
        if isinstance(event, CellFinished):
            living[event.address] = [process.poll() is None for process in compilers]

    monkeypatch.setattr(compiling_ahead, "_start", start)
    monkeypatch.setattr(compiling_ahead, "_orders", lambda *_: {"method": []})
    execute(world.plan(COMPARED, cores=2), world.folder / "run", world.store, listen)
    assert living == {
        "first": [True],
        "second@second=a": [False],
        "second@second=b": [False],
        "third": [False, True],
        "fourth": [False, True],
    }
    assert [process.poll() is None for process in compilers] == [False, False]


def test_kernels_that_are_not_as_they_were_foretold_are_left_to_their_steps(tmp_path: Path) -> None:
    orders = {"gone": [["workshop.kernels", "gone", []], ["nowhere", "f", ["float64"]]]}
    compiling_ahead.compile_all(tmp_path, orders)
    assert [path.name for path in tmp_path.iterdir()] == ["gone"]


def test_every_kernel_that_is_foretold_is_there_and_takes_what_is_told() -> None:
    """Where not: `python benchmarks/foretell_kernels.py --write`, with a recipe that needs it."""
    told = json.loads(_KERNELS.read_bytes())
    assert "plane.hough2d" in told["methods"]
    for module, name, arguments in told["kernels"]:
        kernel = getattr(importlib.import_module(module), name)
        taken = inspect.signature(kernel.py_func).parameters
        assert len(taken) == len(arguments), f"{module}.{name}"
        for text in arguments:
            type_of(text)
    numbers = {number for needed in told["methods"].values() for number in needed}
    assert numbers == set(range(len(told["kernels"])))
    assert told["methods"].keys() <= discover_catalog().methods.keys()
