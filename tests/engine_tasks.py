"""A task that asks for nothing, for tests of what becomes of tasks without running any."""

from __future__ import annotations

from typing import Any

from orthoflow.engine.worker import Task


def bare_task(**more: Any) -> Task:
    """Give a task of the toys' method `work.add`; `more` sets or replaces fields."""
    plain: dict[str, Any] = {
        "method": "work.add", "address": "step", "run_id": "r1", "target": "x:Y", "key": "k",
        "key_preimage": "{}", "params": {}, "seed": 0, "inputs": {}, "outputs": {}, "cores": 1,
        "timeout_s": None, "store": "store", "folder": "f", "log": "l", "kernels": "",
    }  # fmt: skip
    return Task(**(plain | more))
