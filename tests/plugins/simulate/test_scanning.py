"""Stations and errors of the simulated scanner, compared with formulas."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.simulate.room_model import main_wall_axes
from orthoflow_plugins.simulate.scanning import (
    SPOILT,
    Errors,
    Scanned,
    Scanner,
    Sweep,
    laser_reflectance,
    planned_sweeps,
    shared_errors,
    station_positions,
)

from orthoflow.geometry import Plane
from orthoflow.geometry.scenes import Scene, TextureKind
from tests.scene_rays import a_scene

NOISE_M = 0.002
SIDE = 200
# Angle between rays in radians; all rays of a sweep hit the surface at the same distance and angle,
# within 2e-4.
STEP = 1e-6
NO_ERRORS = Errors(
    noise_m=0.0, outlier_share=0.0, beam_m=0.0, colour_noise=0.0, inversion=0.0, band_seed=0
)


def surface(
    distance_m: float,
    incidence_deg: float = 0.0,
    kind: TextureKind = TextureKind.PLAIN,
    material: float = 7.0,
) -> dict[str, object]:
    """Return a rectangle on the x axis at a distance, rotated about the vertical."""
    turn = math.radians(incidence_deg)
    return {
        "centre": (distance_m, 0.0, 0.0),
        "a": (math.sin(turn), math.cos(turn), 0.0),
        "b": (0.0, 0.0, 1.0),
        "extent": (-1.0, 1.0, -1.0, 1.0),
        "kind": kind,
        "params": (200.0, 180.0, 160.0, 0.5, 0.3, 0.3, material, 0.0),
    }


def scanned(scene: Scene, step: float = STEP, **errors: float) -> Scanned:
    """Scan a scene with rays around the x axis and only the given errors."""
    sweep = Sweep(
        station=np.zeros(3),
        azimuth=-0.5 * SIDE * step,
        elevation=-0.5 * SIDE * step,
        step=step,
        n_columns=SIDE,
        n_rows=SIDE,
        seed=5,
    )
    n = SIDE * SIDE
    x, y, z, intensity = np.zeros((4, n), dtype=np.float32)
    filled = Scanned(
        x=x,
        y=y,
        z=z,
        intensity=intensity,
        rgb=np.zeros((n, 3), dtype=np.uint8),
        rectangle=np.zeros(n, dtype=np.int32),
    )
    Scanner(scene, replace(NO_ERRORS, **errors)).sweep(sweep, filled, 0, SIDE)
    return filled


def distances_m(points: Scanned) -> NDArray[np.float64]:
    axes = np.stack([points.x, points.y, points.z]).astype(np.float64)
    return np.asarray(np.linalg.norm(axes, axis=0))


def azimuths(step: float = STEP) -> NDArray[np.float64]:
    """Return the azimuth of each ray, column by column."""
    return np.repeat((np.arange(SIDE) - 0.5 * SIDE) * step, SIDE)


# Standard deviations relative to the given one, which is valid at 3 m and perpendicular to plaster.
# They increase by 0.45 times the relative elongation of the spot, at most four; with the root of
# half plus half the squared ratio of range and 3 m; and by a factor of 1.4 on cloth.
@pytest.mark.parametrize(
    ("distance_m", "incidence_deg", "kind", "expected"),
    [
        pytest.param(3.0, 0.0, TextureKind.PLAIN, 1.0, id="square on at 3 m"),
        pytest.param(3.0, 60.0, TextureKind.PLAIN, 1.45, id="spot twice as long"),
        pytest.param(3.0, 80.4059318, TextureKind.PLAIN, 2.8, id="spot six times as long"),
        pytest.param(1.5, 0.0, TextureKind.PLAIN, math.sqrt(0.625), id="near"),
        pytest.param(9.0, 0.0, TextureKind.PLAIN, math.sqrt(5.0), id="far"),
        pytest.param(9.0, 60.0, TextureKind.TEXTILE, 1.4 * 1.45 * math.sqrt(5.0), id="all of it"),
    ],
)
def test_noise_grows_with_slope_range_and_on_cloth(
    distance_m: float, incidence_deg: float, kind: TextureKind, expected: float
) -> None:
    points = scanned(a_scene([surface(distance_m, incidence_deg, kind)]), noise_m=NOISE_M)
    assert (points.rectangle == 0).all()
    # On the surface, x cos(turn) - y sin(turn) = distance cos(turn); all rays are close to x.
    turned = np.tan(azimuths()) * math.tan(math.radians(incidence_deg))
    errors = distances_m(points) - distance_m / (1.0 - turned)
    sigma = NOISE_M * expected
    # The tolerances are five standard deviations of a mean and of a standard deviation.
    assert errors.mean() == pytest.approx(0.0, abs=5.0 * sigma / math.sqrt(errors.size))
    assert errors.std() == pytest.approx(sigma, rel=5.0 / math.sqrt(2.0 * errors.size))


def test_gross_outliers_fall_short_four_times_in_five() -> None:
    points = scanned(a_scene([surface(3.0)]), outlier_share=1.0)
    distance = distances_m(points)
    assert (points.rectangle == SPOILT).all()
    short = distance < 3.0
    # The tolerances are five standard deviations of a binomial share, and of means of uniform
    # distributions.
    n = distance.size
    assert short.mean() == pytest.approx(0.8, abs=5.0 * math.sqrt(0.16 / n))
    assert 0.9 - 1e-5 < distance[short].min() < 0.91
    assert 2.93 < distance[short].max() < 2.94 + 1e-5
    assert distance[short].mean() == pytest.approx(1.92, abs=5.0 * 2.04 / math.sqrt(12.0 * 0.8 * n))
    assert distance[~short].mean() == pytest.approx(4.0, abs=5.0 * 2.0 / math.sqrt(12.0 * 0.2 * n))
    assert distance[~short].max() < 5.0 + 1e-5


def test_distances_mix_where_the_spot_falls_on_two_surfaces() -> None:
    step, beam_m = 2e-5, 0.006
    # The near surface is at negative y and ends at the x axis.
    scene = a_scene([surface(3.0) | {"extent": (-1.0, 0.0, -1.0, 1.0)}, surface(3.5)])
    points = scanned(scene, step, beam_m=beam_m)
    distance, azimuth = distances_m(points), azimuths(step)
    for side, own_m, other_m in ((azimuth < 0.0, 3.0, 3.5), (azimuth > 0.0, 3.5, 3.0)):
        mixed = side & (points.rectangle == SPOILT)
        # A point on the spot's border is beyond the edge for angles with a sufficient cosine.
        away = np.abs(azimuth[side]) / (0.5 * beam_m / own_m)
        chance = np.arccos(np.minimum(away, 1.0)) / math.pi
        limit = 5.0 * math.sqrt(float(np.sum(chance * (1.0 - chance))))
        assert np.count_nonzero(mixed) == pytest.approx(float(chance.sum()), abs=limit)
        # Shares of the other surface are uniform from 0 to 1/2; rays are longer by at most 4.1e-6.
        share = (distance[mixed] - own_m) / (other_m - own_m)
        assert share.min() > -1e-4
        assert share.max() < 0.5 + 1e-4
        spread = 5.0 * 0.5 / math.sqrt(12.0 * len(share))
        assert share.mean() == pytest.approx(0.25, abs=spread)
        np.testing.assert_allclose(distance[side & ~mixed], own_m, rtol=5e-6)


@pytest.mark.parametrize("length_m", [0.5, 2.0])
def test_neighbouring_points_share_an_error_of_the_stated_size_and_reach(length_m: float) -> None:
    rng = np.random.default_rng(1)
    errors = replace(NO_ERRORS, shared_m=0.004, shared_length_m=length_m, band_seed=3)
    first = rng.uniform(-4.0, 4.0, (3, 4000))
    found = [
        shared_errors(first + np.array([[apart], [0.0], [0.0]]), np.zeros(3), errors)
        for apart in (0.0, length_m)
    ]
    assert found[0].std() == pytest.approx(0.004, rel=0.3)
    # At the correlation length, a Gaussian has the value exp(-1/2).
    together = float((found[0] * found[1]).mean() / (found[0] ** 2).mean())
    assert together == pytest.approx(np.exp(-0.5), abs=0.25)


def test_a_station_that_is_registered_wrongly_moves_all_its_points_alike() -> None:
    points = np.random.default_rng(1).uniform(-4.0, 4.0, (3, 50))
    errors = replace(NO_ERRORS, registration_m=0.003)
    one, other = (shared_errors(points, np.array([x, 0.0, 1.5]), errors) for x in (0.0, 2.0))
    assert np.ptp(one, axis=1).max() == 0.0
    assert np.abs(one - other).max() > 1e-4
    assert not shared_errors(points, np.zeros(3), NO_ERRORS).any()


def test_a_bent_cloud_is_off_by_the_stated_bend_five_metres_from_its_middle() -> None:
    points = np.array([[0.0, 5.0, -5.0], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0]])
    off = shared_errors(points, np.zeros(3), replace(NO_ERRORS, bending_m=0.02))
    np.testing.assert_allclose(np.linalg.norm(off, axis=0), [0.0, 0.02, 0.02])


# --- laser reflectance of materials ---

MATERIALS = a_scene([surface(3.0), surface(3.0, material=8.0)])


def seen(
    red: NDArray[np.float64], green: NDArray[np.float64], inversion: float = 1.0, material: int = 0
) -> NDArray[np.float64]:
    """Return the reflectance of colours 0..255, all at the same position."""
    n = len(red)
    points = np.tile(np.array([[3.0], [0.1], [0.1]]), n)
    colours = np.array([red, green, np.full(n, 90.0), np.full(n, 0.5)], dtype=np.float32)
    rectangle = np.full(n, material, dtype=np.int32)
    return laser_reflectance(MATERIALS, rectangle, points, colours, inversion, 3)


@pytest.mark.parametrize("material", [0, 1])
def test_reflectance_falls_with_red_and_rises_with_green(material: int) -> None:
    rising, fixed = np.linspace(0.0, 255.0, 9), np.full(9, 120.0)
    assert (np.diff(seen(rising, fixed, material=material)) < 0.0).all()
    assert (np.diff(seen(fixed, rising, material=material)) > 0.0).all()
    # Without inversion, the reflectance is that of the textures; with half of it, half of the
    # difference.
    none, half, all_of = (seen(rising, fixed, inversion=share) for share in (0.0, 0.5, 1.0))
    np.testing.assert_array_equal(none, 0.5)
    np.testing.assert_allclose(half, 0.5 * (none + all_of), atol=1e-12)


UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("n_stations", [1, 4])
def test_panoramas_close_and_detail_scans_just_hold_the_main_wall(n_stations: int) -> None:
    along, towards = main_wall_axes()
    # The wall is four metres in front of the origin, 6 m x 3 m in size, and off-centre.
    middle = 4.0 * towards + 0.3 * along
    outline = np.array(
        [middle + a * along + h * UP for a, h in ((-3, 1.6), (-3, -1.4), (3, -1.4), (3, 1.6))]
    )
    wall = Plane(normal=-towards, offset_m=-4.0)
    seeds = np.arange(100, 110)
    sweeps = planned_sweeps(station_positions(n_stations), (0.05, 0.02), wall, outline, seeds)
    assert [sweep.seed for sweep in sweeps] == list(range(100, 100 + 2 * n_stations))
    forward = math.atan2(towards[1], towards[0])
    shares = np.linspace(0.0, 1.0, 201)[:, None]
    rim = np.concatenate(
        [a + shares * (b - a) for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True)]
    )
    for k, station in enumerate(station_positions(n_stations)):
        panorama, detail = sweeps[2 * k : 2 * k + 2]
        distance_m = 4.0 - station @ towards
        for sweep, step_m in ((panorama, 0.05), (detail, 0.02)):
            np.testing.assert_array_equal(sweep.station, station)
            assert sweep.step == pytest.approx(step_m / distance_m)
        assert 0.0 <= 2.0 * math.pi - panorama.n_columns * panorama.step < panorama.step
        assert 0.0 <= math.radians(124.0) - panorama.n_rows * panorama.step < panorama.step
        rays = rim - station
        azimuths = np.arctan2(rays[:, 1], rays[:, 0]) - forward
        azimuths = forward + (azimuths + math.pi) % (2.0 * math.pi) - math.pi
        elevations = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
        for seen, first, n_steps in (
            (azimuths, detail.azimuth, detail.n_columns),
            (elevations, detail.elevation, detail.n_rows),
        ):
            assert first == pytest.approx(seen.min(), abs=1e-3)
            assert -1e-3 < first + n_steps * detail.step - seen.max() < 1.001 * detail.step + 1e-3
