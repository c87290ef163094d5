"""Pictures to match: holes filled, sizes kept to, and points lifted onto walls."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import pictures

from orthoflow.errors import MethodError
from orthoflow.products import Photos, Wall
from tests import samples

GSD_M = 0.01


def wall(depth_m: NDArray[np.float32], *, intensity: NDArray[np.float32] | None = None) -> Wall:
    return samples.wall(
        samples.facing_south(GSD_M, *depth_m.shape[::-1]),
        depth_m=depth_m,
        sigma_m=np.full(depth_m.shape, 0.002, dtype=np.float32),
        count=np.full(depth_m.shape, 4, dtype=np.uint32),
        intensity=intensity,
    )


def ramp(rows: int = 20, columns: int = 30) -> NDArray[np.float32]:
    """A millimetre nearer per column, half of one per row."""
    r, c = np.mgrid[:rows, :columns]
    return (0.001 * c + 0.0005 * r).astype(np.float32)


@pytest.mark.parametrize(
    ("place", "depth_m"),
    [
        ((5.5, 7.5), 0.005 + 0.0035),
        ((5.75, 7.5), 0.00525 + 0.0035),
        ((5.5, 7.0), 0.005 + 0.00325),
        # Beyond the outermost centres the last one holds.
        ((0.1, 0.1), 0.0),
        ((29.9, 19.9), 0.029 + 0.0095),
    ],
)
def test_between_cells_a_smooth_surface_is_interpolated(
    place: tuple[float, float], depth_m: float
) -> None:
    found = pictures.points_on_wall(wall(ramp()), np.array([place]))
    np.testing.assert_allclose(
        found[0], [[GSD_M * place[0], -depth_m, -GSD_M * place[1]]], atol=1e-7
    )
    assert found[2].tolist() == [True]


def test_the_accuracy_of_a_point_is_that_of_its_cell_and_its_place_in_it() -> None:
    of = wall(ramp())
    of.count[7, 5], of.sigma_m[7, 5] = 16, 0.008
    of.count[7, 6] = 1  # a single point has no spread of its own
    of.sigma_m[7, 7], of.count[7, 7] = np.nan, 4
    of.count[7, 8] = 400
    places = np.array([[5.5, 7.5], [6.5, 7.5], [7.5, 7.5], [8.5, 7.5]])
    in_cell_m = 0.5 * GSD_M / math.sqrt(12.0)
    # The usual spread is 2 mm; the mean of many is no better than 0.3 of it.
    for usual_m, told_m in ((0.002, None), (0.002, 0.002), (0.005, 0.005)):
        noises_m = (0.008 / 4.0, usual_m, usual_m / 2.0, 0.3 * usual_m)
        np.testing.assert_allclose(
            pictures.points_on_wall(of, places, usual_m=told_m)[1],
            [math.hypot(noise_m, in_cell_m) for noise_m in noises_m],
            rtol=1e-6,
        )


@pytest.mark.parametrize(("step_m", "is_edge"), [(0.0095, False), (0.0105, True)])
def test_at_an_edge_the_nearest_cell_holds_and_the_step_is_doubt(
    step_m: float, is_edge: bool
) -> None:
    depth_m = np.zeros((20, 30), dtype=np.float32)
    depth_m[:, 10:] = step_m
    found = pictures.points_on_wall(wall(depth_m), np.array([[10.25, 7.5]]))
    # A quarter of a cell before the centre of the first cell of the step.
    expected_m = step_m if is_edge else 0.75 * step_m
    assert -found[0][0, 1] == pytest.approx(expected_m, rel=1e-5)
    doubt_m = step_m / math.sqrt(12.0) if is_edge else 0.0
    plain_m = math.hypot(0.001, 0.5 * GSD_M / math.sqrt(12.0))
    assert found[1][0] == pytest.approx(math.hypot(plain_m, doubt_m), rel=1e-5)


def test_where_nothing_is_known_there_is_no_point() -> None:
    depth_m = ramp()
    depth_m[7, 5] = np.nan
    found = pictures.points_on_wall(wall(depth_m), np.array([[5.5, 7.5], [6.4, 7.5]]))
    assert found[2].tolist() == [False, True]
    # Beside a void the nearest cell holds.
    assert -found[0][1, 1] == pytest.approx(0.006 + 0.0035, abs=1e-6)


def test_void_is_filled_from_around_and_what_is_known_stays() -> None:
    values = np.add.outer(np.arange(40.0), 2.0 * np.arange(50.0))
    holes = values.copy()
    holes[10:14, 20:25] = np.nan
    filled = pictures.filled_smoothly(holes)
    known = np.isfinite(holes)
    np.testing.assert_array_equal(filled[known], values[known].astype(np.float32))
    np.testing.assert_allclose(filled[~known], values[~known], atol=6.0)
    assert np.isfinite(pictures.filled_smoothly(np.full((8, 9), np.nan))).all()
    half = np.full((32, 32), np.nan)
    half[0, 0] = 7.0
    np.testing.assert_allclose(pictures.filled_smoothly(half), 7.0, rtol=1e-5)


def test_a_wall_becomes_a_picture_of_its_inner_percentiles() -> None:
    intensity = np.tile(np.linspace(0.2, 0.4, 200, dtype=np.float32), (100, 1))
    intensity[40:60, 80:120] = np.nan
    picture = pictures.wall_picture(
        wall(np.zeros((100, 200), np.float32), intensity=intensity),
        clip_limit=0.0,
        void_margin_cells=2,
    )
    assert picture is not None
    whole, usable = picture
    grey = whole[20].astype(int)
    assert (grey[0], grey[-1]) == (0, 255)
    assert (np.diff(grey) >= 0).all()
    assert grey[100] == pytest.approx(128, abs=3)
    # Of the 5 x 5 around a cell more than 0.7 must be known: beside a straight rim 0.8 or 0.6.
    assert usable[50, 78]
    assert not usable[50, 79]
    assert not usable[50, 100]
    assert usable[:38].all()


def test_nothing_to_match_is_refused() -> None:
    with pytest.raises(MethodError, match="there are no photos to match"):
        pictures.require_photos(Photos(photos=()))
    silent = wall(np.zeros((2, 2), np.float32))
    shown = replace(silent, intensity=np.zeros((2, 2), np.float32))
    with pytest.raises(MethodError, match="there are no walls to match photos with"):
        pictures.require_intensity(samples.walls())
    with pytest.raises(MethodError, match="the scan has neither intensity nor colour"):
        pictures.require_intensity(samples.walls(silent))
    pictures.require_intensity(samples.walls(silent, shown))


def test_a_wall_that_shows_nothing_has_no_picture() -> None:
    plain = np.zeros((20, 30), dtype=np.float32)
    for intensity in (None, np.full((20, 30), np.nan, dtype=np.float32)):
        of = wall(plain, intensity=intensity)
        assert pictures.wall_picture(of, clip_limit=2.0, void_margin_cells=2) is None
