"""Fixtures of the tests of detectors."""

from __future__ import annotations

import pytest
from orthoflow_plugins.plane import cloud

from tests.undrawn_charts import blank_charts


@pytest.fixture(autouse=True)
def _few_seeds(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure the noise of clouds at fewer places, which took a third of each detection."""
    if "nois" not in request.node.name:
        monkeypatch.setattr(cloud, "NOISE_SEEDS", 200)


@pytest.fixture(autouse=True)
def _blank_charts(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    blank_charts(request, monkeypatch)
