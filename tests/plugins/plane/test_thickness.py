"""Thickness of the cloud: noise is measured, relief and bow are not, by class and along a row."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.cloud import prepare
from orthoflow_plugins.plane.ransac import Ransac
from orthoflow_plugins.plane.thickness import row_points
from pydantic import ValidationError

from orthoflow.errors import MethodError
from orthoflow.products import PointCloud
from tests import plane_scenes
from tests.plane_scenes import cloud_of

# A wall of 6 x 3 m at y = 2, seen from the middle of a room.
STATION = np.array([[0.0, 0.0, 0.0]])
N_POINTS = 90_000


def wall(noise_m: NDArray[np.float64] | float, *, bow_m: float = 0.0) -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    x, z = rng.uniform(-3.0, 3.0, N_POINTS), rng.uniform(-1.5, 1.5, N_POINTS)
    y = 2.0 + bow_m * (x / 3.0) ** 2 + rng.normal(0.0, 1.0, N_POINTS) * noise_m
    return np.column_stack([x, y, z])


def detect(cloud: PointCloud, folder: Path, **params: object) -> tuple[Any, dict[str, float]]:
    out, ctx = plane_scenes.detect(Ransac, cloud, folder, **params)
    return out.planes, {metric.name: metric.value for metric in ctx.metrics}


@pytest.mark.parametrize(("noise_m", "bow_m"), [(0.001, 0.0), (0.001, 0.006), (0.004, 0.006)])
def test_thickness_is_the_noise_and_not_the_bow(
    noise_m: float, bow_m: float, tmp_path: Path
) -> None:
    _, metrics = detect(cloud_of(wall(noise_m, bow_m=bow_m), stations=STATION), tmp_path)
    # 50 points in a tile, 90 000 in all: half a percent; a bow of 6 mm slopes little in a tile.
    assert metrics["thickness_mm"] == pytest.approx(1000.0 * noise_m, rel=0.03)
    assert metrics["thickness_width_mm"] == pytest.approx(3.92 * 1000.0 * noise_m, rel=0.03)
    assert metrics["thickest_mm"] == metrics["thickness_mm"]
    step_mm = 1000.0 * np.sqrt(18.0 / N_POINTS)
    assert metrics["scan_step_mm"] == pytest.approx(step_mm, rel=0.03)
    assert metrics["thickness_scan_steps"] == pytest.approx(1000.0 * noise_m / step_mm, rel=0.05)


@pytest.mark.usefixtures("charts")
def test_materials_have_a_thickness_each_on_the_plane_and_along_a_row(tmp_path: Path) -> None:
    fabric = wall(0.0)[:, 0] > 0.0
    intensity = np.where(fabric, 0.2, 0.8) + np.random.default_rng(1).normal(0, 0.02, N_POINTS)
    cloud = dataclasses.replace(
        cloud_of(wall(np.where(fabric, 0.004, 0.001))),
        intensity=intensity.astype(np.float32),
        row=np.repeat(np.arange(30), N_POINTS // 30).astype(np.uint32),
        column=np.zeros(N_POINTS, dtype=np.uint32),
    )
    names = {"fabric": (0.0, 0.5), "plaster": (0.5, 1.0)}
    planes, _ = detect(cloud, tmp_path, materials=names)
    thickness, row = planes.thickness[0], planes.scan_row
    for spreads, rel in ((thickness.material, 0.05), (row.material, 0.15)):
        assert [item.name for item in spreads] == ["fabric", "plaster"]
        assert spreads[0].sigma_m == pytest.approx(0.004, rel=rel)
        assert spreads[1].sigma_m == pytest.approx(0.001, rel=rel)
    assert row.n_points == 3000
    with pytest.raises(MethodError, match="omit materials"):
        detect(cloud_of(wall(0.002)), tmp_path, materials=names)


@pytest.mark.parametrize(
    ("materials", "message"),
    [
        ({"a": (0.2, 0.2)}, "intensities of a must ascend between 0 and 1, got 0.2 and 0.2"),
        ({"a": (0.1, 1.1)}, "must ascend"),
        ({"b": (0.2, 0.5), "a": (0.0, 0.3)}, "intensities of b begin at 0.2, below 0.3 where"),
    ],
)
def test_materials_that_overlap_or_fall_are_refused(
    materials: dict[str, tuple[float, float]], message: str
) -> None:
    with pytest.raises(ValidationError, match=message):
        Ransac.Params.model_validate({"materials": materials})


def test_the_row_with_most_points_on_the_first_plane_is_taken() -> None:
    # Two scans of a wall at y = 2 in rows of points; row 3 of scan 1 has most on the wall.
    rng = np.random.default_rng(0)
    count = np.array([[40, 40, 40, 40, 40], [40, 40, 40, 60, 40]])
    scan, row = (np.repeat(index.ravel(), count.ravel()) for index in np.indices(count.shape))
    y = 2.0 + rng.normal(0.0, 0.001, len(row))
    # A few points of each row lie far before the wall.
    y[np.unique(10 * scan + row, return_index=True)[1][:, None] + np.arange(5)] = 0.5
    points = np.column_stack([rng.uniform(-1.0, 1.0, len(row)), y, 0.1 * row])
    known = dataclasses.replace(
        cloud_of(points, origin=(100.0, 200.0, 300.0)),
        row=row.astype(np.uint32),
        scan=scan.astype(np.uint16),
        intensity=np.linspace(0.0, 1.0, len(row), dtype=np.float32),
    )
    planes: Any = SimpleNamespace(
        normal=np.array([[0.0, -1.0, 0.0]]), offset=np.array([-202.0]), up=np.array([0, 0, 1.0])
    )
    cloud = prepare(known, parts=1)
    on_wall = np.abs(y - 2.0) < 0.1
    cloud.claims[on_wall] = 0
    of_sample = np.where(on_wall, 0, -1)
    found = row_points(planes, of_sample, cloud, known)
    assert found is not None
    assert (found.row, found.scan) == (3, 1)
    mine = np.flatnonzero(on_wall & (row == 3) & (scan == 1))
    order = mine[np.argsort(known.x[mine])]
    # To the right of a viewer in the south is east.
    np.testing.assert_allclose(found.along_m, known.x[order])
    np.testing.assert_allclose(found.distance_m, 2.0 - known.y[order].astype(float), atol=1e-12)
    np.testing.assert_allclose(found.intensity, np.asarray(known.intensity)[order])
    # Without numbers of scans a row is one of all scans.
    blind = dataclasses.replace(known, scan=None, intensity=None)
    both = row_points(planes, of_sample, cloud, blind)
    assert both is not None
    assert (both.row, both.scan, both.intensity, len(both.along_m)) == (3, 0, None, 35 + 55)
    # Neither rows nor points, or fewer than twenty.
    assert row_points(planes, of_sample, cloud, dataclasses.replace(known, row=None)) is None
    assert row_points(planes, np.full(len(of_sample), -1), cloud, known) is None
    cloud.claims[:] = np.where(np.cumsum(on_wall) <= 19, of_sample, -1)
    assert row_points(planes, cloud.claims.astype(int), cloud, known) is None
