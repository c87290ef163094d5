"""What the laser sees of materials: contrast the other way round, wet patches, blinding spots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.simulate import scanning
from orthoflow_plugins.simulate.scanning import LaserBand

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
    band = LaserBand(scene=scene, inversion=inversion, seed=3)
    return band.reflectance(np.full(n, material, dtype=np.int32), points, colours)


def test_without_inversion_the_laser_sees_what_the_textures_say(scene: Scene) -> None:
    red = np.linspace(0.0, 255.0, 9)
    np.testing.assert_array_equal(seen(scene, red, red, inversion=0.0), np.full(9, 0.5))


@pytest.mark.parametrize("material", [0, 1])
def test_reflectance_falls_with_red_and_rises_with_green(scene: Scene, material: int) -> None:
    rising, fixed = np.linspace(0.0, 255.0, 9), np.full(9, 120.0)
    assert (np.diff(seen(scene, rising, fixed, material=material)) < 0.0).all()
    assert (np.diff(seen(scene, fixed, rising, material=material)) > 0.0).all()


def test_materials_respond_by_gains_of_their_own(scene: Scene) -> None:
    red, green = np.linspace(0.0, 255.0, 9), np.full(9, 60.0)
    # Both at a dry place: the driest of many, so that patches do not tell them apart.
    responses = [
        np.max(
            [seen(scene, red, green, material=m, at=(a, 0.3)) for a in np.arange(-9.0, 9.0, 0.37)],
            axis=0,
        )
        for m in (0, 1)
    ]
    assert np.abs(np.diff(responses[0]) - np.diff(responses[1])).max() > 0.005


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
    band = LaserBand(scene=scene, inversion=1.0, seed=3)
    values = band.reflectance(rectangle, points, colours)
    dry = float(np.median(values))
    # One spot of 12 mm in every twentieth square of 0.4 m: 1.4e-4 of the area.
    assert 0.5e-4 < np.mean(values == 1.0) < 3e-4
    wet = values < 0.8 * dry
    assert 0.05 < wet.mean() < 0.5
    assert values[wet].min() == pytest.approx(0.55 * dry, rel=0.02)
    # What a place shows does not hang on what else is asked about.
    some = slice(1000, 1010)
    alone = band.reflectance(rectangle[some], points[:, some], colours[:, some])
    np.testing.assert_array_equal(alone, values[some])
    other = replace(band, seed=4).reflectance(rectangle, points, colours)
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
    band = LaserBand(scene=many, inversion=0.5, seed=3)
    seen_at = []
    for a, b in places:
        points = np.tile(np.array([[a], [b], [0.0]]), N_MATERIALS)
        mixed = band.reflectance(rectangle, points, np.tile(colours, N_MATERIALS))
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


def test_a_third_of_a_materials_own_pattern_is_seen(many: Scene) -> None:
    lighter = dry(many, 0.3, 0.2, own=0.7) - dry(many, 0.3, 0.2, own=0.5)
    np.testing.assert_allclose(lighter, 0.35 * 0.2, atol=1e-6)


def test_nothing_is_darker_than_a_hundredth(many: Scene) -> None:
    n = N_MATERIALS
    colours = np.tile(np.array([[255.0], [0.0], [90.0], [0.0]], dtype=np.float32), n)
    band = LaserBand(scene=many, inversion=1.0, seed=3)
    values = band.reflectance(np.arange(n, dtype=np.int32), np.zeros((3, n)), colours)
    assert values.min() == 0.01
    assert values.max() <= 1.0


def test_noise_is_smooth_between_a_lattice_of_numbers() -> None:
    rng = np.random.default_rng(1)
    cells = rng.integers(-50, 50, (2, 500)).astype(np.float64)
    seeds = np.full(500, 7, dtype=np.int64)

    def noise(right: float, down: float) -> NDArray[np.float64]:
        return scanning._smooth_noise(cells[0] + right, cells[1] + down, seeds)

    corners = [noise(right, down) for down in (0.0, 1.0) for right in (0.0, 1.0)]
    spans(corners[0], 0.0, 1.0)
    np.testing.assert_allclose(noise(0.5, 0.5), np.mean(corners, axis=0))
    np.testing.assert_allclose(noise(0.5, 0.0), 0.5 * (corners[0] + corners[1]))
    # A quarter of the way it has gone over by three parts of sixteen and two of sixty-four.
    share = 3.0 / 16.0 - 2.0 / 64.0
    np.testing.assert_allclose(noise(0.0, 0.25), (1 - share) * corners[0] + share * corners[2])
    assert not np.array_equal(scanning._smooth_noise(cells[0], cells[1], seeds + 1), corners[0])


def test_spots_are_discs_of_a_centimetre_in_every_twentieth_square() -> None:
    step_m, side_m = 0.004, 8.0
    steps = np.arange(0.0, side_m, step_m)
    a, b = (axis.ravel() for axis in np.meshgrid(steps, steps))
    spot = scanning._is_spot(a, b, np.full(a.size, 5, dtype=np.int64))
    # 400 squares of 0.4 m.
    square = (b[spot] // 0.4).astype(int) * 100 + (a[spot] // 0.4).astype(int)
    found = np.unique(square)
    assert 10 <= len(found) <= 30
    for name in found:
        mine = square == name
        points = np.column_stack([a[spot][mine], b[spot][mine]])
        middle = points.mean(axis=0)
        area_m2 = np.count_nonzero(mine) * step_m**2
        assert area_m2 == pytest.approx(np.pi * 0.012**2, rel=0.3)
        assert np.linalg.norm(points - middle, axis=1).max() < 0.012 + step_m
        # Its middle keeps off the sides of its square by a fifth of them.
        assert (np.abs(middle % 0.4 - 0.2) < 0.3 * 0.4 + step_m).all()
