"""Parts of walls: a crop has the cells of the whole wall, and is void outside its outline."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster.grid import RasterGrid
from pydantic import ValidationError

from orthoflow.errors import MethodError
from orthoflow.products import SurfaceMask, Wall
from orthoflow.sdk import StepContext
from tests import raster_scenes as scenes

# The wall has 40 x 30 cells of 0.125 m, so it is 5 m wide and 3.75 m high.
KNOWN = scenes.upright_wall()


def rastered(folder: Path, **params: object) -> tuple[Wall, StepContext]:
    columns, rows = scenes.cell_centres(KNOWN.shape)
    points = KNOWN.world(columns, rows, scenes.relief_m(columns))
    intensity = np.linspace(0.1, 0.9, columns.size, dtype=np.float32)
    cloud = scenes.cloud_of(points, rgb=scenes.checker(columns, rows), intensity=intensity)
    walls, ctx = scenes.rastered(cloud, KNOWN.planes(), folder, gsd_m=KNOWN.gsd_m, **params)
    return walls.walls[0], ctx


def assert_same(part: Wall, whole: Wall, cells: Any, kept: NDArray[np.bool_]) -> None:
    for name in ("depth_m", "sigma_m", "count", "mask", "intensity", "rgb", "rgb_mask"):
        one, other = getattr(part, name), getattr(whole, name)[cells]
        np.testing.assert_array_equal(one[kept], other[kept], err_msg=name)


@pytest.mark.parametrize(
    ("crop", "part"),
    [
        ((1.0, 0.5, 2.0, 1.5), np.s_[4:12, 8:16]),
        ((0.99, 0.51, 2.01, 1.49), np.s_[4:12, 7:17]),
        ((4.0, 3.0, 9.0, 9.0), np.s_[24:30, 32:40]),
        ((-3.0, -1.0, 0.25, 0.125), np.s_[0:1, 0:2]),
        (((1.0, 0.5), (1.0, 1.5), (2.0, 1.5), (2.0, 0.5)), np.s_[4:12, 8:16]),
    ],
    ids=["whole cells", "cells in part", "past a corner", "past the origin", "square polygon"],
)
def test_a_crop_holds_the_cells_of_the_whole_wall(
    tmp_path: Path, crop: object, part: tuple[slice, slice]
) -> None:
    whole, _ = rastered(tmp_path)
    wall, ctx = rastered(tmp_path, crop=crop)
    assert_same(wall, whole, part, np.ones(wall.frame.shape, dtype=np.bool_))
    corner = np.array([[part[1].start, part[0].start]], dtype=np.float64)
    np.testing.assert_allclose(
        wall.frame.origin_world, whole.frame.world_from_wall(corner)[0], atol=1e-12
    )
    assert not any(one.code.startswith("crop") for one in ctx.diagnostics)


def test_cells_beyond_a_polygon_are_void(tmp_path: Path) -> None:
    whole, _ = rastered(tmp_path)
    # The crop is the triangle to the right of the line from (1, 3) to (3, 1), below v = 1.
    wall, _ = rastered(tmp_path, crop=[[1.0, 3.0], [3.0, 1.0], [3.0, 3.0]])
    assert wall.frame.shape == (16, 16)
    rows, columns = np.mgrid[8:24, 8:24] + 0.5
    # Cells with their centres on the diagonal may be on either side.
    inside, on = columns + rows > 32.0, columns + rows == 32.0
    kept = wall.mask == SurfaceMask.MEASURED
    np.testing.assert_array_equal(kept[~on], inside[~on])
    assert_same(wall, whole, np.s_[8:24, 8:24], kept)
    assert np.isnan(wall.depth_m[~kept]).all()
    assert np.isnan(wall.intensity[~kept]).all()
    assert not wall.count[~kept].any()
    assert not wall.rgb[~kept].any()


def test_a_notch_of_a_polygon_is_outside(tmp_path: Path) -> None:
    notched = [[0, 0], [4, 0], [4, 3], [2.5, 3], [2.5, 1], [1.5, 1], [1.5, 3], [0, 3]]
    wall, _ = rastered(tmp_path, crop=notched)
    expected = np.ones((24, 32), dtype=bool)
    expected[8:, 12:20] = False
    np.testing.assert_array_equal(wall.mask == SurfaceMask.MEASURED, expected)


def test_a_crop_without_an_area_or_beside_the_wall_is_refused(tmp_path: Path) -> None:
    for crop in ((1, 1, 1, 2), ((0, 0), (1, 1)), ((0, 0), (1, 1), (2, 2))):
        with pytest.raises(ValidationError, match="that span an area"):
            RasterGrid.Params.model_validate({"crop": crop})
    with pytest.raises(MethodError, match=r"wall 0 is 5\.000 m wide and 3\.750 m high"):
        rastered(tmp_path, crop=(6.0, 0.0, 7.0, 1.0))


@pytest.mark.parametrize(("away_m", "is_told"), [(0.95, False), (1.05, True)])
def test_a_point_a_metre_beside_the_nearest_wall_is_told_of(
    tmp_path: Path, away_m: float, *, is_told: bool
) -> None:
    _, ctx = rastered(tmp_path, near=[[2.0, -away_m, -1.0]])
    apart = [one.values["apart_m"] for one in ctx.diagnostics if one.code == "near-is-far"]
    assert apart == [pytest.approx(away_m)] * is_told


def test_walls_are_chosen_in_one_way() -> None:
    with pytest.raises(ValidationError, match="by ranks or by near, not by both"):
        RasterGrid.Params.model_validate({"ranks": [0], "near": [[0, 0, 0]]})
