"""Planes beside true ones, and labels beside true labels, against counts and geometry by hand."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.inspect import plane_errors

from orthoflow.products import Finding, Planes
from orthoflow.sdk import StepContext
from tests import samples


def floors(*heights_m: float, tilt_deg: float = 0.0) -> Planes:
    """Squares of 2 m about the z axis, tilted about x."""
    turn = math.radians(tilt_deg)
    normal = np.array([0.0, -math.sin(turn), math.cos(turn)])
    square = np.array([[-1.0, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0]])
    corners = np.array([square + np.array([0.0, 0.0, height]) for height in heights_m])
    return samples.planes(
        normal=np.tile(normal, (len(heights_m), 1)),
        offset=np.array([normal[2] * height for height in heights_m]),
        corners=corners,
        names=tuple(f"floor {index}" for index in range(len(heights_m))),
    )


def counts(findings: list[Finding]) -> dict[str, float]:
    return {finding.name: finding.value for finding in findings}


def test_labels_are_scored_by_plane_whichever_number_they_have(tmp_path: Path) -> None:
    ctx = StepContext(rng=np.random.default_rng(0), cores=1, scratch=tmp_path)
    labels: Any = SimpleNamespace(plane_index=np.array([2, 2, -1, 0, 0, 0], dtype=np.int16))
    truth: Any = SimpleNamespace(
        labels=np.array([0, 0, 0, 1, 1, -1], dtype=np.int16), planes=floors(0.0, 3.0, 6.0)
    )
    found = counts(plane_errors.label_findings(labels, None, truth, ctx))
    # Of the third plane there is no point.
    expected = {
        "precision": (1.0, 2.0 / 3.0, 0.0),
        "recall": (2.0 / 3.0, 1.0, 0.0),
        "f1": (0.8, 0.8, 0.0),
        "iou": (2.0 / 3.0, 2.0 / 3.0, 0.0),
    }
    for score, values in expected.items():
        of_each = [found[f"label_{score}[floor {k}]"] for k in range(3)]
        assert of_each == pytest.approx(values), score
        assert found[f"label_{score}_mean"] == pytest.approx(sum(values) / 3.0), score
