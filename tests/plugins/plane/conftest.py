"""What the tests of detectors share."""

from __future__ import annotations

import pytest

from tests.undrawn_charts import build_plane_charts_once


@pytest.fixture(autouse=True)
def _charts_built_once(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    build_plane_charts_once(request, monkeypatch)
