"""Parts of walls: the cells of a crop are those of the whole wall, and void beyond its outline."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster.grid import RasterGrid
from pydantic import ValidationError

from orthoflow.errors import MethodError
from orthoflow.products import SurfaceMask, Wall
from tests import raster_scenes as scenes

# 40 x 30 cells of 0.125 m: 5 m wide, 3.75 m high.
KNOWN = scenes.upright_wall()


def rastered(folder: Path, **params: object) -> tuple[Wall, list[str]]:
    columns, rows = scenes.cell_centres(KNOWN.shape)
    points = KNOWN.world(columns, rows, scenes.relief_m(columns))
    intensity = np.linspace(0.1, 0.9, columns.size, dtype=np.float32)
    cloud = scenes.cloud_of(points, rgb=scenes.checker(columns, rows), intensity=intensity)
    folder.mkdir(exist_ok=True)
    ctx = scenes.context(folder)
    checked = RasterGrid.Params.model_validate({"gsd_m": KNOWN.gsd_m, **params})
    inputs = RasterGrid.In(cloud=cloud, planes=KNOWN.planes())
    walls = RasterGrid().run(inputs, checked, ctx).walls
    return walls.walls[0], list(ctx.warnings)


def arrays(wall: Wall) -> dict[str, NDArray[np.generic]]:
    names = ("depth_m", "sigma_m", "count", "mask", "intensity", "rgb", "rgb_mask")
    return {name: getattr(wall, name) for name in names}


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
    whole, _ = rastered(tmp_path / "whole")
    wall, warnings = rastered(tmp_path / "part", crop=crop)
    for name, values in arrays(wall).items():
        np.testing.assert_array_equal(values, arrays(whole)[name][part], err_msg=name)
    corner = np.array([[part[1].start, part[0].start]], dtype=np.float64)
    np.testing.assert_allclose(
        wall.frame.origin_world, whole.frame.world_from_wall(corner)[0], atol=1e-12
    )
    assert not [warning for warning in warnings if "crop" in warning]


def test_cells_beyond_a_polygon_are_void(tmp_path: Path) -> None:
    whole, _ = rastered(tmp_path / "whole")
    # A triangle: right of the line from (1, 3) to (3, 1), below v = 1.
    wall, _ = rastered(tmp_path / "part", crop=[[1.0, 3.0], [3.0, 1.0], [3.0, 3.0]])
    assert wall.frame.shape == (16, 16)
    rows, columns = np.mgrid[8:24, 8:24] + 0.5
    # The cells on the diagonal have their centres on it and belong to neither side for certain.
    inside, on = columns + rows > 32.0, columns + rows == 32.0
    kept = wall.mask == SurfaceMask.MEASURED
    np.testing.assert_array_equal(kept[~on], inside[~on])
    part = np.s_[8:24, 8:24]
    for name, values in arrays(wall).items():
        np.testing.assert_array_equal(values[kept], arrays(whole)[name][part][kept], err_msg=name)
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


@pytest.mark.parametrize(
    "crop",
    [(1, 1, 1, 2), ((0, 0), (1, 1)), ((0, 0), (1, 1), (2, 2)), (0, 0, 0, 0)],
    ids=["no width", "two corners", "a line", "nothing"],
)
def test_a_crop_without_an_area_is_refused(crop: object) -> None:
    with pytest.raises(ValidationError, match="that span an area"):
        RasterGrid.Params.model_validate({"crop": crop})


def test_a_crop_beside_the_wall_says_how_large_the_wall_is(tmp_path: Path) -> None:
    with pytest.raises(MethodError, match=r"wall 0 is 5\.000 m wide and 3\.750 m high"):
        rastered(tmp_path, crop=(6.0, 0.0, 7.0, 1.0))


def test_a_point_far_from_every_wall_is_told(tmp_path: Path) -> None:
    _, warnings = rastered(tmp_path / "near", near=[[2.0, 0.2, -1.0]])
    assert not [warning for warning in warnings if "near" in warning]
    _, warnings = rastered(tmp_path / "far", near=[[2.0, 30.0, -1.0]])
    (warning,) = [warning for warning in warnings if "near" in warning]
    assert "the nearest wall, wall 0, is 30.00 m away" in warning


def test_walls_are_chosen_in_one_way() -> None:
    with pytest.raises(ValidationError, match="by ranks or by near, got both"):
        RasterGrid.Params.model_validate({"ranks": [0], "near": [[0, 0, 0]]})
