"""Positions of cells in a photo, their occlusion, and sampling of colours."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho import painting, surfaces
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.parameters import BackwardParams, VisibilityParams
from orthoflow_plugins.ortho.visibility_kernels import (
    NO_SURFACE,
    OCCLUDED,
    PAINTED,
    Relief,
    TileVisibility,
    WallView,
)
from scipy.ndimage import map_coordinates

from orthoflow.geometry import WallFrame
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.geometry.occluders import nothing_in_the_way
from orthoflow.geometry.robust import depth_noise_m
from orthoflow.products import LayerMask, Wall
from tests import ortho_scenes as scenes
from tests import samples
from tests.raster_scenes import context

PARAMS = VisibilityParams(incidence_max_deg=80.0)


def noisy_depths() -> NDArray[np.float32]:
    rng = np.random.default_rng(6)
    depths = scenes.depth_m() + rng.normal(0.0, 0.002, scenes.SHAPE).astype(np.float32)
    depths[rng.random(scenes.SHAPE) < 0.01] = np.nan
    return depths


def wall_of(depths: NDArray[np.floating]) -> Wall:
    frame = samples.facing_south(GSD_M, *depths.shape[::-1], (1.0, 2.0, 3.0))
    return samples.wall(frame, depth_m=depths.astype(np.float32))


def surface_of(
    depths: NDArray[np.floating], *, hides: bool = True, where: WallFrame | None = None
) -> surfaces.Surface:
    """Return the scene's wall with other depths, or with another frame."""
    where = where or scenes.frame()
    relief = surfaces.relief_of(samples.wall(where, depth_m=depths.astype(np.float32)), hides=hides)
    return surfaces.Surface(frame=where, relief=relief, front_m=scenes.BUFFER_M, tolerance_m=0.008)


def seen_of(
    surface: surfaces.Surface, camera: ViewingCamera, buffer: DepthBuffer | None = None
) -> TileVisibility:
    view = surfaces.view_of(camera, surface, PARAMS)
    rows, columns = (slice(0, size) for size in scenes.SHAPE)
    return surfaces.cells_seen(
        view, surface.relief, buffer or nothing_in_the_way(camera), rows, columns
    )


@pytest.mark.parametrize("aside_m", [-0.7, 0.0, 1.4])
@pytest.mark.parametrize(("hides", "at_survey"), [(False, True), (True, False)])
def test_places_and_quality_match_the_camera(aside_m: float, hides: bool, at_survey: bool) -> None:
    where = scenes.frame(at_survey=at_survey)
    camera = replace(scenes.camera(where, aside_m=aside_m), skew=20.0)
    surface = surface_of(noisy_depths(), hides=hides, where=where)
    visible = seen_of(surface, camera)
    cosine_least = surfaces.view_of(camera, surface, PARAMS).cosine_least
    assert cosine_least == pytest.approx(math.cos(math.radians(80.0)))
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
    size = [camera.width, camera.height]
    inside = np.minimum(exact[:, :2], size - exact[:, :2]).min(axis=1)
    quality = cosine * area / exact[:, 2] ** 2 * np.clip(inside / (0.05 * min(size)), 0.0, 1.0)
    np.testing.assert_allclose(visible.quality[painted], quality, rtol=1e-5, atol=1e-4)


