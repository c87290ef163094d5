"""Charts at the width of a column: sizes of letters, colours that differ, scales that compare."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pytest
from matplotlib.text import Text

from orthoflow.files.drawing import (
    COLUMN_INCHES,
    column_figure,
    in_column_style,
    map_chart,
    picture_figure,
    plane_ink,
    round_scale,
)
from orthoflow.files.images import decode_image
from orthoflow.geometry import frame_over
from tests import samples


def test_no_letter_is_smaller_than_six_points_at_the_width_of_a_column() -> None:
    with in_column_style():
        figure = column_figure(3.0)
        axes = figure.subplots()
        axes.plot([0.0, 1.0], label="a line")
        axes.set(xlabel="x [m]", ylabel="y [m]", title="a title")
        axes.legend()
        figure.draw_without_rendering()
    assert figure.get_size_inches()[0] * 25.4 == pytest.approx(85.0)
    sizes = [text.get_fontsize() for text in figure.findobj(Text) if text.get_text()]
    assert len(sizes) > 10
    assert min(sizes) >= 6.0


def test_colours_of_twenty_planes_differ() -> None:
    inks = np.array([[plane_ink(k) for k in range(20)]], dtype=np.float32)
    lab = cv2.cvtColor(inks, cv2.COLOR_RGB2Lab)[0]
    # CIE76: a just noticeable difference is 2.3.
    assert min(np.linalg.norm(a - b) for a, b in combinations(lab, 2)) > 20.0


@pytest.mark.parametrize("shape", [(40, 90), (900, 300)])
def test_a_picture_keeps_its_proportions_and_leaves_room(shape: tuple[int, int]) -> None:
    with in_column_style():
        figure, axes = picture_figure(np.zeros(shape, dtype=np.uint8), extra_inches=0.5)
    width, height = figure.get_size_inches()
    assert width == COLUMN_INCHES
    assert height == pytest.approx(min(width * shape[0] / shape[1], 6.0) + 0.5)
    axes.quiver([0.0], [shape[0]], [0.0], [shape[0]], angles="xy", scale_units="xy", scale=1.0)
    axes.plot([-shape[1]], [0.0])
    assert axes.get_xlim() == (0.0, shape[1])
    assert axes.get_ylim() == (shape[0], 0.0)


@pytest.mark.parametrize(
    ("up", "normal", "axes", "left", "top"),
    [
        ((0.0, 0.0, 1.0), [0.0, -1.0, 0.0], ("along the wall [m]", "height [m]"), 2.5, 6.0),
        ((0.0, 0.0, 1.0), [0.0, 0.0, 1.0], ("x [m]", "y [m]"), 4.0, 5.0),
        (None, [0.0, -1.0, 0.0], ("across [m]", "up [m]"), 0.0, 0.0),
    ],
)
def test_a_picture_of_a_wall_has_the_axes_of_its_files(
    up: tuple[float, float, float] | None,
    normal: list[float],
    axes: tuple[str, str],
    left: float,
    top: float,
) -> None:
    frame = replace(
        samples.facing_south(0.01, 200, 100, (4.0, 5.0, 6.0)),
        v_world=np.cross([1.0, 0.0, 0.0], normal),
        normal_world=np.array(normal),
        left_m=2.5,
        up=up,
    )
    with in_column_style():
        figure, shown = picture_figure(np.zeros((50, 100), dtype=np.uint8), frame=frame)
        figure.draw_without_rendering()
    # Columns and rows of the raster, whatever the picture's own size.
    assert shown.get_xlim() == (0.0, 200.0)
    along, up_axis = shown.child_axes
    assert (along.get_xlabel(), up_axis.get_ylabel()) == axes
    # A number stands where its place in the raster is drawn.
    drawn = shown.transData.transform((60.0, 30.0))
    assert along.transData.transform((left + 0.6, 0.0))[0] == pytest.approx(drawn[0])
    assert up_axis.transData.transform((0.0, top - 0.3))[1] == pytest.approx(drawn[1])


def test_means_of_a_large_map_leave_out_what_is_unknown() -> None:
    values = np.full((2_000, 2_000), np.nan)
    values[::2] = 1.0
    corners = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 0.0, 2.0]])
    frame = frame_over(corners, np.array([0.0, -1.0, 0.0]), gsd_m=0.001)
    shown = decode_image(map_chart(values, "error [mm]", frame, low=0.0, high=1.0), "map")
    # Half known: the full colour, neither mixed with zeros nor missing.
    np.testing.assert_allclose(shown[400, 500], (252, 255, 164), atol=10)


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.0, 1.0), (0.1, 0.1), (0.11, 0.2), (2.0, 2.0), (2.1, 5.0), (51.0, 100.0), (1e-7, 1e-7)],
)
def test_scales_are_rounded_up(value: float, expected: float) -> None:
    assert round_scale(value) == pytest.approx(expected)
