"""Display of the progress of a run: a live table on a terminal, and plain lines elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from orthoflow.cli.commands import echo_error
from orthoflow.cli.tables import counted, duration
from orthoflow.diagnostics import PLAIN_WARNING, Diagnostic
from orthoflow.engine.journal import (
    CellFinished,
    CellReported,
    CellStarted,
    RunEvent,
    RunStarted,
)
from orthoflow.geometry.threads import start_beside
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    from rich.console import Console, Group, RenderableType
    from rich.live import Live
    from rich.table import Table

    from orthoflow.engine.plan import PlannedCell

# Below these limits, a step has progressed too little to predict its remaining time.
_MIN_FRACTION: Final = 0.05
_MIN_ELAPSED_S: Final = 2.0
_REFRESH_PER_S: Final = 4
# Maximum time between lines in a log file.
_EVERY_S: Final = 10.0
# Time for starting, loading and compiling is reported only if it is longer than this.
_MIN_MORE_S: Final = 2.0
_STYLES: Final = {
    "running": "cyan",
    "ok": "green",
    "cached": "blue",
    "failed": "bold red",
    "skipped": "yellow",
}


@dataclass
class CellState:
    """State of a cell of a run that is in progress.

    Attributes:
        state: `waiting`, `running`, or the outcome of the cell.
        fraction: progress reported by the step, from 0 to 1.
        text: current activity of the cell, or the reason for its outcome.
        started: start of the cell, in seconds of the monotonic clock.
        wall_s: duration in seconds, once the cell has ended.
        took_s: duration in seconds of an earlier run of this cell or a similar one; None if
            unknown.
    """

    state: str = "waiting"
    fraction: float = 0.0
    text: str = ""
    started: float = 0.0
    wall_s: float = 0.0
    took_s: float | None = None

    def left_s(self, now_s: float) -> float | None:
        """Estimate the remaining time in seconds; return None if it cannot be estimated."""
        if self.state == "waiting":
            return self.took_s
        if self.state != "running":
            return 0.0
        elapsed_s = now_s - self.started
        if self.took_s is not None and elapsed_s < self.took_s:
            return self.took_s - elapsed_s
        if self.fraction < _MIN_FRACTION or elapsed_s < _MIN_ELAPSED_S:
            return None
        return elapsed_s * (1 - self.fraction) / self.fraction


def left_of_run(cells: Iterable[CellState], now_s: float, *, jobs: int = 1) -> str:
    """Describe the estimated remaining time of a run; empty if nothing remains.

    Args:
        cells: all cells.
        now_s: current time of the monotonic clock in seconds.
        jobs: number of cells that run at the same time.
    """
    left = [
        cell.left_s(now_s)
        for cell in cells
        # Omit waiting cells that will not run, whose `took_s` is 0.
        if cell.state == "running" or (cell.state == "waiting" and cell.took_s != 0.0)
    ]
    known = [seconds for seconds in left if seconds is not None]
    n_unknown = len(left) - len(known)
    if not left:
        return ""
    # Give no estimate if most cells have none: a few short steps would suggest that the run is
    # nearly finished.
    if not known or n_unknown > len(known):
        return "remaining time not yet known"
    seconds = about(max(*known, sum(known) / jobs, 0.0))
    if n_unknown:
        return f"at least {seconds} left; {counted(n_unknown, 'step')} not estimated"
    return f"about {seconds} left"


def about(seconds: float) -> str:
    """Format an estimated duration, rounded up to a coarse unit.

    >>> [about(seconds) for seconds in (0.3, 7, 42, 130, 4000)]
    ['5 s', '10 s', '45 s', '2 min 10 s', '1 h 07 min']
    """
    step = 5 if seconds <= 60 else 10 if seconds <= 600 else 60
    rounded = max(step, step * -(-round(seconds) // step))
    return f"{rounded} s" if rounded < 60 else duration(rounded)


class Progress:
    """Display of a run: a table on a terminal, and log lines elsewhere.

    Attributes:
        every_s: interval in seconds between log lines about running steps.
        console: console of the terminal; None if there is no terminal.
    """

    def __init__(self, cells: Sequence[PlannedCell] = (), *, jobs: int = 1) -> None:
        self._jobs = jobs
        self._lock = threading.Lock()
        self._cells = {item.cell.address: CellState(took_s=item.took_s) for item in cells}
        # A diagnostic that a step with one of these methods may resolve is not reported during the
        # run; if it is not resolved, the summary contains it.
        self._methods = {item.cell.method for item in cells}
        self._n_cells = len(cells)
        self._reported: set[tuple[str, str]] = set()
        self._n_similar: Counter[str] = Counter()
        self._stack = ExitStack()
        self.every_s = _EVERY_S
        self.console: Console | None = None
        if sys.stderr.isatty():
            from rich.console import Console

            self.console = Console(stderr=True)

    def __enter__(self) -> Self:
        shows = (
            _live(self.console, self.drawn)
            if self.console
            else _repeating(self.refresh, self.every_s)
        )
        self._stack.enter_context(shows)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def take(self, event: RunEvent) -> None:
        """Update the display with an event."""
        line = self._applied(event)
        if isinstance(event, RunStarted):
            self._n_cells = event.n_cells
            left = "" if self.console else self.left()
            line += f", {left}" if left else ""
        if not line:
            return
        if self.console:
            # Print warnings and failures above the table, so that they remain visible.
            has_failed = isinstance(event, CellFinished) and event.result.status == "failed"
            style = _STYLES["failed"] if has_failed else "yellow"
            if has_failed or isinstance(event, CellReported | RunStarted):
                self.console.print(shown(line), style=style, markup=False, highlight=False)
        else:
            is_end = isinstance(event, CellFinished)
            echo_error(f"{line} ({self.n_ended} of {self._n_cells})" if is_end else line)

    def _applied(self, event: RunEvent) -> str:
        with self._lock:
            match event:
                case RunStarted():
                    what = "resuming run" if event.is_resumed else "run"
                    return f"{what} {event.run_id}: {counted(event.n_cells, 'step')}"
                case CellStarted():
                    cell = self._cells.setdefault(event.address, CellState())
                    cell.state, cell.text, cell.fraction = "running", "starting", 0.0
                    cell.started = time.monotonic()
                    return f"{event.address}: started"
                case CellReported() if event.event.kind == "progress":
                    cell = self._cells.setdefault(event.address, CellState(state="running"))
                    cell.fraction, cell.text = event.event.fraction, event.event.text
                case CellReported() if event.event.diagnostic is not None:
                    return self._reported_line(event.address, event.event.diagnostic)
                case CellFinished():
                    result = event.result
                    started = self._cells.get(event.address, CellState()).started
                    more_s = time.monotonic() - started - result.wall_s if started else 0.0
                    self._cells[event.address] = CellState(
                        state="cached" if event.cached else result.status,
                        text=result.error_message,
                        wall_s=result.wall_s,
                    )
                    n_similar = self._n_similar.pop(event.address, 0)
                    more = (
                        f", {counted(n_similar, 'warning')} with a code shown above"
                        if n_similar
                        else ""
                    )
                    return f"{_end_text(event, more_s)}{more}"
        return ""

    def _reported_line(self, address: str, one: Diagnostic) -> str:
        if one.is_summary:
            return f"{address}: {one.text}"
        if one.severity == "note" or not self._methods.isdisjoint(one.settled_by):
            return ""
        is_plain = one.code == PLAIN_WARNING.code
        key = (one.code, one.text if is_plain else "")
        if key in self._reported:
            self._n_similar[address] += 1
            return ""
        self._reported.add(key)
        has_remedy = one.severity == "error" and one.remedy
        text = f"{one.text}: {one.remedy}" if has_remedy else one.text
        return f"{address}: {one.severity}: {text}"

    def cells(self) -> dict[str, CellState]:
        """Return all cells in their current state."""
        with self._lock:
            return dict(self._cells)

    def left(self) -> str:
        """Describe the estimated remaining time of the run; empty if nothing remains."""
        return left_of_run(self.cells().values(), time.monotonic(), jobs=self._jobs)

    @property
    def n_ended(self) -> int:
        """Return the number of cells that have ended."""
        return sum(cell.state not in ("waiting", "running") for cell in self.cells().values())

    def refresh(self) -> None:
        """Log the progress of running steps."""
        now_s = time.monotonic()
        running = []
        for address, cell in self.cells().items():
            if cell.state == "running":
                left_s = cell.left_s(now_s)
                parts = [
                    f"{100 * cell.fraction:.0f} %",
                    cell.text,
                    f"{duration(now_s - cell.started)} so far",
                    f"about {about(left_s)} left" if left_s is not None else "",
                ]
                running.append(f"{address}: {', '.join(part for part in parts if part)}")
        if running:
            echo_error(*running)

    def drawn(self) -> Group:
        """Return the table of cells for a terminal, followed by the progress of the run."""
        from rich.console import Group
        from rich.text import Text

        ended = f"{self.n_ended} of {counted(len(self.cells()), 'step')} ended"
        left = self.left()
        return Group(self.table(), Text(f"{ended}, {left}" if left else ended, style="dim"))

    def table(self) -> Table:
        """Return the table of cells; omit cells if it is too long for the terminal."""
        from rich.table import Table
        from rich.text import Text

        now_s = time.monotonic()
        table = Table(box=None, pad_edge=False, header_style="bold")
        for title in ("step", "state", "time", "left", ""):
            table.add_column(title, no_wrap=True, overflow="ellipsis")
        cells = self.cells()
        most = (self.console.height if self.console else len(cells) + 4) - 4
        ended = len(cells) - most if len(cells) > most else 0
        for address, cell in cells.items():
            # Omit the cells that ended first, except failed cells.
            if ended > 0 and cell.state not in ("running", "failed", "waiting"):
                ended -= 1
                continue
            running = cell.state == "running"
            state = f"{100 * cell.fraction:3.0f} %" if running else cell.state
            seconds = now_s - cell.started if running else cell.wall_s
            left_s = cell.left_s(now_s) if running else None
            table.add_row(
                Text(shown(address)),
                Text(state, style=_STYLES.get(cell.state, "dim")),
                Text(duration(seconds) if seconds else ""),
                Text(about(left_s) if left_s is not None else ""),
                Text(shown(cell.text)),
            )
        return table


def _end_text(event: CellFinished, more_s: float) -> str:
    """Describe the outcome of a cell, its duration, and the reason for a failure.

    Args:
        event: the end of the cell.
        more_s: elapsed seconds since the start of the cell that are not part of its duration.
    """
    result = event.result
    if event.cached:
        return f"{event.address}: cached"
    took = f" in {duration(result.wall_s)}" if result.started else ""
    if took and more_s >= _MIN_MORE_S:
        took += f", plus {duration(more_s)} for starting, loading and compiling"
    # The summary contains the reasons why cells were skipped.
    why = f": {result.error_message}" if result.status == "failed" else ""
    return f"{event.address}: {result.status}{took}{why}"


@contextmanager
def working_on(what: str, *, every_s: float = _EVERY_S) -> Iterator[Callable[[str], None]]:
    """While the block runs, show an activity outside cells, and its duration so far.

    Yields:
        A function to call with the name of the current part of the activity.
    """
    started = time.monotonic()
    parts = [what]

    def line() -> str:
        return f"{parts[-1]}, {duration(time.monotonic() - started)} so far"

    if sys.stderr.isatty():
        from rich.console import Console

        with _live(Console(stderr=True), line):
            yield parts.append
    else:
        with _repeating(lambda: echo_error(line()), every_s):
            yield parts.append


def _live(console: Console, drawn: Callable[[], RenderableType]) -> Live:
    from rich.live import Live

    return Live(
        console=console,
        get_renderable=drawn,
        refresh_per_second=_REFRESH_PER_S,
        transient=True,
    )


@contextmanager
def _repeating(call: Callable[[], None], every_s: float) -> Iterator[None]:
    is_over = threading.Event()

    def go() -> None:
        while not is_over.wait(every_s):
            call()

    thread = start_beside(go)
    try:
        yield
    finally:
        is_over.set()
        if thread is not None:
            thread.join()
