"""What the scheduler makes of the state of a run: room, parts, repeats, what is settled anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.engine import scheduling
from orthoflow.engine.events import (
    CellFinished,
    CellLogged,
    CellProgress,
    CellWarned,
)
from orthoflow.engine.executors import Capacity
from orthoflow.engine.keys import CellKey
from orthoflow.engine.results import CellResult, ProductRef
from orthoflow.engine.run_folder import CellDamaged, CellEnded
from orthoflow.errors import CancelledStepError, DamageError
from orthoflow.sdk.context import StepEvent
from orthoflow.workflow.cells import Cell, CellOutput

WIDE = Capacity(n_tasks=3, n_cores=4, cores_of_one=4, share=2)


def cell(address: str, *sources: str, **more: Any) -> Cell:
    """A step that takes what others give, on ports called as these."""
    inputs = {name: CellOutput(address=name, port="out") for name in sources}
    return Cell(address=address, step=address, method="work.add", inputs=inputs, **more)


def ref(digest: str) -> ProductRef:
    return ProductRef(type_name="numbers", encoding_version=1, digest=digest)


def result(address: str, digest: str = "", **more: Any) -> CellResult:
    plain: dict[str, Any] = {
        "status": "ok", "key": f"key of {address}", "method": "work.add", "run_id": "r1",
        "outputs": {"out": ref(digest or address)},
    }  # fmt: skip
    return CellResult(**(plain | more))


class Store:
    """What a store says of products and results; those that are named are damaged."""

    folder = Path("store")

    def __init__(self) -> None:
        self.unsound: set[str] = set()
        # What shows only to who looks at every byte again.
        self.rotten: set[str] = set()
        self.taken = SimpleNamespace(result=None, damage="")

    def is_sound(self, digest: str, *, again: bool = False) -> bool:
        return digest not in self.unsound and not (again and digest in self.rotten)

    def take(self, key: str) -> SimpleNamespace:
        return self.taken


def a_run(*cells: Cell, **options: Any) -> Any:
    """A run that has begun; `lines` and `events` are what it writes and tells."""
    plain = {"force": (), "parts": None, "executor": "local", "scheduler": "", "all_cores": 4}
    plan = SimpleNamespace(
        cells=tuple(SimpleNamespace(cell=one) for one in cells),
        inputs={},
        methods={},
        options=SimpleNamespace(**(plain | options)),
    )
    lines: list[Any] = []
    events: list[Any] = []
    journal = SimpleNamespace(
        run_id="r1", started="then", damaged={}, finished_keys=frozenset(), write=lines.append,
        is_resumed=False,
    )  # fmt: skip
    store: Any = Store()
    tasks: Any = SimpleNamespace(plan=plan, store=store, logs=Path("run/logs"))
    splits: Any = SimpleNamespace(addresses=(), has_key=lambda key: key == "split")
    run: Any = scheduling._Run(tasks, splits, journal, events.append, SimpleNamespace())  # type: ignore[arg-type]
    run.lines, run.events = lines, events
    return run


def running(*cores: int) -> dict[str, Any]:
    return {f"t{index}": SimpleNamespace(cores=n, key=f"k{index}") for index, n in enumerate(cores)}


@pytest.mark.parametrize(
    ("cores", "wanted", "has_room"),
    [
        # What runs alone may want more than there is.
        ((), 9, True),
        ((2,), 2, True),
        ((2,), 3, False),
        ((1, 1), 2, True),
        # Three tasks at the most, however small.
        ((1, 1, 1), 1, False),
        ((2,), None, True),
        ((3,), None, False),
    ],
)
def test_a_step_begins_where_its_cores_are_free(
    cores: tuple[int, ...], wanted: int | None, has_room: bool
) -> None:
    run = a_run()
    run._running = running(*cores)
    assert run._has_room(cell("a", cores=wanted), WIDE) is has_room


def test_a_step_has_its_share_unless_it_asks_and_never_more_than_one_may() -> None:
    asked = {wanted: scheduling._cores(cell("a", cores=wanted), WIDE) for wanted in (None, 1, 4, 9)}
    assert asked == {None: 2, 1: 1, 4: 4, 9: 4}


@pytest.mark.parametrize(
    ("options", "is_compared", "n_parts"),
    [
        ({}, False, 1),
        ({"parts": 5}, True, 5),
        ({"executor": "dask", "parts": 5}, False, 5),
        ({"executor": "dask"}, True, 1),
        # One of eight workers is busy, and two other steps wait for room.
        ({"executor": "dask", "scheduler": "tcp://x:1"}, False, 2),
        # Workers of its own have the four cores of this machine.
        ({"executor": "dask"}, False, 1),
        ({"executor": "dask", "all_cores": 5}, False, 1),
        ({"executor": "dask", "all_cores": 99}, False, 2),
    ],
)
def test_a_step_is_computed_in_as_many_parts_as_keep_all_busy(
    options: dict[str, Any], is_compared: bool, n_parts: int
) -> None:
    run = a_run(cell("a"), cell("b"), cell("c"), cell("late", "a"), **options)
    run._running = running(1)
    del run._waiting["a"]
    run._ready = {"b": object(), "c": object()}
    task: Any = SimpleNamespace(is_compared=is_compared)
    assert run._n_parts(task, replace(WIDE, n_tasks=8)) == n_parts


def test_an_equal_step_waits_for_the_one_that_runs() -> None:
    run = a_run()
    run._running = running(1)
    keys = {key: run._is_under_way(CellKey(key=key, preimage="")) for key in ("k0", "split", "x")}
    assert keys == {"k0": True, "split": True, "x": False}


CHAIN = (cell("a"), cell("b", "a"), cell("c", "b"), cell("d"), cell("e", "d"))


def test_what_hangs_on_a_damaged_product_is_settled_anew() -> None:
    run = a_run(*CHAIN)
    run._results = {name: result(name) for name in "abcd"}
    run._waiting.clear()
    run._ready = {name: object() for name in "ce"}
    run._cached = dict.fromkeys("abd", "r0")
    run._resumed = {"b", "d"}
    assert not run._is_held_up(CHAIN[1], {"a": ref("a")})
    assert list(run._results) == ["a", "b", "c", "d"]
    run._store.rotten = {"a"}
    assert run._is_held_up(CHAIN[1], {"a": ref("a")}) is False
    run._store.unsound = {"a"}
    assert run._is_held_up(CHAIN[1], {"a": ref("a")}) is True
    assert list(run._results) == ["d"]
    assert list(run._waiting) == ["a", "b", "c"]
    assert (list(run._ready), list(run._cached), run._resumed) == (["e"], ["d"], {"d"})


def test_inputs_are_others_where_a_giver_gave_anew() -> None:
    run = a_run(*CHAIN)
    task: Any = SimpleNamespace(inputs={"a": SimpleNamespace(ref=ref("a"))})
    assert run._has_other_inputs_now(CHAIN[1], task)
    run._results["a"] = result("a")
    assert not run._has_other_inputs_now(CHAIN[1], task)
    run._results["a"] = result("a", "other")
    assert run._has_other_inputs_now(CHAIN[1], task)


def failed(error: type[Exception] = ValueError, exit_code: int = 1) -> CellResult:
    return result(
        "b", status="failed", error_type=error.__name__, error_message="why", exit_code=exit_code
    )


def test_a_step_that_failed_by_the_store_has_three_more_chances() -> None:
    task: Any = SimpleNamespace(inputs={"a": SimpleNamespace(ref=ref("a"))})
    for fault in ("unsound", "set aside"):
        run = a_run(*CHAIN)
        run._store.rotten = {"a"} if fault == "unsound" else set()
        end = failed() if fault == "unsound" else failed(DamageError)
        tried = [run._is_to_repeat(CHAIN[1], task, end) for _ in range(5)]
        assert tried == [True, True, True, False, False]
    run = a_run(*CHAIN)
    assert run._is_to_repeat(CHAIN[1], task, failed()) is False
    run._store.unsound = {"a"}
    assert run._is_to_repeat(CHAIN[1], task, result("b")) is False
    stopped = failed(CancelledStepError, CancelledStepError.exit_code)
    assert not run._is_to_repeat(CHAIN[1], task, stopped)


def test_a_step_without_what_it_needs_says_what_is_missing() -> None:
    run = a_run(*CHAIN)
    run._results = {
        "a": result("a"),
        "b": result("b", status="failed"),
        "c": result("c", status="skipped"),
    }
    assert run._missing(("a",)) == ""
    assert run._missing(("a", "b", "c")) == "needs b, which failed"
    assert run._missing(("c",)) == "needs c, which was skipped"


def test_a_forced_step_is_taken_only_from_this_run() -> None:
    key = CellKey(key="k", preimage="")
    run = a_run(*CHAIN, force=("b",))
    run._store.taken = SimpleNamespace(result=result("b"), damage="")
    assert run._known(CHAIN[1], key) is None
    assert run._known(CHAIN[0], key) is run._store.taken.result
    run._made.add("k")
    assert run._known(CHAIN[1], key) is run._store.taken.result
    run._made.clear()
    run._journal.finished_keys = frozenset({"k"})
    assert run._known(CHAIN[1], key) is run._store.taken.result
    assert (run.lines, run.events) == ([], [])
    run._store.taken = SimpleNamespace(result=None, damage="product.h5")
    assert run._known(CHAIN[1], key) is None
    (line,), (event,) = run.lines, run.events
    assert isinstance(line, CellDamaged)
    assert (line.address, line.key, line.what) == ("b", "k", "product.h5")
    assert event == CellWarned(
        address="b", text="the stored result was damaged (product.h5) and is computed again"
    )


@pytest.mark.parametrize(
    ("run_id", "is_made", "is_cached", "cached", "resumed"),
    [
        ("r0", False, True, {"a": "r0"}, set()),
        # Of this run itself: from before it was interrupted, or of an equal step just now.
        ("r1", False, True, {}, {"a"}),
        ("r1", True, True, {}, set()),
        ("r1", False, False, {}, set()),
    ],
    ids=["of another run", "resumed", "of an equal step", "computed"],
)
def test_where_a_result_comes_from_is_kept(
    run_id: str, is_made: bool, is_cached: bool, cached: dict[str, str], resumed: set[str]
) -> None:
    run = a_run(*CHAIN)
    given = result("a", run_id=run_id, error_type="")
    run._made |= {given.key} if is_made else set()
    run._settle(CHAIN[0], given, is_cached=is_cached)
    assert (run._cached, run._resumed) == (cached, resumed)
    assert "a" not in run._waiting
    assert run._results == {"a": given}
    (line,), (event,) = run.lines, run.events
    assert isinstance(line, CellEnded)
    assert (line.address, line.key, line.status, line.cached) == ("a", given.key, "ok", is_cached)
    assert event == CellFinished(address="a", result=given, cached=is_cached)


@pytest.mark.parametrize("status", ["ok", "failed"])
def test_a_result_says_that_the_one_before_was_damaged(status: str) -> None:
    run = a_run(*CHAIN)
    run._journal.damaged["a"] = "the record"
    run._settle(CHAIN[0], result("a", status=status, warnings=("dark",)))
    warnings = run._results["a"].warnings
    said = "the stored result was damaged (the record) and was computed again"
    assert warnings == (("dark", said) if status == "ok" else ("dark",))


def test_of_a_run_that_was_broken_off_there_is_what_was_not_stopped() -> None:
    run = a_run(*CHAIN)
    run._cached = {"d": "r0"}
    run._journal.damaged = {"a": "x", "gone": "y"}
    run._results = {
        "d": result("d"),
        "a": result("a"),
        "b": failed(CancelledStepError, CancelledStepError.exit_code),
    }
    told = run.so_far()
    # In the order of the plan.
    assert list(told.results) == ["a", "d"]
    assert (told.cached, told.damaged) == ({"d": "r0"}, {"a": "x"})
    assert (told.run_id, told.started, told.status, told.exit_code) == ("r1", "then", "ok", 0)


def test_an_interrupted_run_waits_for_its_tasks_and_says_how_to_go_on() -> None:
    run = a_run(*CHAIN)
    asked: list[str] = []
    run._running = {"a": SimpleNamespace(), "d": SimpleNamespace()}

    def poll(_timeout_s: float) -> tuple[Any, ...]:
        # One ends after the other.
        return (next(iter(run._running)),)

    run._take = run._running.pop
    executor: Any = SimpleNamespace(cancel=lambda: asked.append("cancel"), poll=poll)
    with pytest.raises(CancelledStepError, match=r"goes on where it stopped, given -o run$"):
        run._break_off(executor)
    assert (asked, run._running) == (["cancel"], {})
    assert [line.event for line in run.lines] == ["interrupted"]


def taking(run: Any, end: CellResult, *, is_unchanged: bool = True) -> list[tuple[str, Any]]:
    """What a run does with the end of the task of `b`, in order."""
    done: list[tuple[str, Any]] = []

    def note(what: str) -> Callable[..., None]:
        return lambda *given: done.append((what, given[0]))

    task = SimpleNamespace(
        address="b", key="key of b", folder="/nonexistent/x", cores=1,
        inputs={"a": SimpleNamespace(ref=ref("a"))},
    )  # fmt: skip
    run._running = {"b": task}
    run._splits = SimpleNamespace(take=lambda *_: (task, end), forget=note("forget parts"))
    run._plan.methods["work.add"] = SimpleNamespace(is_code_unchanged=lambda: is_unchanged)
    run._store.put_result = note("put")
    run._store.trust = note("trust")
    run._failures = SimpleNamespace(forget=note("forget"), remember=note("remember"))
    run._take(SimpleNamespace(address="b", result=end))
    return done


def test_a_result_is_kept_unless_the_code_changed_meanwhile() -> None:
    good = result("b")
    run = a_run(*CHAIN)
    run._results["a"] = result("a")
    kept = taking(run, good)
    assert [what for what, _ in kept] == ["put", "trust", "forget parts", "forget"]
    assert (run._made, run._results["b"], run._running) == ({"key of b"}, good, {})
    assert run.events == [CellFinished(address="b", result=good, cached=False)]
    run = a_run(*CHAIN)
    run._results["a"] = result("a")
    assert taking(run, good, is_unchanged=False) == []
    assert run._made == set()
    (warning,) = run._results["b"].warnings
    assert warning.startswith("the code of the method changed during the run")
    assert run.events[0] == CellWarned(address="b", text=warning)


def test_a_part_that_ends_settles_nothing() -> None:
    run = a_run(*CHAIN)
    run._running = {"b, part 1": SimpleNamespace(address="b, part 1", folder="/nonexistent/x")}
    run._splits = SimpleNamespace(take=lambda *_: None)
    run._take(SimpleNamespace(address="b, part 1", result=result("b")))
    assert (run._results, run._running, run.lines, run.events) == ({}, {}, [], [])


def test_failures_are_remembered_and_interruptions_are_not() -> None:
    run = a_run(*CHAIN)
    run._results["a"] = result("a")
    assert taking(run, failed()) == [("remember", "key of b")]
    assert run._results["b"].status == "failed"
    run = a_run(*CHAIN)
    run._results["a"] = result("a")
    assert taking(run, failed(CancelledStepError, CancelledStepError.exit_code)) == []


def test_a_step_waits_again_where_its_inputs_came_out_otherwise() -> None:
    run = a_run(*CHAIN)
    run._waiting.clear()
    run._ready["b"] = object()
    # Nobody has what it took any more.
    taking(run, result("b"))
    assert (list(run._waiting), "b" in run._results) == (["b"], False)
    run = a_run(*CHAIN)
    run._waiting.clear()
    run._ready["b"] = object()
    run._results["a"] = result("a")
    taking(run, failed(DamageError))
    assert (list(run._waiting), run._ready, "b" in run._results) == (["b"], {}, False)


def test_what_tasks_say_is_passed_on_as_of_their_step() -> None:
    heard: list[Any] = []
    splits: Any = SimpleNamespace(said_by=lambda task, fraction: (f"step of {task}", fraction / 2))
    tell = scheduling._passing_on(heard.append, splits)
    for kind in ("progress", "warning", "log"):
        tell("t", StepEvent(kind=kind, text=f"a {kind}", fraction=0.5))  # type: ignore[arg-type]
    assert heard == [
        CellProgress(address="step of t", fraction=0.25, text="a progress"),
        CellWarned(address="step of t", text="a warning"),
        CellLogged(address="step of t", text="a log"),
    ]
