"""Fixtures of the tests of orientation."""

from __future__ import annotations

import pytest
from orthoflow_plugins.orient import report

from tests.undrawn_charts import blank_charts


@pytest.fixture(autouse=True)
def _small_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw ties on a reduced photo, since encoding it would take longer than orienting it.

    Other tests check pictures at full size.
    """
    if request.path.stem != "test_figures":
        monkeypatch.setattr(report, "SIDE_PX", 90)


@pytest.fixture(autouse=True)
def _blank_charts(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    blank_charts(request, monkeypatch)
