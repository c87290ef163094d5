"""Edges of known blur give their width and MTF."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.inspect.image_quality import sharpness_findings
from orthoflow_plugins.inspect.patches import GreyImage
from scipy.special import erf


@pytest.mark.parametrize("sigma", [0.8, 1.5, 2.5])
def test_blurred_edges_tell_their_blur(sigma: float) -> None:
    # Bars 40 cells wide, a little askew so that edges fall anywhere between cells.
    rows, columns = np.mgrid[:400, :400]
    place = np.mod(columns + 0.13 * rows, 80.0)
    across = np.where(place < 60.0, place - 20.0, np.nan) / np.hypot(1.0, 0.13)
    back = (60.0 - place) / np.hypot(1.0, 0.13)
    signed = np.where(place < 40.0, np.nan_to_num(across), back)
    grey = 120.0 + 60.0 * erf(signed / (sigma * np.sqrt(2.0)))
    grey += np.random.default_rng(1).normal(scale=1.0, size=grey.shape)
    valid = np.ones(grey.shape, dtype=np.bool_)
    found = {
        finding.name: finding.value
        for finding in sharpness_findings(GreyImage(grey=grey, valid=valid, region=valid), 0)
    }
    assert found["n_edges"] >= 20
    # A Gaussian's 10 to 90 % take 2.563 sigma; its MTF halves at sqrt(ln 2 / 2) / (pi sigma).
    assert found["edge_width_cells"] == pytest.approx(2.563 * sigma, rel=0.1)
    assert found["mtf50_per_cell"] == pytest.approx(0.1874 / sigma, rel=0.1)


def test_an_image_without_edges_tells_nothing() -> None:
    flat = np.full((100, 100), 90.0)
    for valid in (np.ones(flat.shape, dtype=np.bool_), np.zeros(flat.shape, dtype=np.bool_)):
        assert sharpness_findings(GreyImage(grey=flat, valid=valid, region=valid), 0) == []
