"""Where the backward projection finds cells in a photo, against the exact camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.parameters import VisibilityParams
from orthoflow_plugins.ortho.surfaces import Surface, cells_seen, relief_of, view_of
from orthoflow_plugins.ortho.visibility_kernels import (
    NO_SURFACE,
    OCCLUDED,
    PAINTED,
    Relief,
    TileVisibility,
    WallView,
)

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.geometry.occluders import nothing_in_the_way
from orthoflow.products import LayerMask
from tests import ortho_scenes as scenes
from tests import samples
from tests.raster_scenes import context

PARAMS = VisibilityParams(incidence_max_deg=80.0)


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
        relief=relief_of(wall, hides=not is_transparent),
        front_m=scenes.BUFFER_M,
        tolerance_m=0.008,
    )


def seen(camera: ViewingCamera, *, is_transparent: bool) -> TileVisibility:
    return seen_of(surface_of(noisy_depths(), is_transparent=is_transparent), camera)


def seen_of(
    surface: Surface,
    camera: ViewingCamera,
    buffer: DepthBuffer | None = None,
) -> TileVisibility:
    view = view_of(camera, surface, PARAMS)
    rows, columns = (slice(0, size) for size in scenes.SHAPE)
    return cells_seen(view, surface.relief, buffer or nothing_in_the_way(camera), rows, columns)


@pytest.mark.parametrize("aside_m", [-0.7, 0.0, 1.4])
@pytest.mark.parametrize("is_transparent", [True, False], ids=["none", "full"])
def test_places_and_quality_are_those_of_the_camera(aside_m: float, is_transparent: bool) -> None:
    where = scenes.frame()
    camera = replace(scenes.camera(where, aside_m=aside_m), skew=20.0)
    visible = seen(camera, is_transparent=is_transparent)
    painted = visible.mask == PAINTED
    rows, columns = np.nonzero(painted)
    depths = noisy_depths()[painted].astype(np.float64)
    points = where.world_from_wall(np.column_stack([columns, rows]) + 0.5, depths)
    exact = camera.project(points)
    assert painted.mean() > 0.7
    np.testing.assert_allclose(visible.u[painted], exact[:, 0], atol=1e-3)
    np.testing.assert_allclose(visible.v[painted], exact[:, 1], atol=1e-3)
    towards = camera.centre_world - points
    cosine = towards @ where.normal_world / np.linalg.norm(towards, axis=1)
    area = camera.fx * camera.fy * where.gsd_m**2
    inside = np.minimum.reduce(
        [exact[:, 0], camera.width - exact[:, 0], exact[:, 1], camera.height - exact[:, 1]]
    )
    border = 0.05 * min(camera.width, camera.height)
    quality = cosine * area / exact[:, 2] ** 2 * np.clip(inside / border, 0.0, 1.0)
    np.testing.assert_allclose(visible.quality[painted], quality, rtol=1e-5, atol=1e-4)


def are_hidden(view: WallView, relief: Relief, cells: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Follow rays to the camera: the surface between two cells is linear, void hides nothing.

    They rise, so that nothing of the relief meets a ray that is above all of it.
    """
    heights, highest = relief.occluding, float(relief.occluding.max())
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
        with np.errstate(invalid="ignore"):
            surface = np.where(share == 0.0, one, (1.0 - share) * one + share * other)
        ray = depths[followed] + way * (view.height_m - depths[followed])
        is_known = np.isfinite(one) & np.isfinite(other)
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


@pytest.mark.parametrize("aside_m", [-0.7, 1.4])
def test_a_point_hides_what_lies_behind_it_and_the_slab_of_the_wall(
    aside_m: float,
) -> None:
    where = scenes.frame()
    camera = scenes.camera(where, aside_m=aside_m)
    depths = noisy_depths()
    surface = surface_of(depths, is_transparent=True)
    before = seen_of(surface, camera).mask
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
        mask = seen_of(surface, camera, buffer).mask
        hidden = nearest_m < leaves_m - surface.tolerance_m
        # The buffer is float32: at 2 m it knows a quarter of a micrometre.
        is_clear = np.abs(nearest_m - (leaves_m - surface.tolerance_m)) > 1e-6
        assert 0.05 < hidden.mean() < 0.95
        np.testing.assert_array_equal((mask[free] == OCCLUDED)[is_clear], hidden[is_clear])


