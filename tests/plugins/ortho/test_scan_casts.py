"""Casts of single scans: found where scans overlap, taken away, and reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.diagnostics import Diagnostic
from orthoflow.geometry.levels import light_of_levels, lit
from orthoflow.products import LayerMask, PointCloud, Walls
from tests.raster_scenes import context

# Factors on the light of one scan: yellowish.
CAST = np.array([1.3, 1.0, 0.7])


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[PointCloud, Walls]:
    """A simulated room, scanned in colour twice from two stations, and its largest wall."""
    ctx = context(tmp_path_factory.mktemp("room"))
    params = SimulateRoom.Params(scan_step_m=0.012, panorama_step_m=0.012)
    simulated = SimulateRoom().run(SimulateRoom.In(), params, ctx)
    inputs = RasterGrid.In(cloud=simulated.cloud, planes=simulated.truth.planes)
    chosen = RasterGrid.Params(gsd_m=0.02, n_walls_max=1)
    return simulated.cloud, RasterGrid().run(inputs, chosen, ctx).walls


def painted(
    cloud: PointCloud, walls: Walls, folder: Path, **params: object
) -> tuple[NDArray[np.float64], list[Diagnostic]]:
    """Logarithm of the light of each cell (rows, cols, 3), NaN without; what was reported."""
    folder.mkdir()
    ctx = context(folder)
    chosen = PointcloudDirect.Params.model_validate({"inpaint": "none", **params})
    (layer,) = (
        PointcloudDirect()
        .run(PointcloudDirect.In(walls=walls, cloud=cloud), chosen, ctx)
        .layers.layers
    )
    light = np.log(np.maximum(light_of_levels(255)[layer.rgb], 1e-3).astype(np.float64))
    light[(layer.mask != LayerMask.PAINTED) | (layer.rgb.min(axis=2) < 20)] = np.nan
    return light, [one for one in ctx.diagnostics if one.code == "scans-balanced"]


def test_scans_of_one_white_balance_are_painted_as_they_are(
    tmp_path: Path, room: tuple[PointCloud, Walls]
) -> None:
    found, reported = painted(*room, tmp_path / "on")
    plain, _ = painted(*room, tmp_path / "off", balance_scans=False)
    np.testing.assert_array_equal(found, plain)
    assert reported == []


def test_a_cast_of_one_scan_is_taken_away(tmp_path: Path, room: tuple[PointCloud, Walls]) -> None:
    cloud, walls = room
    assert cloud.rgb is not None
    assert cloud.scan is not None
    rgb, is_off = np.array(cloud.rgb), cloud.scan == np.bincount(cloud.scan).argmax()
    gains = np.broadcast_to(np.log(CAST).astype(np.float32), (int(is_off.sum()), 3))
    rgb[is_off] = lit(rgb[is_off], gains)
    cast = replace(cloud, rgb=rgb)
    expected, _ = painted(cloud, walls, tmp_path / "expected")
    found, reported = painted(cast, walls, tmp_path / "balanced")
    left, silent = painted(cast, walls, tmp_path / "left", balance_scans=False)
    (said,) = reported
    assert silent == []
    assert (said.values["n"], said.values["n_scans"]) == (1, int(cloud.scan.max()) + 1)
    assert said.values["share"] == pytest.approx(1.0 / CAST.min() - 1.0, abs=0.05)
    apart, before = found - expected, left - expected
    known = np.isfinite(apart).all(axis=2) & np.isfinite(before).all(axis=2)
    # Where that scan paints, its cast is visible, and afterwards no cell differs.
    is_cast = known & (np.abs(before - np.log(CAST)).max(axis=2) < 0.1)
    assert is_cast.mean() > 0.05
    for cells in (is_cast, known):
        assert np.abs(np.median(apart[cells], axis=0)).max() < 0.03
        assert np.percentile(np.abs(apart[cells]), 95) < 0.05
