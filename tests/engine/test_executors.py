"""The executor that runs tasks in this very process keeps to the interface of all of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.engine.local import Capacity, InlineExecutor
from orthoflow.engine.worker import Task
from tests.engine_world import toy_world


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
        Capacity.of_jobs(1, 1), listen=lambda address, event: None, is_interrupted=lambda: False
    )
    executor.start(task)
    executor.start(task)
    executor.start(task)
    executor.cancel()
    for _ in range(2):
        (end,) = executor.poll(0.0).items()
        assert (end[0], end[1].status) == ("a", "failed")
        assert end[1].error_message == "step a was interrupted"
    executor.close()
    assert executor.poll(0.0) == {}
