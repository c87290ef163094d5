"""How a photo is paired with walls: which sizes are tried, what agrees, and from which side."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import pairing, sift
from orthoflow_plugins.match.descriptors import Matches
from orthoflow_plugins.match.features import FeatureRule, Features
from orthoflow_plugins.match.pairing import (
    Expectation,
    Pair,
    PairingRule,
    PhotoPairs,
    mapped,
    pair_photo,
    rematched,
    side_matches,
)

RULE = PairingRule(
    features=FeatureRule(n_most=8000, contrast_threshold=0.02, edge_threshold=10.0),
    ratio_most=0.85,
    n_verified_least=8,
    longest_side_px=4000,
    clip_limit=3.0,
)
LOOSE_PX = 20.0
# Photo pixels from wall pixels: turned, shrunk, and seen a little from aside.
TILTED = np.array([[0.8, -0.3, 500.0], [0.25, 0.9, 300.0], [1e-5, -2e-5, 1.0]])
MIRRORED = np.diag([-1.0, 1.0, 1.0])


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


def verified(wall: NDArray[np.float64], photo: NDArray[np.float64]) -> Pair:
    sets = (features(photo), features(wall))
    return pairing._verified(3, in_order(len(wall)), sets, (LOOSE_PX, RULE))


# --- what agrees ---


def test_points_are_mapped_as_rays_through_planes_are() -> None:
    wall = on_wall(30)
    across, down, depth = TILTED @ np.vstack([wall.T, np.ones(30)])
    np.testing.assert_allclose(
        mapped(TILTED, wall), np.column_stack([across, down]) / depth[:, None]
    )


@pytest.mark.parametrize(("n", "is_shown"), [(3, False), (7, False), (8, True), (60, True)])
def test_eight_places_that_agree_show_a_wall(n: int, is_shown: bool) -> None:
    wall = on_wall(n)
    found = verified(wall, mapped(TILTED, wall))
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
    np.testing.assert_array_equal(verified(wall, photo).agreeing, off_px < LOOSE_PX)


@pytest.mark.parametrize("is_photo", [True, False], ids=["in the photo", "on the wall"])
def test_many_key_points_on_one_place_are_one(is_photo: bool) -> None:
    # Nine places four pixels apart, or all within two of them.
    rows, columns = np.divmod(np.arange(9.0), 3.0)
    lattice = np.column_stack([columns, rows])
    for apart_px, is_shown in ((4.0, True), (0.5, False)):
        near, far = 100.0 + apart_px * lattice, 100.0 + 300.0 * lattice
        assert verified(*((far, near) if is_photo else (near, far))).is_shown == is_shown


def test_places_are_cells_of_a_grid() -> None:
    pixels = np.array([[0.1, 0.1], [1.9, 1.9], [2.1, 0.1], [0.1, 2.1], [-0.1, 0.1], [3.9, 1.0]])
    assert pairing._n_places(pixels, 2.0) == 4
    assert pairing._n_places(pixels, 4.0) == 2


def test_a_wall_seen_from_behind_is_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = on_wall(60)
    behind = TILTED @ MIRRORED
    assert not verified(wall, mapped(behind, wall)).is_shown
    # Nor where all its points agree with such a homography.
    monkeypatch.setattr(pairing, "_homography", lambda *_: behind)
    found = verified(wall, mapped(behind, wall))
    assert found.agreeing.all()
    assert not found.is_shown
    assert found.homography is None
    at = np.array([700.0, 300.0])
    assert pairing._is_from_the_front(TILTED, at)
    assert not pairing._is_from_the_front(TILTED @ MIRRORED, at)
    assert pairing._is_from_the_front(MIRRORED @ TILTED @ MIRRORED, at)


def test_points_on_a_line_show_nothing() -> None:
    line = np.column_stack([np.arange(20.0) * 40.0, np.arange(20.0) * 10.0])
    assert not verified(line, line + 50.0).is_shown


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
    expected = Expectation(pixels=0.5 * pixels, agreeing=agreeing, radius_px=10.0)
    found = rematched(first, (photo, wall), expected, ratio_most=1.0)
    np.testing.assert_array_equal(found.first[:10], first.first)
    np.testing.assert_array_equal(found.ratio[:10], 0.5)
    pairs = list(zip(found.first[10:].tolist(), found.second[10:].tolist(), strict=True))
    assert pairs == [(10, 10), (11, 11)][: 1 + is_found]
    # Nothing that is twice as far as allowed from all of the photo is even looked at.
    away = replace(expected, pixels=expected.pixels + 5000.0)
    assert len(rematched(first, (photo, wall), away, ratio_most=1.0)) == 10


def shown(n: int, wall: int = 0, is_shown: bool = True) -> Pair:
    matches = in_order(n)
    return Pair(
        wall=wall,
        matches=matches,
        agreeing=np.ones(n, dtype=np.bool_),
        is_shown=is_shown,
        homography=np.eye(3) if is_shown else None,
    )


def found_at(scale: float, *pairs: Pair, n: int = 100, size_px: float = 4.0) -> PhotoPairs:
    pixels = on_wall(n)
    return PhotoPairs(
        features=features(pixels, sizes_px=np.full(n, size_px)),
        scale=scale,
        pairs=pairs,
        radius_px=10.0,
    )


def test_ties_are_counted_over_the_walls_shown() -> None:
    assert found_at(1.0, shown(5), shown(9, 1, is_shown=False), shown(11, 2)).n_verified == 16
    assert found_at(1.0).n_verified == 0


def test_the_size_of_cells_in_pixels_is_that_of_key_points_that_agree() -> None:
    pair = shown(9)
    pair.agreeing[5:] = False
    sizes = np.full(100, 7.0)
    sizes[5:9] = 1000.0
    walls = [features(on_wall(100), sizes_px=sizes), features(on_wall(100))]
    pairs = found_at(0.5, pair, shown(50, 1, is_shown=False))
    # 7 cells are 4 pixels of the photo, of which every second is looked at.
    assert pairing._cells_per_pixel(pairs, walls) == pytest.approx(3.5)
    assert pairing._cells_per_pixel(found_at(0.5, shown(50, 1, is_shown=False)), walls) == 1.0
    assert pairing._shown(pairs, walls) == [walls[0], None]


def test_a_second_look_asks_walls_that_are_shown_about_all_their_key_points(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wall = features(on_wall(30))
    pairs = replace(found_at(1.0, shown(12), shown(5, 1, is_shown=False)), features=wall)
    off = in_order(30)
    wrong = replace(
        wall, pixels=wall.pixels + np.where(np.arange(30) < 3, 10.5, 9.5)[:, None] * [1, 0]
    )
    asked = []

    def looked(matches: Matches, sets: Any, expected: Expectation, *, ratio_most: float) -> Matches:
        asked.append((len(matches), expected.radius_px, ratio_most))
        np.testing.assert_allclose(expected.pixels, sets[1].pixels)
        return off

    monkeypatch.setattr(pairing, "rematched", looked)
    completed = pairing._completed(replace(pairs, features=wrong), [wall, wall], RULE)
    assert asked == [(12, 10.0, 0.85)]
    first, second = completed.pairs
    assert first.matches is off
    np.testing.assert_array_equal(first.agreeing, np.arange(30) >= 3)
    assert second is pairs.pairs[1]


# --- which sizes of a photo are tried ---


class Looks:
    """What is found at each scale, in place of key points; and what was asked for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, found: dict[float, int]) -> None:
        self.scales: list[float] = []
        self.asked: list[tuple[int, int]] = []

        def key_points(seeker: Any, scale: float) -> Any:
            self.scales.append(scale)
            return pairing._KeyPoints(features=features(on_wall(3001)), scale=scale)

        def pairs(seeker: Any, points: Any, walls: Any) -> PhotoPairs:
            self.asked.append((len(points.features), len(walls[0])))
            return found_at(points.scale, shown(found[points.scale]))

        monkeypatch.setattr(pairing._Seeker, "key_points", key_points)
        monkeypatch.setattr(pairing._Seeker, "pairs", pairs)


