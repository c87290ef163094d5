"""Plan, store and executors: turns cells into results."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from orthoflow.engine.events import (
        CellFinished,
        CellLogged,
        CellProgress,
        CellStarted,
        CellWarned,
        RunEvent,
        RunListener,
        RunStarted,
    )
    from orthoflow.engine.garbage import GarbageReport, collect_garbage
    from orthoflow.engine.plan import PlannedCell, PlannedInput, RunOptions, RunPlan, plan_run
    from orthoflow.engine.results import CellResult, ProductRef
    from orthoflow.engine.scheduling import RunOutcome, execute
    from orthoflow.engine.soundness import Soundness, check_store
    from orthoflow.engine.store import Store
    from orthoflow.engine.stored_results import StoredResult, list_results

__all__ = [
    "CellFinished",
    "CellLogged",
    "CellProgress",
    "CellResult",
    "CellStarted",
    "CellWarned",
    "GarbageReport",
    "PlannedCell",
    "PlannedInput",
    "ProductRef",
    "RunEvent",
    "RunListener",
    "RunOptions",
    "RunOutcome",
    "RunPlan",
    "RunStarted",
    "Soundness",
    "Store",
    "StoredResult",
    "check_store",
    "collect_garbage",
    "execute",
    "list_results",
    "plan_run",
]

# The child of a step enters through this package too: it must not load numpy and h5py before it
# has tied its life to the coordinator's.
_HOMES = {
    "CellFinished": "events",
    "CellLogged": "events",
    "CellProgress": "events",
    "CellResult": "results",
    "CellStarted": "events",
    "CellWarned": "events",
    "GarbageReport": "garbage",
    "PlannedCell": "plan",
    "PlannedInput": "plan",
    "ProductRef": "results",
    "RunEvent": "events",
    "RunListener": "events",
    "RunOptions": "plan",
    "RunOutcome": "scheduling",
    "RunPlan": "plan",
    "RunStarted": "events",
    "Soundness": "soundness",
    "Store": "store",
    "StoredResult": "stored_results",
    "check_store": "soundness",
    "collect_garbage": "garbage",
    "execute": "scheduling",
    "list_results": "stored_results",
    "plan_run": "plan",
}


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(f"orthoflow.engine.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'orthoflow.engine' has no attribute {name!r}")
