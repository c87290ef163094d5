"""Parts of a sheet: the key plan, the numbers of contours, and the title block."""

from __future__ import annotations

import math

import numpy as np
import pytest

from orthoflow.files.drawings.key_plans import key_plan
from orthoflow.files.drawings.printed_pictures import label_place
from orthoflow.geometry.frames import frame_over
from tests import samples
from tests.drawing_runs import GAP_M, SIZE_M, box_planes, wall_frame


@pytest.mark.parametrize(
    ("direction_deg", "turned_deg"),
    [(0, 0), (30, 30), (90, 90), (91, -89), (225, 45), (300, -60)],
)
def test_a_number_lies_along_its_line_and_is_never_upside_down(
    direction_deg: float, turned_deg: float
) -> None:
    angle = math.radians(direction_deg)
    line = np.array([[5.0, 6.0], [5.0 + 40.0 * math.cos(angle), 6.0 + 40.0 * math.sin(angle)]])
    place = label_place(line, 4.0, [])
    assert place is not None
    np.testing.assert_allclose(place[0], line.mean(axis=0))
    assert math.isclose(math.sin(math.radians(place[1] - turned_deg)), 0.0, abs_tol=1e-9)
    assert -90.0 - 1e-9 <= place[1] <= 90.0


def test_numbers_keep_apart_and_short_lines_have_none() -> None:
    line = np.array([[0.0, 0.0], [80.0, 0.0]])
    first = label_place(line, 4.0, [])
    assert first is not None
    second = label_place(line, 4.0, [np.array(first[0])])
    assert second is not None
    assert abs(second[0][0] - first[0][0]) >= 12.0
    everywhere = [np.array([x, 1.0]) for x in np.arange(0.0, 81.0, 10.0)]
    assert label_place(line, 4.0, everywhere) is None
    assert label_place(line[:, :] * 0.24, 4.0, []) is None


def test_a_number_stands_where_its_line_is_straight() -> None:
    # A corner in the middle: there the number would lie beside its line.
    line = np.array([[0.0, 0.0], [30.0, 0.0], [28.0, 1.0], [0.0, 1.0]])
    place = label_place(line, 6.0, [])
    assert place is not None
    assert place[0][1] in (0.0, 1.0)
    assert place[0][0] < 27.0
    zigzag = np.array([[float(k % 2), 0.2 * k] for k in range(60)])
    assert label_place(zigzag, 6.0, []) is None


@pytest.mark.parametrize(("sine", "share"), [(0.89, 0.25), (0.91, 0.5)])
def test_a_corner_below_a_number_is_a_blunt_one(sine: float, share: float) -> None:
    # From the corner both ways: the ends of the number are that sine of its width apart.
    half = 40.0 * np.array([sine, math.sqrt(1.0 - sine**2)])
    line = np.array([half * (-1.0, 1.0), [0.0, 0.0], half])
    place = label_place(line, 5.0, [])
    assert place is not None
    at = line[0] * (1.0 - 2.0 * share)
    below = 2.5 * math.sqrt(1.0 - sine**2) if share == 0.5 else 0.0
    np.testing.assert_allclose(place[0], at + np.array([0.0, below]), atol=1e-9)


def test_the_marked_wall_is_as_long_as_its_points_and_seen_along_its_normal() -> None:
    planes = box_planes()
    plan = key_plan(planes, wall_frame(planes))
    assert len(plan.walls) == 4
    left, right = plan.marked
    wide_m = SIZE_M[0] - 2 * GAP_M
    assert np.linalg.norm(right - left) == pytest.approx(wide_m, abs=1e-6)
    assert plan.arrow is not None
    begin, end = plan.arrow
    across = (right - left) / wide_m
    middle = 0.5 * (left + right)
    # It stands over the middle of the wall, points straight at it, and ends before it.
    for place in (begin, end):
        assert abs(float((place - middle) @ across)) < 1e-6
    assert np.linalg.norm(begin - middle) == pytest.approx(0.25 * wide_m, abs=1e-6)
    assert np.linalg.norm(end - middle) == pytest.approx(0.025 * wide_m, abs=1e-6)
    assert (begin - middle) @ (end - middle) > 0.0
    # In the room: on the same side as the other walls.
    others = plan.walls.reshape(-1, 2).mean(axis=0)
    assert (begin - middle) @ (others - middle) > 0.0


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0, -25.0])
def test_arrows_are_as_long_at_walls_that_lean(tilt_deg: float) -> None:
    angle = np.radians(tilt_deg)
    normal = np.array([0.0, -np.cos(angle), np.sin(angle)])
    down = np.array([0.0, -np.sin(angle), -np.cos(angle)])
    corner = np.array([1.0, 2.0, 3.0])
    sides = np.array([[0, 0], [0, 1], [1, 1], [1, 0]], dtype=np.float64)
    corners = corner + 4.0 * sides[:, :1] * [1.0, 0.0, 0.0] + 2.0 * sides[:, 1:] * down
    planes = samples.planes(
        normal=normal[None],
        offset=np.array([normal @ corner]),
        corners=corners[None],
        names=("wall 0",),
    )
    plan = key_plan(planes, frame_over(corners, normal, gsd_m=0.01))
    assert plan.arrow is not None
    along = plan.arrow[1] - plan.arrow[0]
    # A quarter of the wall before it, but for a tenth of that; towards it, seen from above.
    assert np.linalg.norm(along) == pytest.approx(0.25 * 4.0 * 0.9)
    before = plan.arrow[0] - plan.marked.mean(axis=0)
    np.testing.assert_allclose(before, -along / 0.9, atol=1e-9)