def seeker(side_px: int, longest_side_px: int = 4000) -> pairing._Seeker:
    rule = replace(RULE, longest_side_px=longest_side_px)
    return pairing._Seeker(grey=np.zeros((10, side_px), dtype=np.uint8), rule=rule)


@pytest.mark.parametrize(
    ("side_px", "longest_px", "found", "tried", "best"),
    [
        (3200, 4000, {0.25: 8}, [0.25], 0.25),
        (3200, 4000, {0.25: 7, 0.5: 8}, [0.25, 0.5], 0.5),
        (3200, 4000, {0.25: 5, 0.5: 7, 1.0: 3}, [0.25, 0.5, 1.0], 0.5),
        # Of equal ones the finer.
        (3200, 4000, {0.25: 5, 0.5: 5, 1.0: 3}, [0.25, 0.5, 1.0], 0.5),
        # No finer than asked for, nor than the photo.
        (3200, 1200, {0.25: 1, 0.375: 2}, [0.25, 0.375], 0.375),
        (600, 4000, {1.0: 0}, [1.0], 1.0),
    ],
)
def test_a_photo_is_tried_at_growing_sizes_until_a_wall_is_recognised(
    monkeypatch: pytest.MonkeyPatch,
    side_px: int,
    longest_px: int,
    found: dict[float, int],
    tried: list[float],
    best: float,
) -> None:
    looks = Looks(monkeypatch, found)
    pairs, points = seeker(side_px, longest_px).first_look([features(on_wall(4001))])
    assert looks.scales == pytest.approx(tried)
    assert pairs.scale == points.scale == best
    # The strongest key points first, and all of them where these do not suffice.
    few, every = (3000, 4000), (3001, 4001)
    expected = [few if found[scale] >= 8 else (few, every) for scale in tried]
    assert looks.asked == [
        one
        for each in expected
        for one in ([each] if each == few else list(each))  # type: ignore[list-item]
    ]


