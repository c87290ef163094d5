"""Fixtures of the tests of detectors."""

from __future__ import annotations

import pytest

from tests.undrawn_charts import blank_charts


@pytest.fixture(autouse=True)
def _blank_charts(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    blank_charts(request, monkeypatch)
