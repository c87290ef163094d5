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
