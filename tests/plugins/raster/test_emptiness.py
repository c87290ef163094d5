"""Why cells are empty: walls with openings, things before them and sparse points, all known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster.grid import RasterGrid

from orthoflow.products import PointCloud
from tests import raster_scenes as scenes

# A wall of 4 m x 3 m seen along +y, points 8 mm apart, cells of 2 cm; depth is -y.
WALL = scenes.KnownWall(
    normal=np.array([0.0, -1.0, 0.0]),
    top_left=np.array([0.0, 0.0, 3.0]),
    gsd_m=0.02,
    shape=(150, 200),
)
STEP_M = 0.008
# Half a tile on each side of what is empty, 5 cm, of openings of 0.8 m and more.
SHARE = 0.015


def grid(
    x: tuple[float, float], z: tuple[float, float], *, depth_m: float = 0.0, step_m: float = STEP_M
) -> NDArray[np.float64]:
    across, up = (
        axis.ravel() for axis in np.meshgrid(np.arange(*x, step_m), np.arange(*z, step_m))
    )
    return np.column_stack([across, np.full(across.size, -depth_m), up])


def without(
    points: NDArray[np.float64], x: tuple[float, float], z: tuple[float, float]
) -> NDArray[np.float64]:
    inside = (points[:, 0] > x[0]) & (points[:, 0] < x[1])
    return points[~(inside & (points[:, 2] > z[0]) & (points[:, 2] < z[1]))]


def causes(cloud: PointCloud, folder: Path, **params: object) -> tuple[dict[str, float], list[str]]:
    """Share of empty cells by cause, and what is said."""
    ctx = scenes.context(folder)
    chosen = RasterGrid.Params.model_validate({"gsd_m": WALL.gsd_m, **params})
    RasterGrid().run(RasterGrid.In(cloud=cloud, planes=WALL.planes()), chosen, ctx)
    named = {metric.name: metric.value for metric in ctx.metrics}
    shares = {
        cause: named[f"void_{cause}_share"] for cause in ("behind", "hidden", "sparse", "unseen")
    }
    assert sum(shares.values()) == pytest.approx(named["void_share"], abs=1e-9)
    return shares, [text for text in ctx.warnings if "cells are empty" in text]


def only(cause: str, share: float) -> dict[str, object]:
    expected = dict.fromkeys(("behind", "hidden", "sparse", "unseen"), 0.0) | {cause: share}
    return {name: pytest.approx(value, abs=SHARE) for name, value in expected.items()}


def test_a_wall_that_is_full_says_nothing(tmp_path: Path) -> None:
    shares, said = causes(scenes.cloud_of(grid((0, 4), (0, 3))), tmp_path)
    assert shares == only("behind", 0.0)
    assert said == []


def test_what_lies_behind_the_buffer_is_told_with_its_depth(tmp_path: Path) -> None:
    wall = without(grid((0, 4), (0, 3)), (1.0, 2.5), (0.5, 2.0))
    alcove = grid((1.0, 2.5), (0.5, 2.0), depth_m=-1.3)
    shares, said = causes(scenes.cloud_of(np.vstack([wall, alcove])), tmp_path)
    assert shares == only("behind", 1.5 * 1.5 / 12.0)
    (text,) = said
    assert "lie behind the buffer, about 1.3 m behind the plane (raise buffer_behind_m" in text


def test_an_opening_that_shows_nothing_has_no_setting(tmp_path: Path) -> None:
    wall = without(grid((0, 4), (0, 3)), (1.0, 2.5), (0.5, 2.0))
    shares, said = causes(scenes.cloud_of(wall), tmp_path)
    assert shares == only("unseen", 1.5 * 1.5 / 12.0)
    assert "show nothing that was scanned" in said[0]
    assert "raise" not in said[0]


def test_the_shadow_of_a_thing_before_the_wall_is_hidden(tmp_path: Path) -> None:
    # From the station 4 m before the wall, a screen halfway hides twice its size, aside of it.
    station = np.array([[0.0, -4.0, 1.5]])
    screen = grid((0.8, 1.4), (1.2, 1.8), depth_m=2.0, step_m=0.02)
    shadow = ((1.6, 2.8), (0.9, 2.1))
    wall = without(grid((0, 4), (0, 3)), *shadow)
    cloud = scenes.cloud_of(np.vstack([wall, screen]))
    known = dataclasses.replace(cloud, stations=station)
    shares, said = causes(known, tmp_path)
    # A voxel of 10 cm before the station is as wide as 20 cm on the wall.
    assert shares["hidden"] > 0.8 * 1.44 / 12.0
    assert shares["hidden"] + shares["unseen"] == pytest.approx(1.44 / 12.0, abs=SHARE)
    assert "are hidden by what stands before the wall" in said[0]
    nowhere, _ = causes(cloud, tmp_path)
    assert nowhere == only("unseen", 1.44 / 12.0)


def test_cells_finer_than_the_scan_are_told_from_holes(tmp_path: Path) -> None:
    cloud = scenes.cloud_of(grid((0, 4), (0, 3), step_m=0.025))
    shares, said = causes(cloud, tmp_path, gsd_m=0.005, recover_gap_cells=0)
    assert shares["sparse"] > 0.9
    assert shares["unseen"] < SHARE
    assert "lie between the scan's points (raise gsd_m or recover_gap_cells)" in said[0]
