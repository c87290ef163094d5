"""How a running workflow shows itself: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Protocol, Self

from orthoflow.cli.commands import say_error
from orthoflow.cli.tables import counted, duration
from orthoflow.diagnostics import PLAIN_WARNING
from orthoflow.engine.journal import (
    CellFinished,
    CellProgress,
    CellReported,
    CellStarted,
    RunEvent,
    RunStarted,
)
from orthoflow.foreign_text import shown
from orthoflow.geometry.threads import start_beside

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

    from orthoflow.engine.plan import PlannedCell


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


_REFRESH_PER_S: Final = 4
# A log file gets a line at least so often.
_EVERY_S: Final = 10.0
_NOTEBOOK_EVERY_S: Final = 1.0
# Of more lines a notebook shows the last: while a run goes on, what runs stays in sight below them.
_NOTEBOOK_LINES: Final = 40
_NOTEBOOK_LINES_KEPT: Final = 1000
# Before a step has said for long what it compiles, nobody misses that time.
_TOLD_COMPILE_S: Final = 2.0
_STARTING: Final = "starting"
_STYLES: Final = {
    "running": "cyan",
    "ok": "green",
    "cached": "blue",
    "failed": "bold red",
    "skipped": "yellow",
}


class Progress(AbstractContextManager["Progress"], Protocol):
    """Shows what the cells of a run do."""

    def tell(self, event: RunEvent) -> None:
        """Show an event of the run."""


class RunState:
    """What the cells of a run do; threads may share it."""

    def __init__(self, cells: Sequence[PlannedCell], jobs: int) -> None:
        self._jobs = jobs
        self._lock = threading.Lock()
        self._cells = {item.cell.address: CellState(took_s=item.took_s) for item in cells}
        self._reported: set[tuple[str, str]] = set()
        self._n_similar: Counter[str] = Counter()

    def take(self, event: RunEvent) -> None:
        """Hear of an event."""
        with self._lock:
            match event:
                case CellStarted():
                    cell = self._cells.setdefault(event.address, CellState())
                    cell.state, cell.text, cell.started = "running", _STARTING, time.monotonic()
                    cell.fraction = cell.compiled_s = 0.0
                case CellProgress():
                    cell = self._cells.setdefault(event.address, CellState(state="running"))
                    cell.hear(event.fraction, event.text, time.monotonic())
                case CellFinished():
                    result = event.result
                    self._cells[event.address] = CellState(
                        state="cached" if event.cached else result.status,
                        text=result.error_message,
                        wall_s=result.wall_s,
                    )
                case _:
                    return

    def news(self, event: CellReported) -> str:
        """A diagnostic in a line; empty for plain notes, and for codes reported before."""
        one = event.diagnostic
        if one.is_summary:
            return f"{event.address}: {one.text}"
        key = (one.code, one.text if one.code == PLAIN_WARNING.code else "")
        with self._lock:
            is_new = one.severity != "note" and key not in self._reported
            self._reported.add(key)
            self._n_similar[event.address] += one.severity != "note" and not is_new
        if not is_new or one.severity == "note":
            return ""
        # The summary has the sentences.
        about = f" ({one.subject})" if one.subject else ""
        name = one.text if one.code == PLAIN_WARNING.code else f"{one.code}{about}"
        return f"{event.address}: {one.severity}: {name}"

    def end(self, event: CellFinished) -> str:
        """How a cell ended, and how many of its warnings were left out as similar."""
        with self._lock:
            n_similar = self._n_similar.pop(event.address, 0)
        more = f", {counted(n_similar, 'warning')} like one above" if n_similar else ""
        return f"{end_text(event)}{more}"

    def cells(self) -> dict[str, CellState]:
        """Give all cells, as they are now."""
        with self._lock:
            return dict(self._cells)

    def running_lines(self) -> list[str]:
        """Say of each cell that runs how far it is."""
        now_s = time.monotonic()
        lines = []
        for address, cell in self.cells().items():
            if cell.state == "running":
                parts = [
                    f"{100 * cell.done(now_s):.0f} %",
                    cell.text,
                    f"{duration(now_s - cell.started)} so far",
                    left_of_cell(cell, now_s),
                ]
                lines.append(f"{address}: {', '.join(part for part in parts if part)}")
        return lines

    def left(self) -> str:
        """Say how long the run still takes; empty when nobody knows."""
        return left_of_run(self.cells().values(), time.monotonic(), jobs=self._jobs)

    @property
    def n_ended(self) -> int:
        """How many cells have an outcome."""
        return sum(cell.state not in ("waiting", "running") for cell in self.cells().values())


class PlainProgress:
    """Lines on standard error, fit for log files.

    One per start and end and per code of warnings; one about what runs where none came for long.
    """

    def __init__(
        self, cells: Sequence[PlannedCell] = (), *, jobs: int = 1, every_s: float = _EVERY_S
    ) -> None:
        self._n_cells = len(cells)
        self._state = RunState(cells, jobs)
        self._clock = _Clock(self._remind, every_s)

    def __enter__(self) -> Self:
        self._clock.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._clock.stop()

    def tell(self, event: RunEvent) -> None:
        """Print an event; each percentage and log line would drown the rest."""
        self._state.take(event)
        match event:
            case RunStarted():
                self._n_cells = event.n_cells
                left = self._state.left()
                self._say(f"{start_text(event)}{', ' if left else ''}{left}")
            case CellStarted():
                self._say(f"{event.address}: started")
            case CellReported():
                if line := self._state.news(event):
                    self._say(line)
            case CellFinished():
                self._say(f"{self._state.end(event)} ({self._state.n_ended} of {self._n_cells})")
            case _:
                return

    def _say(self, line: str) -> None:
        self._clock.reset()
        say_error(line)

    def _remind(self) -> None:
        for line in self._state.running_lines():
            say_error(line)


class NotebookProgress:
    """A line per ended step and per code of warnings, below them what runs: one output.

    It is written anew every second, so that a notebook keeps its last state only: what ended.
    """

    def __init__(
        self,
        cells: Sequence[PlannedCell],
        *,
        jobs: int = 1,
        every_s: float = _NOTEBOOK_EVERY_S,
    ) -> None:
        self._state = RunState(cells, jobs)
        self._lines: list[str] = []
        self._place = _NotebookPlace()
        self._clock = _Clock(self._draw, every_s)

    def __enter__(self) -> Self:
        self._clock.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._clock.stop()
        self._place.show("\n".join(_last(self._lines, most=_NOTEBOOK_LINES_KEPT)))

    def tell(self, event: RunEvent) -> None:
        """Take an event; the clock shows it."""
        self._state.take(event)
        match event:
            case RunStarted():
                self._lines.append(start_text(event))
            case CellReported():
                self._lines += filter(None, [self._state.news(event)])
            case CellFinished():
                self._lines.append(self._state.end(event))
            case _:
                return

    def _draw(self) -> None:
        lines, running = _last(self._lines, most=_NOTEBOOK_LINES), self._state.running_lines()
        left = self._state.left() if running else ""
        self._place.show("\n".join([*lines, *running, *([left] if left else [])]))


def _last(lines: Sequence[str], *, most: int) -> list[str]:
    """The first line and the last ones, and how many there are between them."""
    n_more = len(lines) - most
    if n_more <= 0:
        return list(lines)
    return [lines[0], f"... {counted(n_more, 'line')} more", *lines[n_more + 1 :]]


class _NotebookPlace:
    """One output of a notebook's cell."""

    def __init__(self) -> None:
        # Any: IPython need not be there, and its types are none.
        self._handle: Any = None

    @property
    def is_taken(self) -> bool:
        """Whether a text stands there."""
        return self._handle is not None

    def show(self, text: str) -> None:
        """Put a text into the place of the one before."""
        said = {"text/plain": shown(text, keep="\n")}
        if self._handle is None:
            display = import_module("IPython.display").display
            self._handle = display(said, raw=True, display_id=True)
        else:
            self._handle.update(said, raw=True)


