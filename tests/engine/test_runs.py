"""A run computes what is missing, keeps what it computes, and says what it does."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from orthoflow.engine.environment import environment
from orthoflow.engine.journal import CellReported, CellStarted
from orthoflow.engine.scheduler import execute
from orthoflow.sdk.context import StepEvent
from tests.engine_world import World, digests

CHAIN = """
steps:
  first: {use: make.range}
  second: {use: work.noise, in: {numbers: first.numbers}}
  third: {use: work.add, in: {numbers: second.numbers}}
"""


def doing(code: str) -> str:
    return (
        "steps: {a: {use: make.range}, b: {use: work.does, in: {numbers: a.numbers}, "
        f"params: {{code: {json.dumps(code)}}}}}}}"
    )


def test_both_executors_and_all_job_counts_give_the_same_digests(world: World) -> None:
    inline = world.run(CHAIN, into="inline", executor="inline")
    steps = ("first", "second", "third")
    local = world.run(CHAIN, into="local", force=steps)
    jobs = world.run(CHAIN, into="jobs", force=steps, jobs=2)
    assert digests(inline) == digests(local) == digests(jobs)
    assert not local.cached
    assert {result.run_id for result in local.results.values()} == {local.run_id}


def test_the_environment_holds_versions_but_nobody() -> None:
    found = environment(2)
    assert found.threads == 2
    assert "numpy" in found.packages
    assert str(Path.home()) not in json.dumps(dataclasses.asdict(found))
    assert found.id == environment(2).id != environment(1).id


def test_equal_cells_run_once(world: World) -> None:
    steps = """
steps:
  first: {use: make.range}
  second:
    in: {numbers: first.numbers}
    variants: {a: {use: work.add}, b: {use: work.add}}
compare: {design: product}
"""
    outcome = world.run(steps, jobs=2)
    started = [event.address for event in world.events if isinstance(event, CellStarted)]
    assert len(started) == 2
    assert len(set(digests(outcome).values())) == 2
    # Neither another run nor an earlier attempt of this one gave the second.
    assert (outcome.cached, outcome.resumed) == ({}, frozenset())


def test_what_a_step_says_is_in_its_log_and_passed_on_while_it_runs(world: World) -> None:
    code = """
print("on stdout")
os.write(2, b"on stderr \\0 with NUL\\n")
ctx.log("a line of log")
for k in range(12):
    ctx.progress(k / 12)
    time.sleep(0.05)
"""
    outcome = world.run(doing(code))
    assert outcome.results["b"].log == "on stdout\non stderr  with NUL\na line of log\n"
    assert "\0" in (world.folder / "run" / "logs" / "b.log").read_text()
    reported = [
        event.event
        for event in world.events
        if isinstance(event, CellReported) and event.address == "b"
    ]
    assert StepEvent(kind="log", text="a line of log") in reported
    fractions = [event.fraction for event in reported if event.kind == "progress"]
    assert len(fractions) >= 3
    assert fractions == sorted(fractions)
    order = [type(event).__name__ for event in world.events if getattr(event, "address", "") == "b"]
    assert order[0] == "CellStarted"
    assert order[-1] == "CellFinished"


THREADS = """
names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS")
assert "NUMBA_DISABLE_JIT" not in os.environ
print(os.environ["NUMBA_CACHE_DIR"], os.getcwd(), ctx.scratch)
values = np.array([ctx.cores, *[float(os.environ[name]) for name in names]])
"""


@pytest.mark.parametrize(("jobs", "cores"), [(2, 2), (8, 1)])
def test_threads_are_fixed_before_any_library_loads(
    world: World, monkeypatch: pytest.MonkeyPatch, jobs: int, cores: int
) -> None:
    monkeypatch.setattr("orthoflow.engine.scheduler.usable_cores", lambda: 4)
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    outcome = world.run(doing(THREADS), jobs=jobs)
    assert world.values(outcome, "b") == [float(cores)] * 5
    numba, where, scratch = outcome.results["b"].log.split()
    assert not numba.startswith(str(world.folder))
    assert where == scratch
    assert scratch.startswith(str(world.store.scratch))
    assert not Path(scratch).exists()


def test_results_of_code_that_changed_during_the_run_are_not_kept(world: World) -> None:
    (world.site / "toy_plugin-1.0.dist-info" / "direct_url.json").write_text("{}")
    plan = world.plan(CHAIN, executor="inline")
    works = world.site / "toy_plugin" / "works.py"

    def edit(event: object) -> None:
        if event == CellStarted(address="second"):
            works.write_text(works.read_text() + "\n# edited\n")

    outcome = execute(plan, world.folder / "run", world.store, edit)
    assert outcome.status == "ok"
    warned = [address for address, result in outcome.results.items() if result.warnings]
    assert warned == ["second", "third"]
    assert outcome.results["second"].warnings == (
        "the code of the method changed during the run: the result is not stored",
    )
    results = outcome.results
    assert world.store.result(results["first"].key) == results["first"]
    assert world.store.result(results["second"].key) is None


# Run folders --------------------------------------------------------------------------------------


def test_a_run_that_goes_on_computes_nothing_twice_and_removes_what_a_killed_one_left(
    world: World,
) -> None:
    first = world.run(CHAIN, executor="inline", force=("second",))
    (world.store.scratch / "dead-run" / "task").mkdir(parents=True)
    second = world.run(CHAIN, executor="inline", force=("second",))
    assert second.results == first.results
    assert list(world.store.scratch.iterdir()) == []


# Loading and compiling ----------------------------------------------------------------------------


STEPS = (
    "steps: {{a: {{use: make.range}}, b: {{use: work.{0}, in: {{numbers: a.numbers}}, "
    "params: {1}}}}}"
)
# Reading the input takes half a second of the processor.
BURNS = """
def burn():
    end_s = time.thread_time() + 0.5
    while time.thread_time() < end_s:
        pass

def read(cls, payload, plain=Numbers.from_payload):
    burn()
    return plain(payload)

import time
Numbers.from_payload = classmethod(read)
"""
# A library that takes a second to load, a kernel that takes 1.5 s to compile, half of it computing,
# a library that a daemon thread loads, and a figure that takes half a second of the processor.
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
        products.burn()
    return lambda values: values

@numba.njit(nogil=True)
def kernel(values):
    return slowly_typed(values) + 1.0

kernel(values)
time.sleep(0.2)
ctx.metric("own_s", ctx.clock_s() - started, "s")
ctx.metric("own_cpu_s", ctx.processor_s() - started_cpu, "s")
ctx.figure("dot", lambda: products.burn() or b"\\x89PNG\\r\\n\\x1a\\n0123")
"""


def test_loading_and_compiling_show_in_compile_s_only(world: World) -> None:
    package = world.site / "toy_plugin"
    with (package / "products.py").open("a") as file:
        file.write(BURNS)
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
