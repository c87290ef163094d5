"""What the user may choose about a run besides the workflow itself."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

from orthoflow.errors import ArgumentError

ExecutorName = Literal["local", "inline"]


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of plan and run.

    Attributes:
        jobs: cells that run at the same time; they share the cores.
        executor: `local` (a child process per cell) or `inline` (this process, for debugging).
        only: run these steps and what they need, from the store where it is there.
        from_: run these steps, what follows from them, and what all these need.
        until: run these steps and what they need.
        force: run these steps although their results are in the store.
        cores: processors to use in all; None for all this process may use.
    """

    jobs: int = 1
    executor: ExecutorName = "local"
    only: tuple[str, ...] = ()
    from_: tuple[str, ...] = ()
    until: tuple[str, ...] = ()
    force: tuple[str, ...] = ()
    cores: int | None = None

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise ArgumentError(f"--jobs must be 1 or more, got {self.jobs}")
        if self.cores is not None and self.cores < 1:
            raise ArgumentError(f"cores must be 1 or more, got {self.cores}")
        if self.executor not in ("local", "inline"):
            raise ArgumentError(f"--executor must be local or inline, got {self.executor}")

    @property
    def all_cores(self) -> int:
        """Processors the run may use in all."""
        return self.cores or len(os.sched_getaffinity(0))
