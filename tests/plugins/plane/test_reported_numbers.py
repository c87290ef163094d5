"""The numbers that every detector reports are those of the products that it hands on."""

from __future__ import annotations

from itertools import count
from pathlib import Path

import numpy as np
import pytest

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.diagnostics import Diagnostic
from orthoflow.geometry import omega_phi_deg
from orthoflow.products import Planes, PointLabels
from orthoflow.sdk import StepContext
from orthoflow.testing import example_room

DETECTORS = ["plane.hough2d", "plane.hough3d", "plane.ransac", "plane.region"]
N_POINTS = 40_000


@pytest.mark.parametrize("method_id", DETECTORS)
def test_metrics_are_those_of_the_planes_and_labels(method_id: str, tmp_path: Path) -> None:
    cloud, true = example_room(n_points=N_POINTS)
    method = discover_catalog().method(method_id).load()
    # A clock that goes on when it is asked: once at the beginning, for each plane, and at the end.
    clock, processor = count(), count(step=10)
    ctx = StepContext(
        rng=np.random.default_rng(3),
        cores=1,
        scratch=tmp_path,
        clock_s=lambda: float(next(clock)),
        processor_s=lambda: float(next(processor)),
    )
    out = vars(method().run(method.In(cloud=cloud), method.Params(), ctx))
    planes, labels = out["planes"], out["labels"]
    assert isinstance(planes, Planes)
    assert isinstance(labels, PointLabels)
    told = {metric.name: metric.value for metric in ctx.metrics}
    counts = np.bincount(labels.plane_index[labels.plane_index >= 0], minlength=len(planes))
    assert told["n_planes"] == len(planes) == len(true)
    np.testing.assert_array_equal(planes.n_points, counts)
    assert told["labelled_share"] == pytest.approx(counts.sum() / len(cloud), rel=1e-12)
    assert told["first_share"] == pytest.approx(counts[0] / len(cloud), rel=1e-12)
    assert told["rms_mm"] == pytest.approx(1e3 * planes.rms_m[0], rel=1e-12)
    # 2 mm of noise; all labelled points are at least those of the fit.
    assert told["rms_mm"] == pytest.approx(2.0, rel=0.1)
    assert told["fit_rms_mm"] <= told["rms_mm"]
    omega_deg, phi_deg = omega_phi_deg(planes.normal[0], planes.up)
    assert (told["omega_deg"], told["phi_deg"]) == (omega_deg, phi_deg)
    assert planes.up.tolist() == true.up.tolist()
    distances = planes.plane(0).distances_m(cloud.points_world()[labels.plane_index == 0])
    seconds = {name: value for name, value in told.items() if name.endswith("_s")}
    assert seconds == {
        "detection_s": len(true) + 1,
        "detection_cpu_s": 10 * (len(true) + 1),
        "first_plane_s": 1,
        "first_plane_cpu_s": 10,
        "next_plane_s": 1,
        "next_plane_cpu_s": 10,
    }
    assert np.sqrt(np.mean(distances**2)) == pytest.approx(planes.rms_m[0], rel=1e-3)


def test_points_on_no_plane_are_reported_where_they_are_more_than_on_any(tmp_path: Path) -> None:
    cloud, true = example_room(n_points=N_POINTS)
    method = discover_catalog().method("plane.hough2d").load()

    def reported(**params: object) -> tuple[list[Diagnostic], float]:
        ctx = StepContext(rng=np.random.default_rng(3), cores=1, scratch=tmp_path)
        method().run(method.In(cloud=cloud), method.Params(**params), ctx)
        (share,) = (item.value for item in ctx.metrics if item.name == "labelled_share")
        return [item for item in ctx.diagnostics if item.code == "points-on-no-plane"], share

    assert reported() == ([], pytest.approx(1.0, abs=0.05))
    # The largest of several walls has less than half of the points.
    (told,), labelled_share = reported(n_planes_max=1)
    assert len(true) > 2
    assert told.values["share"] == pytest.approx(1.0 - labelled_share)
    assert told.values["largest"] == pytest.approx(labelled_share)
