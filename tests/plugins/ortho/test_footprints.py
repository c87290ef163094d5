"""How a photo sees the middle of a tile, and what of the photo is averaged for a cell."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from orthoflow_plugins.ortho.photos_on_walls import VisibilityParams
from orthoflow_plugins.ortho.sampling import CellFootprint, footprint_of, sample
from orthoflow_plugins.ortho.surfaces import Surface, relief_of, view_of

from tests import ortho_scenes as scenes

PARAMS = VisibilityParams(incidence_max_deg=80.0, border_share=0.05)


@pytest.mark.parametrize("aside_m", [0.0, 0.5])
def test_a_footprint_is_that_of_the_middle_of_what_is_painted(aside_m: float) -> None:
    where = scenes.frame()
    camera = scenes.camera(where, aside_m=aside_m)
    surface = Surface(
        frame=where,
        relief=relief_of(scenes.walls(where, scenes.depth_m()).walls[0], threads=1),
        front_m=scenes.BUFFER_M,
        tolerance_m=0.008,
    )
    view = view_of(camera, surface, PARAMS)
    # Nine cells about column 31, row 14, 3 cm before the wall.
    visible: Any = SimpleNamespace(summary=np.array([0, 0, 0, 0, 9, 9 * 31, 9 * 14, 9 * 0.03]))
    found = footprint_of(view, visible)
    at = np.array([[31.5, 14.5], [35.5, 14.5], [31.5, 18.5]])
    points = where.world_from_wall(at, 0.03)
    pixels = camera.project(points)
    # Over four cells.
    assert found.pixels_across == pytest.approx(
        math.hypot(pixels[1, 0] - pixels[0, 0], pixels[2, 0] - pixels[0, 0]) / 4.0, rel=1e-6
    )
    assert found.pixels_down == pytest.approx(
        math.hypot(pixels[1, 1] - pixels[0, 1], pixels[2, 1] - pixels[0, 1]) / 4.0, rel=1e-6
    )
    assert found.photo_gsd_m == pytest.approx(pixels[0, 2] / math.sqrt(camera.fx * camera.fy))
    ray = camera.centre_world - points[0]
    cosine = float(ray @ where.normal_world) / np.linalg.norm(ray)
    assert found.obliquity_deg == pytest.approx(math.degrees(math.acos(cosine)), abs=1e-6)
    assert found.n_cells == 9


def visible_of(rng: np.random.Generator, shape: tuple[int, int]) -> Any:
    """Places of cells in a photo, and their bounds."""
    rows, columns = np.indices(shape)
    u = (41.0 + 2.3 * columns + 0.1 * rows + rng.uniform(0, 0.2, shape)).astype(np.float32)
    v = (33.0 + 1.9 * rows - 0.2 * columns + rng.uniform(0, 0.2, shape)).astype(np.float32)
    summary = np.array([u.min(), u.max(), v.min(), v.max(), u.size, 0.0, 0.0, 0.0])
    return SimpleNamespace(u=u, v=v, summary=summary)


def footprint(across: float, down: float) -> CellFootprint:
    return CellFootprint(
        pixels_across=across, pixels_down=down, photo_gsd_m=0.001, obliquity_deg=0.0, n_cells=9
    )


@pytest.mark.parametrize("resampling", ["nearest", "bilinear", "cubic", "lanczos"])
@pytest.mark.parametrize("is_filtered", [False, True])
def test_what_is_cut_out_of_a_photo_does_not_show(resampling: Any, is_filtered: bool) -> None:
    rng = np.random.default_rng(0)
    photo = cv2.GaussianBlur(rng.integers(0, 256, (120, 160, 3), dtype=np.uint8), (0, 0), 1.5)
    visible = visible_of(rng, (20, 30))
    u, v = visible.u.copy(), visible.v.copy()
    inner = (slice(2, 18), slice(3, 27))
    into = np.zeros((16, 24, 3), dtype=np.uint8)
    found = sample(
        photo, visible, inner, footprint(2.3, 1.9), resampling, is_filtered=is_filtered, into=into
    )
    if resampling == "nearest":
        expected = photo[np.floor(v[inner]).astype(int), np.floor(u[inner]).astype(int)]
        np.testing.assert_array_equal(found, expected)
        return
    # A cell of n pixels is their mean: a Gauss of half of sqrt(n^2 - 1) pixels.
    whole = photo
    if is_filtered:
        sigmas = [0.5 * math.sqrt(n**2 - 1.0) for n in (2.3, 1.9)]
        whole = cv2.GaussianBlur(
            photo, (0, 0), sigmaX=sigmas[0], sigmaY=sigmas[1], borderType=cv2.BORDER_REPLICATE
        )
    flag = {"bilinear": 1, "cubic": cv2.INTER_CUBIC, "lanczos": cv2.INTER_LANCZOS4}[resampling]
    expected = cv2.remap(whole, u[inner] - 0.5, v[inner] - 0.5, flag)
    apart = np.abs(found.astype(int) - expected)
    # OpenCV knows places to a 32nd of a pixel, and its own kernel is a little wider than ours.
    assert apart.mean() < 0.6
    assert apart.max() <= 6


@pytest.mark.parametrize(("pixels", "is_blurred"), [(1.06, False), (1.3, True)])
def test_cells_of_hardly_more_than_a_pixel_are_not_averaged(
    pixels: float, is_blurred: bool
) -> None:
    """Eight bits do not show a Gauss of less than a fifth of a pixel."""
    rng = np.random.default_rng(1)
    photo = rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)
    inner = (slice(0, 20), slice(0, 30))
    shown = []
    for is_filtered in (False, True):
        visible = visible_of(np.random.default_rng(0), (20, 30))
        into = np.zeros((20, 30, 3), dtype=np.uint8)
        sample(
            photo, visible, inner, footprint(1.0, pixels), "cubic",
            is_filtered=is_filtered, into=into,
        )  # fmt: skip
        shown.append(into)
    assert (shown[0] != shown[1]).any() == is_blurred
