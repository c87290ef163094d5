"""How a running workflow shows itself: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Self

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

# Below these, the progress of a step does not yet predict its remaining time.
_MIN_FRACTION: Final = 0.05
_MIN_ELAPSED_S: Final = 2.0
_REFRESH_PER_S: Final = 4
# A log file gets a line at least so often.
_EVERY_S: Final = 10.0
_NOTEBOOK_EVERY_S: Final = 1.0
# While it runs, a notebook shows the last lines, so that the running steps stay in view below them.
_NOTEBOOK_LINES: Final = 40
# Shorter times of loading and compiling are not mentioned.
_MIN_COMPILE_S: Final = 2.0
_STYLES: Final = {
    "running": "cyan",
    "ok": "green",
    "cached": "blue",
    "failed": "bold red",
    "skipped": "yellow",
}


@dataclass
class CellState:
    """One cell of a run in progress.

    Attributes:
        state: `waiting`, `running`, or how it ended.
        fraction: 0..1 as the step reports it.
        text: what it does, or why it ended so.
        started: seconds of a clock.
        wall_s: how long it took.
        took_s: how long it, or one like it, took before; None when unknown.
    """

    state: str = "waiting"
    fraction: float = 0.0
    text: str = ""
    started: float = 0.0
    wall_s: float = 0.0
    took_s: float | None = None

    def left_s(self, now_s: float) -> float | None:
        """Seconds that it still takes: by its earlier duration, then by its progress."""
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
    """Estimate how long a run still takes; empty where nothing is left.

    Args:
        cells: all of them.
        now_s: on the clock that started them.
        jobs: how many run at the same time.
    """
    left = [
        cell.left_s(now_s)
        for cell in cells
        # Stored and skipped steps take no time and predict nothing of the others.
        if cell.state == "running" or (cell.state == "waiting" and cell.took_s != 0.0)
    ]
    known = [seconds for seconds in left if seconds is not None]
    n_unknown = len(left) - len(known)
    if not left:
        return ""
    # A few short steps would suggest that a run of minutes is nearly over.
    if not known or n_unknown > len(known):
        return "remaining time not yet known"
    seconds = about(max(*known, sum(known) / jobs, 0.0))
    if n_unknown:
        return f"at least {seconds} left; {counted(n_unknown, 'step')} without an estimate"
    return f"about {seconds} left"


def about(seconds: float) -> str:
    """Write a forecast, rounded up.

    >>> [about(seconds) for seconds in (0.3, 7, 42, 130, 4000)]
    ['5 s', '10 s', '45 s', '2 min 10 s', '1 h 07 min']
    """
    step = 5 if seconds <= 60 else 10 if seconds <= 600 else 60
    rounded = max(step, step * -(-round(seconds) // step))
    return f"{rounded} s" if rounded < 60 else duration(rounded)


class Progress:
    """Shows a run: a live table on a terminal, one output in a notebook, lines for logs elsewhere.

    Attributes:
        every_s: a notebook's output, and the running steps in a log, are shown so often.
        console: of the terminal; None without one.
    """

    def __init__(self, cells: Sequence[PlannedCell] = (), *, jobs: int = 1) -> None:
        self._jobs = jobs
        self._lock = threading.Lock()
        self._cells = {item.cell.address: CellState(took_s=item.took_s) for item in cells}
        self._n_cells = len(cells)
        self._reported: set[tuple[str, str]] = set()
        self._n_similar: Counter[str] = Counter()
        self._lines: list[str] = []
        self._stack = ExitStack()
        self._notebook = _NotebookOutput() if in_notebook() else None
        self.every_s = _NOTEBOOK_EVERY_S if self._notebook else _EVERY_S
        self.console: Console | None = None
        if sys.stderr.isatty() and not self._notebook:
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
        if self._notebook:
            self._notebook.show(self._lines)

    def take(self, event: RunEvent) -> None:
        """Show an event of the run."""
        line = self._applied(event)
        if isinstance(event, RunStarted):
            self._n_cells = event.n_cells
            left = "" if self._notebook or self.console else self.left()
            line += f", {left}" if left else ""
        if not line:
            return
        if self._notebook:
            self._lines += [] if isinstance(event, CellStarted) else [line]
        elif self.console:
            # Warnings and failures stand above the table, to stay readable.
            has_failed = isinstance(event, CellFinished) and event.result.status == "failed"
            style = _STYLES["failed"] if has_failed else "yellow"
            if has_failed or isinstance(event, CellReported | RunStarted):
                self.console.print(shown(line), style=style, markup=False, highlight=False)
        else:
            is_end = isinstance(event, CellFinished)
            echo_error(f"{line} ({self.n_ended} of {self._n_cells})" if is_end else line)

    def _applied(self, event: RunEvent) -> str:
        """Apply an event; return the line that a log shows of it, empty for none."""
        with self._lock:
            match event:
                case RunStarted():
                    what = "going on with run" if event.is_resumed else "run"
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
                    self._cells[event.address] = CellState(
                        state="cached" if event.cached else result.status,
                        text=result.error_message,
                        wall_s=result.wall_s,
                    )
                    n_similar = self._n_similar.pop(event.address, 0)
                    more = f", {counted(n_similar, 'warning')} like one above" if n_similar else ""
                    return f"{_end_text(event)}{more}"
        return ""

    def _reported_line(self, address: str, one: Diagnostic) -> str:
        """A diagnostic in a line; empty for notes, and for codes reported before."""
        if one.is_summary:
            return f"{address}: {one.text}"
        if one.severity == "note":
            return ""
        is_plain = one.code == PLAIN_WARNING.code
        key = (one.code, one.text if is_plain else "")
        if key in self._reported:
            self._n_similar[address] += 1
            return ""
        self._reported.add(key)
        # The summary has the sentences.
        about = f" ({one.subject})" if one.subject else ""
        return f"{address}: {one.severity}: {one.text if is_plain else one.code + about}"

    def cells(self) -> dict[str, CellState]:
        """Return all cells as they are now."""
        with self._lock:
            return dict(self._cells)

    def left(self) -> str:
        """Estimate how long the run still takes; empty when nothing is left."""
        return left_of_run(self.cells().values(), time.monotonic(), jobs=self._jobs)

    @property
    def n_ended(self) -> int:
        """How many cells have an outcome."""
        return sum(cell.state not in ("waiting", "running") for cell in self.cells().values())

    def refresh(self) -> None:
        """Show how far the running steps are."""
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
        if self._notebook:
            left = [self.left()] if running else []
            lines = [*self._lines[-_NOTEBOOK_LINES:], *running, *filter(None, left)]
            self._notebook.show(lines)
        elif running:
            echo_error(*running)

    def drawn(self) -> Group:
        """Return the table of a terminal, and below it how far the whole run is."""
        from rich.console import Group
        from rich.text import Text

        ended = f"{self.n_ended} of {counted(len(self.cells()), 'step')} ended"
        left = self.left()
        return Group(self.table(), Text(f"{ended}, {left}" if left else ended, style="dim"))

    def table(self) -> Table:
        """Return the table as it is now; of too many rows the running, failed and waiting ones."""
        from rich.table import Table
        from rich.text import Text

        now_s = time.monotonic()
        table = Table(box=None, pad_edge=False, header_style="bold")
        for title in ("step", "state", "time", "left", ""):
            table.add_column(title, no_wrap=True, overflow="ellipsis")
        cells = self.cells()
        urgency = {"running": 0, "failed": 1, "waiting": 2}
        most = max(1, (self.console.height if self.console else len(cells)) - 4)
        chosen = sorted(cells, key=lambda address: urgency.get(cells[address].state, 3))[:most]
        for address, cell in cells.items():
            if address not in chosen:
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


def _end_text(event: CellFinished) -> str:
    """Describe how a cell ended, how long it took, and why it failed."""
    result = event.result
    if event.cached:
        return f"{event.address}: cached"
    took = f" in {duration(result.wall_s)}" if result.started else ""
    if took and (result.compile_s or 0.0) >= _MIN_COMPILE_S:
        took += f", plus {duration(result.compile_s or 0.0)} of loading and compiling"
    # The summary states why something was skipped.
    why = f": {result.error_message}" if result.status == "failed" else ""
    return f"{event.address}: {result.status}{took}{why}"


class _NotebookOutput:
    """One output of a notebook's cell, replaced by each text shown."""

    # Any: IPython need not be installed, and is untyped.
    handle: Any = None

    def show(self, lines: Sequence[str]) -> None:
        data = {"text/plain": shown("\n".join(lines), keep="\n")}
        if self.handle is None:
            display = import_module("IPython.display").display
            self.handle = display(data, raw=True, display_id=True)
        else:
            self.handle.update(data, raw=True)