def test_what_hides_is_the_surface_without_spikes_and_with_its_edges_in_full() -> None:
    rng = np.random.default_rng(3)
    depth = rng.normal(0.0, 0.002, (77, 61)).astype(np.float32)
    depth[20:40, 10:30] += 0.1
    depth[50:60, 5:9] = depth[:2, :2] = depth[30, 50] = np.nan
    depth[70, 40] = 0.5
    edge_m = 0.015
    frame = samples.facing_south(edge_m / 5.0, 61, 77)
    occluding = relief_of(samples.wall(frame, depth_m=depth)).occluding

    def of_windows(
        values: NDArray[np.float32], pick: np.ufunc, steps: range
    ) -> NDArray[np.float32]:
        padded = np.pad(values, 1, mode="edge")
        rows, columns = values.shape
        parts = [padded[1 + i :, 1 + j :][:rows, :columns] for i in steps for j in steps]
        return np.asarray(pick.reduce(parts), dtype=np.float32)

    known = np.where(np.isnan(depth), np.float32(-np.inf), depth)
    closed = np.where(np.isnan(depth), of_windows(known, np.maximum, range(-1, 2)), known)
    lowest = of_windows(closed, np.minimum, range(2))
    opened = of_windows(lowest, np.maximum, range(-1, 1))
    with np.errstate(invalid="ignore"):
        highest = of_windows(opened, np.maximum, range(-1, 2))
        expected = np.where(highest - opened > np.float32(edge_m), highest, opened)
    np.testing.assert_array_equal(occluding, expected)
    assert occluding[70, 40] < 0.02  # the spike
    assert occluding[19, 15] > 0.08  # beside the edge


def test_visibility_none_paints_the_board_and_says_so(tmp_path: Path) -> None:
    inputs = scenes.inputs(DsmBackward.In)
    ctx = context(tmp_path)
    params = DsmBackward.Params(visibility="none", resampling="nearest")
    (layer,) = DsmBackward().run(inputs, params, ctx).layers.layers
    assert (layer.rgb[..., 2] == scenes.BLUE[scenes.BOARD]).sum() > 1000
    assert not (layer.mask == LayerMask.OCCLUDED).any()
    assert any("visibility none" in warning for warning in ctx.warnings)


def test_cells_at_the_border_of_a_photo_ask_the_last_pixel_of_the_buffer() -> None:
    # Positions just before column 8190, divided by 8190, are 1 in float32.
    size, gsd_m = 8190, 1e-8
    assert np.nextafter(np.float32(size), np.float32(0.0)) * np.float32(1.0 / size) == 1.0
    flat = np.zeros(25)
    flat[[0, 4, 8, 11]] = 1.0, 1.0, -1.0, 1.0
    flat[12:16], flat[21:24] = (3000.0, 3000.0, size - 0.0077, 2000.0), (size, size, 10.0)
    view = WallView(
        camera=flat, column=0.0, row=0.0, height_m=1.0, gsd_m=gsd_m, front_m=0.1,
        tolerance_m=0.001, cosine_least=0.1, border_px=1.0,
    )  # fmt: skip
    relief = relief_of(samples.wall(samples.facing_south(gsd_m, 512, 1)), hides=False)
    # What lies behind the buffer in memory hides everything.
    memory = np.array([[np.inf, 0.0]], dtype=np.float32)
    buffer = DepthBuffer(nearest=memory[:, :1], reduction=float(size))
    mask = cells_seen(view, relief, buffer, slice(0, 1), slice(0, 512)).mask
    n_inside = np.count_nonzero(mask == PAINTED)
    assert 200 < n_inside < 300
    assert (mask[0, n_inside:] == LayerMask.OUTSIDE).all()
