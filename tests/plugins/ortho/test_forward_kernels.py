"""Where rays of pixels meet the surface, against every border of cells that they cross."""

from __future__ import annotations

import itertools
import math
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.forward_kernels import _first_meeting
from orthoflow_plugins.ortho.parameters import VisibilityParams
from orthoflow_plugins.ortho.surfaces import Surface, relief_of, view_of
from orthoflow_plugins.ortho.visibility_kernels import Relief, WallView

from tests import ortho_scenes as scenes
from tests.long_loops import seeds

TOLERANCE_M: Final = 0.008


def boxes(seed: int) -> tuple[WallView, Relief]:
    """A wall with boxes on it, steps of millimetres, and holes, before a camera."""
    rng = np.random.default_rng(seed)
    depths = rng.choice([0.0, 0.002, 0.005], scenes.SHAPE).astype(np.float32)
    for row, column in rng.integers(0, scenes.SHAPE, (60, 2)):
        rows, columns = rng.integers(2, 9, 2)
        depths[row : row + rows, column : column + columns] += rng.choice([-0.03, 0.04, 0.1])
    depths[rng.random(scenes.SHAPE) < 0.02] = np.nan
    where = scenes.frame()
    surface = Surface(
        frame=where,
        relief=relief_of(scenes.walls(where, depths).walls[0]),
        front_m=scenes.BUFFER_M,
        tolerance_m=TOLERANCE_M,
    )
    params = VisibilityParams(incidence_max_deg=80.0)
    camera = scenes.camera(where, aside_m=rng.uniform(-0.5, 0.5))
    view = view_of(camera, surface, params)
    # So near that rays graze: they fall by less over a cell than boxes are high.
    return view._replace(height_m=surface.relief.highest_m + 0.3), surface.relief


def met(
    view: WallView, relief: Relief, ray: NDArray[np.float64], lowest: float
) -> tuple[float, str]:
    """Distance at which a ray meets a patch or, by little, a side; what it meets.

    All borders of cells are crossed in order, whichever way the ray goes.
    """
    rows, columns = relief.depth.shape
    eye = np.array([view.column + 0.5, view.row + 0.5, view.height_m])
    first = (relief.highest_m - eye[2]) / ray[2]
    last = (lowest - view.tolerance_m - eye[2]) / ray[2]
    lines = [(np.arange(-400, 800) - eye[k]) / ray[k] for k in range(2)]
    crossed = np.concatenate(lines)
    at = np.sort(np.concatenate([[first, last], crossed[(crossed > first) & (crossed < last)]]))
    # A ray may be below a surface by as much as it falls over a cell.
    fall = -ray[2] * min(*(1.0 / np.abs(ray[:2])), last - first)
    for begin, end in itertools.pairwise(at):
        column, row = (math.floor(value) for value in (eye + 0.5 * (begin + end) * ray)[:2])
        if not (0 <= column < columns and 0 <= row < rows):
            continue
        depth = float(relief.depth[row, column])
        above, below = eye[2] + begin * ray[2], eye[2] + end * ray[2]
        if below <= depth <= above:
            return (depth - eye[2]) / ray[2], "patch"
        if below <= depth:
            is_little = depth - above <= fall + 2.0 * view.tolerance_m
            return (begin, "slope") if is_little else (-1.0, "side")
    return -1.0, "nothing"


@pytest.mark.parametrize("seed", seeds(2))
def test_rays_meet_the_first_patch_on_their_way_and_no_sides(seed: int) -> None:
    view, relief = boxes(seed)
    rng = np.random.default_rng(seed)
    lowest = float(np.nanmin(relief.depth))
    seen = set()
    for _ in range(150):
        # From near its foot, to beyond the wall's ends, in all four directions.
        goal = rng.uniform(-60.0, [scenes.SHAPE[1] + 60.0, scenes.SHAPE[0] + 60.0])
        way = np.append(goal, lowest) - [view.column + 0.5, view.row + 0.5, view.height_m]
        ray = way / rng.uniform(1.0, 3.0)
        expected, what = met(view, relief, ray, lowest)
        found = _first_meeting(view, relief, *(float(value) for value in ray), lowest)
        assert found == pytest.approx(expected, abs=1e-9), what
        seen.add((what, ray[0] > 0.0, ray[1] > 0.0))
    for what in ("patch", "slope", "side", "nothing"):
        assert sum(item[0] == what for item in seen) >= 2, what
    assert len({item[1:] for item in seen if item[0] == "patch"}) == 4
