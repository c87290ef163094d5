"""Outlines of openings, moved by known amounts, compared with a scene with a known recess."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.inspect import openings as inspected
from orthoflow_plugins.inspect.openings import InspectOpenings

from orthoflow.errors import MethodError
from orthoflow.products import Inspection, Opening, Openings
from tests.method_runs import run
from tests.raster_scenes import context
from tests.raster_scenes import numbers as numbers_of
from tests.recess_scenes import GSD_M, RECESS, opening, scene

# Size of the recess, 0.8 m by 1.22 m.
WIDTH_M, HEIGHT_M = RECESS[1] - RECESS[0], RECESS[3] - RECESS[2]


def judged(
    folder: Path, *openings: Opening, **params: float
) -> tuple[dict[str, float], Inspection]:
    truth, walls = scene()
    ctx = context(folder)
    found = Openings(openings=openings, walls=(3,))
    inputs = {"truth": truth, "walls": walls, "openings": found}
    inspection = run(InspectOpenings, ctx, inputs, **params).inspection
    return numbers_of(ctx), inspection


# The wall has 15,000 cells; if fewer are allowed, 2 x 2 cells are joined.
@pytest.mark.parametrize(("n_samples", "apart"), [(15_000, 0.0), (4_000, 0.05)])
def test_large_walls_are_judged_in_coarser_cells_but_sides_as_exactly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_samples: int, apart: float
) -> None:
    walls = scene()[1]
    found = opening(walls, outwards_m=0.03), opening(walls, right_m=0.9)
    whole, inspection = judged(tmp_path, *found)
    monkeypatch.setattr(inspected, "MAX_SAMPLES", n_samples)
    coarse, again = judged(tmp_path, *found)
    np.testing.assert_array_equal(again.displacement_m, inspection.displacement_m)
    np.testing.assert_array_equal(again.points_world, inspection.points_world)
    for name in ("opening_iou_mean", "opening_iou_min"):
        assert coarse.pop(name) == pytest.approx(whole.pop(name), abs=apart)
    assert coarse == pytest.approx(whole, abs=1e-9)


@pytest.mark.parametrize("outwards_m", [0.0, 0.03, -0.05])
def test_all_sides_have_the_error_of_the_outline(tmp_path: Path, outwards_m: float) -> None:
    numbers, inspection = judged(tmp_path, opening(scene()[1], outwards_m=outwards_m))
    assert (numbers["n_true_openings"], numbers["n_found_openings"]) == (1, 1)
    assert (numbers["n_false_openings"], numbers["n_stray_sides"]) == (0, 0)
    assert numbers["opening_depth_error_max_mm"] == pytest.approx(3.0, abs=0.01)
    assert len(inspection.points_world) == 4
    # Rays are a sixteenth of a cell of 20 mm apart.
    assert numbers["side_max_mm"] == pytest.approx(1e3 * abs(outwards_m), abs=0.7)
    assert numbers["side_mean_mm"] == pytest.approx(1e3 * outwards_m, abs=0.7)
    assert numbers["side_rmse_mm"] == pytest.approx(1e3 * abs(outwards_m), abs=0.7)
    assert numbers["side_rmse_cells"] == pytest.approx(abs(outwards_m) / GSD_M, abs=0.04)
    assert numbers["side_error_over_sigma"] == pytest.approx(1e3 * abs(outwards_m), abs=0.7)
    ratio = (WIDTH_M + 2 * outwards_m) * (HEIGHT_M + 2 * outwards_m) / (WIDTH_M * HEIGHT_M)
    assert numbers["opening_iou_min"] == pytest.approx(min(ratio, 1.0 / ratio), abs=0.02)


def test_openings_of_other_walls_are_refused(tmp_path: Path) -> None:
    truth, walls = scene()
    inputs = {"truth": truth, "walls": walls, "openings": Openings(openings=(), walls=(7,))}
    with pytest.raises(
        MethodError,
        match=r"there are openings on wall 7, which is not among the connected walls \(3\)",
    ):
        run(InspectOpenings, context(tmp_path), inputs)


@pytest.mark.parametrize(("right_m", "is_found"), [(0.24, True), (0.29, False), (-0.24, True)])
def test_outlines_match_by_half_of_their_area(
    tmp_path: Path, right_m: float, is_found: bool
) -> None:
    numbers, _ = judged(tmp_path, opening(scene()[1], right_m=right_m))
    shared = (WIDTH_M - abs(right_m)) / (WIDTH_M + abs(right_m))
    assert numbers["opening_iou_min"] == pytest.approx(shared if is_found else 0.0, abs=0.02)
    assert (numbers["n_found_openings"], numbers["n_false_openings"]) == (is_found, not is_found)


def test_a_side_without_length_has_no_error(tmp_path: Path) -> None:
    plain = opening(scene()[1])
    last = {
        name: np.append(corners := getattr(plain, name), corners[-1:], axis=0)
        for name in ("outline_m", "outline_world", "side_sigma_m", "side_source")
    }
    numbers, inspection = judged(tmp_path, replace(plain, **last))
    assert len(inspection.points_world) == 4
    # It is not the side of any true border.
    assert numbers == judged(tmp_path, plain)[0] | {"n_stray_sides": 1}
