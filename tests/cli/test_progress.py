"""How a run shows itself while it goes on."""

from __future__ import annotations

import dataclasses
import io
import re
import sys
import time
from types import SimpleNamespace

import pytest
from rich.console import Console

from orthoflow.cli.progress import (
    CellState,
    LiveProgress,
    NotebookProgress,
    PlainProgress,
    _Clock,
    about,
    left_of_cell,
    left_of_run,
    make_progress,
    visible_cells,
    working_on,
)
from orthoflow.diagnostics import PLAIN_WARNING, DiagnosticSpec
from orthoflow.engine.journal import (
    CellFinished,
    CellLogged,
    CellProgress,
    CellReported,
    CellStarted,
    RunEvent,
    RunStarted,
)
from orthoflow.engine.plan import PlannedCell
from orthoflow.engine.results import CellResult
from orthoflow.workflow.expand import Cell

OK = CellResult(status="ok", started="2026-01-02T03:04:05.000Z", wall_s=1.25, compile_s=1.9)
COMPILED = dataclasses.replace(OK, compile_s=45.0)
FAILED = CellResult(
    status="failed", started="2026-01-02T03:04:05.000Z", wall_s=75.0, error_message="no plane"
)
SKIPPED = CellResult(status="skipped", error_message="needs plane, which failed")


def reported(address: str, text: str, code: str = "warning", subject: str = "") -> CellReported:
    spec = DiagnosticSpec(code=code, severity="warning", text="{text}")
    return CellReported(address=address, diagnostic=spec.of(subject, {"text": text}))


EVENTS: list[RunEvent] = [
    RunStarted(run_id="r1", n_cells=5, is_resumed=False),
    CellFinished(address="cloud", result=OK, cached=True),
    CellStarted(address="plane"),
    CellProgress(address="plane", fraction=0.5, text="peeling"),
    CellLogged(address="plane", text="a detail"),
    reported("plane", "the side is a [guess]"),
    reported("plane", "no point", code="empty-wall", subject="wall 2"),
    reported("plane", "no point", code="empty-wall", subject="wall 17"),
    CellFinished(address="plane", result=FAILED, cached=False),
    CellFinished(address="wall", result=SKIPPED, cached=False),
    CellFinished(address="other", result=OK, cached=False),
    CellFinished(address="last", result=COMPILED, cached=False),
]


def planned(*addresses: str, took_s: float | None = None) -> tuple[PlannedCell, ...]:
    return tuple(
        PlannedCell(
            cell=Cell(address=address, step=address, method="toy.toy"),
            status="will run",
            reason="",
            took_s=took_s,
        )
        for address in addresses
    )


