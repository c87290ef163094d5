"""Which executor a run gets: the one that it names, as far as the system has what that needs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from orthoflow.engine.executors import Capacity, Executor, InlineExecutor, Tell
from orthoflow.engine.plan import RunPlan
from orthoflow.errors import PluginError
from orthoflow.system import HAS_STEP_PROCESSES


def executor_of(
    plan: RunPlan, scratch: Path, tell: Tell, is_asked_to_stop: Callable[[], bool]
) -> Executor:
    """Give the executor that the options of a run name.

    Args:
        plan: of the run.
        scratch: its scratch folder.
        tell: takes what steps say.
        is_asked_to_stop: whether somebody interrupts the run.

    Raises:
        PluginError: its library is not installed.
    """
    options = plan.options
    capacity = Capacity.of_jobs(options.jobs, options.all_cores)
    if options.executor == "dask":
        try:
            from orthoflow.engine.dask_executor import DaskExecutor  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise PluginError(
                "--executor dask needs dask: pip install 'orthoflow-tls[dask]'"
            ) from error
        return DaskExecutor(plan, scratch, capacity, tell)
    # Without processes that can be stopped there are neither timeouts nor a guard of memory.
    if options.executor == "inline" or not HAS_STEP_PROCESSES:
        return InlineExecutor(capacity, tell, is_asked_to_stop)
    from orthoflow.engine.local_executor import LocalExecutor  # noqa: PLC0415 - of Linux

    return LocalExecutor(capacity, tell)
