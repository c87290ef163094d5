"""`ortho.dsm-forward`: each pixel paints the cell that it shows, and no cell behind it."""

from __future__ import annotations

import itertools
import math
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho import dsm_forward
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.dsm_forward import DsmForward
from orthoflow_plugins.ortho.forward_kernels import first_hit
from orthoflow_plugins.ortho.parameters import VisibilityParams
from orthoflow_plugins.ortho.surfaces import Surface, relief_of, view_of
from orthoflow_plugins.ortho.visibility_kernels import Relief, WallView

from orthoflow.products import Layer, LayerMask
from orthoflow.sdk import StepContext
from tests import ortho_scenes as scenes
from tests.long_loops import seeds


def given(*, aside_m: float, width: int = 1000, **known: Any) -> dict[str, Any]:
    viewer = scenes.camera(scenes.frame(), aside_m=aside_m, width=width)
    return scenes.inputs(scenes.rendered(aside_m=aside_m, width=width), viewers=[viewer], **known)


def thrown(of: dict[str, Any], folder: Path, **params: Any) -> tuple[Layer, StepContext]:
    ((layer,), ctx) = scenes.laid(DsmForward, folder, of, **params)
    return layer, ctx


@cache
def layer_of(aside_m: float) -> Layer:
    return thrown(given(aside_m=aside_m), Path(mkdtemp()))[0]


@pytest.mark.parametrize("aside_m", [-0.7, 0.9])
def test_pixels_paint_the_visible_cells_that_they_show(aside_m: float) -> None:
    layer = layer_of(aside_m)
    assert layer.filled is not None
    taken = (layer.mask == LayerMask.PAINTED) & (layer.filled == 0)
    is_raised = scenes.depth_m() > 0.0
    expected = np.where(is_raised, scenes.BLUE[scenes.RAISED], scenes.BLUE[scenes.BASE])
    assert np.mean(layer.rgb[..., 2][taken] == expected[taken]) > 0.999
    # The limit is the sum of half a cell, half of a grey level (a quarter of a cell), and a
    # hundredth of a pixel.
    assert np.quantile(np.abs(scenes.places_off(layer)[taken]), 0.999) <= 0.5 + 0.125 + 0.01
    is_visible, is_behind_board = scenes.visible(scenes.camera(scenes.frame(), aside_m=aside_m))
    assert not (layer.rgb[..., 2] == scenes.BLUE[scenes.BOARD]).any()
    # A gap of one cell at an edge is filled.
    assert np.mean(layer.mask[is_behind_board] == LayerMask.OCCLUDED) > 0.99
    assert np.mean(layer.mask[is_visible] == LayerMask.PAINTED) > 0.96
    assert (layer.quality[layer.mask != LayerMask.PAINTED] == 0.0).all()
    assert not layer.rgb[layer.mask != LayerMask.PAINTED].any()


def test_quality_and_reach_are_those_of_the_backward_projection(tmp_path: Path) -> None:
    layer = layer_of(0.9)
    ((back,), _) = scenes.laid(DsmBackward, tmp_path, given(aside_m=0.9))
    both = (layer.mask == LayerMask.PAINTED) & (back.mask == LayerMask.PAINTED)
    assert both.sum() > 0.9 * (back.mask == LayerMask.PAINTED).sum()
    np.testing.assert_allclose(layer.quality[both], back.quality[both], rtol=1e-3, atol=1e-4)
    assert ((layer.mask == LayerMask.OUTSIDE) == (back.mask == LayerMask.OUTSIDE)).all()


def test_a_coarse_photo_leaves_gaps_that_are_filled_and_marked(tmp_path: Path) -> None:
    coarse = given(aside_m=0.0, width=300, cloud=None)
    holed, ctx = thrown(coarse, tmp_path, fill_gap_cells=0)
    assert "occluders-unknown" in [one.code for one in ctx.diagnostics]
    assert holed.filled is not None
    assert not holed.filled.any()
    # Pixels are at least 5 mm wide on 4 mm cells.
    gsd_m = 2.0 / (1.5 * 300)
    assert np.mean(holed.mask == LayerMask.PAINTED) <= 1.1 * (scenes.GSD_M / gsd_m) ** 2
    closed, _ = thrown(coarse, tmp_path, fill_gap_cells=2)
    assert np.mean(closed.mask == LayerMask.PAINTED) > 0.97
    is_old = (closed.mask == LayerMask.PAINTED) & (closed.filled == 0)
    np.testing.assert_array_equal(is_old, holed.mask == LayerMask.PAINTED)


def test_bands_do_not_show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    coarse = given(aside_m=0.0, width=300, cloud=None)
    whole, _ = thrown(coarse, tmp_path, fill_gap_cells=3)
    monkeypatch.setattr(dsm_forward, "BAND_CELLS", 25 * scenes.SHAPE[1])
    banded, _ = thrown(coarse, tmp_path, fill_gap_cells=3)
    for name in ("rgb", "mask", "quality", "filled"):
        np.testing.assert_array_equal(getattr(banded, name), getattr(whole, name), err_msg=name)


TOLERANCE_M: Final = 0.008


def boxes(seed: int) -> tuple[WallView, Relief]:
    """Return a camera and a wall with boxes, steps of millimetres, and holes."""
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
    # The camera is so close that rays descend by less than the height of a box within a cell.
    return view._replace(height_m=surface.relief.highest_m + 0.3), surface.relief


def met(
    view: WallView, relief: Relief, ray: NDArray[np.float64], lowest: float
) -> tuple[float, str]:
    """Return the distance at which a ray hits a patch or the top of a side, and what it hits.

    The ray crosses all borders of cells in order, in any direction.
    """
    rows, columns = relief.depth.shape
    eye = np.array([view.column + 0.5, view.row + 0.5, view.height_m])
    first = (relief.highest_m - eye[2]) / ray[2]
    last = (lowest - view.tolerance_m - eye[2]) / ray[2]
    lines = [(np.arange(-400, 800) - eye[k]) / ray[k] for k in range(2)]
    crossed = np.concatenate(lines)
    at = np.sort(np.concatenate([[first, last], crossed[(crossed > first) & (crossed < last)]]))
    # A ray may be below a surface by its descent within a cell.
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
        # Rays are aimed at positions on and beside the wall, in all four directions.
        goal = rng.uniform(-60.0, [scenes.SHAPE[1] + 60.0, scenes.SHAPE[0] + 60.0])
        way = np.append(goal, lowest) - [view.column + 0.5, view.row + 0.5, view.height_m]
        ray = way / rng.uniform(1.0, 3.0)
        expected, what = met(view, relief, ray, lowest)
        found = first_hit(view, relief, *(float(value) for value in ray), lowest)
        assert found == pytest.approx(expected, abs=1e-9), what
        seen.add((what, ray[0] > 0.0, ray[1] > 0.0))
    for what in ("patch", "slope", "side", "nothing"):
        assert sum(item[0] == what for item in seen) >= 2, what
    assert len({item[1:] for item in seen if item[0] == "patch"}) == 4