def test_plain_progress_is_one_line_per_start_sense_of_warning_and_end(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with PlainProgress() as progress:
        for event in EVENTS:
            progress.tell(event)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.splitlines() == [
        "run r1: 5 steps",
        "cloud: cached (1 of 5)",
        "plane: started",
        "plane: warning: the side is a [guess]",
        "plane: warning: empty-wall (wall 2)",
        "plane: failed in 1 min 15 s: no plane, 1 warning like one above (2 of 5)",
        "wall: skipped (3 of 5)",
        "other: ok in 1.2 s (4 of 5)",
        "last: ok in 1.2 s, besides 45.0 s of loading and compiling (5 of 5)",
    ]


def test_a_resumed_run_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    PlainProgress().tell(RunStarted(run_id="r1", n_cells=1, is_resumed=True))
    assert capsys.readouterr().err == "going on with run r1: 1 step\n"


def test_the_live_table_keeps_warnings_readable_and_shows_every_state(
    capsys: pytest.CaptureFixture[str],
) -> None:
    progress = LiveProgress(planned("cloud", "plane", "wall", "other"))
    with progress as entered:
        assert entered is progress
        for event in EVENTS[:6]:
            progress.tell(event)
        table = progress.table()
        columns = [[str(cell) for cell in column.cells] for column in table.columns]
        assert columns[0] == ["cloud", "plane", "wall", "other"]
        assert columns[1] == ["cached", " 50 %", "waiting", "waiting"]
        assert columns[4] == ["", "peeling", "", ""]
        whole = "1 of 4 steps ended, time left not known yet"
        assert str(progress.drawn().renderables[1]) == whole
    assert "plane: warning: the side is a [guess]" in capsys.readouterr().err


def test_times_are_told_of_what_has_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    progress = LiveProgress(planned("waits", "runs", "done"))
    cells = {
        "waits": CellState(state="waiting"),
        "runs": CellState(state="running", started=100.0, took_s=40.0, fraction=0.25),
        "done": CellState(state="ok", wall_s=75.0, took_s=40.0),
    }
    monkeypatch.setattr(progress._state, "cells", lambda: cells)
    monkeypatch.setattr(time, "monotonic", lambda: 120.0)
    columns = [[str(cell) for cell in column.cells] for column in progress.table().columns]
    assert columns[1] == ["waiting", " 50 %", "ok"]
    assert columns[2] == ["", "20.0 s", "1 min 15 s"]
    assert columns[3] == ["", "20 s", ""]


def test_what_does_not_fit_is_what_matters_least() -> None:
    states = ["ok", "cached", "running", "failed", "waiting", "waiting"]
    cells = {f"step{i}": CellState(state=state) for i, state in enumerate(states)}
    assert list(visible_cells(cells, 6)) == list(cells)
    assert list(visible_cells(cells, 3)) == ["step2", "step3", "step4"]
    assert list(visible_cells(cells, 0)) == ["step2"]
    for order in (("ok", "waiting"), ("waiting", "failed"), ("failed", "running")):
        pair = {state: CellState(state=state) for state in order}
        assert list(visible_cells(pair, 1)) == [order[1]]


def test_the_live_table_leaves_four_lines_for_all_else(monkeypatch: pytest.MonkeyPatch) -> None:
    progress = LiveProgress(planned(*"abcdefgh"))
    monkeypatch.setattr(progress, "_console", Console(height=10, file=io.StringIO()))
    assert progress.table().row_count == 6


def test_a_run_of_which_nothing_is_left_says_how_many_ended() -> None:
    progress = LiveProgress(planned("a", "b"))
    for address in ("a", "b"):
        progress.tell(CellFinished(address=address, result=OK, cached=True))
    assert str(progress.drawn().renderables[1]) == "2 of 2 steps ended"


def test_a_step_that_begins_anew_begins_at_nought() -> None:
    progress = LiveProgress(planned("a"))
    progress.tell(CellProgress(address="a", fraction=0.5, text="half"))
    progress.tell(CellStarted(address="a"))
    state = progress._state.cells()["a"]
    assert (state.state, state.fraction) == ("running", 0.0)


@pytest.mark.parametrize(("is_terminal", "kind"), [(True, LiveProgress), (False, PlainProgress)])
def test_a_terminal_has_a_table_and_a_file_has_lines(
    monkeypatch: pytest.MonkeyPatch, is_terminal: bool, kind: type
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: is_terminal)
    made = make_progress(planned("a", "b", took_s=60.0), jobs=2)
    assert type(made) is kind
    # Two at a time.
    assert made._state.left() == "about 1 min 00 s left"


def test_a_step_that_says_nothing_still_moves_in_plain_lines(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with PlainProgress(planned("plane", "wall", took_s=60.0), every_s=0.2) as progress:
        progress.tell(RunStarted(run_id="r1", n_cells=2, is_resumed=False))
        progress.tell(CellStarted(address="plane"))
        progress.tell(CellProgress(address="plane", fraction=0.25, text="compiling peel"))
        time.sleep(0.7)
    said = capsys.readouterr().err.splitlines()
    assert said[:2] == ["run r1: 2 steps, about 2 min 00 s left", "plane: started"]
    assert 2 <= len(said[2:]) <= 3
    for line in said[2:]:
        assert re.fullmatch(
            r"plane: 25 %, compiling peel, 0\.\d\d s so far, about 1 min 00 s left", line
        )


@pytest.fixture
def places(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """A notebook: of each output all that stood in it, the last of it what is kept."""
    found: list[list[str]] = []

    def display(data: dict[str, str], **_: object) -> SimpleNamespace:
        found.append([data["text/plain"]])
        return SimpleNamespace(update=lambda data, **_: found[-1].append(data["text/plain"]))

    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=display))
    return found


def test_a_notebook_keeps_one_output_with_a_line_per_step(
    places: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    # Plain lines came every ten seconds, and a notebook kept all of them.
    progress = make_progress(planned("cloud", "plane", took_s=60.0))
    assert type(progress) is NotebookProgress
    progress._clock = _Clock(progress._draw, 0.05)
    with progress:
        for event in EVENTS[:4]:
            progress.tell(event)
        time.sleep(0.3)
        for event in EVENTS[4:]:
            progress.tell(event)
    (written,) = places
    assert any("\nplane: 50 %, peeling, 0." in text for text in written[:-1])
    assert written[-1].splitlines() == [
        "run r1: 5 steps",
        "cloud: cached",
        "plane: warning: the side is a [guess]",
        "plane: warning: empty-wall (wall 2)",
        "plane: failed in 1 min 15 s: no plane, 1 warning like one above",
        "wall: skipped",
        "other: ok in 1.2 s",
        "last: ok in 1.2 s, besides 45.0 s of loading and compiling",
    ]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("n_steps", "first_kept"), [(999, 0), (1000, 1)])
def test_of_many_steps_a_notebook_shows_the_last_lines_and_keeps_all_of_a_thousand(
    places: list[list[str]], n_steps: int, first_kept: int
) -> None:
    ended = [f"c{index}: cached" for index in range(n_steps)]
    with NotebookProgress(()) as progress:
        progress.tell(EVENTS[0])
        for index in range(n_steps):
            progress.tell(CellFinished(address=f"c{index}", result=OK, cached=True))
        progress._draw()
    while_running, kept = (text.splitlines() for text in places[0])
    n_more = n_steps + 1 - 40
    assert while_running == ["run r1: 5 steps", f"... {n_more} lines more", *ended[n_more:]]
    assert kept == [
        "run r1: 5 steps",
        *([f"... {first_kept} line more"] if first_kept else []),
        *ended[first_kept:],
    ]


def test_what_was_broken_off_does_not_run_for_ever_in_a_notebook(places: list[list[str]]) -> None:
    with NotebookProgress(()) as progress:
        progress.tell(EVENTS[0])
        progress.tell(CellStarted(address="plane"))
        progress._draw()
    assert places[0][0].splitlines()[1].startswith("plane: 0 %, starting, ")
    assert places[0][1:] == ["run r1: 5 steps"]


def test_a_terminal_s_ipython_is_no_notebook(
    places: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=SimpleNamespace))
    assert type(make_progress(())) is not NotebookProgress
    assert places == []


