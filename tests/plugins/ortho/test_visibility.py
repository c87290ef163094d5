"""Where the backward projection finds cells in a photo, against the exact camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.block_kernels import room_for_blocks
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.photos_on_walls import VisibilityParams
from orthoflow_plugins.ortho.relief_kernels import make_occluding
from orthoflow_plugins.ortho.surfaces import Surface, relief_of, transparent_relief_of, view_of
from orthoflow_plugins.ortho.views import (
    BLOCK_CELLS,
    FINE_CELLS,
    NO_SURFACE,
    NOTHING,
    NOTHING_M,
    OCCLUDED,
    PAINTED,
    Relief,
    TileVisibility,
    WallView,
)
from orthoflow_plugins.ortho.visibility_kernels import look_at_blocks, look_at_cells

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.geometry.occluders import nothing_in_the_way
from orthoflow.products import LayerMask
from tests import ortho_scenes as scenes
from tests.raster_scenes import context

PARAMS = VisibilityParams(incidence_max_deg=80.0, border_share=0.05)


def noisy_depths() -> NDArray[np.float32]:
    rng = np.random.default_rng(6)
    depths = scenes.depth_m() + rng.normal(0.0, 0.002, scenes.SHAPE).astype(np.float32)
    depths[rng.random(scenes.SHAPE) < 0.01] = np.nan
    return depths


def surface_of(depths: NDArray[np.float32], *, is_transparent: bool) -> Surface:
    where = scenes.frame()
    wall = scenes.walls(where, depths).walls[0]
    return Surface(
        frame=where,
        relief=(transparent_relief_of if is_transparent else relief_of)(wall, threads=2),
        front_m=scenes.BUFFER_M,
        tolerance_m=0.008,
    )


def seen(camera: ViewingCamera, *, is_transparent: bool) -> TileVisibility:
    return seen_of(surface_of(noisy_depths(), is_transparent=is_transparent), camera)


def seen_of(
    surface: Surface,
    camera: ViewingCamera,
    buffer: DepthBuffer | None = None,
    *,
    is_exact: bool = False,
) -> TileVisibility:
    height, width = scenes.SHAPE
    visible = TileVisibility(
        u=np.empty((height, width), dtype=np.float32),
        v=np.empty((height, width), dtype=np.float32),
        mask=np.empty((height, width), dtype=np.uint8),
        quality=np.empty((height, width), dtype=np.float32),
        summary=np.empty(8),
    )
    view = view_of(camera, surface, PARAMS, is_exact=is_exact)
    look_at_cells(view, surface.relief, buffer or nothing_in_the_way(camera), visible, 0, 0)
    return visible


@pytest.mark.parametrize("aside_m", [-0.7, 0.0, 1.4])
@pytest.mark.parametrize("is_transparent", [True, False], ids=["none", "full"])
def test_places_are_exact_to_a_twentieth_of_a_pixel(aside_m: float, is_transparent: bool) -> None:
    where = scenes.frame()
    camera = scenes.camera(where, aside_m=aside_m)
    visible = seen(camera, is_transparent=is_transparent)
    painted = visible.mask == PAINTED
    rows, columns = np.nonzero(painted)
    depths = noisy_depths()[painted].astype(np.float64)
    points = where.world_from_wall(np.column_stack([columns, rows]) + 0.5, depths)
    exact = camera.project(points)
    assert painted.mean() > 0.7
    # Parabolas stray by at most 0.02 px, float32 by less than 0.001.
    np.testing.assert_allclose(visible.u[painted], exact[:, 0], atol=0.05)
    np.testing.assert_allclose(visible.v[painted], exact[:, 1], atol=0.05)
    towards = camera.centre_world - points
    cosine = towards @ where.normal_world / np.linalg.norm(towards, axis=1)
    area = camera.fx * camera.fy * where.gsd_m**2
    inside = np.minimum.reduce(
        [exact[:, 0], camera.width - exact[:, 0], exact[:, 1], camera.height - exact[:, 1]]
    )
    border = 0.05 * min(camera.width, camera.height)
    quality = cosine * area / exact[:, 2] ** 2 * np.clip(inside / border, 0.0, 1.0)
    np.testing.assert_allclose(visible.quality[painted], quality, rtol=2e-3, atol=2e-3)


def are_hidden(view: WallView, relief: Relief, cells: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Follow rays to the camera: the surface between two cells is linear, void hides nothing.

    They rise, so that nothing of the relief meets a ray that is above all of it.
    """
    heights = relief.occluding.reshape(relief.depth.shape)
    highest = relief.step_m * float(heights[heights != NOTHING].max())
    assert view.height_m > highest
    depths = relief.depth[tuple(cells.T)].astype(np.float64)
    ways = np.array([view.row, view.column]) - cells
    along = np.abs(ways).max(axis=1)
    is_main = np.arange(2) == np.where(np.abs(ways[:, 0]) >= np.abs(ways[:, 1]), 0, 1)[:, None]
    hidden, followed = np.zeros(len(cells), dtype=np.bool_), np.arange(len(cells))
    for k in range(1, int(along.max()) + 1):
        followed = followed[k <= along[followed]]
        way = k / along[followed]
        at = cells[followed] + way[:, None] * ways[followed]
        at = np.where(is_main[followed], np.round(at), at)
        first, second = np.floor(at).astype(int), np.ceil(at).astype(int)
        inside = (first >= 0).all(axis=1) & (second < heights.shape).all(axis=1)
        followed, way, at, first, second = (
            each[inside] for each in (followed, way, at, first, second)
        )
        one, other = (heights[tuple(places.T)].astype(np.float64) for places in (first, second))
        share = (at - first).sum(axis=1)
        surface = relief.step_m * ((1.0 - share) * one + share * other)
        ray = depths[followed] + way * (view.height_m - depths[followed])
        is_known = (one != NOTHING) & (other != NOTHING)
        is_met = is_known & (surface > ray + view.tolerance_m)
        hidden[followed[is_met]] = True
        followed = followed[~is_met & (ray < highest)]
    return hidden


