"""Walls resampled to the cells of orthoimages from other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.inspect import placing
from orthoflow_plugins.inspect.placing import in_files, on_walls, wall_of

from orthoflow.errors import MethodError
from orthoflow.geometry import frame_over
from orthoflow.products import Orthoimages, SurfaceMask, Walls
from tests import inspect_scenes, scenes
from tests.inspect_scenes import BUFFER_M, image_of
from tests.raster_scenes import context


def slanted() -> Walls:
    """Return a wall whose depths, counts and deviations identify the cell."""
    given = inspect_scenes.walls()
    wall = given.walls[0]
    rows, columns = np.indices(wall.frame.shape)
    known = wall.mask == SurfaceMask.MEASURED
    depth = np.where(known, 1e-4 * columns + 1e-5 * rows, np.nan).astype(np.float32)
    intensity = (1e-3 * columns + 1e-4 * rows).astype(np.float32)
    changed = replace(
        wall,
        depth_m=depth,
        sigma_m=(1e-3 * columns).astype(np.float32),
        count=(1000 * rows + columns).astype(np.uint32),
        intensity=intensity,
    )
    return replace(given, walls=(changed,))


def test_an_image_is_of_the_wall_of_its_plane() -> None:
    wall = slanted().walls[0]
    walls = replace(slanted(), walls=(replace(wall, plane_index=3), replace(wall, plane_index=8)))
    image = image_of(np.full(wall.frame.shape, 100.0))

    def placed(**changed: int | None) -> tuple[int, int | None]:
        (found,) = on_walls(Orthoimages(images=(replace(image, **changed),)), walls).images
        return found.wall, found.plane_index

    # The plane determines the wall, even if the image numbers walls differently.
    assert placed(wall=8, plane_index=8) == (1, 8)
    assert placed(wall=0, plane_index=8) == (1, 8)
    assert placed(wall=0, plane_index=None) == (0, 3)
    with pytest.raises(
        MethodError, match=r"shows wall 2, which is not among the connected walls \(3, 8\)"
    ):
        placed(wall=2, plane_index=None)
    with pytest.raises(
        MethodError, match=r"shows wall 1, which is not among the connected walls \(3, 8\)"
    ):
        placed(wall=1, plane_index=1)
    with pytest.raises(MethodError, match="shows wall -1"):
        placed(wall=-1, plane_index=None)


def test_cells_have_the_values_of_the_nearest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walls = slanted()
    wall = walls.walls[0]
    frame = wall.frame
    # The image is coarser, begins 3.3 cells to the left and 2.2 cells higher, and is 1 cm in front
    # of the wall.
    corner = frame.world_from_wall(np.array([[-3.3, -2.2]]), 0.01)[0]
    shape = (40, 50)
    other = replace(
        frame, origin_world=corner, gsd_m=1.5 * frame.gsd_m, width=shape[1], height=shape[0]
    )
    laid = wall_of(image_of(np.full(shape, 100.0), other), walls)
    assert laid.frame is other
    rows, columns = np.indices(shape)
    exact = np.stack([-3.3 + 1.5 * (columns + 0.5), -2.2 + 1.5 * (rows + 0.5)], axis=-1)
    place = np.floor(exact).astype(int)
    inside = (place >= 0).all(axis=-1)
    assert (~inside).any()
    expected = 1000 * place[..., 1] + place[..., 0]
    np.testing.assert_array_equal(laid.count, np.where(inside, expected, 0))
    np.testing.assert_allclose(laid.sigma_m[inside], 1e-3 * place[inside, 0], rtol=1e-6)
    assert np.isnan(laid.sigma_m[~inside]).all()
    assert (laid.mask[~inside] == SurfaceMask.VOID).all()
    held = wall.mask[place[inside][:, 1], place[inside][:, 0]]
    np.testing.assert_array_equal(laid.mask[inside], held)
    known = inside.copy()
    known[inside] = held == SurfaceMask.MEASURED
    depth = 1e-4 * place[..., 0] + 1e-5 * place[..., 1]
    # Depths are relative to the plane of the image.
    np.testing.assert_allclose(laid.depth_m[known], depth[known] - 0.01, atol=1e-6)
    assert np.isnan(laid.depth_m[~known]).all()
    assert laid.intensity is not None
    whole = (exact >= 1.0).all(axis=-1)
    # Values are interpolated between the four nearest cells, with positions that OpenCV rounds to
    # 1/32 cell.
    shade = 1e-3 * (exact[..., 0] - 0.5) + 1e-4 * (exact[..., 1] - 0.5)
    np.testing.assert_allclose(laid.intensity[whole], shade[whole], atol=5e-5)
    monkeypatch.setattr(placing, "IN_MEMORY_CELLS", 1999)
    ctx = context(tmp_path)
    kept = wall_of(image_of(np.full(shape, 100.0), other), walls, in_files(ctx, "0"))
    for name in ("depth_m", "sigma_m", "count", "mask", "intensity"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(laid, name))
    assert len(list((ctx.scratch / "allocated").iterdir())) == 5
    blind = replace(walls, walls=(replace(wall, intensity=None),))
    assert wall_of(image_of(np.full(shape, 100.0), other), blind).intensity is None


@pytest.mark.parametrize(
    ("shift_m", "angle_deg", "is_refused"),
    [
        (0.99 * BUFFER_M, 0.0, False),
        (1.01 * BUFFER_M, 0.0, True),
        (-0.99 * BUFFER_M, 0.0, False),
        (-1.01 * BUFFER_M, 0.0, True),
        (0.0, 1.9, False),
        (0.0, -2.1, True),
        (0.0, 80.0, True),
    ],
)
def test_misplaced_images_are_refused(shift_m: float, angle_deg: float, is_refused: bool) -> None:
    walls = slanted()
    frame = walls.walls[0].frame
    corners = frame.corners_world() + shift_m * frame.normal_world
    middle = corners.mean(axis=0)
    turn = scenes.rotation_about(frame.v_world, angle_deg)
    turned = (corners - middle) @ turn.T + middle
    other = frame_over(turned, turn @ frame.normal_world, gsd_m=2.0 * frame.gsd_m)
    image = image_of(np.full(other.shape, 100.0), other)
    if is_refused:
        with pytest.raises(MethodError, match="connect the walls that the orthoimages show"):
            wall_of(image, walls)
    else:
        assert wall_of(image, walls).frame is other
