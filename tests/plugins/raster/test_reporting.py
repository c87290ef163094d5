"""Reports about rastered walls: metrics computed by hand, and complete warnings."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.raster import reporting
from orthoflow_plugins.raster.emptiness import Emptiness

from orthoflow.products import SurfaceMask, Wall
from orthoflow.sdk import StepContext
from tests import samples
from tests.raster_scenes import context, numbers

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def ctx(tmp_path: Path) -> StepContext:
    return context(tmp_path)


def wall(
    count: list[list[int]], *, name: str = "wall 0", mask: list[list[int]] | None = None
) -> Wall:
    counts = np.array(count, dtype=np.uint32)
    states = counts > 0 if mask is None else np.array(mask)
    return samples.wall(
        samples.facing_south(0.005, counts.shape[1], counts.shape[0]),
        name=name,
        depth_m=np.where(states == SurfaceMask.VOID, np.nan, 0.0).astype(np.float32),
        sigma_m=np.where(counts > 1, 0.001 * counts, np.nan).astype(np.float32),
        count=counts,
        mask=states.astype(np.uint8),
    )


def test_walls_are_told_in_numbers(ctx: StepContext) -> None:
    first = wall([[0, 1, 3], [5, 2, 0]], mask=[[2, 1, 1], [1, 1, 0]])
    second = wall([[0, 0], [7, 1]])
    reporting.report(ctx, [first, second], 0.0042, UP)
    assert numbers(ctx) == {
        "n_walls": 2.0,
        # The first wall faces south.
        "omega_deg": pytest.approx(270.0),
        "phi_deg": pytest.approx(0.0),
        "area_m2": pytest.approx(6 * 0.005**2),
        "n_points_inside": 19.0,
        # Cells have 1, 1, 2, 3, 5 and 7 points, and spreads of 2, 3, 5 and 7 mm.
        "points_per_cell": 2.5,
        "scan_step_mm": pytest.approx(4.2),
        "gsd_mm": 5.0,
        "depth_noise_mm": 0.0,
        "sigma_median_mm": pytest.approx(4.0),
        "empty_share": 0.3,
        "measured_share": 0.6,
        "recovered_share": 0.1,
    }


def test_cells_finer_than_the_scan_are_told_with_how_many_hold_a_point(ctx: StepContext) -> None:
    given = [[1, 0, 2], [0, 0, 0]]
    walls, steps_m = zip(
        (wall([[0, 0]], name="empty"), 0.01),
        (wall(given, name="coarse"), 0.0123),
        (wall(given, name="close", mask=[[1, 2, 1], [2, 0, 0]]), 0.0034),
        (wall(given, name="just fine"), 0.0033),
        (wall(given, name="gaps", mask=[[1, 2, 1], [0, 0, 0]]), 0.003),
        strict=True,
    )
    reporting.warn(ctx, walls, steps_m, "laser")
    empty, *fine = ctx.diagnostics
    assert (empty.code, empty.subject) == ("wall-without-points", "empty")
    assert [(one.subject, one.values["measured"], one.values["interpolated"]) for one in fine] == [
        ("coarse", pytest.approx(1 / 3), 0.0),
        ("close", pytest.approx(1 / 3), pytest.approx(1 / 3)),
        # In an uneven scan, many cells are interpolated, however dense points are elsewhere.
        ("gaps", pytest.approx(1 / 3), pytest.approx(1 / 6)),
    ]
    assert ["gsd_m=0.019" in fine[0].remedy, "gsd_m=0.0051" in fine[1].remedy] == [True, True]
    assert fine[2].remedy == ""


def test_cells_that_are_advised_are_no_longer_too_fine(ctx: StepContext) -> None:
    step_m = 0.003_37  # needs 0.005055 m; the nearest number with two digits is that given
    reporting.warn(ctx, [wall([[1]])], [step_m], "laser")
    [said] = ctx.diagnostics
    [advised] = re.findall(r"gsd_m=([0-9.]+)", said.remedy)
    assert float(advised) == 0.0051
    assert step_m <= 2 / 3 * float(advised)


def emptiness(**shares: float) -> Emptiness:
    return Emptiness(
        behind_m=0.4321 if "behind" in shares else math.nan,
        before_m=2.7254 if "before" in shares else math.nan,
        shares={cause: shares.get(cause, 0.0) for cause in reporting.CAUSES},
    )


def test_walls_included_in_others_are_reported(ctx: StepContext) -> None:
    names = ("wall 0", "wall 1", "wall 2", "wall 3")
    reporting.warn_of_covered(ctx, names, {1: 0, 2: 0})
    reporting.warn_of_covered(ctx, names, {})
    (said,) = ctx.diagnostics
    assert (said.code, said.values["included"]) == ("wall-includes-others", "wall 1, wall 2")


def test_causes_of_empty_cells_are_weighed_by_the_size_of_their_walls(ctx: StepContext) -> None:
    reporting.report_empty(
        ctx,
        [wall([[1, 1, 1]]), wall([[1]])],
        [emptiness(behind=0.04, unseen=0.05), emptiness(hidden=0.08)],
    )
    assert numbers(ctx) == pytest.approx(
        {
            "empty_behind_share": 0.03,
            "empty_before_share": 0.0,
            "empty_hidden_share": 0.02,
            "empty_sparse_share": 0.0,
            "empty_unseen_share": 0.0375,
        }
    )
    # Less than a tenth of either is not reported.
    assert ctx.warnings == []


def test_objects_in_front_of_walls_are_errors_and_on_floors_notes(ctx: StepContext) -> None:
    floor = wall([[1, 1]], name="floor 1")
    flat = replace(
        floor.frame, v_world=np.array([0.0, -1.0, 0.0]), normal_world=UP.copy(), up=(0.0, 0.0, 1.0)
    )
    walls = [wall([[1, 1]]), replace(floor, frame=flat)]
    reporting.report_empty(ctx, walls, [emptiness(before=0.06), emptiness(before=0.12)])
    first, second = ctx.diagnostics
    assert (first.code, first.severity, first.subject) == ("wall-front-left-out", "error", "wall 0")
    assert first.values["buffer_front_m"] == 2.8
    assert "buffer_front_m=2.8" in first.remedy
    assert (second.code, second.severity, second.remedy) == ("floor-stood-on", "note", "")
