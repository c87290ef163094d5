"""The executor that runs tasks in this very process keeps to the interface of all of them."""

from __future__ import annotations

from orthoflow.engine.local import Capacity, InlineExecutor
from tests.engine_tasks import bare_task


def test_what_is_in_line_ends_as_interrupted_once_it_is_cancelled() -> None:
    executor = InlineExecutor(
        Capacity.of_jobs(1, 1), listen=lambda address, event: None, is_interrupted=lambda: False
    )
    for _ in range(3):
        executor.start(bare_task())
    executor.cancel()
    for _ in range(2):
        (end,) = executor.poll(0.0).items()
        assert (end[0], end[1].status) == ("step", "failed")
        assert end[1].error_message == "step step was interrupted"
    executor.close()
    assert executor.poll(0.0) == {}
