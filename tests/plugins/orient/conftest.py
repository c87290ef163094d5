"""Fixtures of the tests of orientation."""

from __future__ import annotations

import pytest
from orthoflow_plugins.orient import report

from orthoflow.geometry import covariances
from tests.undrawn_charts import blank_charts


@pytest.fixture(autouse=True)
def _small_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw ties on a reduced photo, since encoding it would take longer than orienting it.

    Other tests check pictures at full size.
    """
    if request.path.stem != "test_report":
        monkeypatch.setattr(report, "SIDE_PX", 90)


@pytest.fixture(autouse=True)
def _few_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Average ties in fewer cells for their common errors, which took a third of orienting.

    tests/geometry/test_covariances.py holds these errors to drawn ones with all cells.
    """
    monkeypatch.setattr(covariances, "MAX_CELLS", 50)
    monkeypatch.setattr(covariances, "MAX_CELLS_OF_SEVERAL", 110)


@pytest.fixture(autouse=True)
def _blank_charts(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    blank_charts(request, monkeypatch)
