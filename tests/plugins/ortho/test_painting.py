"""Which cells near hidden ones are left out, and how colours are sampled from a photo."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.painting import (
    CellFootprint,
    footprint_of,
    near_patches,
    sample,
    sample_bilinear,
)
from orthoflow_plugins.ortho.parameters import BackwardParams, VisibilityParams
from orthoflow_plugins.ortho.surfaces import Surface, relief_of, view_of
from orthoflow_plugins.ortho.visibility_kernels import TileVisibility

from tests import ortho_scenes as scenes


@pytest.mark.parametrize("reach", [0, 3])
def test_cells_near_hidden_patches_are_those_within_reach_of_two_by_two(reach: int) -> None:
    hidden = np.random.default_rng(0).random((23, 31)) < 0.12
    hidden[5:7, 20:22] = hidden[0:2, 0:2] = hidden[21:23, 29:31] = True
    hidden[12, 3:12] = True  # one row is no patch
    hidden[11, 3:12] = hidden[13, 3:12] = False
    near = np.zeros(hidden.shape, dtype=np.bool_)
    for row in range(22):
        for column in range(30):
            if hidden[row : row + 2, column : column + 2].all():
                top, left = max(0, row - reach), max(0, column - reach)
                near[top : row + 2 + reach, left : column + 2 + reach] = True
    inner = (slice(reach + 1, -reach - 1),) * 2
    np.testing.assert_array_equal(near_patches(hidden, reach)[inner], near[inner])


@pytest.mark.parametrize("aside_m", [0.0, 0.5])
def test_a_footprint_is_that_of_the_middle_of_what_is_painted(aside_m: float) -> None:
    where = scenes.frame()
    camera = scenes.camera(where, aside_m=aside_m)
    depths = np.full(scenes.SHAPE, 0.03, dtype=np.float32)
    surface = Surface(
        frame=where,
        relief=relief_of(scenes.walls(where, depths).walls[0]),
        front_m=scenes.BUFFER_M,
        tolerance_m=0.008,
    )
    # Nine cells about column 31, row 14, of a tile whose margin begins two cells before it.
    painted = np.zeros((20, 40), dtype=np.bool_)
    painted[13 - 10 : 16 - 10, 30 - 18 : 33 - 18] = True
    tile, inner = (slice(12, 30), slice(20, 58)), (slice(2, 20), slice(2, 40))
    params = VisibilityParams(incidence_max_deg=80.0)
    found = footprint_of(view_of(camera, surface, params), surface, painted, tile, inner)
    at = np.array([[31.5, 14.5], [35.5, 14.5], [31.5, 18.5]])
    points = where.world_from_wall(at, 0.03)
    pixels = camera.project(points)
    # Over four cells.
    across, down = (
        math.hypot(pixels[1, k] - pixels[0, k], pixels[2, k] - pixels[0, k]) / 4.0 for k in range(2)
    )
    assert found.pixels_across == pytest.approx(across, rel=1e-6)
    assert found.pixels_down == pytest.approx(down, rel=1e-6)
    assert found.photo_gsd_m == pytest.approx(pixels[0, 2] / math.sqrt(camera.fx * camera.fy))
    ray = camera.centre_world - points[0]
    cosine = float(ray @ where.normal_world) / np.linalg.norm(ray)
    assert found.obliquity_deg == pytest.approx(math.degrees(math.acos(cosine)), abs=1e-6)
    assert found.n_cells == 9


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("size", [(40, 60), (1, 7), (6, 1), (1, 1)], ids=str)
def test_bilinear_colours_are_those_of_the_formula(depth: int, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    photo = rng.integers(0, 2**depth, (*size, 3), dtype=np.uint8 if depth == 8 else np.uint16)
    # From the centre of the first pixel of a part that begins at column 7 and row 3.
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
    sample_bilinear(photo, (7, 3), visible, inner, colours)
    # Positions are float32: a millionth of a pixel is a sixteenth of a level of 16 bits.
    tolerance = 0.5 + (1e-3 if depth == 8 else 0.5)
    assert np.abs(colours - expected[inner]).max() <= tolerance


def places_of(rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions of cells in a photo."""
    rows, columns = np.indices((16, 24))
    u = 41.0 + 2.3 * columns + 0.1 * rows + rng.uniform(0, 0.2, rows.shape)
    v = 37.0 + 1.9 * rows - 0.2 * columns + rng.uniform(0, 0.2, rows.shape)
    return u.astype(np.float32), v.astype(np.float32)


def sampled(photo: Any, pixels: tuple[float, float], resampling: Any, *, antialias: bool) -> Any:
    u, v = places_of(np.random.default_rng(0))
    across, down = pixels
    footprint = CellFootprint(
        pixels_across=across, pixels_down=down, photo_gsd_m=0.001, obliquity_deg=0.0, n_cells=9
    )
    bounds = tuple(math.floor(value) for value in (u.min(), u.max(), v.min(), v.max()))
    visible = TileVisibility(u, v, np.ones(u.shape, dtype=np.uint8), np.ones_like(u))
    inner, colours = (slice(0, u.shape[0]), slice(0, u.shape[1])), np.empty((*u.shape, 3), np.uint8)
    params = BackwardParams(resampling=resampling, antialias=antialias)
    sample(photo, visible, inner, bounds, footprint, params, into=colours)
    return colours


@pytest.mark.parametrize("resampling", ["nearest", "bilinear", "cubic", "lanczos"])
@pytest.mark.parametrize("antialias", [False, True])
def test_what_is_cut_out_of_a_photo_does_not_show(resampling: Any, antialias: bool) -> None:
    rng = np.random.default_rng(0)
    photo = cv2.GaussianBlur(rng.integers(0, 256, (120, 160, 3), dtype=np.uint8), (0, 0), 1.5)
    u, v = places_of(np.random.default_rng(0))
    found = sampled(photo, (2.3, 1.9), resampling, antialias=antialias)
    if resampling == "nearest":
        expected = photo[np.floor(v).astype(int), np.floor(u).astype(int)]
        np.testing.assert_array_equal(found, expected)
        return
    # A cell of n pixels is their mean: a Gauss of half of sqrt(n^2 - 1) pixels.
    whole = photo
    if antialias:
        sigmas = [0.5 * math.sqrt(n**2 - 1.0) for n in (2.3, 1.9)]
        whole = cv2.GaussianBlur(
            photo, (0, 0), sigmaX=sigmas[0], sigmaY=sigmas[1], borderType=cv2.BORDER_REPLICATE
        )
    flag = {"bilinear": 1, "cubic": cv2.INTER_CUBIC, "lanczos": cv2.INTER_LANCZOS4}[resampling]
    expected = cv2.remap(whole, u - 0.5, v - 0.5, flag)
    apart = np.abs(found.astype(int) - expected)
    # OpenCV knows places to a 32nd of a pixel, and its own kernel is a little wider than ours.
    assert apart.mean() < 0.6
    assert apart.max() <= 6


@pytest.mark.parametrize(("pixels", "is_blurred"), [(1.06, False), (1.3, True)])
def test_cells_of_hardly_more_than_a_pixel_are_not_averaged(
    pixels: float, is_blurred: bool
) -> None:
    """Eight bits do not show a Gauss of less than a fifth of a pixel."""
    photo = np.random.default_rng(1).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    plain, filtered = (
        sampled(photo, (1.0, pixels), "cubic", antialias=antialias) for antialias in (False, True)
    )
    assert (plain != filtered).any() == is_blurred
