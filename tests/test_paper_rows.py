"""Rows of docs/papers.md recomputed with numpy, scipy and OpenCV from the papers' own words.

Others are recomputed beside their modules in tests/plugins: votes of cells and places
(plane/test_votes), inPaint (ortho/test_direct), residuals (orient/test_report), matches with
a ratio (match/test_sift).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from orthoflow_plugins.inspect.findings import check_findings
from orthoflow_plugins.inspect.image_quality import OrthoimageGrey
from orthoflow_plugins.inspect.key_pairs import find_key_pairs
from orthoflow_plugins.orient.dlt import direct_linear
from orthoflow_plugins.ortho.filling import fillable_gaps
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect
from orthoflow_plugins.plane.hough import PlanProposer
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.planes import normality
from orthoflow_plugins.register.similarity import fit_similarity
from scipy import ndimage, stats

from orthoflow.geometry import frame_over
from orthoflow.geometry.key_points import mutual_matches
from tests import raster_scenes, samples
from tests.inspect_scenes import displaced
from tests.plane_scenes import ROOM, prepared, sampled, search_in, turned


def normal_of(omega_deg: float, phi_deg: float) -> NDArray[np.float64]:
    """Equation 3 of markiewicz2015."""
    omega, phi = np.radians([omega_deg, phi_deg])
    return np.array([np.cos(phi) * np.cos(omega), np.cos(phi) * np.sin(omega), np.sin(phi)])


@pytest.mark.parametrize("accumulator", ["counts", "unit"])
def test_the_fullest_bin_of_the_plan(accumulator: str) -> None:
    """Figures 10b and 10c of markiewicz2015: cells of 20 mm vote for lines at steps of 1 deg."""
    points = sampled(ROOM[:4]) @ turned(17.37).T
    search = search_in(prepared(points), min_share=0.02)
    params = Hough2d.Params.model_validate(
        {"scoring": "votes", "accumulator": accumulator, "constraint": "vertical"}
    )
    found = PlanProposer(search, params).propose(search)
    assert found is not None
    cells, votes = np.unique(np.floor(points[:, :2] / 0.02), axis=0, return_counts=True)
    weights = votes if accumulator == "counts" else np.ones(len(votes))
    centres = 0.02 * (cells + 0.5)
    counted = np.array(
        [
            np.histogram(centres @ normal_of(omega, 0.0)[:2], 500, (-5.0, 5.0), weights=weights)[0]
            for omega in range(180)
        ]
    )
    omega, place = np.unravel_index(int(counted.argmax()), counted.shape)
    normal, r_m = normal_of(float(omega), 0.0), -5.0 + 0.02 * (place + 0.5)
    sign = np.sign(found.plane.normal @ normal)
    # Cells and bins begin elsewhere, and votes are shared between two bins.
    np.testing.assert_allclose(sign * found.plane.normal, normal, atol=np.radians(1.01))
    assert float(sign * found.plane.offset_m) == pytest.approx(r_m, abs=0.06)


def test_deviations_from_a_plane() -> None:
    """Figures 6c, 7c, 11c and 14c of markiewicz2015: moments of the deviations, by scipy."""
    distances_m = np.random.default_rng(2).gamma(9.0, 0.001, 200_000) - 0.009
    counts = np.histogram(distances_m, 200, (-0.05, 0.05))[0].astype(np.int64)
    shape = normality(counts, tolerance_m=0.05, fit_tolerance_m=0.05)
    assert shape is not None
    assert shape.sigma_m == pytest.approx(distances_m.std(), rel=0.01)
    assert shape.skewness == pytest.approx(stats.skew(distances_m), abs=0.03)
    assert shape.excess_kurtosis == pytest.approx(stats.kurtosis(distances_m), abs=0.1)


def test_best_match() -> None:
    """4.3 of markiewicz2015: the mutual nearest neighbours, by OpenCV."""
    rng = np.random.default_rng(3)
    first = rng.integers(0, 120, (400, 128)).astype(np.float32)
    second = (first[:300] + rng.integers(-30, 31, (300, 128))).astype(np.float32)
    expected = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(first, second)
    found = mutual_matches(first, second, ratio=1.0)
    pairs = set(zip(found.first.tolist(), found.second.tolist(), strict=True))
    assert pairs == {(match.queryIdx, match.trainIdx) for match in expected}


def test_eleven_parameters() -> None:
    """4.3.3 of markiewicz2015: the DLT as the null space of its equations, by numpy."""
    rng = np.random.default_rng(4)
    points = rng.uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 5.0], (60, 3))
    matrix = np.array([[3000.0, 8.0, 2010.0], [0.0, 3010.0, 1490.0], [0.0, 0.0, 1.0]])
    seen = points @ matrix.T
    pixels = seen[:, :2] / seen[:, 2:] + rng.normal(0.0, 0.5, (60, 2))
    # Both shifted and scaled, as the equations need it.
    shift_p, shift_x = pixels.mean(axis=0), points.mean(axis=0)
    u, v = ((pixels - shift_p) / 1000.0).T
    ones = np.ones((60, 1))
    x = np.hstack([points - shift_x, ones])
    zero = np.zeros_like(x)
    rows = np.vstack([np.hstack([x, zero, -u[:, None] * x]), np.hstack([zero, x, -v[:, None] * x])])
    projection = np.linalg.svd(rows)[2][-1].reshape(3, 4)
    back = x @ projection.T
    expected = 1000.0 * back[:, :2] / back[:, 2:] + shift_p
    found = direct_linear(pixels, points, (4000, 3000))[0].project(points)[:, :2]
    # Pixels: the same equations in other weights, far below the noise of 0.5 px.
    np.testing.assert_allclose(found, expected, atol=0.1)


def test_surf_key_points() -> None:
    """3.5.2 of markiewicz2015: key points are extrema of the Hessian's determinant, by scipy."""
    shown, reference = (OrthoimageGrey(displaced(*by)) for by in ((1.4, -0.6), (0.0, 0.0)))
    pairs = find_key_pairs(shown, reference, radius_cells=20.0)
    assert len(pairs) >= 50
    # Key points of two pictures are two cells apart at least, so that each pair is off by one.
    np.testing.assert_allclose(pairs.found.mean(axis=0), [1.4, -0.6], atol=0.25)
    picture = shown.whole().grey.astype(np.float64)

    def curvature(sigma: float) -> NDArray[np.float64]:
        xx, yy, xy = (
            ndimage.gaussian_filter(picture, sigma, order=order)
            for order in ((0, 2), (2, 0), (1, 1))
        )
        return np.asarray(sigma**4 * (xx * yy - xy**2))

    strongest = np.max([curvature(sigma) for sigma in (1.2, 1.8, 2.6, 3.8, 5.6)], axis=0)
    column, row = np.floor(pairs.centre - pairs.found / 2.0).astype(int).T
    assert np.median(strongest[row, column]) > 3.0 * np.median(strongest)


