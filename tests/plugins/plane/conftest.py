"""Fixtures of the tests of detectors."""

from __future__ import annotations

import pytest
from orthoflow_plugins.plane import cloud

from tests.undrawn_charts import blank_charts

_ALL_PLACES = cloud.NOISE_SEEDS


@pytest.fixture(autouse=True)
def _few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure the noise of clouds at few places, because it took a third of each detection."""
    monkeypatch.setattr(cloud, "NOISE_SEEDS", 100)


@pytest.fixture
def all_places(_few_places: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure the noise of clouds at all places, for tests whose subject is noise."""
    monkeypatch.setattr(cloud, "NOISE_SEEDS", _ALL_PLACES)


@pytest.fixture(autouse=True)
def _blank_charts(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    blank_charts(request, monkeypatch)
