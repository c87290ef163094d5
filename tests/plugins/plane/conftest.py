"""What the tests of detectors share."""

from __future__ import annotations

import pytest
from orthoflow_plugins.plane import detecting, search_figures

from tests.undrawn_charts import build_charts_once

# What builds the charts of every detection, and those of some detectors.
COMMON = ("draw_deviations", "draw_planes", "draw_thickness")
OWN = ("draw_accumulator", "draw_space", "draw_sections", "_draw_normals")


@pytest.fixture(autouse=True)
def _charts_built_once(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    build_charts_once(request, monkeypatch, detecting, *COMMON)
    build_charts_once(request, monkeypatch, search_figures, *OWN)
