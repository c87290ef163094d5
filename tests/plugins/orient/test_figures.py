"""Histograms of residuals: all photos together, and each with its own normal distribution."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from orthoflow_plugins.orient.figures import PhotoResiduals, _normal, draw_residuals

from orthoflow.products import TieRole
from orthoflow.sdk import StepContext


def residuals(name: str, n: int, seed: int, *, shift_px: float = 0.0) -> PhotoResiduals:
    rng = np.random.default_rng(seed)
    role = np.where(np.arange(n) % 5 == 0, TieRole.CHECK, TieRole.CONTROL).astype(np.uint8)
    role[-1] = TieRole.REJECTED
    values = rng.normal(shift_px, 0.5, (n, 2))
    values[-1] = 1e6
    return PhotoResiduals(name=name, residuals_px=values, role=role)


def test_a_normal_curve_has_as_many_ties_below_it_as_the_bars() -> None:
    values = np.random.default_rng(1).normal(0.3, 0.5, 5000)
    edges = np.linspace(-3.0, 3.0, 61)
    curve = _normal(values, edges, edges)
    # Counts per bar, summed over bars: all ties lie within.
    assert curve.sum() == pytest.approx(5000.0, rel=1e-3)
    assert edges[curve.argmax()] == pytest.approx(0.3, abs=0.06)


@pytest.mark.usefixtures("charts")
def test_each_photo_has_a_row_of_its_own(tmp_path: Path) -> None:
    context = StepContext(rng=np.random.default_rng(1), cores=1, scratch=tmp_path)
    draw_residuals(context, [residuals(f"{k}.jpg", 300, k, shift_px=k - 1.0) for k in range(3)])
    assert [figure.name for figure in context.figures] == ["residuals", "residuals_by_photo"]
    drawn = cv2.imread(str(context.figures[1].path)).astype(int)
    bars = np.abs(drawn - [210, 184, 157]).sum(axis=2) < 8  # blue, green, red of the bars
    # A photo shifted to the left lies above one shifted to the right, in each of four columns.
    for part in np.array_split(bars, 4, axis=1):
        rows, columns = np.nonzero(part)
        third = np.quantile(rows, [1 / 3, 2 / 3])
        upper, lower = columns[rows < third[0]], columns[rows > third[1]]
        assert np.median(upper) < np.median(lower)


def test_without_residuals_nothing_is_drawn(tmp_path: Path) -> None:
    context = StepContext(rng=np.random.default_rng(1), cores=1, scratch=tmp_path)
    draw_residuals(context, [])
    assert context.figures == []
