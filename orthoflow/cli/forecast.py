"""How long a run still takes: what its cells took before, and how far they say they are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from orthoflow.cli.tables import duration

# Below these, what a step has done so far says nothing of what is left.
_SMALLEST_FRACTION: Final = 0.05
_SHORTEST_S: Final = 2.0
# So far the clock alone moves a step that says less of itself.
_MOST_BY_CLOCK: Final = 0.95


@dataclass
class CellState:
    """One cell of a run that goes on.

    Attributes:
        state: `waiting`, `running`, or how it ended.
        fraction: 0..1 while it runs, as it says itself.
        text: what it does, or why it ended so.
        started: seconds of a clock.
        wall_s: how long it took.
        took_s: how long it, or one like it, took before; None when nobody knows.
        compiled_s: how long it has waited for kernels.
        heard: when it said something last, seconds of that clock.
    """

    state: str = "waiting"
    fraction: float = 0.0
    text: str = ""
    started: float = 0.0
    wall_s: float = 0.0
    took_s: float | None = None
    compiled_s: float = 0.0
    heard: float = 0.0

    def hear(self, fraction: float, text: str, now_s: float) -> None:
        """Take what it says of itself."""
        if self._is_compiling:
            self.compiled_s += now_s - self.heard
        self.fraction, self.text, self.heard = fraction, text, now_s

    @property
    def _is_compiling(self) -> bool:
        # As `geometry.compiling` tells it, before a kernel and after it.
        return self.text.startswith("compiling ")

    def left_s(self, now_s: float) -> float | None:
        """Seconds that it still takes; None when nobody knows.

        What it took before counts until that is over, then how far it says it is.
        """
        if self.state == "waiting":
            return self.took_s
        if self.state != "running":
            return 0.0
        elapsed_s = now_s - self.started
        if self.took_s is not None and elapsed_s < self.took_s:
            return self.took_s - elapsed_s
        # Kernels are compiled once: the share that is done took the rest of the time.
        worked_s = elapsed_s - self.compiled_s
        is_early = self.fraction < _SMALLEST_FRACTION or worked_s < _SHORTEST_S
        if is_early or self._is_compiling:
            return None
        return worked_s * (1 - self.fraction) / self.fraction

    def done(self, now_s: float) -> float:
        """How far it is, 0..1: as it says, or as far as such a step was by now.

        What it took before counts as long as it may be true, and where it says nothing itself.
        """
        if not self.took_s or self.state != "running":
            return self.fraction
        by_clock = (now_s - self.started) / self.took_s
        if by_clock > 1 and self.fraction:
            return self.fraction
        return max(self.fraction, min(by_clock, _MOST_BY_CLOCK))


def left_of_run(cells: Iterable[CellState], now_s: float, *, jobs: int = 1) -> str:
    """Say how long a run still takes, or that nobody knows it; empty where nothing is left.

    Args:
        cells: all of them.
        now_s: on the clock that started them.
        jobs: how many run at the same time.
    """
    open_cells = [cell for cell in cells if cell.state in ("waiting", "running")]
    # What is stored or skipped takes no time, and says nothing of the others.
    working = [cell for cell in open_cells if cell.state == "running" or cell.took_s != 0.0]
    if not working:
        return ""
    left = [cell.left_s(now_s) for cell in working]
    known = [seconds for seconds in left if seconds is not None]
    # The few seconds of the known ones would be true, and mislead.
    if not known or 2 * len(known) < len(left):
        return "time left not known yet"
    seconds = max(*known, sum(known) / jobs, 0.0)
    if len(known) == len(left):
        return f"about {about(seconds)} left"
    unknown = len(left) - len(known)
    more = "a step that takes" if unknown == 1 else f"{unknown} steps that take"
    return f"at least {about(seconds)} left, and {more} nobody knows how long"


def left_of_cell(cell: CellState, now_s: float) -> str:
    """Say how long a running cell still takes; empty when nobody knows."""
    seconds = cell.left_s(now_s) if cell.state == "running" else None
    return f"about {about(seconds)} left" if seconds is not None else ""


def about(seconds: float) -> str:
    """Say a time as exactly as a forecast is.

    >>> [about(seconds) for seconds in (0.3, 7, 42, 130, 4000)]
    ['5 s', '10 s', '45 s', '2 min 10 s', '1 h 07 min']
    """
    step = 5 if seconds <= 60 else 10 if seconds <= 600 else 60
    rounded = max(step, step * -(-round(seconds) // step))
    return f"{rounded} s" if rounded < 60 else duration(rounded)
