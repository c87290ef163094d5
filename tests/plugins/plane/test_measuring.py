"""Thickness by class and along a row, from deviations that are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.cloud import prepare
from orthoflow_plugins.plane.planes import measure_planes
from orthoflow_plugins.plane.ransac import Ransac
from orthoflow_plugins.plane.thickness import RowPoints, measure_thickness, row_points
from pydantic import ValidationError

from orthoflow.products import PointCloud
from tests.plane_scenes import cloud_of

UP = np.array([0.0, 0.0, 1.0])


def spread_of(values: NDArray[np.float64]) -> float:
    """Robust standard deviation about zero."""
    return float(1.4826 * np.median(np.abs(values)))


# --- a row ---


def test_a_row_is_measured_piece_by_piece_about_its_means() -> None:
    rng = np.random.default_rng(1)
    along = np.sort(rng.uniform(0.0, 1.0, 300)) + 5.0
    # Relief by piece, and one piece with three points only.
    piece = np.floor((along - along[0]) / 0.1).astype(int)
    kept = (piece != 4) | (np.cumsum(piece == 4) <= 3)
    along, piece = along[kept], piece[kept]
    distance = 0.01 * piece + rng.normal(0.0, 0.001, len(along))
    intensity = rng.uniform(0.0, 1.0, len(along))
    row = RowPoints(row=7, scan=2, along_m=along, distance_m=distance, intensity=intensity)
    found = row.measured({"dark": (0.0, 0.5)})
    deviation, shown = [], []
    for k in np.unique(piece):
        mine = piece == k
        n = np.count_nonzero(mine)
        if n >= 4:
            deviation.append((distance[mine] - distance[mine].mean()) / np.sqrt(1.0 - 1.0 / n))
            shown.append(intensity[mine])
    values, shades = np.concatenate(deviation), np.concatenate(shown)
    assert (found.row, found.scan, found.n_points) == (7, 2, len(along))
    assert found.sigma_m == pytest.approx(spread_of(values), rel=1e-4)
    (dark,) = found.material
    assert dark.n_points == np.count_nonzero(shades <= 0.5)
    assert dark.sigma_m == pytest.approx(spread_of(values[shades <= 0.5]), rel=1e-4)
    assert replace(row, intensity=None).measured({"dark": (0.0, 0.5)}).material == ()
    thin = RowPoints(row=0, scan=0, along_m=np.arange(9.0), distance_m=np.ones(9), intensity=None)
    assert thin.measured({}).sigma_m is None


def wall_of_rows() -> tuple[PointCloud, Any]:
    """Two scans of a wall at y = 2 in rows of points; row 3 of scan 1 has most on the wall."""
    rng = np.random.default_rng(0)
    parts, rows, scans = [], [], []
    for scan in range(2):
        for row in range(5):
            count = 60 if (scan, row) == (1, 3) else 40
            x = rng.uniform(-1.0, 1.0, count)
            y = 2.0 + rng.normal(0.0, 0.001, count)
            # A few points of each row lie far before the wall.
            y[:5] = 0.5
            parts.append(np.column_stack([x, y, np.full(count, 0.1 * row)]))
            rows += [row] * count
            scans += [scan] * count
    plain = cloud_of(np.concatenate(parts), origin=(100.0, 200.0, 300.0))
    known = replace(
        plain,
        row=np.array(rows, dtype=np.uint32),
        scan=np.array(scans, dtype=np.uint16),
        intensity=np.linspace(0.0, 1.0, len(rows), dtype=np.float32),
    )
    planes: Any = type("P", (), {})()
    planes.normal = np.array([[0.0, -1.0, 0.0]])
    planes.offset = np.array([-202.0])
    planes.up = UP
    return known, planes


def test_the_row_with_most_points_on_the_first_plane_is_taken() -> None:
    known, planes = wall_of_rows()
    prepared = prepare(known, parts=1)
    on_wall = np.abs(known.y.astype(float) - 2.0) < 0.1
    prepared.claims[on_wall] = 0
    of_sample = np.where(on_wall, 0, -1)
    found = row_points(planes, of_sample, prepared, known)
    assert found is not None
    assert known.row is not None
    assert known.scan is not None
    assert (found.row, found.scan) == (3, 1)
    mine = np.flatnonzero(on_wall & (known.row == 3) & (known.scan == 1))
    order = mine[np.argsort(known.x[mine])]
    # To the right of a viewer in the south is east.
    np.testing.assert_allclose(found.along_m, known.x[order])
    np.testing.assert_allclose(found.distance_m, 2.0 - known.y[order].astype(float), atol=1e-12)
    np.testing.assert_allclose(found.intensity, known.intensity[order])
    # Without numbers of scans a row is one of all scans.
    blind = replace(known, scan=None, intensity=None)
    both = row_points(planes, of_sample, prepared, blind)
    assert both is not None
    assert (both.row, both.scan, both.intensity) == (3, 0, None)
    assert len(both.along_m) == 35 + 55
    assert row_points(planes, of_sample, prepared, replace(known, row=None)) is None
    nobody = np.full(len(of_sample), -1)
    assert row_points(planes, nobody, prepared, known) is None
    few = np.where(np.cumsum(on_wall) <= 19, of_sample, -1)
    prepared.claims[:] = np.where(few == 0, 0, -1)
    assert row_points(planes, few, prepared, known) is None


def test_thickness_needs_fifty_points_in_tiles_of_four() -> None:
    rng = np.random.default_rng(2)

    def thickness(n_points: int, per_tile: int) -> Any:
        tile = np.arange(n_points) // per_tile
        x = 0.1 * tile + 0.05
        points = np.column_stack(
            [x, 2.0 + rng.normal(0.0, 0.001, n_points), np.full(n_points, 0.05)]
        )
        known = cloud_of(np.vstack([points, [[0.0, 0.0, 9.0]]]))
        prepared = prepare(known, parts=1)
        planes: Any = type("P", (), {"__len__": lambda _: 1})()
        planes.normal, planes.offset, planes.up = np.array([[0.0, -1.0, 0.0]]), [-2.0], UP
        of_sample = np.append(np.zeros(n_points, dtype=np.int64), -1)
        (found,) = measure_thickness(planes, of_sample, prepared, known, 0.05, {})
        return found

    assert thickness(52, 4) is not None
    assert thickness(48, 4) is None
    assert thickness(90, 3) is None
    found = thickness(4_000, 40)
    assert found.sigma_m == pytest.approx(0.001, rel=0.05)
    assert found.width_95_m == pytest.approx(3.92 * 0.001, rel=0.05)
    # Forty points on a square decimetre.
    assert found.scan_step_m == pytest.approx(0.1 / np.sqrt(40.0))


@pytest.mark.parametrize(
    ("materials", "sentence"),
    [
        ({"a": (0.3, 0.2)}, "intensities of a must ascend between 0 and 1, got 0.3 and 0.2"),
        ({"a": (0.2, 0.2)}, "must ascend"),
        ({"a": (-0.1, 0.2)}, "must ascend"),
        ({"a": (0.1, 1.1)}, "must ascend"),
        ({"b": (0.2, 0.5), "a": (0.0, 0.3)}, "intensities of b begin at 0.2, below 0.3 where"),
    ],
)
def test_materials_that_overlap_or_fall_are_refused(
    materials: dict[str, tuple[float, float]], sentence: str
) -> None:
    with pytest.raises(ValidationError, match=sentence):
        Ransac.Params.model_validate({"materials": materials})


def test_materials_may_touch() -> None:
    touching = {"b": (0.3, 1.0), "a": (0.0, 0.3)}
    assert Ransac.Params.model_validate({"materials": touching}).materials == touching


# --- all points ---


@pytest.mark.parametrize("parts", [1, 3])
def test_planes_are_measured_on_all_points_that_they_have(parts: int) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (3_000, 3))
    prepared = prepare(cloud_of(points), parts=parts)
    seen = prepared.sample.offsets_m
    # Level planes at -0.5, 0 and 0.5; the last has no points.
    heights = np.array([-0.5, 0.0, 0.5])
    slabs = np.array([[0, 0, 1.0, h, 1.0, 0, 0, 0.1, 0, 1.0, 0, -0.2] for h in heights])
    find_m, fit_m = 0.2, 0.1
    claims = np.full(3_000, -1)
    for k in range(2):
        claims[np.abs(seen[:, 2] - heights[k]) <= find_m] = k
    prepared.claims[:] = claims
    bounds = np.array([[-0.9, 0.8, -0.7, 0.9]] * 3)
    found = measure_planes(prepared, slabs, bounds, tolerance_m=find_m, fit_tolerance_m=fit_m)
    for k in range(2):
        away = seen[claims == k, 2] - heights[k]
        fits = np.abs(away) <= fit_m
        u, v = seen[claims == k, 0] - 0.1, seen[claims == k, 1] + 0.2
        held = fits & (u >= -0.9) & (u <= 0.8) & (v >= -0.7) & (v <= 0.9)
        assert (found.n_points[k], found.n_fit[k]) == (len(away), fits.sum())
        assert found.rms_m[k] == pytest.approx(np.sqrt((away**2).mean()), rel=1e-4)
        assert found.rms_fit_m[k] == pytest.approx(np.sqrt((away[fits] ** 2).mean()), rel=1e-4)
        assert found.mean_fit_m[k] == pytest.approx(away[fits].mean(), abs=1e-5)
        assert found.histogram[k].sum() == len(away)
        sides = [u[held].min(), u[held].max(), v[held].min(), v[held].max()]
        np.testing.assert_allclose(found.extents_m[k], sides, atol=1e-6)
    assert (found.n_points[2], found.rms_m[2], found.mean_fit_m[2]) == (0, 0.0, 0.0)
    # Without points near it a plane reaches as far as its rectangle.
    np.testing.assert_array_equal(found.extents_m[2], bounds[2])
    # A fit tolerance beyond the find tolerance is none.
    wide = measure_planes(prepared, slabs, bounds, tolerance_m=fit_m, fit_tolerance_m=find_m)
    assert wide.fit_tolerance_m == wide.tolerance_m == fit_m
    order = np.array([1, 0, 2])
    turned = found.take(order)
    for name in ("n_points", "rms_m", "n_fit", "rms_fit_m", "mean_fit_m", "histogram"):
        np.testing.assert_array_equal(getattr(turned, name), getattr(found, name)[order])
    assert (turned.tolerance_m, turned.fit_tolerance_m) == (find_m, fit_m)
