"""Figures of planes: the data of each panel are compared with the planes found."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.hough3d import Hough3d
from orthoflow_plugins.plane.ransac import Ransac
from orthoflow_plugins.plane.region import Region

from tests.plane_scenes import STATION, Rectangle, cloud_of, detect, sampled

ORIGIN: Final = np.array([100.0, 200.0, 50.0])
POINTS: Final = sampled()[::4].astype(np.float32).astype(np.float64)


def detected(method: Any, folder: Path, **params: Any) -> tuple[Any, NDArray[np.int16]]:
    """Return the planes of a room and the labels of its points, which have rows and intensities."""
    cloud = cloud_of(POINTS, origin=tuple(ORIGIN), stations=STATION)
    at = np.arange(len(POINTS))
    rows, columns = (place.astype(np.uint32) for place in np.divmod(at, 500))
    intensity = np.linspace(0.0, 1.0, len(at), dtype=np.float32)
    known = replace(cloud, row=rows, column=columns, intensity=intensity)
    out = detect(method, known, folder, **params)[0]
    return out.planes, out.labels.plane_index


def lines(axes: Any) -> list[NDArray[np.float64]]:
    """Return the data (2, n) of each line of a panel."""
    return [np.array(line.get_data(), dtype=np.float64) for line in axes.lines]


def image(axes: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    (shown,) = axes.images
    return np.ma.filled(shown.get_array().astype(float), np.nan), np.array(shown.get_extent())


def brightest(axes: Any) -> NDArray[np.float64]:
    """Return the position (2,) of the largest value of an image, in the units of its axes."""
    shown, extent = image(axes)
    place = np.array(np.unravel_index(np.nanargmax(shown), shown.shape))[::-1] + 0.5
    sides = extent.reshape(2, 2)
    return np.asarray(sides[:, 0] + place / shown.shape[::-1] * np.diff(sides)[:, 0])


def test_deviations_are_drawn_with_the_gauss_curve_of_their_fit(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    planes, labels = detected(Hough2d, tmp_path)
    panels = drawings["deviations"].axes
    assert len(panels) == 8
    for k, (axes, beside) in enumerate(zip(panels[::2], panels[1::2], strict=True)):
        away_mm = 1e3 * planes.plane(k).distances_m(POINTS[labels == k] + ORIGIN)
        values, edges_mm, _ = axes.patches[0].get_data()
        # A point in per cent of the points per millimetre.
        per_point = 100.0 / len(away_mm) / (edges_mm[1] - edges_mm[0])
        counts = np.histogram(away_mm, edges_mm)[0]
        np.testing.assert_allclose(values / per_point, counts, atol=5)
        sigma_mm = 1e3 * planes.details["fit_rms_m"][k]
        assert axes.get_title() == f"{planes.names[k]}: SD {sigma_mm:.1f} mm"
        ((x_mm, curve),) = lines(axes)
        # The area below the curve is the number of points of the fit; the curve is centred on their
        # mean.
        n_fit = planes.details["fit_n_points"][k]
        assert curve.sum() == pytest.approx(per_point * n_fit, rel=1e-3)
        mean_mm = (x_mm @ curve) / curve.sum()
        shape = planes.details["normality"][k]
        assert mean_mm == pytest.approx(1e3 * shape["mean_m"], abs=0.02)
        drawn_mm = math.sqrt((x_mm - mean_mm) ** 2 @ curve / curve.sum())
        assert drawn_mm == pytest.approx(sigma_mm, rel=0.01)
        expected, found = lines(beside)[1]
        np.testing.assert_allclose(found[5:-5], expected[5:-5], atol=0.35)


def test_thickness_is_drawn_by_plane_material_and_row(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    materials = {"dark": (0.0, 0.15), "bright": (0.15, 1.0)}
    planes, _ = detected(Ransac, tmp_path, materials=materials)
    found = planes.thickness
    sigmas, *by_class, by_material, in_row = drawings["thickness"].axes
    widths_mm = [1e3 * item.sigma_m for item in found]
    np.testing.assert_allclose([bar.get_width() for bar in sigmas.patches], widths_mm)
    assert [text.get_text() for text in sigmas.get_yticklabels()] == list(planes.names)
    np.testing.assert_allclose(lines(sigmas)[0][0], [1e3 * item.scan_step_m for item in found])
    for axes, name in zip(by_class, ("incidence_deg", "range_m"), strict=True):
        for line, item in zip(lines(axes), found, strict=False):
            expected = [
                (0.5 * (one.low + one.high), 1e3 * one.sigma_m) for one in getattr(item, name)
            ]
            np.testing.assert_allclose(line.T, np.reshape(expected, (-1, 2)))
    bars = [
        (f"{spread.name}, {planes.names[k]}", 1e3 * spread.sigma_m)
        for k, item in enumerate(found[:4])
        for spread in item.material
    ]
    labels = [text.get_text() for text in by_material.get_yticklabels()]
    widths = [bar.get_width() for bar in by_material.patches]
    assert list(zip(labels, widths, strict=True)) == bars
    every, dark, bright = lines(in_row)
    assert every.shape[1] == planes.scan_row.n_points == dark.shape[1] + bright.shape[1]
    assert np.std(every[1]) == pytest.approx(2.0, rel=0.2)


def test_directions_sections_and_voxels_show_the_planes(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    planes, _ = detected(Hough3d, tmp_path, cell_m=0.05)
    axes, _ = drawings["accumulator"].axes
    circles = np.array([line[:, 0] for line in lines(axes)])
    assert (circles[:, 0] >= 0.0).all()
    assert (circles[:, 0] < 180.0).all()
    omega, phi = np.radians(circles).T
    ways = np.array([np.cos(phi) * np.cos(omega), np.cos(phi) * np.sin(omega), np.sin(phi)]).T
    np.testing.assert_allclose(np.abs(np.sum(ways * planes.normal, axis=1)), 1.0, atol=1e-9)
    # Pixels of two degrees are centred on the directions.
    np.testing.assert_allclose(image(axes)[1], [-1.0, 179.0, -91.0, 91.0])
    level, upright = drawings["accumulator-sections"].axes[:2]
    # In the section of upright planes, the front wall has the most votes.
    assert (level.get_title(), upright.get_title()) == ("phi = 0 deg", "omega = 0 deg")
    assert brightest(level)[0] == pytest.approx(90.0, abs=3.0)
    assert abs(brightest(level)[1]) == pytest.approx(2.0, abs=0.2)
    corners = planes.corners.reshape(-1, 3) - ORIGIN
    low, high = corners.min(axis=0), corners.max(axis=0)
    axes_of = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
    for axes, (first, second, across) in zip(drawings["voxels"].axes[:3], axes_of, strict=True):
        shown, extent = image(axes)
        middle = 0.5 * (low + high)[across]
        near = POINTS[np.abs(POINTS[:, across] - middle) < 0.025]
        for at, axis, counts in ((0, first, shown.sum(axis=0)), (2, second, shown.sum(axis=1))):
            # The image extends five voxels beyond the planes, and consists of whole voxels.
            assert extent[at] == pytest.approx(low[axis] - 0.25)
            assert 0.0 <= extent[at + 1] - (high[axis] + 0.25) < 0.051
            cells = np.floor((near[:, axis] - extent[at]) / 0.05).astype(int)
            np.testing.assert_allclose(counts, np.bincount(cells, minlength=len(counts)))


def test_normals_are_drawn_by_points_and_over_the_first_plane(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    wall = Rectangle("wall", (0, 2, 0), (1.5, 0, 0), (0, 0, 1.0), 60_000)
    # There is a slope of 30 degrees relative to the wall, half a metre in front of it.
    up = (0, 0.3 * math.sin(math.radians(30.0)), 0.3 * math.cos(math.radians(30.0)))
    points = sampled((wall, Rectangle("slope", (0, 1.5, 0), (0.3, 0, 0), up, 9_000)), noise_m=1e-3)
    cloud = cloud_of(points, origin=tuple(ORIGIN))
    params = {"neighbourhood_m": 0.15, "cell_m": 0.05, "min_share": 0.005}
    _, ctx = detect(Region, cloud, tmp_path, **params)
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    # The error of a slope is s / (extent sqrt(n)) about both axes, with 225 points over 15 cm; half
    # of the normals are within 1.18 times this error.
    expected_deg = math.degrees(1.18 * 1e-3 / (0.15 / math.sqrt(12.0) * 15.0))
    assert metrics["normal_scatter_deg"] == pytest.approx(expected_deg, rel=0.1)
    assert (metrics["n_regions"], metrics["cell_mm"]) == (2, pytest.approx(50.0))
    assert metrics["neighbourhood_mm"] == pytest.approx(150.0)
    left, middle, right, _ = drawings["normals"].axes
    np.testing.assert_allclose(left.patches[0].get_data()[1], np.arange(91.0))
    np.testing.assert_allclose(middle.patches[0].get_data()[1], np.arange(-90.0, 91.0))
    shown, extent = image(right)
    np.testing.assert_allclose(extent, (0.0, 3.0, 2.0, 0.0), atol=0.01)
    assert shown.shape == (40, 60)
    # Here the slope is in front of the wall, and is clipped to 15 degrees.
    assert shown[20, 30] == pytest.approx(15.0)
    assert np.nanmedian(shown[:8]) < 0.2
