"""How a photo is paired with walls: which sizes are tried, what agrees, and from which side."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match.key_points import Pair, mapped, rematched, verified

from orthoflow.geometry.key_points import Features, Matches

LOOSE_PX = 20.0
# Photo pixels from wall pixels: turned, shrunk, and seen a little from aside.
TILTED = np.array([[0.8, -0.3, 500.0], [0.25, 0.9, 300.0], [1e-5, -2e-5, 1.0]])


def features(pixels: NDArray[np.float64], **more: Any) -> Features:
    n = len(pixels)
    usual: dict[str, Any] = {
        "sizes_px": np.full(n, 4.0),
        "angles_deg": np.zeros(n),
        "descriptors": np.zeros((n, 128), dtype=np.float32),
    }
    return Features(pixels=np.asarray(pixels, dtype=np.float64), **{**usual, **more})


def in_order(n: int) -> Matches:
    return Matches(first=np.arange(n), second=np.arange(n), ratio=np.linspace(0.3, 0.8, n))


def on_wall(n: int, seed: int = 1) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(0.0, 2000.0, (n, 2))


def judged(wall: NDArray[np.float64], photo: NDArray[np.float64]) -> Pair:
    sets = (features(photo), features(wall))
    return verified(3, in_order(len(wall)), sets, LOOSE_PX)


# --- what agrees ---


@pytest.mark.parametrize(("n", "is_shown"), [(3, False), (7, False), (8, True), (60, True)])
def test_eight_places_that_agree_show_a_wall(n: int, is_shown: bool) -> None:
    wall = on_wall(n)
    found = judged(wall, mapped(TILTED, wall))
    assert (found.wall, found.is_shown) == (3, is_shown)
    assert found.agreeing.all() == (n >= 4)
    if is_shown:
        assert found.homography is not None
        np.testing.assert_allclose(mapped(found.homography, wall), mapped(TILTED, wall), atol=0.01)
    else:
        assert found.homography is None


def test_what_lies_loosely_where_it_should_agrees_and_nothing_farther_off() -> None:
    wall = on_wall(200)
    photo = mapped(TILTED, wall)
    off_px = np.zeros(200)
    off_px[[3, 50, 120]] = 0.95 * LOOSE_PX, 1.05 * LOOSE_PX, 400.0
    photo[:, 0] += off_px
    np.testing.assert_array_equal(judged(wall, photo).agreeing, off_px < LOOSE_PX)


@pytest.mark.parametrize("is_photo", [True, False], ids=["in the photo", "on the wall"])
def test_many_key_points_on_one_place_are_one(is_photo: bool) -> None:
    # Nine places four pixels apart, or all within two of them.
    rows, columns = np.divmod(np.arange(9.0), 3.0)
    lattice = np.column_stack([columns, rows])
    for apart_px, is_shown in ((4.0, True), (0.5, False)):
        near, far = 100.0 + apart_px * lattice, 100.0 + 300.0 * lattice
        assert judged(*((far, near) if is_photo else (near, far))).is_shown == is_shown


# --- the second look ---


@pytest.mark.parametrize(
    ("size", "turn_deg", "off_px", "is_found"),
    [
        (1.0, 0.0, 0.0, True),
        (1.6, 0.0, 0.0, True),
        (1.65, 0.0, 0.0, False),
        (1.0 / 1.6, 0.0, 0.0, True),
        (1.0 / 1.65, 0.0, 0.0, False),
        (1.0, 29.0, 0.0, True),
        (1.0, -31.0, 0.0, False),
        (1.0, 0.0, 9.5, True),
        (1.0, 0.0, 10.5, False),
    ],
)
def test_key_points_are_added_where_place_size_and_direction_are_as_expected(
    size: float, turn_deg: float, off_px: float, is_found: bool
) -> None:
    rng = np.random.default_rng(2)
    pixels = on_wall(12)
    descriptors = rng.integers(0, 200, (12, 128)).astype(np.float32)
    # The photo is half as large as the wall, and turned by 170 degrees; the last is asked about.
    wall = features(pixels, sizes_px=rng.uniform(3.0, 9.0, 12), descriptors=descriptors)
    sizes = 0.5 * wall.sizes_px
    turns = np.full(12, 170.0)
    sizes[-1] *= size
    turns[-1] += turn_deg
    places = 0.5 * pixels
    places[-1, 1] += off_px
    photo = features(places, sizes_px=sizes, angles_deg=turns % 360.0, descriptors=descriptors)
    first = Matches(first=np.arange(10), second=np.arange(10), ratio=np.full(10, 0.5))
    agreeing = np.arange(10) < 8
    # What did not agree says nothing of sizes and turns.
    look = partial(rematched, first, (photo, wall), agreeing=agreeing, radius_px=10.0, ratio=1.0)
    found = look(0.5 * pixels)
    np.testing.assert_array_equal(found.first[:10], first.first)
    np.testing.assert_array_equal(found.ratio[:10], 0.5)
    pairs = list(zip(found.first[10:].tolist(), found.second[10:].tolist(), strict=True))
    assert pairs == [(10, 10), (11, 11)][: 1 + is_found]
    # Nothing that is twice as far as allowed from all of the photo is even looked at.
    assert len(look(0.5 * pixels + 5000.0)) == 10


def test_a_wall_seen_from_behind_is_not_shown() -> None:
    wall = on_wall(40)
    front = mapped(TILTED, wall)
    assert judged(wall, front).is_shown
    assert not judged(wall, front * [-1.0, 1.0] + [3000.0, 0.0]).is_shown
