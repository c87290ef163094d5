"""What the simulation reports: the step of the scan, and its photos."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.simulate import deliverables

from orthoflow.files.images import encode_png
from orthoflow.products import Photo, Photos
from orthoflow.sdk import StepContext
from tests import samples
from tests.plane_scenes import cloud_of


@pytest.mark.parametrize("step_m", [0.005, 0.02])
def test_the_step_of_a_square_grid_is_its_spacing(step_m: float) -> None:
    at = np.arange(step_m / 2, 2.0, step_m)
    u, v = (grid.ravel() for grid in np.meshgrid(at, at))
    # Some points of another plane before it.
    beside = np.column_stack([u[:50], np.full(50, -0.3), v[:50]])
    cloud = cloud_of(np.vstack([np.column_stack([u, np.zeros(u.size), v]), beside]))
    planes = samples.planes(
        normal=np.array([[0.0, -1.0, 0.0]]),
        offset=np.zeros(1),
        corners=np.array([[[0.0, 0, 2], [0, 0, 0], [2, 0, 0], [2, 0, 2]]]),
        n_points=np.array([u.size]),
        names=("wall",),
    )
    truth: Any = SimpleNamespace(planes=planes, labels=np.repeat([0, -1], [u.size, 50]))
    step = deliverables.measured_step(truth, cloud, 0)
    assert step == pytest.approx((step_m, step_m), rel=1e-6)


@pytest.mark.usefixtures("charts")
def test_photos_are_reported_by_their_shots(tmp_path: Path) -> None:
    context = StepContext(rng=np.random.default_rng(1), cores=1, scratch=tmp_path)
    shots: Any = tuple(
        SimpleNamespace(taken=SimpleNamespace(gsd_m=gsd_m, obliquity_deg=obliquity))
        for gsd_m, obliquity in ((0.002, 5.0), (0.004, 30.0))
    )
    picture = encode_png(np.full((480, 640, 3), 90, dtype=np.uint8))
    photos = [Photo(name=name, encoded=picture, width=640, height=480) for name in "ab"]
    deliverables.report_photos(Photos(photos=tuple(photos)), shots, context)
    assert {metric.name: metric.value for metric in context.metrics} == {
        "n_photos": 2.0,
        "photo_megapixels": pytest.approx(2 * 0.3072),
        "photo_gsd_mm": pytest.approx(3.0),
        "photo_obliquity_max_deg": 30.0,
    }
    assert [figure.name for figure in context.figures] == ["photos"]
    silent = StepContext(rng=np.random.default_rng(1), cores=1, scratch=tmp_path)
    deliverables.report_photos(Photos(photos=()), (), silent)
    assert (silent.metrics, silent.figures) == ([], [])
