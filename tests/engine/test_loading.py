"""Loading and compiling are measured apart, in no other number, whoever's method it is."""

from __future__ import annotations

from orthoflow.engine.results import CellResult
from tests.engine_world import World

STEPS = "steps: {{a: {{use: make.range}}, b: {{use: work.{0}, in: {{numbers: a.numbers}}{1}}}}}"


def metric(result: CellResult, name: str) -> float:
    return next(item.value for item in result.metrics if item.name == name)


def test_seconds_of_compiling_show_in_compile_s_only(world: World) -> None:
    outcome = world.run(STEPS.format("compiles", ", params: {amount: 3}"))
    result = outcome.results["b"]
    assert result.error_message == ""
    assert result.compile_s is not None
    # What else it loads and compiles takes seconds on a busy machine.
    assert 3.0 <= result.compile_s < 50.0
    assert 0.2 <= metric(result, "kernel_s") <= result.wall_s < 2.9
    # One of the three seconds is the processor's.
    assert 0.0 <= metric(result, "kernel_cpu_s") <= result.cpu_s < 0.9


def test_loading_shows_in_compile_s_only_and_stops_no_clock_from_a_daemon(world: World) -> None:
    package = world.site / "toy_plugin"
    (package / "heavy.py").write_text("import time\ntime.sleep(3)\n")
    (package / "aside.py").write_text("import time\ntime.sleep(0.5)\n")
    result = world.run(STEPS.format("loads", "")).results["b"]
    assert result.compile_s is not None
    assert result.compile_s >= 3.0
    assert 0.5 <= metric(result, "loads_s") <= result.wall_s < 2.9
    (package / "heavy.py").write_text("import time\ntime.sleep(0.1)\n")
    again = world.run(STEPS.format("loads", ""), into="inline", executor="inline", force=("b",))
    assert again.results["b"].compile_s is not None


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
