"""The executor that runs tasks in this very process keeps to the interface of all of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from orthoflow.engine.local import Capacity, InlineExecutor
from orthoflow.engine.worker import Task
from tests.engine_world import toy_world


def test_with_nothing_in_line_nothing_ends() -> None:
    executor = InlineExecutor(
        Capacity.of_jobs(1, 1), tell=lambda address, event: None, is_interrupted=lambda: False
    )
    assert executor.poll(0.0) == ()


def test_results_keep_the_code_of_success_or_of_their_error(tmp_path: Path) -> None:
    text = "steps: {a: {use: make.range}, b: {use: work.unreadable, in: {numbers: a.numbers}}}"
    with toy_world(tmp_path) as world:
        outcome = world.run(text, executor="inline")
    codes = {address: result.exit_code for address, result in outcome.results.items()}
    assert codes == {"a": 0, "b": 2}
    (kept,) = (tmp_path / "store" / "results").glob("*.json")
    assert json.loads(kept.read_text())["exit_code"] == 0


def test_what_is_in_line_ends_as_interrupted_once_it_is_cancelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[Task] = []
    start = InlineExecutor.start
    monkeypatch.setattr(
        InlineExecutor, "start", lambda self, task: (started.append(task), start(self, task))[1]
    )
    with toy_world(tmp_path) as world:
        world.run("steps: {a: {use: make.range}}", executor="inline")
    monkeypatch.undo()
    (task,) = started
    executor = InlineExecutor(
        Capacity.of_jobs(1, 1), tell=lambda address, event: None, is_interrupted=lambda: False
    )
    executor.start(task)
    executor.start(task)
    executor.start(task)
    executor.cancel()
    for _ in range(2):
        (end,) = executor.poll(0.0)
        assert end.address == "a"
        assert end.result.status != "ok"
        assert end.result.status == "failed"
        assert end.result.error_message == "step a was interrupted"
    executor.close()
    assert executor.poll(0.0) == ()
