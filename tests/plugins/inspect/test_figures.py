"""Pictures of an inspection: which colour an error has, and where arrows begin and end."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from orthoflow_plugins.inspect import figures
from orthoflow_plugins.inspect.figures import (
    colour_error_map,
    enlargement,
    vector_map,
)

from tests.inspect_scenes import image_of


@pytest.fixture(autouse=True)
def _exact_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures as they are before WebP loses some of them."""
    monkeypatch.setattr(figures, "encode_webp", np.array)


def test_large_maps_are_shrunk_to_nine_hundred_pixels() -> None:
    assert np.shape(colour_error_map(np.zeros((1_800, 450)))) == (900, 225, 3)
    assert np.shape(colour_error_map(np.zeros((300, 900)))) == (300, 900, 3)


def grey_image(rows: int, columns: int) -> Any:
    return image_of(np.full((rows, columns), 80.0))


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
