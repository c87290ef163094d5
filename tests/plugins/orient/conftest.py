"""What the tests of orientation share."""

from __future__ import annotations

import pytest
from orthoflow_plugins.orient import report

from tests.undrawn_charts import blank_charts


@pytest.fixture(autouse=True)
def _small_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw ties on a tenth of the photo, or to encode it takes longer than to orient it.

    How pictures look at their own size is for the tests of these.
    """
    if request.path.stem != "test_figures":
        monkeypatch.setattr(report, "_SIDE_PX", 90)


@pytest.fixture(autouse=True)
def _blank_charts(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    blank_charts(request, monkeypatch)