@pytest.mark.parametrize("aside_m", [-1.4, -0.7, 0.0, 0.4, 1.4])
def test_every_cell_is_hidden_whose_ray_meets_the_relief(aside_m: float) -> None:
    rng = np.random.default_rng(8)
    depths = noisy_depths()
    for row, column in rng.integers(0, scenes.SHAPE, (40, 2)):
        rows, columns = rng.integers(1, 12, 2)
        depths[row : row + rows, column : column + columns] += rng.uniform(0.01, 0.06)
    surface = surface_of(depths, is_transparent=False)
    camera = scenes.camera(scenes.frame(), aside_m=aside_m)
    view, relief = view_of(camera, surface, PARAMS), surface.relief
    visible = seen_of(surface, camera)
    asked = (visible.mask == PAINTED) | (visible.mask == OCCLUDED)
    # Each ray is followed to the camera, whatever bounds say.
    followed = are_hidden(view, relief, np.argwhere(asked))
    assert 200 < followed.sum() < 0.5 * len(followed)
    np.testing.assert_array_equal(visible.mask[asked] == OCCLUDED, followed)
    painted = visible.mask == PAINTED
    assert visible.summary[4] == painted.sum()
    # Places are float32, their bounds are not.
    for values, (least, most) in (
        (visible.u, visible.summary[:2]),
        (visible.v, visible.summary[2:4]),
    ):
        assert least - 1e-3 <= values[painted].min()
        assert values[painted].max() <= most + 1e-3


@pytest.mark.parametrize("is_exact", [True, False], ids=["cell-by-cell", "in-blocks"])
@pytest.mark.parametrize("aside_m", [-0.7, 1.4])
def test_a_point_hides_what_lies_behind_it_and_the_slab_of_the_wall(
    aside_m: float, is_exact: bool
) -> None:
    where = scenes.frame()
    camera = scenes.camera(where, aside_m=aside_m)
    depths = noisy_depths()
    surface = surface_of(depths, is_transparent=True)
    before = seen_of(surface, camera, is_exact=is_exact).mask
    free = before == PAINTED
    np.testing.assert_array_equal(before == NO_SURFACE, np.isnan(depths))
    rows, columns = np.nonzero(free)
    heights = depths[free].astype(np.float64)
    points = where.world_from_wall(np.column_stack([columns, rows]) + 0.5, heights)
    towards = camera.centre_world - points
    # Where the ray to the camera passes the front of the slab, and its depth along the axis there.
    share = (surface.front_m - heights) / (towards @ where.normal_world)
    leaves_m = camera.project(points + share[:, None] * towards)[:, 2]
    for nearest_m in np.quantile(leaves_m, [0.1, 0.5, 0.9]):
        buffer = nothing_in_the_way(camera)._replace(
            nearest=np.full((1, 1), nearest_m, dtype=np.float32)
        )
        mask = seen_of(surface, camera, buffer, is_exact=is_exact).mask
        hidden = nearest_m < leaves_m - surface.tolerance_m
        # The buffer is float32: at 2 m it knows a quarter of a micrometre.
        is_clear = np.abs(nearest_m - (leaves_m - surface.tolerance_m)) > 1e-6
        assert 0.05 < hidden.mean() < 0.95
        np.testing.assert_array_equal((mask[free] == OCCLUDED)[is_clear], hidden[is_clear])


