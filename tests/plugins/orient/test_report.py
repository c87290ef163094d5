"""The table of residuals: every number against its definition, worked out by hand."""

from __future__ import annotations

from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.orient.report import (
    numbers_json,
    residual_rows,
    residual_table,
)

from orthoflow.geometry.cameras import LensFreedom
from orthoflow.geometry.resection import Resection, SeenPoints
from orthoflow.testing import photographed as ms

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


# --- a whole photo ---

CAMERA = replace(
    ms.camera_before(ms.textured_wall(0)), distortion=np.array([-0.09, 0.0, 0.0, 0.0, 0.0])
)
CONTROL = np.array([True, True, True, False, False, False])
CHECKED = np.array([False, False, False, True, True, False])


def candidate(**changes: Any) -> Any:
    """Six ties 2 m before a camera: three control, two withheld, one rejected."""
    lens = LensFreedom(focal_sigma=0.05, k1_sigma=0.1)
    resection = Resection(
        camera=CAMERA,
        covariance=np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 4e-6, 9e-6]),
        sigma0=1.25,
        variance_factor=1.5,
        lens=changes.pop("lens", lens),
    )
    residuals = np.array(
        [[1.0, -1.0], [1.0, 1.0], [-2.0, 2.0], [3.0, 1.0], [1.0, 3.0], [90.0, 9.0]]
    )
    estimate = SimpleNamespace(
        fit=SimpleNamespace(residuals_px=residuals),
        resection=resection,
        agreeing=CONTROL | CHECKED,
        limit=4.5,
        source="exif",
        numbers={"skew_px": 0.3},
    )
    points = CAMERA.centre_world + 2.0 * np.tile(CAMERA.rotation[2], (6, 1))
    # What does not determine the pose lies far away, where pixels are larger.
    points[~CONTROL] += 50.0 * CAMERA.rotation[2]
    usual: dict[str, Any] = {
        "photo": SimpleNamespace(name="a.jpg"),
        "seen": SeenPoints(
            pixels_photo=np.zeros((6, 2)),
            points_world=points,
            sigma_px=np.ones(6),
            sigma_m=np.zeros(6),
        ),
        "control": CONTROL,
        "checked": CHECKED,
        "estimate": estimate,
        "hull_ratio": 0.7,
        "gsd_m": 0.002,
        "gsd_mm": 2.0,
        "error": SimpleNamespace(
            rms_mm=1.0, worst_mm=3.0, corners_m=np.array([0.004, np.nan, 0.002, 0.001])
        ),
    }
    return SimpleNamespace(**{**usual, **changes})


PIXEL_MM = 2000.0 / np.sqrt(CAMERA.fx * CAMERA.fy)


def test_an_orientation_is_recorded_with_its_lens_and_errors() -> None:
    of = candidate()
    entry = numbers_json(of)
    assert entry == {
        "n_control": 3,
        "n_check": 2,
        "n_rejected": 1,
        "pixel_mm": pytest.approx(PIXEL_MM),
        "hull_ratio": 0.7,
        "limit_sigma": 4.5,
        "sigma0": 1.25,
        "variance_factor": 1.5,
        "lens": "exif",
        "focal_px": CAMERA.fx,
        "k1": -0.09,
        "skew_px": 0.3,
        "sigma_wall_mm": 1.0,
        "sigma_wall_worst_mm": 3.0,
        "sigma_image_corners_mm": [4.0, None, 2.0, 1.0],
        # Of the logarithm of the focal length: two thousandths.
        "focal_sigma_px": pytest.approx(0.002 * CAMERA.fx),
    }
    fixed = candidate(lens=LensFreedom(), error=None)
    left = numbers_json(fixed)
    assert set(entry) - set(left) == {
        "sigma_wall_mm",
        "sigma_wall_worst_mm",
        "sigma_image_corners_mm",
        "focal_sigma_px",
    }


@pytest.mark.parametrize("gsd_m", [0.002, None])
def test_the_table_has_control_and_check_in_units_of_the_wall(gsd_m: float | None) -> None:
    of = candidate(gsd_m=gsd_m)
    table = residual_table(of)
    units = ["px", "mm", *(["cell"] if gsd_m else [])]
    assert [(row.role, row.axis, row.unit) for row in table] == [
        (role, axis, unit) for role in ("control", "check") for axis in "uv" for unit in units
    ]
    assert {row.photo for row in table} == {"a.jpg"}
    by = {(row.role, row.axis, row.unit): row for row in table}
    assert (by["control", "u", "px"].n, by["check", "u", "px"].n) == (3, 2)
    assert by["control", "u", "px"].max == 2.0
    assert by["check", "v", "mm"].max == pytest.approx(3.0 * PIXEL_MM)
    if gsd_m:
        assert by["check", "v", "cell"].max == pytest.approx(3.0 * PIXEL_MM / 2.0)


def test_numbers_that_nothing_determines_are_none() -> None:
    found = rows(np.ones((3, 2)), {"px": 1.0})["u", "px"]
    assert (found["beyond_cells"], found["skewness"], found["shift_p"]) == (None, None, 0.0)
    assert rows(np.array([[0.5, -0.5]]))["u", "px"]["shift_p"] is None
    assert residual_rows("a", "check", np.empty((0, 2)), UNITS) == []
