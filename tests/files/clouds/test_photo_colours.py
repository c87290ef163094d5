"""Which photo colours a point best, what hides it, and where most of a cloud lies."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

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


def photo(grey: int) -> Photo:
    encoded = encode_png(np.full((HEIGHT, WIDTH, 3), grey, np.uint8))
    return Photo(name=f"{grey}.png", width=WIDTH, height=HEIGHT, encoded=encoded)


def colours_of(count: int) -> PointColours:
    return PointColours(
        rgb=np.full((count, 3), 99, dtype=np.uint8),
        best=np.zeros(count, dtype=np.float32),
        photo=np.full(count, -1, dtype=np.int16),
    )


@pytest.mark.parametrize("keeps_photo", [True, False])
def test_a_point_gets_the_colour_of_the_photo_that_shows_it_largest(keeps_photo: bool) -> None:
    rng = np.random.default_rng(1)
    # A wall two metres before the first camera; the second stands nearer and more to the right.
    points = np.column_stack(
        [rng.uniform(-3.0, 3.0, 4_000), np.full(4_000, 2.0), rng.uniform(-1.4, 1.4, 4_000)]
    )
    cameras = [camera(), camera((0.8, 1.0, 0.0))]
    colours = colours_of(4_000)
    if not keeps_photo:
        colours = replace(colours, photo=None)
    colour_points(cloud(points), list(zip(map(photo, (40, 200)), cameras, strict=True)), colours)
    qualities = []
    for one in cameras:
        placed = one.project(points + ORIGIN)
        inside = one.sees(placed[:, :2])
        # Pixels per metre squared, less within a twentieth of the shorter side of the border.
        from_border = np.minimum(placed[:, :2], (WIDTH, HEIGHT) - placed[:, :2]).min(axis=1)
        known = (FOCAL / placed[:, 2]) ** 2 * np.clip(from_border / (0.05 * HEIGHT), 1e-3, 1.0)
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


def test_a_point_behind_a_board_is_not_coloured() -> None:
    a, b = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1.0, 1.0, 161)] * 2))
    wall = np.column_stack([2.0 * a, np.full(len(a), 4.0), b])
    board = np.column_stack([0.25 * a, np.full(len(a), 2.0), 0.25 * b])
    colours = colours_of(2 * len(a))
    colour_points(cloud(np.vstack([wall, board])), [(photo(40), camera(focal=150.0))], colours)
    assert colours.photo is not None
    # The board, 0.25 m at 2 m, hides 0.5 m at 4 m.
    off = np.maximum(np.abs(2.0 * a), np.abs(b))
    assert (colours.photo[: len(a)][off < 0.45] == -1).all()
    assert (colours.photo[: len(a)][(off > 0.55) & (np.abs(a) < 0.6)] == 0).all()
    assert (colours.rgb[: len(a)][off < 0.45] == 99).all()
    assert (colours.photo[len(a) :] == 0).all()