def in_notebook() -> bool:
    """Whether a notebook's kernel shows what this process says; a terminal's IPython is none."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")


def start_text(event: RunStarted) -> str:
    """Say that a run begins or goes on."""
    what = "going on with run" if event.is_resumed else "run"
    return f"{what} {event.run_id}: {counted(event.n_cells, 'step')}"


def end_text(event: CellFinished) -> str:
    """Say how a cell ended, how long it took, and why it has no result when it has none."""
    result = event.result
    if event.cached:
        return f"{event.address}: cached"
    took = f" in {duration(result.wall_s)}" if result.started else ""
    if took and (result.compile_s or 0.0) >= _TOLD_COMPILE_S:
        took += f", besides {duration(result.compile_s or 0.0)} of loading and compiling"
    # The summary says why something was skipped.
    why = f": {result.error_message}" if result.status == "failed" else ""
    return f"{event.address}: {result.status}{took}{why}"


class LiveProgress:
    """A table of all cells that redraws itself, on standard error."""

    def __init__(self, cells: Sequence[PlannedCell], *, jobs: int = 1) -> None:
        from rich.console import Console
        from rich.live import Live

        self._state = RunState(cells, jobs)
        self._console = Console(stderr=True)
        self._live = Live(
            console=self._console,
            get_renderable=self.drawn,
            refresh_per_second=_REFRESH_PER_S,
            transient=True,
        )

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def tell(self, event: RunEvent) -> None:
        """Change the table; what must stay readable is printed above it."""
        self._state.take(event)
        match event:
            case RunStarted():
                self._print(start_text(event))
            case CellReported():
                if line := self._state.news(event):
                    self._print(line, style="yellow")
            case CellFinished() if event.result.status == "failed":
                self._print(end_text(event), style=_STYLES["failed"])
            case _:
                return

    def _print(self, text: str, style: str | None = None) -> None:
        self._live.console.print(shown(text), style=style, markup=False, highlight=False)

    def drawn(self) -> Group:
        """Give the table, and below it how far the whole run is."""
        from rich.console import Group
        from rich.text import Text

        return Group(self.table(), Text(self._whole(), style="dim"))

    def table(self) -> Table:
        """Give the table as it is now."""
        from rich.table import Table
        from rich.text import Text

        cells, now_s = self._state.cells(), time.monotonic()
        table = Table(box=None, pad_edge=False, header_style="bold")
        for title in ("step", "state", "time", "left", ""):
            table.add_column(title, no_wrap=True, overflow="ellipsis")
        for address, cell in visible_cells(cells, self._console.height - 4).items():
            running = cell.state == "running"
            state = f"{100 * cell.done(now_s):3.0f} %" if running else cell.state
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

    def _whole(self) -> str:
        ended = f"{self._state.n_ended} of {counted(len(self._state.cells()), 'step')} ended"
        left = self._state.left()
        return f"{ended}, {left}" if left else ended


def visible_cells(cells: Mapping[str, CellState], height: int) -> dict[str, CellState]:
    """Choose the rows that fit: running ones, then failed, waiting, and the rest; in their order.

    Args:
        cells: all of them.
        height: lines there are for rows.
    """
    if len(cells) <= height:
        return dict(cells)
    urgency = {"running": 0, "failed": 1, "waiting": 2}
    by_urgency = sorted(cells, key=lambda address: urgency.get(cells[address].state, 3))
    chosen = set(by_urgency[: max(1, height)])
    return {address: cell for address, cell in cells.items() if address in chosen}


def make_progress(cells: Sequence[PlannedCell], *, jobs: int = 1) -> Progress:
    """Give the live table when standard error is a terminal, plain lines otherwise."""
    if in_notebook():
        return NotebookProgress(cells, jobs=jobs)
    if sys.stderr.isatty():
        return LiveProgress(cells, jobs=jobs)
    return PlainProgress(cells, jobs=jobs)


@contextmanager
def working_on(what: str, *, every_s: float = _EVERY_S) -> Iterator[None]:
    """Show while the block runs that something is done that no cell does, and since when.

    A notebook keeps it where it took long, with the time it took.
    """
    started = time.monotonic()

    def took() -> str:
        return duration(time.monotonic() - started)

    def line() -> str:
        return f"{what}, {took()} so far"

    if sys.stderr.isatty():
        from rich.console import Console
        from rich.live import Live
        from rich.text import Text

        with Live(
            console=Console(stderr=True),
            get_renderable=lambda: Text(line()),
            refresh_per_second=_REFRESH_PER_S,
            transient=True,
        ):
            yield
        return
    place = _NotebookPlace() if in_notebook() else None
    clock = _Clock(lambda: place.show(line()) if place else say_error(line()), every_s)
    clock.start()
    end = "broken off after"
    try:
        yield
        end = "done in"
    finally:
        clock.stop()
        if place and place.is_taken:
            place.show(f"{what}: {end} {took()}")


class _Clock:
    """Calls somebody where nothing was said for some seconds."""

    def __init__(self, call: Callable[[], None], every_s: float) -> None:
        self._call = call
        self._every_s = every_s
        self._last = time.monotonic()
        self._is_over = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to watch."""
        self.reset()
        self._thread = start_beside(self._go)

    def reset(self) -> None:
        """Hear that something was said."""
        self._last = time.monotonic()

    def stop(self) -> None:
        """End; nothing is said after that."""
        self._is_over.set()
        if self._thread is not None:
            self._thread.join()

    def _go(self) -> None:
        wait_s = self._every_s
        while not self._is_over.wait(wait_s):
            wait_s = self._last + self._every_s - time.monotonic()
            if wait_s <= 0:
                self._call()
                self.reset()
                wait_s = self._every_s
