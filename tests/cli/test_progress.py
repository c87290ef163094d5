"""How a run shows itself while it goes on."""

from __future__ import annotations

import dataclasses
import io
import itertools
import re
import time
from typing import Literal

import pytest
from rich.console import Console
from syrupy.assertion import SnapshotAssertion

from orthoflow.cli.progress import (
    CellState,
    Progress,
    left_of_run,
    working_on,
)
from orthoflow.diagnostics import PLAIN_WARNING, Diagnostic, DiagnosticSpec
from orthoflow.engine.journal import (
    CellFinished,
    CellReported,
    CellStarted,
    RunEvent,
    RunStarted,
)
from orthoflow.engine.plan import PlannedCell
from orthoflow.engine.results import CellResult
from orthoflow.sdk.context import StepEvent
from orthoflow.workflow.expand import Cell

OK = CellResult(status="ok", started="2026-01-02T03:04:05.000Z", wall_s=1.25, compile_s=1.9)
FAILED = CellResult(
    status="failed", started="2026-01-02T03:04:05.000Z", wall_s=75.0, error_message="no plane"
)
SKIPPED = CellResult(status="skipped", error_message="needs plane, which failed")


def progressed(address: str, fraction: float, text: str) -> CellReported:
    event = StepEvent(kind="progress", text=text, fraction=fraction)
    return CellReported(address=address, event=event)


def of_diagnostic(address: str, one: Diagnostic) -> CellReported:
    event = StepEvent(kind="diagnostic", text=one.text, diagnostic=one)
    return CellReported(address=address, event=event)


def reported(
    address: str,
    text: str,
    code: str = "warning",
    subject: str = "",
    severity: Literal["error", "warning"] = "warning",
) -> CellReported:
    spec = DiagnosticSpec(code=code, severity=severity, text="{text}")
    return of_diagnostic(address, spec.of(subject, {"text": text}))