def test_without_visibility_only_void_and_the_frame_of_the_photo_count() -> None:
    where = scenes.frame()
    camera = scenes.camera(where, aside_m=1.4)
    visible, hidden = seen(camera, is_transparent=True), seen(camera, is_transparent=False)
    assert (hidden.mask == OCCLUDED).sum() > 100
    assert not (visible.mask == OCCLUDED).any()
    differs = visible.mask != hidden.mask
    assert (hidden.mask[differs] == OCCLUDED).all()
    assert (visible.mask[differs] == PAINTED).all()


def test_what_hides_is_the_surface_without_spikes_and_with_its_edges_in_full() -> None:
    rng = np.random.default_rng(3)
    depth = rng.normal(0.0, 0.002, (77, 61)).astype(np.float32)
    depth[20:40, 10:30] += 0.1
    depth[50:60, 5:9] = depth[:2, :2] = depth[30, 50] = np.nan
    depth[70, 40] = 0.5
    depth.flags.writeable = False  # as rasters are: the kernel would be compiled once more
    step_m, edge_m = 1e-4, 0.015
    occluding, tops = np.zeros(depth.shape, dtype=np.int16), np.zeros((10, 8), dtype=np.float32)
    for first, end in ((0, 3), (3, 4), (4, 10)):
        make_occluding(depth, step_m, edge_m, occluding, tops, first, end)

    def of_windows(
        values: NDArray[np.float32], pick: np.ufunc, steps: range
    ) -> NDArray[np.float32]:
        padded = np.pad(values, 1, mode="edge")
        rows, columns = values.shape
        parts = [padded[1 + i :, 1 + j :][:rows, :columns] for i in steps for j in steps]
        return np.asarray(pick.reduce(parts), dtype=np.float32)

    known = np.where(np.isnan(depth), np.float32(NOTHING_M), depth)
    closed = np.where(np.isnan(depth), of_windows(known, np.maximum, range(-1, 2)), known)
    lowest = of_windows(closed, np.minimum, range(2))
    opened = of_windows(lowest, np.maximum, range(-1, 1))
    highest = of_windows(opened, np.maximum, range(-1, 2))
    expected = np.where(highest - opened > edge_m, highest, opened)
    np.testing.assert_allclose(occluding * step_m, np.maximum(expected, -3.2768), atol=step_m)
    for row, column in np.ndindex(tops.shape):
        block = expected[FINE_CELLS * row :, FINE_CELLS * column :][:FINE_CELLS, :FINE_CELLS]
        assert tops[row, column] == block.max()
    assert occluding[70, 40] * step_m < 0.02  # the spike
    assert occluding[19, 15] * step_m > 0.08  # beside the edge


def test_visibility_none_paints_the_board_and_says_so(tmp_path: Path) -> None:
    where = scenes.frame()
    inputs = DsmBackward.In(
        walls=scenes.walls(where),
        photos=scenes.photos(scenes.rendered()),
        cameras=scenes.cameras(scenes.camera(where)),
        cloud=scenes.cloud(where),
    )
    ctx = context(tmp_path)
    params = DsmBackward.Params(visibility="none", resampling="nearest")
    (layer,) = DsmBackward().run(inputs, params, ctx).layers.layers
    assert (layer.rgb[..., 2] == scenes.BLUE[scenes.BOARD]).sum() > 1000
    assert not (layer.mask == LayerMask.OCCLUDED).any()
    assert any("visibility none" in warning for warning in ctx.warnings)


NOTHING_SEEN = np.array([np.inf, -np.inf, np.inf, -np.inf, 0.0, 0.0, 0.0, 0.0])
# Rows and columns of the third block of the fourth row, which a tile begins with.
BLOCK = (3, 2)


