"""Four facades that repeat one window: each photo is oriented on its own one, in its own place."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"


@pytest.mark.long
def test_photos_of_repeating_windows_are_oriented_where_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    courtyard = import_module("courtyard")
    built = courtyard.courtyard(2, 4, coarser=2.0)
    n_facades, errors = courtyard.oriented(built, coarser=2.0)
    assert n_facades == 4
    assert [error.status for error in errors] == ["ok"] * 4
    assert not any(error.is_wrong for error in errors)
    # A window farther would be 1.9 m.
    assert max(error.centre_m for error in errors) < 0.05