def test_the_highest_point_paints_its_pixel(tmp_path: Path) -> None:
    """Figures 1 and 2 of skarlatos2012, by a sort."""
    known = raster_scenes.leaning_wall()
    rows, columns = known.shape
    rng = np.random.default_rng(6)
    at = rng.uniform([0.0, 0.0], [columns, rows], (3000, 2))
    height_m = rng.uniform(-0.1, 0.1, 3000)
    rgb = rng.integers(1, 256, (3000, 3)).astype(np.uint8)
    cloud = raster_scenes.cloud_of(known.world(at[:, 0], at[:, 1], height_m), rgb=rgb)
    frame = frame_over(known.planes().corners[0], known.normal, gsd_m=known.gsd_m)
    walls = samples.walls(samples.wall(frame), buffer_m=0.15)
    layer = (
        PointcloudDirect()
        .run(
            PointcloudDirect.In(walls=walls, cloud=cloud),
            PointcloudDirect.Params.model_validate({"inpaint": "none"}),
            raster_scenes.context(tmp_path),
        )
        .layers.layers[0]
    )
    expected = np.zeros((rows, columns, 3), dtype=np.uint8)
    for point in np.argsort(height_m):
        expected[int(at[point, 1]), int(at[point, 0])] = rgb[point]
    np.testing.assert_array_equal(layer.rgb, expected)


def test_three_windows() -> None:
    """3 and 4.3 of skarlatos2012: 7, 23 and 46 void cells at most."""
    rng = np.random.default_rng(7)
    is_void = rng.random((60, 70)) < 0.5
    expected = is_void.copy()
    for window, limit in ((3, 7), (5, 23), (7, 46)):
        # Cells outside the raster count as void, which the paper leaves open.
        padded = np.pad(is_void, window // 2, constant_values=True)
        expected &= sliding_window_view(padded, (window, window)).sum(axis=(2, 3)) <= limit
    found = fillable_gaps(is_void, (7, 23, 46))
    np.testing.assert_array_equal(found, expected)
    assert 0 < expected.sum() < is_void.sum()


def test_seven_parameters() -> None:
    """4.3 of skarlatos2012: the closed form of Umeyama for scale, rotation and translation."""
    rng = np.random.default_rng(8)
    source = rng.uniform(-5.0, 5.0, (12, 3))
    target = 1.7 * source @ turned(33.0).T + [10.0, 20.0, 5.0] + rng.normal(0.0, 0.05, (12, 3))
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    left, values, right = np.linalg.svd(b.T @ a / 12.0)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left * signs @ right
    scale = float(values @ signs / (a**2).sum() * 12.0)
    found = fit_similarity(source, target, with_scale=True)
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
    moved = scale * source @ rotation.T + target.mean(axis=0)
    np.testing.assert_allclose(
        found.apply(source), moved - scale * rotation @ source.mean(axis=0), atol=1e-9
    )


def test_table_1_of_check_points() -> None:
    """Table 1 of skarlatos2012: RMS, standard deviation, outliers beyond twice it, RMS after."""
    residuals_m = np.random.default_rng(9).standard_t(3, (30, 2)) * 0.03
    found: dict[str, Any] = {item.name: item.value for item in check_findings(residuals_m, 0.02)}
    length = np.hypot(*residuals_m.T)
    rms = np.sqrt(np.mean(length**2))
    kept = length <= 2.0 * rms
    assert found["rms_mm"] == pytest.approx(1e3 * rms)
    assert found["sd_mm"] == pytest.approx(1e3 * length.std(ddof=1))
    assert found["n_outliers_once"] == np.count_nonzero(~kept) > 0
    assert found["rms_after_once_mm"] == pytest.approx(1e3 * np.sqrt(np.mean(length[kept] ** 2)))
