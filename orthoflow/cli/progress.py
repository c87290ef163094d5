"""How a running workflow shows itself: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Final, Protocol, Self

from orthoflow.cli.failures import say_error
from orthoflow.cli.tables import counted, duration
from orthoflow.engine.events import (
    CellFinished,
    CellProgress,
    CellStarted,
    CellWarned,
    RunEvent,
    RunStarted,
)
from orthoflow.foreign_text import shown

if TYPE_CHECKING:
    from rich.table import Table

_REFRESH_PER_S: Final = 4
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
        raise AssertionError("a protocol is never called")


class PlainProgress:
    """One line on standard error per start, warning and end, fit for log files."""

    def __init__(self) -> None:
        self._n_cells = 0
        self._n_ended = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        return None

    def tell(self, event: RunEvent) -> None:
        """Print an event; percentages and log lines would drown the rest."""
        match event:
            case RunStarted():
                self._n_cells = event.n_cells
                say_error(start_text(event))
            case CellStarted():
                say_error(f"{event.address}: started")
            case CellWarned():
                say_error(f"{event.address}: warning: {event.text}")
            case CellFinished():
                self._n_ended += 1
                say_error(f"{end_text(event)} ({self._n_ended} of {self._n_cells})")
            case _:
                return


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
    why = f": {result.error_message}" if result.error_message else ""
    return f"{event.address}: {result.status}{took}{why}"


@dataclass
class ProgressRow:
    """One cell in the live table.

    Attributes:
        state: `waiting`, `running`, or how it ended.
        fraction: 0..1 while it runs.
        text: what it does, or why it ended so.
        started: monotonic seconds.
        wall_s: how long it took.
    """

    state: str = "waiting"
    fraction: float = 0.0
    text: str = ""
    started: float = 0.0
    wall_s: float = 0.0


class LiveProgress:
    """A table of all cells that redraws itself, on standard error."""

    def __init__(self, addresses: tuple[str, ...]) -> None:
        from rich.console import Console
        from rich.live import Live

        self._rows = {address: ProgressRow() for address in addresses}
        self._lock = threading.Lock()
        self._console = Console(stderr=True)
        self._live = Live(
            console=self._console,
            get_renderable=self.table,
            refresh_per_second=_REFRESH_PER_S,
            transient=True,
        )

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._live.stop()

    def tell(self, event: RunEvent) -> None:
        """Change the table; what must stay readable is printed above it."""
        match event:
            case RunStarted():
                self._print(start_text(event))
            case CellStarted():
                self._change(event.address, ProgressRow(state="running", started=time.monotonic()))
            case CellProgress():
                self._advance(event)
            case CellWarned():
                self._print(f"{event.address}: warning: {event.text}", style="yellow")
            case CellFinished():
                result = event.result
                self._change(
                    event.address,
                    ProgressRow(
                        state="cached" if event.cached else result.status,
                        text=result.error_message,
                        wall_s=result.wall_s,
                    ),
                )
            case _:
                return

    def _print(self, text: str, style: str | None = None) -> None:
        self._live.console.print(shown(text), style=style, markup=False, highlight=False)

    def _advance(self, event: CellProgress) -> None:
        with self._lock:
            row = self._rows.setdefault(event.address, ProgressRow(state="running"))
            row.fraction, row.text = event.fraction, event.text

    def _change(self, address: str, row: ProgressRow) -> None:
        with self._lock:
            self._rows[address] = row

    def table(self) -> Table:
        """Give the table as it is now."""
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, pad_edge=False, header_style="bold")
        for title in ("cell", "state", "time", ""):
            table.add_column(title, no_wrap=True, overflow="ellipsis")
        with self._lock:
            rows = dict(self._rows)
        visible = visible_rows(rows, self._console.height - 3)
        for address, row in visible.items():
            running = row.state == "running"
            state = f"{100 * row.fraction:3.0f} %" if running else row.state
            seconds = time.monotonic() - row.started if running else row.wall_s
            table.add_row(
                Text(shown(address)),
                Text(state, style=_STYLES.get(row.state, "dim")),
                Text(duration(seconds) if seconds else ""),
                Text(shown(row.text)),
            )
        if len(visible) < len(rows):
            n_ended = sum(row.state not in ("waiting", "running") for row in rows.values())
            table.add_row(Text(f"{n_ended} of {len(rows)} ended", style="dim"))
        return table


def visible_rows(rows: Mapping[str, ProgressRow], height: int) -> dict[str, ProgressRow]:
    """Choose the rows that fit: running ones, then failed, waiting, and the rest; in their order.

    Args:
        rows: all rows.
        height: lines there are for rows.
    """
    if len(rows) <= height:
        return dict(rows)
    urgency = {"running": 0, "failed": 1, "waiting": 2}
    by_urgency = sorted(rows, key=lambda address: urgency.get(rows[address].state, 3))
    chosen = set(by_urgency[: max(1, height)])
    return {address: row for address, row in rows.items() if address in chosen}


def make_progress(addresses: tuple[str, ...]) -> Progress:
    """Give the live table when standard error is a terminal, plain lines otherwise."""
    if sys.stderr.isatty():
        return LiveProgress(addresses)
    return PlainProgress()
