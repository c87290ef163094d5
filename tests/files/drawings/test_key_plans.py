"""A room from above: where its walls lie, which one is marked, and from where it is seen."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.files.drawings.key_plans import key_plan
from orthoflow.geometry.frames import frame_over
from tests import samples
from tests.drawing_runs import GAP_M, SIZE_M, box_planes, wall_frame


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
