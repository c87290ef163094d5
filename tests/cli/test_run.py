"""What a run says when it has ended: which cells failed, which came from the store, how long."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.cli import run as module


def cell(**known: Any) -> Any:
    plain = {
        "address": "wall",
        "status": "ok",
        "cached_from": "",
        "started": "2026-01-02T03:04:05.000Z",
        "wall_s": 75.0,
        "warnings": (),
        "error_message": "",
        "log": "",
    }
    return SimpleNamespace(**{**plain, **known})


SKIPPED = cell(status="skipped", started="", error_message="needs plane, which failed")
CACHED = cell(cached_from="r1")


def test_bugs_are_named_with_the_log_of_their_traceback(
    capsys: pytest.CaptureFixture[str],
) -> None:
    failed = {"status": "failed", "error_message": "no plane"}
    cells = [
        cell(),
        SKIPPED,
        cell(address="plane@plane=a", **failed, log="one\nTraceback (most recent call last)\nx"),
        cell(address="plane", **failed, log="a detail"),
    ]
    module._print_tracebacks(cells, Path("logs"))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("plane@plane=a: traceback: logs/")
    assert line.endswith(".log")


@pytest.mark.parametrize(
    ("cells", "kept", "said"),
    [
        ([CACHED, CACHED, SKIPPED], set(), "all 2 steps were cached"),
        ([CACHED, SKIPPED], set(), "the only step was cached"),
        ([CACHED, cell()], set(), "1 of 2 steps cached"),
        ([cell()], set(), "0 of 1 step cached"),
        ([SKIPPED], {"wall"}, "0 of 0 steps cached"),
        (
            [CACHED, cell(address="a"), cell(address="b"), cell(address="c")],
            {"a", "c"},
            "1 of 4 steps cached, 2 kept from before the interruption",
        ),
    ],
)
def test_steps_that_came_from_the_store_are_counted(
    cells: list[Any], kept: set[str], said: str
) -> None:
    assert module._cached_text(cells, kept) == said


def test_damaged_results_are_counted_and_named() -> None:
    assert module._damaged_text({"wall": "a digest"}) == (
        "1 result of the store was damaged and computed again: wall (a digest)"
    )
    assert module._damaged_text({"a": "x", "b": "y"}) == (
        "2 results of the store were damaged and computed again: a (x), b (y)"
    )


@pytest.mark.parametrize(
    ("one", "status", "time", "remark"),
    [
        (cell(), "ok", "1 min 15 s", ""),
        (cell(warnings=("a", "b")), "ok", "1 min 15 s", "2 warnings"),
        (cell(address="kept"), "kept", "1 min 15 s", ""),
        (cell(address="kept", cached_from="r1"), "cached", "1 min 15 s", ""),
        (cell(status="failed", warnings=("a",)), "failed", "1 min 15 s", "see above"),
        (SKIPPED, "skipped", "", "needs plane, which failed"),
        (cell(started=""), "ok", "", ""),
        (cell(status="skipped"), "skipped", "", ""),
    ],
)
def test_a_cell_is_a_row(one: Any, status: str, time: str, remark: str) -> None:
    assert (module._status(one, {"kept"}), module._time(one), module._remark(one)) == (
        status,
        time,
        remark,
    )