def are_hidden(view: WallView, relief: Relief, cells: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Trace rays to the camera; the surface between two cells is linear, and voids hide nothing.

    Rays rise, so a ray above the whole relief is not hit.
    """
    heights, highest = relief.occluding.astype(np.float64), float(relief.occluding.max())
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
        inside = (np.floor(at) >= 0).all(axis=1) & (np.ceil(at) < heights.shape).all(axis=1)
        followed, way, at = followed[inside], way[inside], at[inside]
        # If one side is void, the surface is unknown, however near the other cell is.
        with np.errstate(invalid="ignore"):
            surface = map_coordinates(heights, at.T, order=1)
        ray = depths[followed] + way * (view.height_m - depths[followed])
        is_met = np.isfinite(surface) & (surface > ray + view.tolerance_m)
        hidden[followed[is_met]] = True
        followed = followed[~is_met & (ray < highest)]
    return hidden


@pytest.mark.parametrize("aside_m", [-1.4, 0.0, 0.4, 1.4])
def test_every_cell_is_hidden_whose_ray_meets_the_relief(aside_m: float) -> None:
    rng = np.random.default_rng(8)
    depths = noisy_depths()
    for row, column in rng.integers(0, scenes.SHAPE, (40, 2)):
        rows, columns = rng.integers(1, 12, 2)
        depths[row : row + rows, column : column + columns] += rng.choice([-0.05, 0.01, 0.06])
    surface, camera = surface_of(depths), scenes.camera(scenes.frame(), aside_m=aside_m)
    visible = seen_of(surface, camera)
    asked = (visible.mask == PAINTED) | (visible.mask == OCCLUDED)
    # Trace each ray to the camera, regardless of bounds.
    view = surfaces.view_of(camera, surface, PARAMS)
    followed = are_hidden(view, surface.relief, np.argwhere(asked))
    assert 200 < followed.sum() < 0.5 * len(followed)
    np.testing.assert_array_equal(visible.mask[asked] == OCCLUDED, followed)


@pytest.mark.parametrize("aside_m", [-0.7, 1.4])
def test_a_point_hides_what_lies_behind_it_and_the_slab_of_the_wall(aside_m: float) -> None:
    where = scenes.frame()
    camera = scenes.camera(where, aside_m=aside_m)
    depths = noisy_depths()
    surface = surface_of(depths, hides=False)
    before = seen_of(surface, camera).mask
    free = before == PAINTED
    np.testing.assert_array_equal(before == NO_SURFACE, np.isnan(depths))
    rows, columns = np.nonzero(free)
    heights = depths[free].astype(np.float64)
    points = where.world_from_wall(np.column_stack([columns, rows]) + 0.5, heights)
    towards = camera.centre_world - points
    # Compute where the ray to the camera passes the front of the slab, and the depth of this
    # position along the axis.
    share = (surface.front_m - heights) / (towards @ where.normal_world)
    leaves_m = camera.project(points + share[:, None] * towards)[:, 2]
    for nearest_m in np.quantile(leaves_m, [0.1, 0.5, 0.9]):
        buffer = nothing_in_the_way(camera)._replace(
            nearest=np.full((1, 1), nearest_m, dtype=np.float32)
        )
        mask = seen_of(surface, camera, buffer).mask
        hidden = nearest_m < leaves_m - surface.tolerance_m
        # The buffer is float32; at 2 m, its precision is a quarter of a micrometre.
        is_clear = np.abs(nearest_m - (leaves_m - surface.tolerance_m)) > 1e-6
        assert 0.05 < hidden.mean() < 0.95
        np.testing.assert_array_equal((mask[free] == OCCLUDED)[is_clear], hidden[is_clear])


def test_what_hides_is_the_surface_without_spikes_and_with_its_edges_in_full(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(3)
    depth = rng.normal(0.0, 0.002, (77, 61)).astype(np.float32)
    depth[20:40, 10:30] += 0.1
    depth[50:60, 5:9] = depth[:2, :2] = depth[30, 50] = np.nan
    depth[70, 40] = 0.5
    edge_m = 0.015
    wall = samples.wall(samples.facing_south(edge_m / 5.0, 61, 77), depth_m=depth)
    relief = surfaces.relief_of(wall)
    occluding = relief.occluding
    # For writable arrays, kernels would be compiled again.
    assert not relief.depth.flags.writeable
    assert not occluding.flags.writeable
    assert surfaces.relief_of(wall, hides=False).highest_m == -np.inf
    # Bands of a large wall do not affect the result.
    monkeypatch.setattr(surfaces, "BAND_CELLS", 20 * 61)
    np.testing.assert_array_equal(surfaces.relief_of(wall).occluding, occluding)

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
    assert occluding[19, 15] > 0.08  # next to the edge


def test_visibility_none_paints_the_board_and_says_so(tmp_path: Path) -> None:
    ((layer,), ctx) = scenes.laid(DsmBackward, tmp_path, visibility="none", resampling="nearest")
    assert (layer.rgb[..., 2] == scenes.BLUE[scenes.BOARD]).sum() > 1000
    assert not (layer.mask == LayerMask.OCCLUDED).any()
    assert [one.code for one in ctx.diagnostics] == ["visibility-not-tested"]


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
    relief = surfaces.relief_of(samples.wall(samples.facing_south(gsd_m, 512, 1)), hides=False)
    # The memory behind the buffer contains values that hide everything.
    memory = np.array([[np.inf, 0.0]], dtype=np.float32)
    buffer = DepthBuffer(nearest=memory[:, :1], reduction=float(size))
    mask = surfaces.cells_seen(view, relief, buffer, slice(0, 1), slice(0, 512)).mask
    n_inside = np.count_nonzero(mask == PAINTED)
    assert 200 < n_inside < 300
    assert (mask[0, n_inside:] == LayerMask.OUTSIDE).all()


GSD_M = 0.01


@pytest.mark.parametrize(("least_m", "is_seen"), [(0.1, True), (1.99, True), (2.01, False)])
def test_a_camera_must_be_in_front_of_some_cell(least_m: float, is_seen: bool) -> None:
    depths = np.full((40, 40), 2.5)
    depths[35, 36] = least_m
    frame = wall_of(depths).frame
    surface, camera = surface_of(depths, hides=False, where=frame), scenes.camera(scenes.frame())
    centre = frame.world_from_wall(np.array([[20.0, 20.0]]), 2.0)[0]
    there = replace(camera, translation=-camera.rotation @ centre)
    assert surfaces.is_before(surfaces.view_of(there, surface, PARAMS), surface) == is_seen


def test_surfaces_tolerate_their_noise_and_what_cells_cannot_hold(tmp_path: Path) -> None:
    depths = np.random.default_rng(1).normal(0.0, 0.002, (60, 60))
    wall = wall_of(depths)
    walls = samples.walls(wall, replace(wall, plane_index=0), buffer_m=0.15)
    ctx = context(tmp_path)
    first, second = surfaces.surfaces_of(walls, ctx)
    noise_m = depth_noise_m(wall.depth_m)
    assert noise_m == pytest.approx(0.002, rel=0.1)
    assert first.tolerance_m == pytest.approx(3.0 * noise_m + 0.5 * GSD_M)
    assert first.front_m == 0.15
    assert first.frame is wall.frame
    assert first.relief.occluding.size == second.relief.occluding.size == 3600
    (clear, _) = surfaces.surfaces_of(walls, ctx, hides=False)
    assert clear.relief.occluding.size == 0
    assert clear.tolerance_m == 0.5 * GSD_M  # no noise


@pytest.mark.parametrize("reach", [0, 3])
def test_cells_near_hidden_patches_are_those_within_reach_of_two_by_two(reach: int) -> None:
    hidden = np.random.default_rng(0).random((23, 31)) < 0.12
    hidden[5:7, 20:22] = hidden[0:2, 0:2] = hidden[21:23, 29:31] = True
    hidden[12, 3:12] = True  # one row is not a patch
    hidden[11, 3:12] = hidden[13, 3:12] = False
    near = np.zeros(hidden.shape, dtype=np.bool_)
    for row in range(22):
        for column in range(30):
            if hidden[row : row + 2, column : column + 2].all():
                top, left = max(0, row - reach), max(0, column - reach)
                near[top : row + 2 + reach, left : column + 2 + reach] = True
    inner = (slice(reach + 1, -reach - 1),) * 2
    np.testing.assert_array_equal(painting.near_patches(hidden, reach)[inner], near[inner])


@pytest.mark.parametrize("aside_m", [0.0, 0.5])
def test_a_footprint_is_that_of_the_middle_of_what_is_painted(aside_m: float) -> None:
    where = scenes.frame()
    camera = scenes.camera(where, aside_m=aside_m)
    surface = surface_of(np.full(scenes.SHAPE, 0.03))
    # There are nine cells around column 31, row 14, in a tile with a margin of two cells.
    painted = np.zeros((20, 40), dtype=np.bool_)
    painted[13 - 10 : 16 - 10, 30 - 18 : 33 - 18] = True
    tile, inner = (slice(12, 30), slice(20, 58)), (slice(2, 20), slice(2, 40))
    found = painting.footprint_of(
        surfaces.view_of(camera, surface, PARAMS), surface, painted, tile, inner
    )
    points = where.world_from_wall(np.array([[31.5, 14.5], [35.5, 14.5], [31.5, 18.5]]), 0.03)
    pixels = camera.project(points)
    # Measured over four cells.
    across, down = np.linalg.norm(pixels[1:, :2] - pixels[0, :2], axis=0) / 4.0
    ray = camera.centre_world - points[0]
    cosine = float(ray @ where.normal_world) / np.linalg.norm(ray)
    assert vars(found) == pytest.approx(
        {
            "pixels_across": across,
            "pixels_down": down,
            "photo_gsd_m": pixels[0, 2] / math.sqrt(camera.fx * camera.fy),
            "obliquity_deg": math.degrees(math.acos(cosine)),
            "n_cells": 9,
        }
    )


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("size", [(40, 60), (1, 7), (6, 1), (1, 1)], ids=str)
def test_bilinear_colours_are_those_of_the_formula(depth: int, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    photo = rng.integers(0, 2**depth, (*size, 3), dtype=np.uint8 if depth == 8 else np.uint16)
    # Positions are relative to the centre of the first pixel of a part that begins at column 7 and
    # row 3.
    u, v = rng.uniform(-4.0, 66.0, (2, 30, 40)).astype(np.float32)
    is_painted = rng.random(u.shape) < 0.9
    last_u, last_v = size[1] - 1, size[0] - 1
    across, down = np.clip(u.astype(float), 0, last_u), np.clip(v.astype(float), 0, last_v)
    left, upper = np.floor(across).astype(int), np.floor(down).astype(int)
    right, lower = np.minimum(left + 1, last_u), np.minimum(upper + 1, last_v)
    a, d = (across - left)[..., None], (down - upper)[..., None]
    above = photo[upper, left] * (1 - a) + photo[upper, right] * a
    below = photo[lower, left] * (1 - a) + photo[lower, right] * a
    expected = np.where(is_painted[..., None], above * (1 - d) + below * d, 0.0)
    visible = TileVisibility(u + 7.5, v + 3.5, is_painted.astype(np.uint8), np.ones_like(u))
    inner, colours = (slice(2, 29), slice(3, 40)), np.empty((27, 37, 3), dtype=photo.dtype)
    painting.sample_bilinear(photo, (7, 3), visible, inner, colours)
    # Positions are float32; a millionth of a pixel is a sixteenth of a 16-bit level.
    tolerance = 0.5 + (1e-3 if depth == 8 else 0.5)
    assert np.abs(colours - expected[inner]).max() <= tolerance


def places_of(rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return positions of cells in a photo."""
    rows, columns = np.indices((16, 24))
    u = 41.0 + 2.3 * columns + 0.1 * rows + rng.uniform(0, 0.2, rows.shape)
    v = 37.0 + 1.9 * rows - 0.2 * columns + rng.uniform(0, 0.2, rows.shape)
    return u.astype(np.float32), v.astype(np.float32)


def sampled(photo: Any, pixels: tuple[float, float], resampling: Any) -> Any:
    u, v = places_of(np.random.default_rng(0))
    across, down = pixels
    footprint = painting.CellFootprint(
        pixels_across=across, pixels_down=down, photo_gsd_m=0.001, obliquity_deg=0.0, n_cells=9
    )
    bounds = tuple(math.floor(value) for value in (u.min(), u.max(), v.min(), v.max()))
    visible = TileVisibility(u, v, np.ones(u.shape, dtype=np.uint8), np.ones_like(u))
    inner, colours = (slice(0, u.shape[0]), slice(0, u.shape[1])), np.empty((*u.shape, 3), np.uint8)
    params = BackwardParams(resampling=resampling)
    painting.sample(photo, visible, inner, bounds, footprint, params, into=colours)
    return colours


@pytest.mark.parametrize("resampling", ["nearest", "bilinear", "cubic", "lanczos"])
@pytest.mark.parametrize("pixels", [(1.0, 1.0), (2.3, 1.9)])
def test_parts_of_a_photo_are_sampled_alike(resampling: Any, pixels: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    photo = cv2.GaussianBlur(rng.integers(0, 256, (120, 160, 3), dtype=np.uint8), (0, 0), 1.5)
    u, v = places_of(np.random.default_rng(0))
    found = sampled(photo, pixels, resampling)
    if resampling == "nearest":
        expected = photo[np.floor(v).astype(int), np.floor(u).astype(int)]
        np.testing.assert_array_equal(found, expected)
        return
    if max(pixels) > 1.0:
        # A cell of n pixels is their mean, like a Gaussian of half of sqrt(n^2 - 1) pixels.
        sigmas = [0.5 * math.sqrt(n**2 - 1.0) for n in pixels]
        photo = cv2.GaussianBlur(
            photo, (0, 0), sigmaX=sigmas[0], sigmaY=sigmas[1], borderType=cv2.BORDER_REPLICATE
        )
    flag = {"bilinear": 1, "cubic": cv2.INTER_CUBIC, "lanczos": cv2.INTER_LANCZOS4}[resampling]
    apart = np.abs(found.astype(int) - cv2.remap(photo, u - 0.5, v - 0.5, flag))
    # OpenCV rounds positions to 1/32 pixel, and its kernel is slightly wider than ours.
    assert apart.mean() < 0.6
    assert apart.max() <= 6


@pytest.mark.parametrize(("pixels", "is_blurred"), [(1.06, False), (1.3, True)])
def test_only_cells_of_several_pixels_are_averaged(pixels: float, is_blurred: bool) -> None:
    """With 8 bits, a Gaussian of less than a fifth of a pixel has no effect."""
    photo = np.random.default_rng(1).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    plain, filtered = (sampled(photo, (1.0, down), "cubic") for down in (1.0, pixels))
    assert (plain != filtered).any() == is_blurred
