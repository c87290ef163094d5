"""What a run says while it goes on, for progress displays and plain log lines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from orthoflow.diagnostics import Diagnostic
from orthoflow.engine.results import CellResult


@dataclass(frozen=True, kw_only=True)
class RunStarted:
    """The run begins, or goes on after an interruption.

    Attributes:
        run_id: id of the run.
        n_cells: cells in the plan.
        is_resumed: the run folder held an unfinished run.
    """

    run_id: str
    n_cells: int
    is_resumed: bool


@dataclass(frozen=True, kw_only=True)
class CellStarted:
    """A cell begins to run."""

    address: str


@dataclass(frozen=True, kw_only=True)
class CellProgress:
    """A running cell is this far, 0..1."""

    address: str
    fraction: float
    text: str


@dataclass(frozen=True, kw_only=True)
class CellLogged:
    """A running cell wrote a line to its log."""

    address: str
    text: str


@dataclass(frozen=True, kw_only=True)
class CellReported:
    """A running cell reports something that deserves attention."""

    address: str
    diagnostic: Diagnostic


@dataclass(frozen=True, kw_only=True)
class CellFinished:
    """A cell has its outcome.

    Attributes:
        address: of the cell.
        result: ok, failed or skipped.
        cached: the result was in the store, also when this run put it there before it was
            interrupted.
    """

    address: str
    result: CellResult
    cached: bool


RunEvent: TypeAlias = (
    RunStarted | CellStarted | CellProgress | CellLogged | CellReported | CellFinished
)
RunListener: TypeAlias = Callable[[RunEvent], None]


def ignore(event: RunEvent) -> None:
    """Take an event and do nothing with it."""
