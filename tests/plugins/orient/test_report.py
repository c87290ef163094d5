"""The table of residuals: every number compared with its definition, computed by hand."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.orient.pnp import OrientPnp
from orthoflow_plugins.orient.report import residual_rows

from orthoflow.products import TieRole
from orthoflow.testing import photographed as ms
from tests import tied_photos as tp

UNITS = {"px": 1.0, "mm": 2.5, "cell": 0.5}


def rows(residuals: np.ndarray, units: dict[str, float] = UNITS) -> dict[tuple[str, str], dict]:
    found = residual_rows("a", "check", residuals, units)
    return {(row.axis, row.unit): asdict(row) for row in found}


def test_numbers_are_those_of_their_definition() -> None:
    residuals = np.array([[1.0, 0.0], [-1.0, 0.0], [3.0, 2.0], [-1.0, 0.0], [-2.0, -2.0]])
    found = rows(residuals)["u", "px"]
    # u: mean 0, squares 1 + 1 + 9 + 1 + 4 = 16, cubes 1 - 1 + 27 - 1 - 8 = 18.
    assert found["n"] == 5
    assert found["mean"] == 0.0
    assert found["shift_p"] == 1.0
    assert found["sd"] == 2.0
    assert found["median"] == -1.0
    # Distances from the median: 2, 0, 4, 0, 1.
    assert found["nmad"] == pytest.approx(1.4826)
    assert found["skewness"] == pytest.approx((18.0 / 5.0) / (16.0 / 5.0) ** 1.5)
    assert found["rmse"] == pytest.approx(np.sqrt(3.2))
    assert found["p95"] == pytest.approx(2.8)
    assert found["max"] == 3.0


def test_shares_follow_their_three_conventions() -> None:
    residuals = np.zeros((20, 2))
    residuals[0, 0] = 5.0  # u: RMSE 1.118, so beyond; 5 px are 2.5 cells, so beyond
    residuals[1, 1] = 3.0  # v: RMSE 0.671, so beyond; 3 px are 1.5 cells, so not
    found = rows(residuals)
    assert (found["u", "px"]["beyond_own"], found["v", "px"]["beyond_own"]) == (0.05, 0.05)
    assert (found["u", "px"]["beyond_cells"], found["v", "px"]["beyond_cells"]) == (0.05, 0.0)
    assert found["u", "px"]["beyond_any"] == found["v", "px"]["beyond_any"] == 0.1


def test_an_orientation_is_recorded_with_its_lens_its_errors_and_its_residuals(
    tmp_path: Path,
) -> None:
    camera = ms.camera_before()
    photos = ms.photos(tp.photo(exif_focal_px=1.01 * camera.fx))
    ties = tp.known_ties(camera, 2, wrong_share=0.2)
    found = tp.oriented(OrientPnp, ties, photos, tp.context(tmp_path))
    (oriented,), role = found.cameras, found.ties.role
    viewing = oriented.viewing()
    entry = found.details["photos"]["a.png"]
    counts = [int((role == kind).sum()) for kind in TieRole]
    assert [entry[name] for name in ("n_control", "n_check", "n_rejected")] == counts
    assert counts[2] >= 40
    depths_m, pixel_mm = viewing.project(ties.points_world[role == 0])[:, 2], entry["pixel_mm"]
    assert pixel_mm == pytest.approx(1000.0 * np.median(depths_m) / viewing.fx, rel=0.03)
    assert (entry["lens"], entry["focal_px"]) == ("exif", viewing.fx)
    assert entry["k1"] == viewing.distortion[0]
    assert entry["sigma_wall_mm"] == 1000.0 * oriented.sigma_wall_m < entry["sigma_wall_worst_mm"]
    # The factor includes the common errors of the ties.
    assert entry["variance_factor"] > entry["sigma0"] ** 2
    assert abs(viewing.fx / camera.fx - 1.0) < 4.0 * entry["focal_sigma_px"] / viewing.fx < 0.1
    table = {(row.role, row.axis, row.unit): row for row in found.residual_table}
    factors = {"px": 1.0, "mm": pixel_mm, "cell": pixel_mm / (1000.0 * ms.GSD_M)}
    for kind in (TieRole.CONTROL, TieRole.CHECK):
        largest = np.abs(found.ties.residual_px[role == kind]).max(axis=0)
        for axis, longest in zip("uv", largest, strict=True):
            for unit, factor in factors.items():
                row = table.pop((kind.name.lower(), axis, unit))
                assert (row.photo, row.n) == ("a.png", counts[kind])
                assert row.max == pytest.approx(longest * factor)
    assert not table


def test_numbers_that_nothing_determines_are_none() -> None:
    found = rows(np.ones((3, 2)), {"px": 1.0})["u", "px"]
    assert (found["beyond_cells"], found["skewness"], found["shift_p"]) == (None, None, 0.0)
    assert rows(np.array([[0.5, -0.5]]))["u", "px"]["shift_p"] is None
    assert residual_rows("a", "check", np.empty((0, 2)), UNITS) == []