def block_looked_at(
    depths: NDArray[np.float32],
    *,
    aside_m: float = 0.4,
    nearest_m: NDArray[np.float32] | float = np.inf,
    is_exact: bool = False,
) -> tuple[bool, TileVisibility]:
    """Whether a block goes fast, and what is found in it."""
    surface = surface_of(depths, is_transparent=False)
    camera = scenes.camera(scenes.frame(), aside_m=aside_m)
    shape = (BLOCK_CELLS, BLOCK_CELLS)
    visible = TileVisibility(
        u=np.full(shape, 7.0, dtype=np.float32),
        v=np.full(shape, 7.0, dtype=np.float32),
        mask=np.full(shape, 99, dtype=np.uint8),
        quality=np.full(shape, 7.0, dtype=np.float32),
        summary=NOTHING_SEEN.copy(),
    )
    row, column = BLOCK[0] * BLOCK_CELLS, BLOCK[1] * BLOCK_CELLS
    tile = (row, column, row + BLOCK_CELLS, column + BLOCK_CELLS)
    buffer = nothing_in_the_way(camera)
    if np.ndim(nearest_m) or np.isfinite(nearest_m):
        filled = np.broadcast_to(np.float32(nearest_m), (camera.height, camera.width))
        # A copy, since a view cannot be written to: the kernel would be compiled once more.
        buffer = DepthBuffer(nearest=np.array(filled, order="C"), reduction=1.0)
    done = look_at_blocks(
        view_of(camera, surface, PARAMS, is_exact=is_exact),
        surface.relief,
        buffer,
        visible,
        room_for_blocks(surface.relief, visible),
        tile,
        (BLOCK[0], BLOCK[1], BLOCK[1] + 1),
    )
    return bool(done), visible


def test_a_block_that_a_photo_sees_as_a_whole_goes_fast() -> None:
    flat = np.zeros(scenes.SHAPE, dtype=np.float32)
    flat[BLOCK[0] * BLOCK_CELLS + 3, BLOCK[1] * BLOCK_CELLS + 4] = np.nan
    done, visible = block_looked_at(flat)
    assert done
    assert (visible.mask == PAINTED).sum() == BLOCK_CELLS**2 - 1
    assert visible.mask[3, 4] == NO_SURFACE
    # Bounds of its places, how many, and those of its middle so many times.
    known = visible.mask == PAINTED
    u, v, n = visible.u[known], visible.v[known], BLOCK_CELLS**2 - 1
    assert visible.summary[0] < u.min() < u.max() < visible.summary[1]
    assert visible.summary[2] < v.min() < v.max() < visible.summary[3]
    middle = 0.5 * (BLOCK_CELLS - 1)
    column, row = BLOCK[1] * BLOCK_CELLS + middle, BLOCK[0] * BLOCK_CELLS + middle
    np.testing.assert_allclose(visible.summary[4:], [n, n * column, n * row, 0.0], atol=1e-6)
    assert not block_looked_at(flat, is_exact=True)[0]


def test_a_block_behind_the_cloud_goes_fast_and_one_in_doubt_does_not() -> None:
    flat = np.zeros(scenes.SHAPE, dtype=np.float32)
    done, visible = block_looked_at(flat, nearest_m=0.5)
    assert done
    assert (visible.mask == OCCLUDED).all()
    np.testing.assert_array_equal(visible.summary, NOTHING_SEEN)
    # Something hides a part of it.
    half = np.full((800, 1000), np.inf, dtype=np.float32)
    done, visible = block_looked_at(flat)
    half[:, : int(np.median(visible.u))] = 0.5
    assert not block_looked_at(flat, nearest_m=half)[0]
    void = flat.copy()
    void[BLOCK[0] * BLOCK_CELLS :][:BLOCK_CELLS] = np.nan
    assert not block_looked_at(void)[0]


def test_of_a_block_in_the_shadow_of_the_relief_nothing_is_seen() -> None:
    depths = np.zeros(scenes.SHAPE, dtype=np.float32)
    end = (BLOCK[1] + 1) * BLOCK_CELLS
    depths[:, end + 4 : end + 12] = 0.25
    done, visible = block_looked_at(depths, aside_m=1.4)
    assert done
    assert (visible.mask == OCCLUDED).all()
    np.testing.assert_array_equal(visible.summary, NOTHING_SEEN)
