"""Rays of every sixteenth pixel, and which cells a photo shows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from orthoflow_plugins.ortho import dsm_forward
from orthoflow_plugins.ortho.surfaces import Surface, relief_of

from orthoflow.geometry.cameras import ViewingCamera
from tests import ortho_scenes as scenes

WHERE = scenes.frame()


def surface_of(depths: np.ndarray) -> Surface:
    wall = scenes.walls(WHERE, depths).walls[0]
    return Surface(
        frame=WHERE,
        relief=relief_of(wall, hides=False),
        front_m=scenes.BUFFER_M,
        tolerance_m=0.008,
    )


@cache
def flat() -> Surface:
    return surface_of(np.zeros(scenes.SHAPE, dtype=np.float32))


def sized(width: int, height: int) -> ViewingCamera:
    return replace(scenes.camera(WHERE, aside_m=0.3), width=width, height=height)


@pytest.mark.parametrize("size", [(160, 128), (100, 90), (177, 113), (33, 15)], ids=str)
def test_rays_between_those_of_the_lattice_are_those_of_the_camera(size: tuple[int, int]) -> None:
    camera = sized(*size)
    lattice = dsm_forward._ray_lattice(camera, flat())
    assert lattice.shape == (size[1] // 16 + 2, size[0] // 16 + 2, 3)

    def between(u: float, v: float) -> np.ndarray:
        """Of the four rays about a place, each as far as the place is near."""
        column, row = int(u // 16), int(v // 16)
        a, d = u / 16 - column, v / 16 - row
        corner = lattice[row : row + 2, column : column + 2]
        return np.asarray(
            (1 - d) * ((1 - a) * corner[0, 0] + a * corner[0, 1])
            + d * ((1 - a) * corner[1, 0] + a * corner[1, 1])
        )

    axes = np.column_stack(
        [WHERE.u_world / WHERE.gsd_m, WHERE.v_world / WHERE.gsd_m, WHERE.normal_world]
    )
    # At the places of the lattice, and at the border of the photo wherever that lies between two.
    places = [(u, v) for u in range(0, size[0], 16) for v in range(0, size[1], 16)]
    places += [(u, size[1]) for u in range(0, size[0], 16)]
    places += [(size[0], v) for v in range(0, size[1], 16)]
    exact = camera.rays_camera(np.array(places, dtype=np.float64)) @ camera.rotation @ axes
    for (u, v), ray in zip(places, exact, strict=True):
        # Just before the border: what lies beyond is not asked for.
        found = between(min(u, size[0] - 1e-9), min(v, size[1] - 1e-9))
        np.testing.assert_allclose(found, ray, atol=1e-5 * np.linalg.norm(ray))


@pytest.mark.parametrize("moved_px", [(0.0, 0.0), (-300.0, -250.0)], ids=["right", "left"])
def test_cells_are_seen_inside_the_photo_and_worth_their_pixels(
    moved_px: tuple[float, float],
) -> None:
    depths = scenes.depth_m()
    depths[30:60, 20:50] = np.nan
    surface = surface_of(depths)
    # A photo of a part of the wall.
    camera = scenes.camera(WHERE, aside_m=0.4, width=1000)
    camera = replace(
        camera, width=700, height=500, cx=camera.cx + moved_px[0], cy=camera.cy + moved_px[1]
    )
    rows = slice(20, 200)
    seen, quality = dsm_forward._seen(camera, surface, rows, border_px=40.0)
    at = np.stack(np.meshgrid(np.arange(scenes.SHAPE[1]), np.arange(20, 200)), axis=-1) + 0.5
    heights = depths[rows].ravel().astype(np.float64)
    points = WHERE.world_from_wall(at.reshape(-1, 2), heights)
    u, v, along = camera.project(points).T
    with np.errstate(invalid="ignore"):
        inside = np.min([u, 700.0 - u, v, 500.0 - v], axis=0)
        expected = (inside >= 0.0) & (u < 700.0) & (v < 500.0)
    np.testing.assert_array_equal(seen.ravel(), expected)
    assert 0.1 < expected.mean() < 0.9
    # Some of what is not seen lies beside the photo by less than a pixel, or is by less within it.
    assert (expected & (inside < 1.0)).any()
    towards = camera.centre_world - points
    cosine = towards @ WHERE.normal_world / np.linalg.norm(towards, axis=1)
    area = camera.fx * camera.fy * WHERE.gsd_m**2 / along**2
    worth = np.where(expected, cosine * area * np.clip(inside / 40.0, 0.0, 1.0), 0.0)
    np.testing.assert_allclose(quality.ravel(), np.nan_to_num(worth), rtol=1e-5, atol=1e-6)
