"""Pictures of an inspection: which colour an error has, and where arrows begin and end."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import figures
from orthoflow_plugins.inspect.figures import (
    colour_error_map,
    depth_error_map,
    displacement_map,
    enlargement,
    vector_map,
)

from tests.inspect_scenes import image_of

UNKNOWN = (20, 40, 60)


@pytest.fixture(autouse=True)
def _exact_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures as they are before WebP loses some of them."""
    monkeypatch.setattr(figures, "encode_webp", np.array)


def in_colours(grey: NDArray[np.float64], colours: int) -> Any:
    """RGB of grey values."""
    return cv2.applyColorMap(grey.astype(np.uint8), colours)[:, :, ::-1]


def test_depth_errors_run_from_blue_to_red_over_a_centimetre_either_way() -> None:
    depth_m = np.array([[-0.02, -0.01, -0.0025, 0.0], [0.004, 0.01, 0.5, np.nan]])
    shown = depth_error_map(depth_m)
    grey = np.array([[0, 0, 95, 127], [178, 255, 255, 0]])
    expected = in_colours(grey, cv2.COLORMAP_JET)
    expected[1, 3] = UNKNOWN
    np.testing.assert_array_equal(shown, expected)


@pytest.mark.parametrize(("draw", "span"), [(colour_error_map, 60.0), (displacement_map, 1.0)])
def test_errors_are_bright_where_they_are_large(draw: Any, span: float) -> None:
    shares = np.array([[0.0, 0.25, 0.5], [1.0, 3.0, np.nan]])
    expected = in_colours(np.array([[0, 63, 127], [255, 255, 0]]), cv2.COLORMAP_INFERNO)
    expected[1, 2] = UNKNOWN
    np.testing.assert_array_equal(draw(shares * span), expected)


def test_large_maps_are_shrunk_to_nine_hundred_pixels() -> None:
    assert np.shape(colour_error_map(np.zeros((1_800, 450)))) == (900, 225, 3)
    assert np.shape(colour_error_map(np.zeros((300, 900)))) == (300, 900, 3)


def grey_image(rows: int, columns: int) -> Any:
    return image_of(np.full((rows, columns), 80.0))


@pytest.mark.parametrize(
    ("shape", "side_px"), [((100, 250), 500), ((700, 600), 700), ((40, 2200), 1100)]
)
def test_arrows_are_drawn_on_the_image_in_pale_grey(shape: tuple[int, int], side_px: int) -> None:
    shown = np.array(vector_map(grey_image(*shape), np.empty((0, 2)), np.empty((0, 2))))
    assert max(shown.shape) == side_px
    assert shown.shape[0] / shown.shape[1] == pytest.approx(shape[0] / shape[1], abs=0.01)
    value = float(np.asarray(grey_image(*shape).rgb)[0, 0, 0])
    assert (shown == int(0.5 * value + 100.0)).all()


def test_arrows_run_from_where_things_should_be_to_where_they_are() -> None:
    # Side 250: pixels are half a cell. The longest usual arrow has 40 pixels.
    image = grey_image(250, 250)
    places = np.array([[50.0, 60.0], [150.0, 100.0], [100.0, 200.0]])
    shift_cells = np.array([[2.0, 0.0], [0.0, 2.0], [-8.0, 0.0]])
    times = enlargement(shift_cells, image)
    usual = np.percentile([2.0, 2.0, 8.0], 95.0)
    assert times == np.floor(40.0 / (2.0 * usual)) == 2.0
    drawn = np.array(vector_map(image, places, shift_cells))
    expected = np.array(vector_map(image, np.empty((0, 2)), np.empty((0, 2))))
    arrows = (
        ((92, 120), (100, 120), (30, 160, 30), 0.3),
        ((300, 192), (300, 200), (30, 160, 30), 0.3),
        # Four times the median; heads are no longer than 8 pixels.
        ((232, 400), (200, 400), (220, 30, 30), 0.25),
    )
    for tail, tip, colour, head in arrows:
        cv2.arrowedLine(expected, tail, tip, colour, 1, cv2.LINE_AA, tipLength=head)
    np.testing.assert_array_equal(drawn, expected)


def test_names_stand_beside_their_arrows_unless_there_are_many() -> None:
    image = grey_image(250, 250)
    places, shift_cells = np.array([[50.0, 60.0], [150.0, 100.0]]), np.ones((2, 2))
    plain = np.array(vector_map(image, places, shift_cells))
    named = np.array(vector_map(image, places, shift_cells, ["P1", "P2"]))
    rows, columns = np.nonzero((named != plain).any(axis=2))
    # Above and to the right of the tips at (100, 120) and (300, 200).
    first = columns < 200
    for own, (x, y) in ((first, (100, 120)), (~first, (300, 200))):
        assert own.any()
        assert (columns[own] - x).min() > 0
        assert (columns[own] - x).max() < 30
        assert np.abs(rows[own] - y).max() < 20
    some = np.tile(places[:1], (60, 1)), np.tile(shift_cells[:1], (60, 1))
    assert (vector_map(image, *some) != np.array(vector_map(image, *some, ["P"] * 60))).any()
    many = 61
    crowd = np.tile(places[:1], (many, 1)), np.tile(shift_cells[:1], (many, 1))
    np.testing.assert_array_equal(
        vector_map(image, *crowd), vector_map(image, *crowd, ["P"] * many)
    )


def test_arrows_beyond_the_median_are_yellow_and_of_many_an_even_part_is_drawn() -> None:
    image = grey_image(500, 500)
    shift_cells = np.tile([[1.0, 0.0], [1.0, 0.0], [1.5, 0.0]], (1_100, 1))
    # All at one place but the yellow ones, of which the first is 2 and every second is drawn.
    places = np.tile([[100.0, 100.0], [100.0, 100.0], [100.0, 300.0]], (1_100, 1))
    places[3::6] = (400.0, 400.0)
    drawn = np.array(vector_map(image, places, shift_cells))
    plain = np.array(vector_map(image, places[:0], shift_cells[:0]))
    changed = (drawn != plain).any(axis=2)
    assert changed[90:110].any()
    assert not changed[395:405].any()
    yellow = (drawn[290:310] == (230, 180, 0)).all(axis=2)
    assert yellow.any()


@pytest.mark.parametrize(
    ("length", "times"), [(0.0, 500.0), (0.07, 500.0), (0.9, 40.0), (3.0, 10.0), (90.0, 1.0)]
)
def test_enlargements_are_round_and_limited(length: float, times: float) -> None:
    shifts = np.tile([0.6 * length, 0.8 * length], (20, 1))
    assert enlargement(shifts, grey_image(600, 800)) == times


def test_nothing_is_not_enlarged() -> None:
    assert enlargement(np.empty((0, 2)), grey_image(600, 800)) == 1.0


def test_cells_of_a_small_image_stay_cells() -> None:
    halves = np.full((60, 150), 80.0)
    halves[:, 75:] = 160.0
    shown = np.array(vector_map(image_of(halves), np.empty((0, 2)), np.empty((0, 2))))
    assert shown.shape == (200, 500, 3)
    assert np.unique(shown).tolist() == [140, 180]
