"""What of a picture is compared: evened channels, places with texture, and how much is measured."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import channels
from scipy.ndimage import gaussian_filter

from orthoflow.products import Wall
from tests import samples


def texture(seed: int = 1, shape: tuple[int, int] = (90, 120)) -> NDArray[np.float32]:
    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 1.5)
    return (100.0 + 20.0 * smooth / smooth.std()).astype(np.float32)


def wall(count: NDArray[np.uint32], depth_m: NDArray[np.float32]) -> Wall:
    return samples.wall(
        samples.facing_south(0.01, *count.shape[::-1]),
        depth_m=depth_m,
        count=count,
        intensity=np.full(count.shape, 0.5, dtype=np.float32),
    )


def grey_of(depth_m: NDArray[np.float32], *, spread_m: float = 0.001) -> NDArray[np.float32]:
    """What is compared of a wall with three points in each cell, NaN where it is left out."""
    made = wall(np.full(depth_m.shape, 3, dtype=np.uint32), depth_m)
    made.sigma_m[:] = spread_m
    grey = channels.target_of(made).grey
    assert grey is not None
    return grey


def test_gradients_have_six_directions_and_do_not_tell_light_from_dark() -> None:
    grey = texture()
    found, negative = (channels.gradient_channels(given) for given in (grey, 200.0 - grey))
    assert found.values.shape == (90, 120, 6)
    np.testing.assert_allclose(found.values, negative.values, atol=1e-4)
    assert (found.values >= 0.0).all()
    # Across a vertical edge the first direction is strongest, the fourth weakest.
    edge = np.zeros((60, 60), dtype=np.float32)
    edge[:, 30:] = 100.0
    at_edge = channels.gradient_channels(edge).values[30, 30]
    assert int(np.argmax(at_edge)) == 0
    assert int(np.argmin(at_edge)) == 3
    assert at_edge[1] == pytest.approx(at_edge[0] * np.cos(np.pi / 6), rel=1e-4)


def test_cells_within_two_of_a_void_are_not_known() -> None:
    grey = texture()
    grey[40, 50] = np.nan
    for content in ("grey", "gradients"):
        found = channels.CHANNELS[content](grey)
        expected = np.ones(grey.shape, dtype=np.float32)
        expected[38:43, 48:53] = 0.0
        np.testing.assert_array_equal(found.known, expected)
        assert not found.values[38:43, 48:53].any()
        assert np.isfinite(found.values).all()


def test_colours_are_evened_out_as_one() -> None:
    red = texture(1)
    colours = np.stack([red, 0.1 * texture(2), np.full(red.shape, 7.0, np.float32)], axis=2)
    values = channels.colour_channels(colours).values
    spreads = values[10:-10, 10:-10].std(axis=(0, 1))
    # Weak channels stay weak beside strong ones.
    assert spreads[0] == pytest.approx(1.0, abs=0.15)
    assert spreads[1] == pytest.approx(0.1, abs=0.03)
    assert spreads[2] < 1e-3


@pytest.mark.parametrize(
    ("every", "grain"), [(1, 1.0), (2, 4.0), (3, 9.0)], ids=["all", "a-fourth", "a-ninth"]
)
def test_a_patch_tells_no_more_than_its_measured_cells(every: int, grain: float) -> None:
    count = np.zeros((60, 60), dtype=np.uint32)
    count[::every, ::every] = 5
    depth_m = np.zeros((60, 60), dtype=np.float32)
    found = channels.grain_of(wall(count, depth_m))
    assert np.mean(found[12:48, 12:48]) == pytest.approx(grain, rel=0.1)
    assert found.min() >= 1.0
    # Void does not count; where nothing is known there is nothing to share.
    depth_m[:, 30:] = np.nan
    assert channels.grain_of(wall(count, depth_m))[30, 50] == 1.0


@pytest.mark.parametrize(
    ("spread_m", "step_m", "is_left_out"),
    [(0.001, 0.015, True), (0.001, 0.008, False), (0.004, 0.015, False), (0.004, 0.03, True)],
    ids=["step", "less-than-a-cell", "noise", "step-beyond-noise"],
)
@pytest.mark.parametrize("quarters", [0, 1, 2])
def test_cells_beside_a_step_are_left_out_of_what_is_compared(
    quarters: int, spread_m: float, step_m: float, is_left_out: bool
) -> None:
    depth_m = np.full((40, 40), 0.3, dtype=np.float32)
    depth_m[:, :20] += np.float32(step_m)
    # A window right beside the step, farther up.
    depth_m[:8, 20:30] = np.nan
    turned = np.rot90(depth_m, quarters).copy()
    grey = grey_of(turned, spread_m=spread_m)
    left_out = np.isnan(np.rot90(grey, -quarters)) & np.isfinite(depth_m)
    assert left_out[10:].any(axis=0).nonzero()[0].tolist() == ([19, 20] if is_left_out else [])
    assert left_out[10:].sum() == (60 if is_left_out else 0)


@pytest.mark.parametrize(("every", "is_kept"), [(8, True), (40, False)], ids=["carved", "panels"])
def test_where_steps_are_everywhere_they_are_compared(every: int, is_kept: bool) -> None:
    columns = np.broadcast_to(np.arange(160), (140, 160))
    depth_m = np.where(columns // every % 2 == 0, 0.03, 0.0).astype(np.float32)
    assert np.isnan(grey_of(depth_m)).sum() == (0 if is_kept else 140 * 2 * 3)


def test_slopes_are_no_steps() -> None:
    depth_m = np.broadcast_to(0.03 * np.arange(40, dtype=np.float32), (30, 40)).copy()
    assert np.isfinite(grey_of(depth_m)).all()


def test_places_are_the_strongest_five_cells_around() -> None:
    strength = np.zeros((40, 60), dtype=np.float32)
    for row, column, value in ((10, 10, 3.0), (10, 12, 2.0), (10, 13, 1.5), (30, 50, 1.0)):
        strength[row, column] = value
    usable = np.ones((40, 60), dtype=np.bool_)
    found = channels.textured_places(strength, usable, 10)
    # The second lies within two cells of the first; the third does of the second only.
    assert {tuple(place) for place in found.tolist()} == {(10, 10), (50, 30)}
    usable[10, 10] = False
    found = channels.textured_places(strength, usable, 10)
    assert {tuple(place) for place in found.tolist()} == {(12, 10), (50, 30)}
    assert channels.textured_places(strength, usable, 1).tolist() == [[12, 10]]
    nothing = channels.textured_places(np.zeros((5, 5), np.float32), np.ones((5, 5), bool), 10)
    assert nothing.shape == (0, 2)
