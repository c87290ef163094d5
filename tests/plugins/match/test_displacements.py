"""How far two pictures are displaced: which places can be measured, and what comes out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import displacements
from orthoflow_plugins.match.channels import Channels
from orthoflow_plugins.match.displacements import Displacements, SearchRule, measure
from scipy.ndimage import gaussian_filter, shift

RULE = SearchRule(radius_cells=4, half_patch_cells=6, score_least=0.5, distinct_least=0.05)


def texture(seed: int = 1, *, side: int = 80) -> NDArray[np.float64]:
    noise = np.random.default_rng(seed).normal(size=(side, side))
    smooth = gaussian_filter(noise, 1.5)
    return np.asarray(smooth / smooth.std())


def channels(*layers: NDArray[np.float64]) -> Channels:
    values = np.stack(layers, axis=-1).astype(np.float32)
    return Channels(values=values, known=np.ones(values.shape[:2], dtype=np.float32))


def moved(layer: NDArray[np.float64], right: float, down: float) -> NDArray[np.float64]:
    """The same content so many cells farther right and down."""
    return np.asarray(shift(layer, (down, right), order=3, mode="nearest"))


PLACES = np.array([[column, row] for row in (25, 40, 55) for column in (20, 40, 60)], dtype=np.intp)


@pytest.mark.parametrize("apart", [(0.0, 0.0), (1.3, -0.6), (-2.75, 3.25)])
def test_a_displacement_is_measured_to_hundredths_of_a_cell(apart: tuple[float, float]) -> None:
    first = texture()
    found = measure(channels(first), channels(moved(first, *apart)), PLACES, RULE)
    assert len(found.places) == 9
    np.testing.assert_array_equal(found.places, PLACES)
    np.testing.assert_allclose(found.shift_cells, np.tile(apart, (9, 1)), atol=0.05)
    assert (found.score > 0.95).all()
    assert (found.sigma_cells < 0.1).all()


def test_noise_is_told_by_the_standard_deviation() -> None:
    first = texture()
    other = moved(first, 1.0, 0.0)
    quiet, loud = (
        measure(channels(first), channels(other + sigma * texture(seed=2)), PLACES, RULE)
        for sigma in (0.05, 0.4)
    )
    assert np.median(loud.sigma_cells) > 3.0 * np.median(quiet.sigma_cells)
    off = np.abs(loud.shift_cells - [1.0, 0.0])
    assert np.median(off / loud.sigma_cells[:, None]) < 2.0


def test_beyond_the_radius_and_in_something_else_nothing_is_found() -> None:
    first = texture()
    far = measure(channels(first), channels(moved(first, 7.0, 0.0)), PLACES, RULE)
    assert len(far.places) <= 2
    assert len(measure(channels(first), channels(texture(seed=9)), PLACES, RULE).places) <= 2


def test_a_mixture_of_colours_is_found_where_no_single_one_shows_it() -> None:
    red, green, blue = (texture(seed) for seed in (3, 4, 5))
    laser = 0.7 * red - 0.5 * green + 0.2 * blue
    colours = [moved(layer, 2.0, -1.0) for layer in (red, green, blue)]
    found = measure(channels(laser), channels(*colours), PLACES, RULE)
    assert len(found.places) >= 7
    np.testing.assert_allclose(
        found.shift_cells, np.tile([2.0, -1.0], (len(found.places), 1)), atol=0.1
    )
    kept = {tuple(place) for place in PLACES.tolist()}
    assert {tuple(place) for place in found.places.tolist()} <= kept


def test_every_column_is_taken_alike() -> None:
    whole = Displacements(
        places=PLACES,
        shift_cells=PLACES * 0.5,
        score=np.arange(9.0),
        sigma_cells=np.arange(9.0) + 1.0,
    )
    chosen = np.arange(9) % 4 == 1
    part = whole.take(chosen)
    np.testing.assert_array_equal(part.places, PLACES[[1, 5]])
    np.testing.assert_array_equal(part.shift_cells, 0.5 * PLACES[[1, 5]])
    assert (part.score.tolist(), part.sigma_cells.tolist()) == ([1.0, 5.0], [2.0, 6.0])


def test_a_search_stays_inside_the_pictures() -> None:
    picture = channels(texture(side=40))
    # Radius 4, half a patch of 6, and two cells for what interpolates: 12 to 27.
    places = np.array(
        [[11, 20], [12, 20], [27, 20], [28, 20], [20, 11], [20, 12], [20, 27], [20, 28]]
    )
    kept = displacements._well_known(picture, picture, places.astype(np.intp), RULE)
    assert kept.tolist() == [[12, 20], [27, 20], [20, 12], [20, 27]]


@pytest.mark.parametrize(("n_known", "is_kept"), [(8, True), (7, False)])
def test_three_fifths_of_a_patch_must_be_known_in_both(n_known: int, is_kept: bool) -> None:
    # Patches of 13 columns: 8 are 0.615 of them, 7 are 0.54.
    first, second = channels(texture()), channels(texture())
    second.known[:, 34 + n_known :] = 0.0
    place = np.array([[40, 40]], dtype=np.intp)
    for one, other in ((first, second), (second, first)):
        assert len(displacements._well_known(one, other, place, RULE)) == int(is_kept)


def test_patches_are_cut_out_one_below_the_other_and_beyond_the_rim_nothing_is_known() -> None:
    values = np.arange(2 * 6 * 8, dtype=np.float32).reshape(6, 8, 2)
    picture = Channels(values=values, known=np.ones((6, 8), dtype=np.float32))
    gains = np.array([[1.0, 0.0], [0.5, -1.0]], dtype=np.float32)
    cut = displacements._cut_out(picture, np.array([[3, 2], [0, 5]], dtype=np.intp), 1, gains)
    assert (cut.values.shape, cut.known.shape) == ((6, 3, 1), (6, 3))
    np.testing.assert_array_equal(cut.values[:3, :, 0], values[1:4, 2:5, 0])
    np.testing.assert_array_equal(cut.known[:3], 1.0)
    mixed = 0.5 * values[4:6, 0:2, 0] - values[4:6, 0:2, 1]
    np.testing.assert_array_equal(cut.values[3:5, 1:, 0], mixed)
    np.testing.assert_array_equal(cut.known[3:], [[0, 1, 1], [0, 1, 1], [0, 0, 0]])
    np.testing.assert_array_equal(cut.values[3:, 0], 0.0)


def test_the_middle_of_a_patch_counts_most() -> None:
    window = displacements._window(5)
    assert window.shape == (11, 11)
    assert window[5, 5] == 1.0
    # Three cells off is one standard deviation.
    assert window[5, 8] == pytest.approx(np.exp(-0.5))
    assert window[2, 5] == pytest.approx(np.exp(-0.5))
    assert window[2, 8] == pytest.approx(np.exp(-1.0))
    np.testing.assert_array_equal(window, window[::-1, ::-1])


def test_only_patches_that_are_alike_and_distinct_are_refined(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scores = np.array([[0.5, 0.05], [0.49, 0.05], [0.5, 0.049], [0.9, 0.9]])

    def search(_first: object, _second: object, _at: object, reach: object, found: Any) -> None:
        assert reach == (6, 4)
        found[:, :2], found[:, 2:] = [3.0, -2.0], scores

    begun: list[Any] = []
    monkeypatch.setattr(displacements, "search_shifts", search)
    monkeypatch.setattr(displacements, "_refined", lambda *asked: begun.append(asked[2]))
    measure(channels(texture()), channels(texture()), PLACES[:4], RULE)
    ((places, shifts),) = begun
    np.testing.assert_array_equal(places, PLACES[[0, 3]])
    np.testing.assert_array_equal(shifts, [[3.0, -2.0]] * 2)


def test_shifts_are_those_of_both_ways_halved_and_believed_when_they_agree(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun = np.tile([1.0, 0.0], (8, 1))
    # There and back: as good as the same, twice hardly and twice too far apart, drifted hardly and
    # too far, not alike, and not fixed at all.
    off = np.array([[0.2, 0], [0.4, 0], [0, 0.4], [0.55, 0], [1.4, 0], [0, 1.6], [0, 0], [0, 0]])
    again = np.array([[0.1, 0], [0, 0], [0, -0.09], [0, 0], [1.4, 0], [0, 1.6], [0, 0], [0, 0]])
    there, back = begun + off, -begun - again
    score = np.array([0.9, 0.5, 0.9, 0.9, 0.9, 0.9, 0.49, 0.9])
    sigma = np.array([0.03, 0.03, 0.03, 0.03, 0.03, 0.03, 0.03, np.inf])
    asked: list[Any] = []

    def matched(pictures: Any, start: Any, *_: object) -> Any:
        asked.append((pictures, start))
        is_there = len(asked) == 1
        return displacements._Matched(
            shifts=there if is_there else back,
            sigma=sigma if is_there else np.full(8, 0.04),
            score=score,
        )

    monkeypatch.setattr(displacements, "_matched", matched)
    one, other = channels(texture()), channels(texture(2))
    found = displacements._refined(one, other, (PLACES[:8], begun), RULE)
    ((pictures, start), (turned, from_there)) = asked
    assert (pictures, turned) == ((one, other), (other, one))
    np.testing.assert_array_equal(start[0], PLACES[:8])
    # The way back begins at the cell that the way there ended in.
    np.testing.assert_array_equal(from_there[0], PLACES[:8] + np.rint(there).astype(int))
    np.testing.assert_array_equal(from_there[1], -there)
    kept = [0, 1, 2, 4]
    np.testing.assert_array_equal(found.places, PLACES[kept])
    np.testing.assert_allclose(found.shift_cells, 0.5 * (there - back)[kept])
    apart = np.abs(there + back).max(axis=1)[kept]
    np.testing.assert_allclose(found.sigma_cells, np.sqrt(0.00125 + 0.25 * apart**2))
    np.testing.assert_array_equal(found.score, score[kept])
