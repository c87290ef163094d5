"""What a run leaves: a result for every cell, for the record and the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from orthoflow.engine.plan import PlannedInput
from orthoflow.engine.results import CellResult


@dataclass(frozen=True, kw_only=True)
class RunOutcome:
    """A finished run.

    Attributes:
        run_id: id of the run.
        started: ISO 8601 UTC; of the first attempt when it was resumed.
        ended: ISO 8601 UTC.
        results: address -> result, in the order of the plan.
        cached: address -> id of the run that computed it, for results of other runs.
        resumed: addresses that this run had computed before it was interrupted.
        inputs: workflow input -> files; None when it is optional and absent.
    """

    run_id: str
    started: str
    ended: str
    results: Mapping[str, CellResult]
    cached: Mapping[str, str] = field(default_factory=dict)
    resumed: frozenset[str] = frozenset()
    inputs: Mapping[str, PlannedInput | None] = field(default_factory=dict)

    @property
    def failed(self) -> Mapping[str, CellResult]:
        """The failed cells; those behind them are skipped and not among them."""
        return {
            address: result for address, result in self.results.items() if result.status == "failed"
        }

    @property
    def status(self) -> Literal["ok", "failed"]:
        """`failed` when some cell failed."""
        return "failed" if self.failed else "ok"

    @property
    def exit_code(self) -> int:
        """0 good; the code that all failures share (2 inputs, 4 plugins or libraries); else 1."""
        codes = {result.exit_code for result in self.failed.values()}
        if not codes:
            return 0
        return codes.pop() if len(codes) == 1 else 1
