"""Which photo colours a point best, what hides it, and where most of a cloud lies."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.files.clouds import photo_colours as module
from orthoflow.files.clouds.photo_colours import PointColours, colour_points
from orthoflow.files.images import encode_png
from orthoflow.products import Photo, PointCloud
from tests import samples

# Looks along y from the origin: x right, y down is minus z.
ALONG_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
WIDTH, HEIGHT, FOCAL = 200, 100, 100.0
ORIGIN = np.array([1000.0, 2000.0, 50.0])


def camera(at: tuple[float, float, float] = (0.0, 0.0, 0.0), focal: float = FOCAL) -> Any:
    return samples.camera(
        ALONG_Y, ORIGIN + at, width=WIDTH, height=HEIGHT,
        fx=focal, fy=focal, cx=0.5 * WIDTH, cy=0.5 * HEIGHT,
    )  # fmt: skip


def cloud(points_m: NDArray[np.float64]) -> PointCloud:
    x, y, z = np.ascontiguousarray(points_m.T.astype(np.float32))
    return PointCloud(origin=ORIGIN, x=x, y=y, z=z, up=np.array([0.0, 0.0, 1.0]))


def shown(pixels: list[list[float]], depth_m: list[float]) -> Any:
    return SimpleNamespace(
        index=np.arange(len(pixels)), pixels=np.array(pixels), depth_m=np.array(depth_m)
    )


def test_quality_is_pixels_per_metre_squared_and_falls_towards_the_border() -> None:
    # A twentieth of the shorter side is 5 pixels.
    places = [[100.0, 50.0], [5.0, 50.0], [2.5, 50.0], [100.0, 99.0], [198.0, 50.0], [0.0, 50.0]]
    found = module._quality(shown(places, [2.0] * 6), camera())
    np.testing.assert_allclose(found, 2500.0 * np.array([1.0, 1.0, 0.5, 0.2, 0.4, 0.001]))
    found = module._quality(shown([[100.0, 50.0]] * 2, [1.0, 4.0]), camera(focal=50.0))
    np.testing.assert_allclose(found, [2500.0, 156.25])


def test_what_is_farther_than_the_nearest_by_more_than_the_tolerance_is_hidden() -> None:
    nearest = np.full((25, 50), np.inf)
    nearest[10, 20] = 3.0
    buffer: Any = SimpleNamespace(reduction=4, nearest=nearest)
    places = [[81.0, 41.0], [83.9, 43.9], [81.0, 41.0], [84.0, 41.0], [81.0, 44.0]]
    found = module._is_seen(shown(places, [3.0, 3.05, 3.06, 9.0, 9.0]), buffer, 0.05)
    assert found.tolist() == [True, True, False, True, True]


def test_most_of_a_cloud_lies_in_its_extent() -> None:
    line = np.linspace(0.0, 10.0, 2_001)
    points = np.column_stack([line, 0.1 * line, np.zeros_like(line)])
    extent = module._extent(cloud(points))
    # Half a per cent at either end may be outliers.
    np.testing.assert_allclose(extent.low, [0.05, 0.005, 0.0], atol=1e-5)
    np.testing.assert_allclose(extent.high, [9.95, 0.995, 0.0], atol=1e-5)
    assert extent.side_m == pytest.approx(9.9 / 64, rel=1e-5)


@pytest.mark.parametrize("n_points", [40_000, 90_000])
def test_points_of_a_surface_are_as_far_apart_as_its_cubes_tell(n_points: int) -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0.0, 4.0, (n_points, 2)), np.ones(n_points)])
    spacing_m = module._extent(cloud(points)).spacing_m
    # 16 square metres; cubes at the border hang over.
    assert spacing_m == pytest.approx(np.sqrt(16.0 / n_points), rel=0.03)


def test_the_box_holds_cameras_and_a_cube_about_the_cloud() -> None:
    corners = np.array([[x, y, z] for x in (0, 6.4) for y in (0, 2) for z in (0, 1)], dtype=float)
    points = np.repeat(corners, 100, axis=0)
    box = module._box_of(cloud(points), [camera((3.0, -5.0, 0.5)), camera((3.0, 1.0, 9.0))])
    np.testing.assert_allclose(box.low, [-0.1, -5.0, -0.1], atol=1e-5)
    np.testing.assert_allclose(box.high, [6.5, 2.1, 9.0], atol=1e-5)
    assert box.spacing_m == module._extent(cloud(points)).spacing_m


@pytest.mark.parametrize("keeps_photo", [True, False])
def test_a_point_gets_the_colour_of_the_photo_that_shows_it_largest(keeps_photo: bool) -> None:
    rng = np.random.default_rng(1)
    # A wall two metres before the first camera; the second stands nearer and more to the right.
    points = np.column_stack(
        [rng.uniform(-3.0, 3.0, 4_000), np.full(4_000, 2.0), rng.uniform(-1.4, 1.4, 4_000)]
    )
    cameras = [camera(), camera((0.8, 1.0, 0.0))]
    photos = [
        Photo(
            name=f"{k}.png",
            width=WIDTH,
            height=HEIGHT,
            encoded=encode_png(np.full((HEIGHT, WIDTH, 3), grey, np.uint8)),
        )
        for k, grey in enumerate((40, 200))
    ]
    colours = PointColours(
        rgb=np.full((4_000, 3), 99, dtype=np.uint8),
        best=np.zeros(4_000, dtype=np.float32),
        photo=np.full(4_000, -1, dtype=np.int16) if keeps_photo else None,
    )
    colour_points(cloud(points), list(zip(photos, cameras, strict=True)), colours)
    qualities = []
    for one in cameras:
        placed = one.project(points + ORIGIN)
        inside = one.sees(placed[:, :2])
        known = module._quality(shown(placed[:, :2].tolist(), placed[:, 2].tolist()), one)
        qualities.append(np.where(inside, known, 0.0))
    best = np.argmax(qualities, axis=0)
    nobody = np.max(qualities, axis=0) == 0.0
    assert {0, 1} == set(best[~nobody].tolist())
    assert nobody.any()
    np.testing.assert_allclose(colours.best, np.max(qualities, axis=0), rtol=1e-4)
    expected = np.where(nobody, 99, np.array([40, 200])[best])
    np.testing.assert_array_equal(colours.rgb, np.repeat(expected[:, None], 3, axis=1))
    if colours.photo is not None:
        np.testing.assert_array_equal(colours.photo, np.where(nobody, -1, best))
