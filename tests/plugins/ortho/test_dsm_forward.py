"""Rays of every sixteenth pixel, and what lies between them."""

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
