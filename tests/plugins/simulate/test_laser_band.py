"""What the laser sees of materials: contrast the other way round, wet patches, blinding spots."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.simulate.scanning import laser_reflectance

from orthoflow.geometry.scenes import Scene, SurfaceRole, TextureKind

SIDE_M = 20.0


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Two materials, side by side in the plane z = 0; reflectance 0.5 each."""
    paints = [(200.0, 180.0, 160.0, 0.5, 0.3, 0.3, seed, 0.0) for seed in (7.0, 8.0)]
    return Scene(
        origin=np.zeros(3),
        centre=np.array([[0.0, 0.0, 0.0], [SIDE_M, 0.0, 0.0]]),
        axis_a=np.tile([1.0, 0.0, 0.0], (2, 1)),
        axis_b=np.tile([0.0, 1.0, 0.0], (2, 1)),
        extent=np.tile([-SIDE_M / 2, SIDE_M / 2, -SIDE_M / 2, SIDE_M / 2], (2, 1)),
        plane_index=np.zeros(2, dtype=np.int16),
        role=np.full(2, SurfaceRole.WALL, dtype=np.uint8),
        texture=np.full(2, TextureKind.PLAIN, dtype=np.int32),
        texture_params=np.array(paints),
        hole_rectangle=np.zeros(0, dtype=np.int32),
        hole_extent=np.zeros((0, 4)),
    )


def seen(
    scene: Scene,
    red: NDArray[np.float64],
    green: NDArray[np.float64],
    *,
    inversion: float = 1.0,
    material: int = 0,
    at: tuple[float, float] = (0.1, 0.1),
) -> NDArray[np.float64]:
    """Reflectance of colours 0..255, all at one place."""
    n = len(red)
    points = np.tile(np.array([[at[0]], [at[1]], [0.0]]), n) + scene.centre[material][:, None]
    colours = np.array([red, green, np.full(n, 90.0), np.full(n, 0.5)], dtype=np.float32)
    rectangle = np.full(n, material, dtype=np.int32)
    return laser_reflectance(scene, rectangle, points, colours, inversion, 3)


@pytest.mark.parametrize("material", [0, 1])
def test_reflectance_falls_with_red_and_rises_with_green(scene: Scene, material: int) -> None:
    rising, fixed = np.linspace(0.0, 255.0, 9), np.full(9, 120.0)
    assert (np.diff(seen(scene, rising, fixed, material=material)) < 0.0).all()
    assert (np.diff(seen(scene, fixed, rising, material=material)) > 0.0).all()
    # Without inversion the laser sees what the textures say, and half way with half of it.
    none, half, all_of = (seen(scene, rising, fixed, inversion=share) for share in (0.0, 0.5, 1.0))
    np.testing.assert_array_equal(none, 0.5)
    np.testing.assert_allclose(half, 0.5 * (none + all_of), atol=1e-12)


def test_wet_patches_are_darker_and_spots_blind(scene: Scene) -> None:
    rng = np.random.default_rng(5)
    n = 200_000
    points = np.vstack([rng.uniform(-SIDE_M / 2, SIDE_M / 2, (2, n)), np.zeros(n)])
    colours = np.tile(np.array([[100.0], [100.0], [100.0], [0.5]], dtype=np.float32), n)
    rectangle = np.zeros(n, dtype=np.int32)
    values = laser_reflectance(scene, rectangle, points, colours, 1.0, 3)
    dry = float(np.median(values))
    # One spot of 12 mm in every twentieth square of 0.4 m: 1.4e-4 of the area.
    assert 0.5e-4 < np.mean(values == 1.0) < 3e-4
    wet = values < 0.8 * dry
    assert 0.05 < wet.mean() < 0.5
    assert values[wet].min() == pytest.approx(0.55 * dry, rel=0.02)
    # What a place shows does not hang on what else is asked about.
    some = slice(1000, 1010)
    alone = laser_reflectance(scene, rectangle[some], points[:, some], colours[:, some], 1.0, 3)
    np.testing.assert_array_equal(alone, values[some])
    other = laser_reflectance(scene, rectangle, points, colours, 1.0, 4)
    assert not np.array_equal(other, values)
