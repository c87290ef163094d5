"""What the laser sees of materials: contrast the other way round, wet patches, blinding spots."""

from __future__ import annotations

from dataclasses import replace

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


def test_without_inversion_the_laser_sees_what_the_textures_say(scene: Scene) -> None:
    red = np.linspace(0.0, 255.0, 9)
    np.testing.assert_array_equal(seen(scene, red, red, inversion=0.0), np.full(9, 0.5))


@pytest.mark.parametrize("material", [0, 1])
def test_reflectance_falls_with_red_and_rises_with_green(scene: Scene, material: int) -> None:
    rising, fixed = np.linspace(0.0, 255.0, 9), np.full(9, 120.0)
    assert (np.diff(seen(scene, rising, fixed, material=material)) < 0.0).all()
    assert (np.diff(seen(scene, fixed, rising, material=material)) > 0.0).all()


def test_half_an_inversion_lies_half_way(scene: Scene) -> None:
    red, green = np.linspace(0.0, 255.0, 9), np.full(9, 120.0)
    none, half, all_of = (seen(scene, red, green, inversion=share) for share in (0.0, 0.5, 1.0))
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


# --- what is drawn of each material ---

N_MATERIALS = 300


@pytest.fixture(scope="module")
def many(scene: Scene) -> Scene:
    """Very many materials, all at one place; reflectance 0.5 each."""
    n = N_MATERIALS
    params = np.tile(scene.texture_params[:1], (n, 1))
    params[:, 6] = np.arange(n) + 11.0
    return replace(
        scene,
        centre=np.zeros((n, 3)),
        axis_a=np.tile(scene.axis_a[:1], (n, 1)),
        axis_b=np.tile(scene.axis_b[:1], (n, 1)),
        extent=np.tile(scene.extent[:1], (n, 1)),
        plane_index=np.zeros(n, dtype=np.int16),
        role=np.full(n, SurfaceRole.WALL, dtype=np.uint8),
        texture=np.full(n, TextureKind.PLAIN, dtype=np.int32),
        texture_params=params,
    )


def dry(many: Scene, red: float, green: float, own: float = 0.5) -> NDArray[np.float64]:
    """Reflectance of each material where it is neither wet nor a spot, not cut off."""
    places = np.random.default_rng(2).uniform(-8.0, 8.0, (40, 2))
    colours = np.array([[255.0 * red], [255.0 * green], [90.0], [own]], dtype=np.float32)
    rectangle = np.arange(N_MATERIALS, dtype=np.int32)
    # Half of an inversion keeps most of what is drawn between black and white.
    seen_at = []
    for a, b in places:
        points = np.tile(np.array([[a], [b], [0.0]]), N_MATERIALS)
        mixed = laser_reflectance(many, rectangle, points, np.tile(colours, N_MATERIALS), 0.5, 3)
        seen_at.append((mixed - 0.5 * own) / 0.5)
    found = np.array(seen_at)
    # Spots are white: more than any material is.
    return np.asarray(np.where(np.isclose(found, 1.0), 0.0, found).max(axis=0))


def spans(values: NDArray[np.float64], low: float, high: float) -> None:
    """Drawn evenly from a range: all of 300 within it, some near both ends."""
    margin = 0.04 * (high - low)
    assert low - 1e-6 <= values.min() < low + margin
    assert high - margin < values.max() <= high + 1e-6
    assert np.mean(values) == pytest.approx(0.5 * (low + high), abs=0.06 * (high - low))


def test_materials_have_gains_and_powers_of_their_own(many: Scene) -> None:
    black = dry(many, 0.0, 0.0)
    spans(black, 0.75, 0.9)
    # A fourth of the red takes a half to the power of the material off what half of it takes.
    half, fourth = (black - dry(many, red, 0.0) for red in (0.5, 0.25))
    power = np.log2(half / fourth)
    spans(power, 0.8, 1.3)
    falls = half * 2.0**power
    spans(falls, 0.6, 0.85)
    rises = dry(many, 0.5, 1.0) - dry(many, 0.5, 0.0)
    spans(rises, 0.4, 0.65)
    bend = np.log2(rises / (dry(many, 0.5, 0.5) - dry(many, 0.5, 0.0)))
    spans(bend, 1.2, 1.8)
    # What is drawn of one says nothing of another.
    draws = [black, falls, power, rises, bend]
    for k, one in enumerate(draws):
        for other in draws[k + 1 :]:
            assert abs(np.corrcoef(one, other)[0, 1]) < 0.2


def test_nothing_is_darker_than_a_hundredth(many: Scene) -> None:
    n = N_MATERIALS
    colours = np.tile(np.array([[255.0], [0.0], [90.0], [0.0]], dtype=np.float32), n)
    values = laser_reflectance(
        many, np.arange(n, dtype=np.int32), np.zeros((3, n)), colours, 1.0, 3
    )
    assert values.min() == 0.01
    assert values.max() <= 1.0
