"""Loading and compiling are measured apart, in no other number, whoever's method it is."""

from __future__ import annotations

import json

from tests.engine_world import World

STEPS = (
    "steps: {{a: {{use: make.range}}, b: {{use: work.{0}, in: {{numbers: a.numbers}}, "
    "params: {1}}}}}"
)
# A library that takes a second to load, a kernel that takes 1.5 s to compile, half of it computing,
# and a library that a daemon thread loads.
LOADS = """
thread = threading.Thread(target=lambda: __import__("toy_plugin.aside"), daemon=True)
started, started_cpu = ctx.clock_s(), ctx.processor_s()
thread.start()
thread.join()
from toy_plugin import heavy
import numba
from numba.extending import overload

def slowly_typed(values):
    raise NotImplementedError

waited = []

@overload(slowly_typed)
def typed(values):
    if not waited:
        waited.append(True)
        time.sleep(1.0)
        end_s = time.thread_time() + 0.5
        while time.thread_time() < end_s:
            pass
    return lambda values: values

@numba.njit(nogil=True)
def kernel(values):
    return slowly_typed(values) + 1.0

kernel(values)
time.sleep(0.2)
ctx.metric("own_s", ctx.clock_s() - started, "s")
ctx.metric("own_cpu_s", ctx.processor_s() - started_cpu, "s")
"""


def test_loading_and_compiling_show_in_compile_s_only(world: World) -> None:
    package = world.site / "toy_plugin"
    (package / "heavy.py").write_text("import time\ntime.sleep(1)\n")
    (package / "aside.py").write_text("import time\ntime.sleep(0.3)\n")
    steps = STEPS.format("does", json.dumps({"code": LOADS}))
    result = world.run(steps).results["b"]
    assert result.error_message == ""
    # What else it loads and compiles takes seconds on a busy machine.
    assert result.compile_s is not None
    assert 2.5 <= result.compile_s < 50.0
    own = {metric.name: metric.value for metric in result.metrics}
    assert 0.5 <= own["own_s"] <= result.wall_s < 1.9
    assert 0.0 <= own["own_cpu_s"] <= result.cpu_s < 0.45


def test_a_deterministic_method_is_repeated_to_be_timed(world: World) -> None:
    steps = STEPS.format("slow", "{steps: 2}, repeat: 3")
    first = world.run(steps)
    repeats = [first.results[address] for address in ("b", "b#1", "b#2")]
    assert len({result.outputs["numbers"].digest for result in repeats}) == 1
    assert len({result.key for result in repeats}) == 3
    assert all(result.wall_s >= 0.1 and result.seed is None for result in repeats)
    assert world.run(steps, into="again").cached.keys() == {"a", "b", "b#1", "b#2"}
    once = STEPS.format("slow", "{steps: 2}")
    assert world.run(once, into="once").cached.keys() == {"a", "b"}
