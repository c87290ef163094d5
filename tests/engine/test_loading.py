"""Loading and compiling are measured apart, in no other number, whoever's method it is."""

from __future__ import annotations

import importlib
import itertools
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from orthoflow.engine import measuring, worker
from orthoflow.engine.measuring import LoadingMeter, MemorySampler
from orthoflow.engine.results import CellResult
from tests.engine_world import World

STEPS = "steps: {{a: {{use: make.range}}, b: {{use: work.{0}, in: {{numbers: a.numbers}}{1}}}}}"


def metric(result: CellResult, name: str) -> float:
    return next(item.value for item in result.metrics if item.name == name)


def test_seconds_of_compiling_show_in_compile_s_only(world: World) -> None:
    outcome = world.run(STEPS.format("compiles", ", params: {amount: 5}"))
    result = outcome.results["b"]
    assert result.error_message == ""
    assert result.compile_s is not None
    # What else it loads and compiles takes seconds on a busy machine.
    assert 5.0 <= result.compile_s < 50.0
    assert 0.2 <= metric(result, "kernel_s") <= result.wall_s < 4.9
    # One of the five seconds is the processor's.
    assert 0.0 <= metric(result, "kernel_cpu_s") <= result.cpu_s < 0.9


def test_loading_shows_in_compile_s_only_and_stops_no_clock_from_a_daemon(world: World) -> None:
    package = world.site / "toy_plugin"
    (package / "heavy.py").write_text("import time\ntime.sleep(5)\n")
    (package / "aside.py").write_text("import time\ntime.sleep(0.5)\n")
    result = world.run(STEPS.format("loads", "")).results["b"]
    assert result.compile_s is not None
    assert result.compile_s >= 5.0
    assert 0.5 <= metric(result, "loads_s") <= result.wall_s < 4.9
    (package / "heavy.py").write_text("import time\ntime.sleep(0.1)\n")
    again = world.run(STEPS.format("loads", ""), into="inline", executor="inline", force=("b",))
    assert again.results["b"].compile_s is not None


def test_looking_at_the_memory_is_in_no_processor_time(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step that compiles for minutes is looked at thousands of times."""

    class Laborious(MemorySampler):
        def _note(self) -> None:
            super()._note()
            end_s = time.thread_time() + 0.05
            while time.thread_time() < end_s:
                pass
            looks.append(self)

    looks: list[MemorySampler] = []
    monkeypatch.setattr(worker, "MemorySampler", Laborious)
    steps = STEPS.format("slow", ", params: {steps: 30}")
    result = world.run(steps, executor="inline").results["b"]
    assert looks[-1].processor_s > 0.15
    assert result.cpu_s < looks[-1].processor_s / 2


def test_a_step_that_takes_nothing_takes_no_less(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Threads' clocks run ahead of their process's by ticks, and a record takes no such time."""
    clock = itertools.count(5.0, -0.001)
    monkeypatch.setattr(worker._Call, "_cpu_s", lambda _: next(clock))
    result = world.run(STEPS.format("slow", ", params: {steps: 1}"), executor="inline").results["b"]
    assert result.cpu_s == 0.0


def test_no_search_for_garbage_looks_at_what_a_step_has_loaded(world: World) -> None:
    """Else what a method states of its speed hangs on who has loaded its libraries."""
    package = world.site / "toy_plugin"
    (package / "aside.py").write_text("")
    (package / "heavy.py").write_text(
        "import time\n"
        "class Loaded: pass\n"
        "objects = [Loaded() for _ in range(1000)]\n"
        "end_s = time.thread_time() + 0.5\n"
        "while time.thread_time() < end_s: pass\n"
    )
    result = world.run(STEPS.format("loads", "")).results["b"]
    assert metric(result, "n_searched") == 0
    # A program that orthoflow is a part of keeps its garbage collected.
    into = {"into": "inline", "executor": "inline", "force": ("b",)}
    here = world.run(STEPS.format("loads", ""), **into).results["b"]
    assert metric(here, "n_searched") == 1000


def test_a_deterministic_method_is_repeated_to_be_timed(world: World) -> None:
    steps = STEPS.format("slow", ", params: {steps: 2}, repeat: 3")
    first = world.run(steps)
    repeats = [first.results[address] for address in ("b", "b#1", "b#2")]
    assert len({result.outputs["numbers"].digest for result in repeats}) == 1
    assert len({result.key for result in repeats}) == 3
    assert all(result.wall_s >= 0.1 and result.seed is None for result in repeats)
    assert world.run(steps, into="again").cached.keys() == {"a", "b", "b#1", "b#2"}
    assert world.run(STEPS.format("slow", ", params: {steps: 2}"), into="once").cached.keys() == {
        "a",
        "b",
    }


def test_threads_that_load_at_once_count_once() -> None:
    meter = LoadingMeter()
    both = threading.Barrier(2)

    def load() -> None:
        meter.begin()
        both.wait()
        time.sleep(0.3)
        meter.end()

    other = threading.Thread(target=load)
    started_s = time.perf_counter()
    other.start()
    load()
    other.join()
    passed_s = time.perf_counter() - started_s
    assert 0.3 <= meter.total_s <= passed_s
    assert meter.processor_s < 0.2


def test_the_clock_stands_still_while_something_is_loaded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = {"s": 100.0}
    clock = SimpleNamespace(perf_counter=lambda: now["s"], thread_time=lambda: now["s"])
    monkeypatch.setattr(measuring, "time", clock)
    meter = LoadingMeter()
    assert meter.clock_s() == 100.0
    now["s"] = 101.0
    meter.begin()
    now["s"] = 102.0
    # What is loaded for what is loaded is part of it.
    meter.begin()
    now["s"] = 104.0
    meter.end()
    now["s"] = 105.0
    assert (meter.clock_s(), meter.total_s) == (101.0, 4.0)
    meter.end()
    assert (meter.clock_s(), meter.total_s, meter.processor_s) == (101.0, 4.0, 4.0)
    # Something that began before anybody listened.
    meter.end()
    now["s"] = 107.0
    assert (meter.clock_s(), meter.total_s) == (103.0, 4.0)


def test_imports_are_as_before_once_it_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import numba
    from numba.core import event

    bootstrap = importlib._bootstrap  # type: ignore[attr-defined]
    before = (bootstrap._find_and_load, bootstrap._lock_unlock_module)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "loaded_slowly.py").write_text(
        "import time\ntime.sleep(0.3)\nfrom missing import x"
    )
    with (
        LoadingMeter() as meter,
        pytest.raises(ModuleNotFoundError, match=r"^No module named 'missing'$"),
    ):
        importlib.import_module("loaded_slowly")
    assert meter.total_s >= 0.3
    assert (bootstrap._find_and_load, bootstrap._lock_unlock_module) == before
    assert event._registered["numba:compiler_lock"] == []
    numba.njit(lambda x: x)(1)
    assert meter.total_s < 30.0
