"""Only missing points between neighbours in the scan's grid are interpolated."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.products import PointCloud, SurfaceMask, Wall
from tests import raster_scenes as scenes

KNOWN = scenes.upright_wall(shape=(40, 60))
# Slope per cell: steep, but points two steps apart differ by less than layer_m.
SLOPE_M = 0.004


def rastered(cloud: PointCloud, folder: Path, **params: object) -> Wall:
    more: dict[str, object] = {"gsd_m": KNOWN.gsd_m, "buffer_m": 1.0, **params}
    return scenes.rastered(cloud, KNOWN.planes(), folder, **more)[0].walls[0]


def depth_m(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    return SLOPE_M * columns


def scanned(
    step_cells: float, *, missing: NDArray[np.bool_] | None = None, depths: str = "slope"
) -> PointCloud:
    """Return a scan with given row and column spacing on the wall, rotated by a few degrees."""
    n = int(120 / step_cells)
    row, column = (grid.ravel() for grid in np.mgrid[:n, :n])
    turned = np.radians(7.0)
    u = 0.3 + step_cells * (np.cos(turned) * column + np.sin(turned) * (row - n / 3))
    v = 0.3 + step_cells * (np.cos(turned) * row - np.sin(turned) * column)
    kept = (u > 0) & (u < KNOWN.shape[1]) & (v > 0) & (v < KNOWN.shape[0])
    if missing is not None:
        kept &= ~missing[np.clip(v, 0, 39.9).astype(int), np.clip(u, 0, 59.9).astype(int)]
    u, v, row, column = u[kept], v[kept], row[kept], column[kept]
    depths_m = depth_m(u) if depths == "slope" else np.where(u < 30.0, 0.0, 0.1)
    cloud = scenes.cloud_of(
        KNOWN.world(u, v, depths_m),
        intensity=(0.2 + 0.01 * u).astype(np.float32),
        rgb=np.repeat(np.rint(2.0 * v)[:, None], 3, axis=1).astype(np.uint8),
    )
    # Row and column numbers may begin with any number, here above 12,000.
    return dataclasses.replace(
        cloud, row=(row + 12_000).astype(np.uint32), column=column.astype(np.uint32)
    )


def test_a_coarse_scan_is_recovered_linear_between_its_points(tmp_path: Path) -> None:
    wall = rastered(scanned(2.4), tmp_path, surface="topmost")
    recovered = wall.mask == SurfaceMask.RECOVERED
    # The border is not between points.
    inner = np.zeros(KNOWN.shape, dtype=bool)
    inner[4:-4, 4:-4] = True
    assert (wall.mask[inner] != SurfaceMask.VOID).all()
    assert np.mean(recovered[inner]) > 0.7
    rows, columns = np.nonzero(recovered & inner)
    expected_m = depth_m(columns.astype(np.float64) + 0.5)
    np.testing.assert_allclose(wall.depth_m[rows, columns], expected_m, atol=1e-6)
    np.testing.assert_allclose(
        wall.intensity[rows, columns], 0.2 + 0.01 * (columns + 0.5), atol=1e-6
    )
    # Colours are rounded for the points, and again after interpolation.
    np.testing.assert_allclose(wall.rgb[rows, columns, 0], 2.0 * (rows + 0.5), atol=1.01)
    assert (wall.count[recovered] == 0).all()
    assert np.isnan(wall.sigma_m[recovered]).all()


def test_single_missing_points_are_recovered_on_the_slope_they_lie_on(
    tmp_path: Path,
) -> None:
    missing = np.random.default_rng(4).random(KNOWN.shape) < 0.08
    errors_m = []
    for steps in (2, 0):
        wall = rastered(
            scanned(0.9, missing=missing), tmp_path, surface="centre", recover_scan_steps=steps
        )
        rows, columns = np.nonzero(wall.mask == SurfaceMask.RECOVERED)
        errors_m.append(
            np.abs(wall.depth_m[rows, columns] - depth_m(columns.astype(np.float64) + 0.5))
        )
    assert np.median(errors_m[0]) < 1e-6
    # Cells surrounded by others are on their slope; at the border, they are on that of their
    # neighbours.
    assert np.median(errors_m[1]) < 0.02 * SLOPE_M
    assert errors_m[1].max() < 2.0 * SLOPE_M


def test_what_the_scanner_looked_through_stays_void(tmp_path: Path) -> None:
    window = np.zeros(KNOWN.shape, dtype=bool)
    window[10:30, 20:40] = True
    wall = rastered(scanned(0.9, missing=window), tmp_path)
    is_void = wall.mask == SurfaceMask.VOID
    assert is_void[11:29, 21:39].all()
    assert np.isnan(wall.depth_m[is_void]).all()
    assert np.isnan(wall.intensity[is_void]).all()
    np.testing.assert_array_equal(wall.rgb_mask > 0, ~is_void)


def test_a_depth_step_is_not_bridged(tmp_path: Path) -> None:
    wall = rastered(scanned(2.4, depths="step"), tmp_path, surface="topmost")
    known = wall.depth_m[np.isfinite(wall.depth_m)]
    assert set(known.round(4).tolist()) == {0.0, np.float32(0.1).item()}


@pytest.mark.parametrize(
    ("without", "reach"),
    [
        (("row", "column"), {}),
        ((), {"recover_scan_steps": 0}),
        ((), {"recover_gap_cells": 0}),
    ],
)
def test_without_grid_or_reach_nothing_is_spanned(
    tmp_path: Path, without: tuple[str, ...], reach: dict[str, object]
) -> None:
    cloud = dataclasses.replace(scanned(2.4), **dict.fromkeys(without))
    params: dict[str, object] = {"surface": "topmost", "recover_gap_cells": 1, **reach}
    wall = rastered(cloud, tmp_path, **params)
    # Cells in the middle between four points are too far away for a gap of one cell.
    assert np.mean(wall.mask[4:-4, 4:-4] == SurfaceMask.VOID) > 0.1