@pytest.mark.parametrize(("n", "n_on_wall"), [(3000, 4000), (3001, 4001)])
def test_a_mirrored_photo_is_compared_with_the_walls_that_it_seemed_to_show(
    monkeypatch: pytest.MonkeyPatch, n: int, n_on_wall: int
) -> None:
    asked: list[Any] = []

    def pairs(self: Any, points: Any, walls: Any) -> PhotoPairs:
        asked.append((points.features.pixels, points.scale, [w and len(w) for w in walls]))
        return found_at(1.0, shown(17))

    monkeypatch.setattr(pairing._Seeker, "pairs", pairs)
    first = found_at(0.25, shown(20, 1), n=n)
    walls = [features(on_wall(50)), features(on_wall(4001))]
    assert seeker(3200).n_verified_mirrored(first, walls) == 17
    ((pixels, scale, counts),) = asked
    np.testing.assert_allclose(pixels[:, 0], 3200.0 - first.features.pixels[:, 0])
    assert (scale, counts) == (0.25, [None, n_on_wall])


def paired(
    monkeypatch: pytest.MonkeyPatch,
    *,
    first: int = 20,
    mirrored: int = 0,
    cells_per_pixel: float = 1.0,
    second: int = 30,
    side_px: int = 3200,
) -> tuple[PhotoPairs, list[float]]:
    """Pair a photo with one wall of which so many matches agree in the first and second look."""
    looked: list[float] = []
    begun = found_at(0.25, *([shown(first)] if first else []))

    def key_points(self: Any, scale: float) -> Any:
        looked.append(scale)
        return pairing._KeyPoints(features=features(on_wall(40)), scale=scale)

    def pairs(self: Any, points: Any, walls: Any) -> PhotoPairs:
        return found_at(points.scale, shown(second))

    start = pairing._KeyPoints(features=begun.features, scale=0.25)
    monkeypatch.setattr(pairing._Seeker, "first_look", lambda *_: (begun, start))
    monkeypatch.setattr(pairing._Seeker, "n_verified_mirrored", lambda *_: mirrored)
    monkeypatch.setattr(pairing._Seeker, "key_points", key_points)
    monkeypatch.setattr(pairing._Seeker, "pairs", pairs)
    monkeypatch.setattr(pairing, "_cells_per_pixel", lambda *_: cells_per_pixel)
    monkeypatch.setattr(pairing, "_completed", lambda best, *_: best)
    grey = np.zeros((10, side_px), dtype=np.uint8)
    return pair_photo(grey, [features(on_wall(40))], RULE), looked


def test_a_photo_that_shows_no_wall_is_not_looked_at_again(monkeypatch: pytest.MonkeyPatch) -> None:
    found, looked = paired(monkeypatch, first=0)
    assert (found.n_verified, found.n_recognised, looked) == (0, 0, [])


