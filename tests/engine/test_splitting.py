"""Steps whose methods map over items come out the same in parts, and go on where they stopped."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.engine import splitting
from orthoflow.engine.events import CellFinished, CellProgress, CellStarted, RunEvent
from orthoflow.engine.garbage import collect_garbage
from orthoflow.engine.results import CellResult, ProductRef
from orthoflow.engine.scheduler import RunOutcome, execute
from orthoflow.engine.splitting import _parts, parts_folder
from orthoflow.engine.store import Store
from orthoflow.engine.worker import Task, TaskPart
from orthoflow.errors import CancelledStepError, DamageError
from tests.engine_tasks import bare_task
from tests.engine_world import World, toy_world

STEPS = """
steps:
  first: {use: make.rows, params: {count: 5}}
  told: {use: tell.sums, in: {rows: first.rows}}
  last: {use: work.add, in: {numbers: told.numbers}}
"""


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with toy_world(tmp_path) as opened:
        yield opened


def in_parts(
    world: World, n_parts: int, *sets: str, into: str = "", **options: object
) -> CellResult:
    """Give the result of the step that maps, computed in so many parts."""
    options = {"executor": "inline", **options}
    outcome = world.run(STEPS, sets=sets, into=into or f"run{n_parts}", parts=n_parts, **options)
    return outcome.results["told"]


def rows_computed(result: CellResult) -> list[str]:
    """What each part printed or logged of its rows."""
    return [line for line in result.log.splitlines() if line.startswith("part ")]


def without_costs(result: CellResult) -> dict[str, object]:
    said = dataclasses.asdict(result)
    for name in ("wall_s", "cpu_s", "compile_s", "peak_rss_mib", "started", "ended", "log"):
        del said[name]
    return said


def test_any_number_of_parts_gives_what_one_gives(world: World) -> None:
    whole = in_parts(world, 1)
    assert whole.status == "ok"
    assert world.values(world.run(STEPS, executor="inline", into="again"), "told")[:2] == (
        pytest.approx([2.4142, 4.1463], abs=1e-4)
    )
    for n_parts in (2, 3, 5, 9):
        result = in_parts(world, n_parts, force=("told",))
        assert result.outputs == whole.outputs
        assert result.metrics == whole.metrics
        assert result.key == whole.key
        assert result.warnings == ("rows are short", "sums are sums")
        assert len(rows_computed(result)) == min(n_parts, 5)


def test_processes_of_their_own_give_what_one_gives(world: World) -> None:
    whole = in_parts(world, 1)
    result = in_parts(world, 2, force=("told",), executor="local", jobs=2)
    said, expected = without_costs(result), without_costs(whole)
    for one in (said, expected):
        del one["run_id"], one["environment"]
    assert said == expected
    assert "rows 0 2\n" in result.log
    assert "rows 2 5\n" in result.log
    assert "joined:\n" in result.log
    log = world.folder / "run2" / "logs" / "told.log"
    assert log.read_text() == result.log


def test_one_step_is_shown_whatever_it_was_computed_in(world: World) -> None:
    in_parts(world, 5)
    events = world.events
    started = [event.address for event in events if isinstance(event, CellStarted)]
    ended = [event.address for event in events if isinstance(event, CellFinished)]
    assert started == ended == ["first", "told", "last"]
    fractions = [e.fraction for e in events if isinstance(e, CellProgress) and e.address == "told"]
    assert fractions == sorted(fractions)
    assert 0.0 < fractions[len(fractions) // 2] < 1.0 == fractions[-1]
    assert not list(parts_folder(world.store).iterdir())


def test_costs_are_those_of_all_parts(world: World) -> None:
    result = in_parts(world, 5, "told.wait_s=0.02")
    assert 0.1 <= result.wall_s < 5.0
    assert result.stored_mib is not None


def test_a_part_that_fails_is_named_and_nothing_else_begins(world: World) -> None:
    result = in_parts(world, 3, "told.bad=row2")
    assert result.status == "failed"
    assert result.error_message == "part 2 of 3 (row1 to row2): no sum is large enough"
    assert result.error_type == "MethodError"
    assert rows_computed(result) == [line for line in rows_computed(result) if "part 1" in line]
    plan = world.plan(STEPS, sets=("told.bad=row2",))
    assert "part 2 of 3" in plan.cells[1].reason


def test_parts_that_cannot_be_joined_fail_the_step(world: World) -> None:
    result = in_parts(world, 3, "told.bad_join=true")
    assert (result.status, result.error_message) == ("failed", "these do not go together")


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ("row2 metric", "reports metrics or figures of a part; it must do that in join"),
        ("row2 gives", "must give its PartOut for a part, got Rows"),
    ],
)
@pytest.mark.parametrize("n_parts", [1, 3])
def test_what_a_part_must_not_do_is_told_whole_or_not(
    world: World, bad: str, said: str, n_parts: int
) -> None:
    assert said in in_parts(world, n_parts, f"told.bad={bad}").error_message


def test_warnings_come_in_the_order_of_the_parts(world: World) -> None:
    result = in_parts(world, 5, "told.bad=row3 warns")
    assert result.warnings == ("rows are short", "row3 is odd", "sums are sums")


def interrupted(world: World, **options: object) -> RunOutcome | None:
    """Run in five parts and stop as soon as the third one speaks."""

    def listen(event: RunEvent) -> None:
        if isinstance(event, CellProgress) and event.text == "row2":
            raise KeyboardInterrupt

    plan = world.plan(STEPS, executor="inline", parts=5, **options)
    with pytest.raises((KeyboardInterrupt, CancelledStepError)):
        execute(plan, world.folder / "run", world.store, listen)
    return None


@pytest.mark.parametrize("n_parts", [5, 2, 1])
def test_a_run_that_goes_on_takes_the_parts_that_are_there(world: World, n_parts: int) -> None:
    whole = in_parts(world, 1, into="whole")
    world.store.results.joinpath(f"{whole.key}.json").unlink()
    interrupted(world)
    (folder,) = parts_folder(world.store).iterdir()
    assert folder.name == whole.key
    assert len(list((folder / "results").iterdir())) == 2
    result = in_parts(world, n_parts, into="run")
    assert result.outputs == whole.outputs
    spoken = [e.text for e in world.events if isinstance(e, CellProgress) and e.address == "told"]
    assert [name for name in spoken if name.startswith("row")] == ["row2", "row3", "row4"]


def test_forced_steps_take_no_parts_of_other_runs(world: World) -> None:
    interrupted(world)
    result = in_parts(world, 5, into="other", force=("told",))
    assert result.status == "ok"
    spoken = [e.text for e in world.events if isinstance(e, CellProgress) and e.address == "told"]
    assert "row0" in spoken


@pytest.mark.parametrize("file", ["objects/*/product.h5", "results/*.json"])
def test_a_damaged_part_is_computed_again(world: World, file: str) -> None:
    whole = in_parts(world, 1, into="whole")
    world.store.results.joinpath(f"{whole.key}.json").unlink()
    interrupted(world)
    damaged = min(parts_folder(world.store).glob(f"*/{file}"))
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    assert in_parts(world, 5, into="run").outputs == whole.outputs


def test_a_part_that_takes_too_long_is_named(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("orthoflow.engine.local._GRACE_S", 0.3)
    steps = STEPS.replace("in: {rows: first.rows}}", "in: {rows: first.rows}, timeout: 1s}")
    outcome = world.run(steps, sets=("told.wait_s=9",), parts=2, jobs=2)
    said = outcome.results["told"].error_message
    assert said.startswith("part ")
    assert "ran past its timeout of 1 s and was stopped" in said


def test_a_result_that_another_run_has_given_meanwhile_is_taken(world: World) -> None:
    plan = world.plan(STEPS, executor="inline", parts=5)
    ran: list[str] = []

    def listen(event: RunEvent) -> None:
        if isinstance(event, CellProgress) and event.text == "row4" and not ran:
            ran.append(execute(plan, world.folder / "other", world.store).run_id)

    outcome = execute(plan, world.folder / "run", world.store, listen)
    assert outcome.status == "ok"
    assert outcome.cached["told"] == ran[0]


def test_garbage_collection_removes_parts(world: World) -> None:
    interrupted(world)
    assert list(parts_folder(world.store).iterdir())
    collect_garbage(world.store)
    assert not list(parts_folder(world.store).iterdir())


def test_a_step_of_one_item_or_of_a_damaged_input_is_computed_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(*_: object) -> list[str]:
        raise DamageError("the input is damaged")

    task: Any = SimpleNamespace(key="ab", address="step")
    facts: Any = SimpleNamespace(maps_over="somewhere")
    split = splitting.Splits(Store(tmp_path / "store"))
    for names in (lambda *_: ["one"], damaged):
        monkeypatch.setattr(splitting, "_item_names", names)
        assert split.begin(task, facts, 4, is_forced=False) is False


def test_parts_fill_what_is_missing() -> None:
    there = dict.fromkeys((range(2, 3), range(6, 8)))
    assert list(_parts(10, 3, there)) == [
        range(2),
        range(2, 3),
        range(3, 6),
        range(6, 8),
        range(8, 10),
    ]
    assert list(_parts(0, 3, {})) == []
    assert list(_parts(4, 9, {})) == [range(nth, nth + 1) for nth in range(4)]
    for n_items in range(1, 30):
        for n_parts in range(1, 12):
            parts = list(_parts(n_items, n_parts, {}))
            assert [item for part in parts for item in part] == list(range(n_items))
            assert len(parts) <= n_parts
            assert max(map(len, parts)) - min(map(len, parts)) <= 1


# What becomes of a step in parts, without running any -------------------------------------------


def a_step(folder: Path) -> Task:
    return bare_task(
        method="work.sums",
        key="key of the step",
        store=str(folder / "store"),
        folder=str(folder / "scratch" / "whole"),
        log=str(folder / "step.log"),
    )


def begun(folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[splitting.Splits, Task]:
    """Five items in two parts, of code that has changed: nothing is kept in the store."""
    monkeypatch.setattr(splitting, "_item_names", lambda *_: tuple("abcde"))
    facts: Any = SimpleNamespace(maps_over="rows", is_code_unchanged=lambda: False)
    splits, task = splitting.Splits(Store(folder / "store")), a_step(folder)
    assert splits.begin(task, facts, 2, is_forced=False)
    return splits, task


def came_to(status: str = "ok", **more: Any) -> CellResult:
    digest = ProductRef(type_name="part", encoding_version=1, digest=f"sha256:{more.get('log')}")
    plain: dict[str, Any] = {"status": status, "outputs": {"part": digest}, "started": "2026-02"}
    return CellResult(**(plain | more))


def ended(task: Task, result: CellResult) -> Any:
    return SimpleNamespace(address=task.address, result=result)


def test_parts_come_one_after_the_other_and_then_what_joins_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    splits, step = begun(tmp_path, monkeypatch)
    assert splits.addresses == ("step",)
    assert splits.has_key("key of the step")
    assert not splits.has_key("another")
    one, two, none = (splits.next_task("step") for _ in range(3))
    assert one is not None
    assert two is not None
    assert none is None
    assert (one.address, two.address) == (
        *("step, part 1 of 2 (a to b)", "step, part 2 of 2 (c to e)"),
    )
    assert one.part == TaskPart(first=0, end=2)
    assert two.part == TaskPart(first=2, end=5)
    assert len({step.key, one.key, two.key}) == 3
    assert len({step.folder, one.folder, two.folder}) == 3
    assert Path(one.folder).parent == Path(step.folder).parent
    assert Path(one.log).parent == Path(one.folder)
    # A third of the way is each part, and what joins them.
    assert splits.said_by("elsewhere", 0.5) == ("elsewhere", 0.5)
    assert splits.said_by(two.address, 0.5) == ("step", pytest.approx(0.5 / 3))
    assert splits.said_by(one.address, 0.25) == ("step", pytest.approx(0.75 / 3))
    first = came_to(
        log="one\n", wall_s=1.0, cpu_s=2.0, compile_s=0.5, peak_rss_mib=7.0, started="2026-01",
        warnings=("dark", "far"),
    )  # fmt: skip
    second = came_to(
        log="two\n", wall_s=2.0, cpu_s=3.0, compile_s=None, peak_rss_mib=9.0, warnings=("far",)
    )
    assert splits.take(two, ended(two, second)) is None
    assert splits.said_by(one.address, 0.5) == ("step", pytest.approx(1.5 / 3))
    assert splits.next_task("step") is None
    assert splits.take(one, ended(one, first)) is None
    joining = splits.next_task("step")
    assert joining is not None
    assert splits.next_task("step") is None
    assert (joining.address, joining.key, joining.part) == ("step", step.key, None)
    assert [(part.first, part.end, part.ref) for part in joining.parts] == [
        (0, 2, first.outputs["part"]),
        (2, 5, second.outputs["part"]),
    ]
    assert splits.said_by("step", 0.5) == ("step", pytest.approx(2.5 / 3))
    last = came_to(
        log="whole\n", wall_s=4.0, cpu_s=4.0, compile_s=1.0, peak_rss_mib=8.0, warnings=("new",)
    )
    over = splits.take(joining, ended(joining, last))
    assert over is not None
    task, result = over
    assert task is step
    assert (result.wall_s, result.cpu_s, result.compile_s) == (7.0, 9.0, 1.5)
    assert (result.peak_rss_mib, result.started) == (9.0, "2026-01")
    assert result.warnings == ("dark", "far", "new")
    assert result.log == (
        "part 1 of 2 (a to b), 1.0 s:\none\npart 2 of 2 (c to e), 2.0 s:\ntwo\njoined:\nwhole\n"
    )
    assert Path(step.log).read_text() == result.log
    assert splits.addresses == ()


@pytest.mark.parametrize(
    ("exit_code", "said"),
    [(1, "part 1 of 2 (a to b): why"), (CancelledStepError.exit_code, "why")],
    ids=["failed", "interrupted"],
)
def test_the_first_failure_is_the_steps_once_nothing_runs_any_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exit_code: int, said: str
) -> None:
    splits, step = begun(tmp_path, monkeypatch)
    one, two = (splits.next_task("step") for _ in range(2))
    assert one is not None
    assert two is not None
    failure = came_to("failed", error_message="why", exit_code=exit_code, log="l\n", key=one.key)
    assert splits.take(one, ended(one, failure)) is None
    # Nothing else begins.
    assert splits.next_task("step") is None
    over = splits.take(two, ended(two, came_to("failed", error_message="too", log="m\n")))
    assert over is not None
    task, result = over
    assert (task, result.error_message, result.exit_code) == (step, said, exit_code)
    assert (result.key, result.key_preimage) == (step.key, step.key_preimage)
    assert result.log == "l\n"
    assert splits.addresses == ()


def test_a_task_of_a_whole_step_is_taken_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    splits, _ = begun(tmp_path, monkeypatch)
    other: Any = SimpleNamespace(address="other")
    result = came_to()
    assert splits.take(other, ended(other, result)) == (other, result)


@pytest.mark.parametrize(("n_parts", "is_there", "begins"), [(1, False, False), (1, True, False)])
def test_a_step_in_one_part_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_parts: int, is_there: bool, begins: bool
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(splitting, "_item_names", lambda *_: asked.append(1) or tuple("abc"))
    facts: Any = SimpleNamespace(maps_over="rows")
    store, task = Store(tmp_path / "store"), a_step(tmp_path)
    if is_there:
        (parts_folder(store) / task.key).mkdir(parents=True)
    assert splitting.Splits(store).begin(task, facts, n_parts, is_forced=False) is begins
    # What an interrupted run left is looked at.
    assert len(asked) == is_there
    plain: Any = SimpleNamespace(maps_over=None)
    assert splitting.Splits(store).begin(task, plain, 3, is_forced=False) is False


def test_parts_that_are_there_are_taken_where_they_do_not_overlap(tmp_path: Path) -> None:
    said: dict[str, object] = {
        "a": {"of": "k", "first": 0, "end": 2},
        "longer": {"of": "k", "first": 0, "end": 3},
        "within": {"of": "k", "first": 2, "end": 4},
        "next": {"of": "k", "first": 3, "end": 5},
        "last": {"of": "k", "first": 7, "end": 9},
        "beyond": {"of": "k", "first": 8, "end": 10},
        "empty": {"of": "k", "first": 6, "end": 6},
        "before": {"of": "k", "first": -1, "end": 6},
        "other": {"of": "another", "first": 5, "end": 7},
        "true": {"of": "k", "first": True, "end": 7},
        "half": {"of": "k", "first": 5, "end": 7.0},
        "gone": None,
    }
    results = {
        name: None if text is None else came_to(key_preimage=json.dumps(text), log=name)
        for name, text in said.items()
    }
    for name in results:
        (tmp_path / f"{name}.json").touch()
    store: Any = SimpleNamespace(
        results=tmp_path, take=lambda key: SimpleNamespace(result=results[key])
    )
    found = splitting._found_parts(store, "k", 9)
    assert {part: result.log for part, result in found.items()} == {
        range(3): "longer",
        range(3, 5): "next",
        range(7, 9): "last",
    }
