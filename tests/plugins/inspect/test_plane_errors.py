"""Planes beside true ones, and labels beside true labels, against counts and geometry by hand."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.inspect import plane_errors

from orthoflow.geometry import Plane
from orthoflow.products import Finding, Planes
from orthoflow.sdk import StepContext
from tests import samples

UP = np.array([0.0, 0.0, 1.0])


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


@pytest.mark.parametrize(
    ("found", "n_found"),
    [
        (floors(0.014, 3.0), 2.0),
        (floors(0.016, 3.0), 1.0),
        (floors(-0.014), 1.0),
        (floors(-0.016), 0.0),
        (floors(0.0, tilt_deg=0.9), 1.0),
        (floors(0.0, tilt_deg=1.1), 0.0),
        (floors(-0.01, 0.01, 0.02), 1.0),
    ],
    ids=["near", "above", "below", "too-low", "level", "tilted", "twice-the-same"],
)
def test_a_plane_is_found_within_a_degree_and_fifteen_millimetres(
    found: Planes, n_found: float
) -> None:
    findings = plane_errors.found_planes(found, floors(0.0, 3.0))
    assert counts(findings) == {"true_planes": 2.0, "true_planes_found": n_found}


def test_a_wall_is_off_by_angle_offset_and_corner() -> None:
    tilted = floors(0.01, tilt_deg=0.5)
    findings = plane_errors.wall_plane_findings(tilted.plane(0), 3, floors(0.0, 3.0))
    by_name = counts(findings)
    assert by_name["plane_angle_deg"] == pytest.approx(0.5, abs=1e-9)
    # It lies above the true one, on the viewer's side, by its distance along its own normal.
    lift_m = 0.01 * math.cos(math.radians(0.5))
    assert by_name["plane_offset_mm"] == pytest.approx(1e3 * lift_m)
    reach_m = math.sin(math.radians(0.5)) + lift_m
    assert by_name["plane_corner_max_mm"] == pytest.approx(1e3 * reach_m)
    assert {finding.wall for finding in findings} == {3}
    assert [finding.unit for finding in findings] == ["deg", "mm", "mm"]


@pytest.mark.parametrize(
    ("height_m", "tilt_deg", "shows"),
    [(0.028, 0.0, True), (0.032, 0.0, False), (0.0, 2.9, True), (0.0, 3.1, False)],
)
def test_a_wall_further_off_shows_no_true_plane(
    height_m: float, tilt_deg: float, shows: bool
) -> None:
    plane = floors(height_m, tilt_deg=tilt_deg).plane(0)
    assert bool(plane_errors.wall_plane_findings(plane, 0, floors(0.0))) is shows


def test_the_nearest_true_plane_weighs_degrees_as_fifteen_millimetres() -> None:
    # 12 mm from the lower, level one; 6 mm and 0.5 deg from the upper one.
    level, tilted = floors(0.0), floors(0.018, tilt_deg=0.5)
    true = Planes(
        **{
            name: np.concatenate([getattr(level, name), getattr(tilted, name)])
            for name in ("normal", "offset", "corners", "covariance", "n_points", "rms_m")
        },
        up=UP,
        names=("level", "tilted"),
    )
    plane = Plane(normal=UP, offset_m=0.012)
    findings = counts(plane_errors.wall_plane_findings(plane, 0, true))
    assert findings["plane_angle_deg"] == pytest.approx(0.0, abs=1e-6)
    nearer = Plane(normal=UP, offset_m=0.0135)
    findings = counts(plane_errors.wall_plane_findings(nearer, 0, true))
    assert findings["plane_angle_deg"] == pytest.approx(0.5, abs=1e-6)


def test_the_worst_of_all_walls_has_no_sign() -> None:
    findings = [
        Finding(name="plane_offset_mm", value=value, unit="mm", wall=wall)
        for wall, value in enumerate((3.0, -7.0, 5.0))
    ]
    (worst,) = plane_errors.worst_plane_findings(findings)
    assert worst == Finding(name="plane_offset_mm", value=7.0, unit="mm")
    assert plane_errors.worst_plane_findings([]) == []


def test_planes_without_labels_are_compared_alone(tmp_path: Path) -> None:
    truth: Any = SimpleNamespace(planes=floors(0.0, 3.0))
    ctx = StepContext(rng=np.random.default_rng(0), cores=1, scratch=tmp_path)
    found = plane_errors.inspect_planes(floors(-0.01, 3.004), None, None, truth, ctx)
    by_name = counts(list(found.findings))
    assert by_name["true_planes_found"] == 2.0
    assert not any("label" in name for name in by_name)
    # The main one without a name, the worst of both without a sign, and each by its name.
    offsets_mm = {name: value for name, value in by_name.items() if "offset" in name}
    assert offsets_mm == pytest.approx(
        {
            "plane_offset_mm": -10.0,
            "worst_plane_offset_mm": 10.0,
            "plane_offset_mm[floor 0]": -10.0,
            "plane_offset_mm[floor 1]": 4.0,
        }
    )
    told = {item.name: item.value for item in ctx.metrics}
    expected = {name: value for name, value in by_name.items() if "[" not in name}
    assert told == expected | {"main_found": 1.0}
    assert ctx.warnings == []


def test_a_main_wall_that_was_not_found_is_told(tmp_path: Path) -> None:
    truth: Any = SimpleNamespace(planes=floors(0.0, 3.0))
    ctx = StepContext(rng=np.random.default_rng(0), cores=1, scratch=tmp_path)
    plane_errors.inspect_planes(floors(3.0), None, None, truth, ctx)
    (warning,) = ctx.warnings
    assert "the main wall of the scene is none of the 1 planes" in warning
    told = {item.name: item.value for item in ctx.metrics}
    assert (told["main_found"], told["true_planes_found"]) == (0.0, 1.0)
    assert "plane_offset_mm" not in told


def test_points_are_counted_by_both_labels() -> None:
    found = np.array([-1, 0, 0, 2, 2, -1], dtype=np.int16)
    true = np.array([-1, 0, 0, 0, 1, 1], dtype=np.int16)
    joint = plane_errors._joint_counts(found, true, 2)
    # Rows: none, plane 0, plane 1; columns: none, 0, 1, 2.
    assert joint.tolist() == [[1, 0, 0, 0], [0, 2, 0, 1], [1, 0, 0, 1]]
    nothing = np.full(3, -1, dtype=np.int16)
    assert plane_errors._joint_counts(nothing, nothing, 2).tolist() == [[3], [0], [0]]


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