EVENTS: list[RunEvent] = [
    RunStarted(run_id="r1", n_cells=5, is_resumed=False),
    CellFinished(address="cloud", result=OK, cached=True),
    CellStarted(address="plane"),
    progressed("plane", 0.5, "peeling"),
    CellReported(address="plane", event=StepEvent(kind="log", text="a detail")),
    reported("plane", "the side is a [guess]"),
    reported("plane", "no point", code="empty-wall", subject="wall 2"),
    reported("plane", "no point", code="empty-wall", subject="wall 17"),
    reported("plane", "all are upside down", code="upside-down", severity="error"),
    CellFinished(address="plane", result=FAILED, cached=False),
    CellFinished(address="wall", result=SKIPPED, cached=False),
    CellFinished(address="other", result=OK, cached=False),
    CellStarted(address="last"),
    CellFinished(address="last", result=OK, cached=False),
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


def running(*, fraction: float = 0.0, took_s: float | None = None) -> CellState:
    return CellState(state="running", fraction=fraction, started=100.0, took_s=took_s)


# Lines --------------------------------------------------------------------------------------------


def test_a_log_has_a_line_per_start_end_and_code(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    snapshot: SnapshotAssertion,
) -> None:
    clock_s = itertools.count(100.0, 46.25)
    monkeypatch.setattr(time, "monotonic", lambda: next(clock_s))
    with Progress() as progress:
        for event in EVENTS:
            progress.take(event)
        progress.take(RunStarted(run_id="r1", n_cells=1, is_resumed=True))
    assert capsys.readouterr() == ("", snapshot)


def test_a_log_shows_a_long_step_again(capsys: pytest.CaptureFixture[str]) -> None:
    progress = Progress(planned("plane", "wall", took_s=60.0))
    progress.every_s = 0.2
    with progress:
        progress.take(RunStarted(run_id="r1", n_cells=2, is_resumed=False))
        progress.take(CellStarted(address="plane"))
        progress.take(progressed("plane", 0.25, "peeling"))
        time.sleep(0.7)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["run r1: 2 steps, about 2 min 00 s left", "plane: started"]
    assert 1 <= len(lines[2:]) <= 3
    for line in lines[2:]:
        assert re.fullmatch(r"plane: 25 %, peeling, \d\.\d+ s so far, about 1 min 00 s left", line)


# The table ----------------------------------------------------------------------------------------


def test_the_live_table_shows_every_state_and_keeps_warnings(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with Progress(planned("cloud", "plane", "wall", "other")) as progress:
        for event in EVENTS[:6]:
            progress.take(event)
        columns = [[str(cell) for cell in column.cells] for column in progress.table().columns]
        assert columns[0] == ["cloud", "plane", "wall", "other"]
        assert columns[1] == ["cached", " 50 %", "waiting", "waiting"]
        assert columns[4] == ["", "peeling", "", ""]
        whole = "1 of 4 steps ended, remaining time not yet known"
        assert str(progress.drawn().renderables[1]) == whole
        progress.take(CellStarted(address="plane"))
        assert str(list(progress.table().columns[1].cells)[1]) == "  0 %"
        for address in ("plane", "wall", "other"):
            progress.take(CellFinished(address=address, result=OK, cached=False))
        assert str(progress.drawn().renderables[1]) == "4 of 4 steps ended"
    assert "plane: warning: the side is a [guess]" in capsys.readouterr().err


def test_of_rows_that_do_not_fit_those_that_ended_are_left_out() -> None:
    progress = Progress(planned(*"abcdef"))
    for event in (
        CellFinished(address="a", result=OK, cached=False),
        CellStarted(address="c"),
        CellFinished(address="d", result=FAILED, cached=False),
    ):
        progress.take(event)
    for rows, addresses in ((6, "abcdef"), (5, "bcdef"), (3, "bcdef")):
        progress.console = Console(height=rows + 4, file=io.StringIO())
        assert [str(cell) for cell in progress.table().columns[0].cells] == [*addresses]


# Work outside of cells ----------------------------------------------------------------------------


def test_long_work_outside_of_cells_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with working_on("writing the record", every_s=0.2) as note:
        time.sleep(0.3)
        note("writing the report")
        time.sleep(0.2)
    with working_on("reading", every_s=5.0):
        pass
    lines = set(re.sub(r"\d\.\d+ s", "T", capsys.readouterr().err).splitlines())
    assert lines == {"writing the record, T so far", "writing the report, T so far"}


# Forecasts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "now_s", "left_s"),
    [
        (CellState(took_s=30.0), 0.0, 30.0),
        (CellState(state="ok", took_s=30.0), 0.0, 0.0),
        # Its earlier duration counts until that is over, then its progress.
        (running(took_s=30.0, fraction=0.9), 110.0, 20.0),
        (running(took_s=30.0), 150.0, None),
        # Where it never ran before, a quarter in ten seconds leaves thirty.
        (running(fraction=0.25), 110.0, 30.0),
        (running(fraction=0.049), 110.0, None),
        (running(fraction=0.25), 101.9, None),
    ],
)
def test_a_cell_is_predicted_by_its_last_run_then_by_its_progress(
    cell: CellState, now_s: float, left_s: float | None
) -> None:
    assert cell.left_s(now_s) == (None if left_s is None else pytest.approx(left_s))


LEFT = [running(took_s=50.0), CellState(took_s=40.0), CellState(took_s=40.0)]
UNKNOWN = [CellState(), CellState()]


@pytest.mark.parametrize(
    ("cells", "jobs", "text"),
    [
        # 50 + 40 + 40 one after the other, or two at a time; three at a time end with the longest.
        ([*LEFT, CellState(state="ok", took_s=1000.0)], 1, "about 2 min 10 s left"),
        (LEFT, 2, "about 1 min 10 s left"),
        (LEFT, 3, "about 50 s left"),
        ([*LEFT[1:], *UNKNOWN], 1, "at least 1 min 20 s left; 2 steps not estimated"),
        # A few seconds of one cell would make a run of minutes look short; stored ones say nothing.
        (
            [CellState(took_s=0.0), CellState(took_s=4.0), *UNKNOWN],
            1,
            "remaining time not yet known",
        ),
        ([CellState(took_s=0.0), CellState(state="ok")], 1, ""),
    ],
)
def test_a_run_takes_as_long_as_its_longest_cell_or_its_share_of_all(
    cells: list[CellState], jobs: int, text: str
) -> None:
    assert left_of_run(cells, 100.0, jobs=jobs) == text


# Untrusted text -----------------------------------------------------------------------------------


def test_text_of_steps_is_shown_and_not_obeyed(capsys: pytest.CaptureFixture[str]) -> None:
    evil = "\x1b[2J\u202e[bold red]x[/]\nplane: ok"
    warning = dataclasses.replace(PLAIN_WARNING.of("", {"text": ""}), text=evil)
    failed = dataclasses.replace(FAILED, error_message=evil)
    live, plain = Progress(), Progress()
    console = live.console = Console(file=io.StringIO(), width=200, height=40)
    for event in (
        RunStarted(run_id=evil, n_cells=1, is_resumed=False),
        CellStarted(address=f"a {evil}"),
        progressed(f"a {evil}", 0.5, evil),
        of_diagnostic(f"a {evil}", warning),
        CellFinished(address=f"b {evil}", result=failed, cached=False),
    ):
        live.take(event)
        plain.take(event)
    console.print(live.table())
    for text in (console.file.getvalue(), capsys.readouterr().err):  # type: ignore[attr-defined]
        assert not {"\x1b", "\u202e"} & {*text}
        assert "\\x1b[2J\\u202e[bold red]x[/]\\nplane: ok" in text
        assert not [line for line in text.splitlines() if line.startswith("plane: ok")]
