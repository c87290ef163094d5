"""How a run shows itself while it goes on."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from orthoflow.cli.progress import LiveProgress, PlainProgress, ProgressRow, visible_rows
from orthoflow.engine import (
    CellFinished,
    CellLogged,
    CellProgress,
    CellResult,
    CellStarted,
    CellWarned,
    RunEvent,
    RunStarted,
)

OK = CellResult(status="ok", started="2026-01-02T03:04:05.000Z", wall_s=1.25)
FAILED = CellResult(
    status="failed", started="2026-01-02T03:04:05.000Z", wall_s=75.0, error_message="no plane"
)
SKIPPED = CellResult(status="skipped", error_message="needs plane, which failed")
EVENTS: list[RunEvent] = [
    RunStarted(run_id="r1", n_cells=4, is_resumed=False),
    CellFinished(address="cloud", result=OK, cached=True),
    CellStarted(address="plane"),
    CellProgress(address="plane", fraction=0.5, text="peeling"),
    CellLogged(address="plane", text="a detail"),
    CellWarned(address="plane", text="the side is a [guess]"),
    CellFinished(address="plane", result=FAILED, cached=False),
    CellFinished(address="wall", result=SKIPPED, cached=False),
    CellFinished(address="other", result=OK, cached=False),
]


def test_plain_progress_is_one_line_per_start_warning_and_end(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with PlainProgress() as progress:
        for event in EVENTS:
            progress.tell(event)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.splitlines() == [
        "run r1: 4 steps",
        "cloud: cached (1 of 4)",
        "plane: started",
        "plane: warning: the side is a [guess]",
        "plane: failed in 1 min 15 s: no plane (2 of 4)",
        "wall: skipped: needs plane, which failed (3 of 4)",
        "other: ok in 1.2 s (4 of 4)",
    ]


def test_a_resumed_run_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    PlainProgress().tell(RunStarted(run_id="r1", n_cells=1, is_resumed=True))
    assert capsys.readouterr().err == "going on with run r1: 1 step\n"


def test_the_live_table_keeps_warnings_readable_and_shows_every_state(
    capsys: pytest.CaptureFixture[str],
) -> None:
    progress = LiveProgress(("cloud", "plane", "wall", "other"))
    with progress:
        for event in EVENTS[:6]:
            progress.tell(event)
        table = progress.table()
        columns = [[str(cell) for cell in column.cells] for column in table.columns]
        assert columns[0] == ["cloud", "plane", "wall", "other"]
        assert columns[1] == ["cached", " 50 %", "waiting", "waiting"]
        assert columns[3] == ["", "peeling", "", ""]
    assert "plane: warning: the side is a [guess]" in capsys.readouterr().err


def test_what_does_not_fit_is_what_matters_least() -> None:
    states = ["ok", "cached", "running", "failed", "waiting", "waiting"]
    rows = {f"step{i}": ProgressRow(state=state) for i, state in enumerate(states)}
    assert list(visible_rows(rows, 6)) == list(rows)
    assert list(visible_rows(rows, 3)) == ["step2", "step3", "step4"]
    assert list(visible_rows(rows, 0)) == ["step2"]


def test_what_steps_say_is_shown_and_not_obeyed(capsys: pytest.CaptureFixture[str]) -> None:
    evil = "\x1b[2J\u202e[bold red]x[/]\nplane: ok"
    result = CellResult(status="failed", started="now", wall_s=1.0, error_message=evil)
    events: list[RunEvent] = [
        RunStarted(run_id=evil, n_cells=1, is_resumed=False),
        CellStarted(address=f"a {evil}"),
        CellProgress(address=f"a {evil}", fraction=0.5, text=evil),
        CellWarned(address=f"a {evil}", text=evil),
        CellFinished(address=f"b {evil}", result=result, cached=False),
    ]
    live = LiveProgress(())
    live._console = Console(file=io.StringIO(), width=200, height=40)
    live._live.console = live._console
    for event in events:
        live.tell(event)
    live._console.print(live.table())
    drawn = live._console.file.getvalue()  # type: ignore[attr-defined]
    with PlainProgress() as progress:
        for event in events:
            progress.tell(event)
    for said in (drawn, capsys.readouterr().err):
        assert "\x1b" not in said
        assert "\u202e" not in said
        assert "\\x1b[2J\\u202e[bold red]x[/]\\nplane: ok" in said
        assert not [line for line in said.splitlines() if line.startswith("plane: ok")]
