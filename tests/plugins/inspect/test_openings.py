"""Outlines of openings against a scene whose recess is known, moved by known amounts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect.openings import InspectOpenings

from orthoflow.errors import MethodError
from orthoflow.products import Inspection, Opening, Openings
from tests.raster_scenes import context
from tests.recess_scenes import GSD_M, opening, scene


def judged(folder: Path, *openings: Opening) -> tuple[dict[str, float], Inspection]:
    truth, walls = scene()
    ctx = context(folder)
    inputs = InspectOpenings.In(
        truth=truth, walls=walls, openings=Openings(openings=openings, walls=(3,))
    )
    outputs = InspectOpenings().run(inputs, InspectOpenings.Params(), ctx)
    return {metric.name: metric.value for metric in ctx.metrics}, outputs.inspection


def test_the_true_outline_has_no_error(tmp_path: Path) -> None:
    numbers, inspection = judged(tmp_path, opening(scene()[1]))
    assert (numbers["n_true_openings"], numbers["n_found_openings"]) == (1, 1)
    assert (numbers["n_false_openings"], numbers["n_stray_sides"]) == (0, 0)
    assert numbers["opening_iou_mean"] == pytest.approx(1.0, abs=1e-9)
    # Rays are a sixteenth of a cell of 20 mm apart.
    assert numbers["side_max_mm"] <= 0.7
    assert numbers["opening_depth_error_max_mm"] == pytest.approx(3.0, abs=0.01)
    assert len(inspection.points_world) == 4


@pytest.mark.parametrize("outwards_m", [0.03, -0.05])
def test_an_outline_that_is_too_large_or_small_is_so_in_every_side(
    tmp_path: Path, outwards_m: float
) -> None:
    numbers, _ = judged(tmp_path, opening(scene()[1], outwards_m=outwards_m))
    assert numbers["side_mean_mm"] == pytest.approx(1e3 * outwards_m, abs=0.7)
    assert numbers["side_rmse_mm"] == pytest.approx(1e3 * abs(outwards_m), abs=0.7)
    assert numbers["side_rmse_cells"] == pytest.approx(abs(outwards_m) / GSD_M, abs=0.04)
    assert numbers["side_error_over_sigma"] == pytest.approx(1e3 * abs(outwards_m), abs=0.7)
    assert 0.8 < numbers["opening_iou_min"] < 0.95


def test_a_shift_moves_upright_sides_alike_and_level_ones_not(tmp_path: Path) -> None:
    _, inspection = judged(tmp_path, opening(scene()[1], right_m=0.04))
    shifts = np.round(1e3 * inspection.displacement_m)
    upright: NDArray[np.bool_] = np.abs(shifts[:, 0]) > 1
    np.testing.assert_allclose(shifts[upright], [[40, 0], [40, 0]], atol=1.0)
    np.testing.assert_allclose(shifts[~upright], 0.0, atol=1.0)


def test_sides_that_nobody_saw_are_not_judged(tmp_path: Path) -> None:
    moved = opening(scene()[1], right_m=0.04, unseen=0)
    assert len(judged(tmp_path, moved)[1].wall) == 3


def test_outlines_elsewhere_are_false_and_what_is_missing_counts_nothing(tmp_path: Path) -> None:
    numbers, _ = judged(tmp_path, opening(scene()[1], right_m=0.9))
    assert (numbers["n_false_openings"], numbers["n_found_openings"]) == (1, 0)
    assert numbers["opening_iou_min"] == 0.0
    assert "side_rmse_mm" not in numbers
    none, _ = judged(tmp_path)
    assert (none["n_true_openings"], none["n_found_openings"]) == (1, 0)


def test_openings_of_other_walls_are_refused(tmp_path: Path) -> None:
    truth, walls = scene()
    inputs = InspectOpenings.In(
        truth=truth, walls=walls, openings=Openings(openings=(), walls=(7,))
    )
    with pytest.raises(MethodError, match="openings of wall 7 are given, but the walls are 3"):
        InspectOpenings().run(inputs, InspectOpenings.Params(), context(tmp_path))