def test_what_a_notebook_waits_for_is_one_line_too(places: list[list[str]]) -> None:
    with working_on("writing the record", every_s=0.1):
        time.sleep(0.35)
    with working_on("reading", every_s=5.0):
        pass
    (written,) = places
    assert len(written) >= 3
    assert all(re.fullmatch(r"writing the record, 0\.\d\d s so far", text) for text in written[:-1])
    # What is kept does not say that it is still written.
    assert re.fullmatch(r"writing the record: done in 0\.[34]\d s", written[-1])


def test_what_breaks_off_in_a_notebook_is_kept_as_broken_off(places: list[list[str]]) -> None:
    @working_on("writing", every_s=0.1)
    def fail_slowly() -> None:
        time.sleep(0.15)
        raise OSError("full")

    with pytest.raises(OSError, match="full"):
        fail_slowly()
    assert re.fullmatch(r"writing: broken off after 0\.\d\d s", places[0][-1])


def test_what_no_cell_does_is_said_while_it_takes_long(capsys: pytest.CaptureFixture[str]) -> None:
    with working_on("writing the record", every_s=0.2):
        time.sleep(0.3)
    with working_on("reading", every_s=5.0):
        pass
    said = capsys.readouterr().err
    assert re.fullmatch(r"writing the record, 0\.2\d s so far\n", said)


def test_what_a_step_took_before_says_how_long_it_takes() -> None:
    cell = CellState(state="running", started=100.0, took_s=40.0)
    assert [cell.left_s(now_s) for now_s in (100.0, 130.0, 150.0)] == [40.0, 10.0, None]
    assert [cell.done(now_s) for now_s in (100.0, 130.0, 150.0)] == [0.0, 0.75, 0.95]
    assert left_of_cell(cell, 130.0) == "about 10 s left"
    cell.fraction = 0.2
    # It takes longer than before: only what it says of itself holds.
    assert [cell.done(now_s) for now_s in (130.0, 150.0)] == [0.75, 0.2]


def test_how_far_a_step_says_it_is_counts_where_nothing_is_known() -> None:
    cell = CellState(state="running", started=100.0, fraction=0.2)
    assert [cell.left_s(now_s) for now_s in (101.0, 110.0)] == [None, 40.0]
    assert cell.done(110.0) == 0.2
    assert CellState(state="running", started=0.0, fraction=0.5, took_s=10.0).left_s(20.0) == 20.0


def test_a_run_takes_as_long_as_what_is_left_of_it() -> None:
    running = CellState(state="running", started=0.0, took_s=30.0)
    waiting, unknown = CellState(took_s=50.0), CellState()
    ended = CellState(state="ok", took_s=500.0)
    assert left_of_run([running, waiting, ended], 10.0) == "about 1 min 10 s left"
    assert left_of_run([running, waiting, ended], 10.0, jobs=2) == "about 50 s left"
    said = "at least 1 min 10 s left, and a step that takes nobody knows how long"
    assert left_of_run([running, waiting, unknown], 10.0) == said
    assert left_of_run([unknown, ended], 10.0) == "time left not known yet"


def test_a_forecast_is_no_more_exact_than_it_can_be() -> None:
    assert [about(seconds) for seconds in (0.0, 41.0, 59.0, 61.0, 599.0, 601.0)] == [
        *("5 s", "45 s", "1 min 00 s", "1 min 10 s", "10 min 00 s", "11 min 00 s")
    ]


def test_what_steps_say_is_shown_and_not_obeyed(capsys: pytest.CaptureFixture[str]) -> None:
    evil = "\x1b[2J\u202e[bold red]x[/]\nplane: ok"
    result = CellResult(status="failed", started="now", wall_s=1.0, error_message=evil)
    events: list[RunEvent] = [
        RunStarted(run_id=evil, n_cells=1, is_resumed=False),
        CellStarted(address=f"a {evil}"),
        CellProgress(address=f"a {evil}", fraction=0.5, text=evil),
        CellReported(
            address=f"a {evil}",
            diagnostic=dataclasses.replace(PLAIN_WARNING.of("", {"text": ""}), text=evil),
        ),
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
