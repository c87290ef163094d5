"""Pictures of an inspection: which scale an error has, and where arrows begin and end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from orthoflow_plugins.inspect.figures import (
    colour_error_map,
    depth_error_map,
    enlargement,
    vector_map,
)

from orthoflow.files.images import decode_image
from tests.inspect_scenes import image_of


def grey_image(rows: int, columns: int) -> Any:
    return image_of(np.full((rows, columns), 80.0))


@pytest.fixture
def arrows(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Tails, components and colours of the arrows that are drawn, and the one of known length."""
    kept: list[tuple[Any, ...]] = []
    quiver, key = Axes.quiver, Axes.quiverkey

    def draw(self: Axes, *args: Any, **settings: Any) -> Any:
        kept.append((np.array(args[:2]).T, np.array(args[2:]).T, settings["color"]))
        return quiver(self, *args, **settings)

    def draw_key(self: Axes, *args: Any, **settings: Any) -> Any:
        kept.append(args[3:])
        return key(self, *args, **settings)

    monkeypatch.setattr(Axes, "quiver", draw)
    monkeypatch.setattr(Axes, "quiverkey", draw_key)
    return kept


def test_maps_have_the_width_of_a_column_and_a_colour_bar() -> None:
    error = np.full((1_800, 450), 30.0)
    error[:900] = np.nan
    frame = grey_image(1_800, 450).frame
    shown = decode_image(colour_error_map(error, frame), "map").astype(int)
    assert shown.shape[1] == 1003
    middle = shown[:, 502]
    # Unknown cells are grey, half of the span is the middle of the colours.
    np.testing.assert_allclose(middle[200], (138, 148, 158), atol=12)
    np.testing.assert_allclose(middle[1200], (188, 55, 84), atol=12)
    square = depth_error_map(np.full((300, 300), 0.01), grey_image(300, 300).frame)
    red, _, blue = decode_image(square, "map")[300, 502]
    assert red > blue


def test_arrows_run_from_where_things_should_be_to_where_they_are(
    arrows: list[tuple[Any, ...]],
) -> None:
    image = grey_image(250, 250)
    places = np.array([[50.0, 60.0], [150.0, 100.0], [100.0, 200.0]])
    shift_cells = np.array([[2.0, 0.0], [0.0, 2.0], [-8.0, 0.0]])
    times = enlargement(shift_cells, image)
    # The longest usual arrow takes at most 6 % of the side: 15 cells of 7.4 give twice, not five.
    assert times == 2.0
    vector_map(image, places, shift_cells)
    (tails, components, colours), (length, label) = arrows
    np.testing.assert_allclose(components, times * shift_cells)
    np.testing.assert_allclose(tails + components, places)
    # Four times the median is red; the median and what equals it is green.
    assert colours[0] == colours[1] != colours[2]
    cell_mm = 1e3 * image.frame.gsd_m
    assert label == f"{length / times * cell_mm:g} mm"


def test_arrows_beyond_the_median_are_yellow_and_of_many_an_even_part_is_drawn(
    arrows: list[tuple[Any, ...]],
) -> None:
    image = grey_image(500, 500)
    shift_cells = np.tile([[1.0, 0.0], [1.0, 0.0], [1.5, 0.0]], (1_100, 1))
    places = np.tile([[100.0, 100.0]], (3_300, 1))
    vector_map(image, places, shift_cells)
    tails, components, colours = arrows[0]
    assert len(tails) == len(components) == 1_650
    assert len(set(colours)) == 2