@pytest.mark.parametrize(
    ("n_mirrored", "n_direct", "is_mirror"),
    [(60, 20, True), (39, 20, False), (40, 20, True), (23, 0, False), (24, 0, True)],
)
def test_a_fact_of_a_mirror_image_needs_many_matches_and_twice_as_many(
    n_mirrored: int, n_direct: int, is_mirror: bool
) -> None:
    assert pairing._is_mirror(n_mirrored, n_direct) == is_mirror


@pytest.mark.parametrize(("mirrored", "is_mirrored"), [(20, False), (21, True)])
def test_a_photo_whose_mirror_image_fits_better_shows_nothing(
    monkeypatch: pytest.MonkeyPatch, mirrored: int, is_mirrored: bool
) -> None:
    found, _ = paired(monkeypatch, mirrored=mirrored)
    assert found.is_mirrored == is_mirrored
    # One sign is none.
    assert not found.is_surely_mirrored
    assert [pair.is_shown for pair in found.pairs] == [not is_mirrored]
    assert (found.pairs[0].homography is None) == is_mirrored
    assert found.n_recognised == (20 if is_mirrored else 30)


@pytest.mark.parametrize(
    ("cells_per_pixel", "looked"),
    [(1.0, []), (1.4, []), (1.45, [0.3625]), (0.72, []), (0.69, [0.1725]), (9.0, [1.0])],
)
def test_a_photo_is_matched_at_a_pixel_per_cell_unless_it_nearly_was(
    monkeypatch: pytest.MonkeyPatch, cells_per_pixel: float, looked: list[float]
) -> None:
    assert paired(monkeypatch, cells_per_pixel=cells_per_pixel)[1] == pytest.approx(looked)


@pytest.mark.parametrize(("second", "n", "scale"), [(21, 21, 0.5), (20, 20, 0.25), (5, 20, 0.25)])
def test_the_look_that_recognised_more_is_kept(
    monkeypatch: pytest.MonkeyPatch, second: int, n: int, scale: float
) -> None:
    found, _ = paired(monkeypatch, second=second, cells_per_pixel=2.0)
    assert (found.n_recognised, found.scale) == (n, scale)


# --- sides ---


@pytest.mark.parametrize(
    ("found", "counts", "tried"),
    [
        ({0.25: (9, 0)}, [[9, 0], [0, 0]], [0.25]),
        ({0.25: (0, 9)}, [[0, 9], [0, 0]], [0.25]),
        ({0.25: (0, 0), 0.5: (12, 10)}, [[12, 10], [0, 0]], [0.25, 0.5]),
        ({0.25: (0, 0), 0.5: (0, 0), 1.0: (0, 0)}, [[0, 0], [0, 0]], [0.25, 0.5, 1.0]),
    ],
)
def test_matches_are_counted_as_seen_from_the_front_and_from_behind(
    monkeypatch: pytest.MonkeyPatch,
    found: dict[float, tuple[int, int]],
    counts: list[list[int]],
    tried: list[float],
) -> None:
    scales: list[float] = []
    original = features(on_wall(20))

    def key_points(self: Any, scale: float) -> Any:
        scales.append(scale)
        return pairing._KeyPoints(features=original, scale=scale)

    def pairs(self: Any, points: Any, walls: Any) -> PhotoPairs:
        is_front = np.array_equal(points.features.pixels, original.pixels)
        assert is_front or np.allclose(points.features.pixels[:, 0], 3200.0 - original.pixels[:, 0])
        n = found[points.scale][0 if is_front else 1]
        return found_at(points.scale, shown(n, is_shown=n > 0), shown(30, 1, is_shown=False))

    monkeypatch.setattr(pairing._Seeker, "key_points", key_points)
    monkeypatch.setattr(pairing._Seeker, "pairs", pairs)
    grey = np.zeros((10, 3200), dtype=np.uint8)
    np.testing.assert_array_equal(side_matches(grey, [original, original], RULE), counts)
    assert scales == tried


def test_other_methods_pair_as_the_matching_does_by_default() -> None:
    assert sift._rule(sift.MatchSift.Params()) == pairing.USUAL_RULE