def in_notebook() -> bool:
    """Whether a notebook's kernel shows the output of this process; IPython in a terminal not."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")


@contextmanager
def working_on(what: str, *, every_s: float = _EVERY_S) -> Iterator[None]:
    """Show while the block runs what is done outside of any cell, and since when.

    A notebook keeps it where it took long, with the time it took.
    """
    started = time.monotonic()

    def took() -> str:
        return duration(time.monotonic() - started)

    def line() -> str:
        return f"{what}, {took()} so far"

    if sys.stderr.isatty():
        from rich.console import Console

        with _live(Console(stderr=True), line):
            yield
        return
    output = _NotebookOutput() if in_notebook() else None
    end = "stopped after"
    try:
        with _repeating(lambda: output.show([line()]) if output else echo_error(line()), every_s):
            yield
        end = "done in"
    finally:
        if output and output.handle:
            output.show([f"{what}: {end} {took()}"])


def _live(console: Console, drawn: Callable[[], RenderableType]) -> Live:
    """A display that redraws itself and vanishes at its end."""
    from rich.live import Live

    return Live(
        console=console,
        get_renderable=drawn,
        refresh_per_second=_REFRESH_PER_S,
        transient=True,
    )


@contextmanager
def _repeating(call: Callable[[], None], every_s: float) -> Iterator[None]:
    """Call a function every few seconds while the block runs."""
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
