"""Thickness of the cloud: noise is measured, relief and bow are not, and classes are told apart."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.ransac import Ransac
from pydantic import ValidationError

from orthoflow.errors import MethodError
from orthoflow.products import PointCloud
from orthoflow.sdk import StepContext
from tests.plane_scenes import cloud_of, context

# A wall of 6 x 3 m at y = 2, seen from the middle of a room.
STATION = np.array([[0.0, 0.0, 0.0]])
N_POINTS = 90_000


def wall(noise_m: NDArray[np.float64] | float, *, bow_m: float = 0.0) -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    x, z = rng.uniform(-3.0, 3.0, N_POINTS), rng.uniform(-1.5, 1.5, N_POINTS)
    y = 2.0 + bow_m * (x / 3.0) ** 2 + rng.normal(0.0, 1.0, N_POINTS) * noise_m
    return np.column_stack([x, y, z])


def detect(
    cloud: PointCloud, folder: Path, **params: object
) -> tuple[Any, StepContext, dict[str, float]]:
    ctx = context(folder)
    out = Ransac().run(Ransac.In(cloud=cloud), Ransac.Params(**params), ctx)
    return out, ctx, {metric.name: metric.value for metric in ctx.metrics}


@pytest.mark.parametrize("noise_m", [0.001, 0.004])
@pytest.mark.parametrize("bow_m", [0.0, 0.006], ids=["flat", "bowed"])
def test_thickness_is_the_noise_and_not_the_bow(
    noise_m: float, bow_m: float, tmp_path: Path
) -> None:
    _, _, metrics = detect(cloud_of(wall(noise_m, bow_m=bow_m), stations=STATION), tmp_path)
    # 50 points in a tile, 90 000 in all: half a percent; a bow of 6 mm slopes little in a tile.
    assert metrics["thickness_mm"] == pytest.approx(1000.0 * noise_m, rel=0.03)
    assert metrics["thickness_width_mm"] == pytest.approx(3.92 * 1000.0 * noise_m, rel=0.03)
    assert metrics["thickest_mm"] == metrics["thickness_mm"]


def test_the_scan_step_is_that_of_the_points_on_the_plane(tmp_path: Path) -> None:
    _, _, metrics = detect(cloud_of(wall(0.002)), tmp_path)
    step_mm = 1000.0 * np.sqrt(18.0 / N_POINTS)
    assert metrics["scan_step_mm"] == pytest.approx(step_mm, rel=0.03)
    assert metrics["thickness_scan_steps"] == pytest.approx(2.0 / step_mm, rel=0.05)


@pytest.mark.usefixtures("charts")
def test_noise_that_grows_with_incidence_and_range_is_told_by_class(tmp_path: Path) -> None:
    flat = wall(0.0)
    range_m = np.linalg.norm(flat, axis=1)
    incidence = np.arccos(2.0 / range_m)
    noise_m = 0.001 + 0.003 * incidence
    out, ctx, _ = detect(cloud_of(wall(noise_m), stations=STATION), tmp_path)
    classes = out.planes.thickness[0]
    assert len(classes.incidence_deg) >= 5
    for item in classes.incidence_deg:
        middle = np.radians(0.5 * (item.low + item.high))
        assert item.sigma_m == pytest.approx(0.001 + 0.003 * middle, rel=0.1)
    sigmas = [item.sigma_m for item in classes.range_m]
    assert sigmas == sorted(sigmas)
    assert sum(item.n_points for item in classes.range_m) > 0.95 * N_POINTS
    assert "thickness" in {figure.name for figure in ctx.figures}


def test_a_material_that_scatters_more_is_told_by_its_intensity(tmp_path: Path) -> None:
    flat = wall(0.0)
    fabric = flat[:, 0] > 0.0
    points = wall(np.where(fabric, 0.004, 0.001))
    intensity = np.where(fabric, 0.2, 0.8) + np.random.default_rng(1).normal(0, 0.02, N_POINTS)
    cloud = dataclasses.replace(cloud_of(points), intensity=intensity.astype(np.float32))
    classes = detect(cloud, tmp_path)[0].planes.thickness[0]
    assert classes.incidence_deg == ()
    assert classes.intensity[0].sigma_m == pytest.approx(0.004, rel=0.05)
    assert classes.intensity[-1].sigma_m == pytest.approx(0.001, rel=0.05)


@pytest.mark.usefixtures("charts")
def test_named_materials_have_a_thickness_each_on_the_plane_and_along_a_row(
    tmp_path: Path,
) -> None:
    fabric = wall(0.0)[:, 0] > 0.0
    points = wall(np.where(fabric, 0.004, 0.001))
    intensity = np.where(fabric, 0.2, 0.8) + np.random.default_rng(1).normal(0, 0.02, N_POINTS)
    cloud = dataclasses.replace(
        cloud_of(points),
        intensity=intensity.astype(np.float32),
        row=np.repeat(np.arange(30), N_POINTS // 30).astype(np.uint32),
        column=np.zeros(N_POINTS, dtype=np.uint32),
    )
    names = {"fabric": (0.0, 0.5), "plaster": (0.5, 1.0), "glass": (0.99, 1.0)}
    with pytest.raises(ValidationError, match=r"begin at 0.99, below 1 where"):
        Ransac.Params(materials=names)
    del names["glass"]
    out, _, _ = detect(cloud, tmp_path, materials=names)
    thickness, row = out.planes.thickness[0], out.planes.scan_row
    for spreads, rel in ((thickness.material, 0.05), (row.material, 0.15)):
        assert [item.name for item in spreads] == ["fabric", "plaster"]
        assert spreads[0].sigma_m == pytest.approx(0.004, rel=rel)
        assert spreads[1].sigma_m == pytest.approx(0.001, rel=rel)
    assert row.n_points == 3000


def test_materials_need_intensities(tmp_path: Path) -> None:
    with pytest.raises(MethodError, match="leave out materials"):
        detect(cloud_of(wall(0.002)), tmp_path, materials={"fabric": (0.0, 0.5)})


@pytest.mark.usefixtures("charts")
def test_one_row_of_the_scan_is_drawn_where_rows_are_known(tmp_path: Path) -> None:
    from orthoflow_plugins.plane import search

    rows = []
    cloud = cloud_of(wall(0.002), stations=STATION)
    row = np.repeat(np.arange(300), N_POINTS // 300).astype(np.uint32)
    cloud = dataclasses.replace(cloud, row=row, column=np.zeros(N_POINTS, dtype=np.uint32))
    original = search.row_points

    def kept(*arguments: Any) -> Any:
        rows.append(original(*arguments))
        return rows[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "row_points", kept)
        detect(cloud, tmp_path)
    (found,) = rows
    assert len(found.along_m) == 300
    assert (np.diff(found.along_m) >= 0.0).all()
    # A hundred or so points of 2 mm noise.
    assert np.std(found.distance_m) == pytest.approx(0.002, rel=0.15)


def test_a_view_point_that_was_stated_is_no_station(tmp_path: Path) -> None:
    cloud = cloud_of(wall(0.002), stations=STATION, source="view_from")
    classes = detect(cloud, tmp_path)[0].planes.thickness[0]
    assert classes.sigma_m < classes.width_95_m
    assert classes.scan_step_m > 0.0
    by_class = (classes.incidence_deg, classes.range_m, classes.intensity, classes.material)
    assert by_class == ((), (), (), ())
