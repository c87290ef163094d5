"""Errors of cells and of their sources, from known displacements, depths and colours."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.inspect.cell_errors import (
    Sampling,
    WallSamples,
    depth_step_band,
    sample_findings,
    wall_errors,
)
from orthoflow_plugins.inspect.findings import pooled
from orthoflow_plugins.inspect.source_errors import SourceErrors, source_findings

from orthoflow.products import OrthoMask, SurfaceMask
from tests.inspect_scenes import frame

# --- errors of cells ---

SHAPE = (12, 20)


def scene() -> tuple[Any, Any, Any]:
    """Return an orthoimage, its wall and their truth, with a depth step at column 10.

    The colours are right except in row 5, wrong by 10 grey levels, and in row 7, filled and wrong
    by 20.
    """
    rgb = np.full((*SHAPE, 3), 100.0, dtype=np.float32)
    depth = np.zeros(SHAPE, dtype=np.float32)
    depth[:, 10:] = 0.1
    rectangle = np.zeros(SHAPE, dtype=np.int32)
    rectangle[11] = -1
    rgb[11], depth[11] = np.nan, np.nan
    seen = rectangle >= 0
    seen[9] = False
    frame = SimpleNamespace(gsd_m=0.01, shape=SHAPE)
    true = SimpleNamespace(rgb=rgb, depth_m=depth, rectangle=rectangle, seen=seen, frame=frame)
    shown = np.full((*SHAPE, 3), 100, dtype=np.uint8)
    shown[5], shown[7, :, 1] = 110, 120
    mask = np.full(SHAPE, OrthoMask.PAINTED, dtype=np.uint8)
    mask[7], mask[10] = OrthoMask.FILLED, OrthoMask.NONE
    measured = np.full(SHAPE, SurfaceMask.MEASURED, dtype=np.uint8)
    measured[0] = SurfaceMask.VOID
    wall = SimpleNamespace(
        mask=measured,
        depth_m=depth + np.float32(0.002),
        sigma_m=np.full(SHAPE, 0.001, dtype=np.float32),
    )
    return SimpleNamespace(rgb=shown, mask=mask), wall, true


def test_cells_are_compared_away_from_steps_and_by_what_they_are() -> None:
    image_, wall, true = scene()
    every = np.ones(SHAPE, dtype=np.bool_)
    lattice = np.zeros(SHAPE, dtype=np.bool_)
    lattice[1::2, 1::2] = True
    steps = depth_step_band(true.depth_m)
    # Expect two cells on either side of the step, and two rows at the border of the surface.
    expected = np.zeros(SHAPE, dtype=np.bool_)
    expected[:, 8:12] = expected[9:] = True
    np.testing.assert_array_equal(steps[:11], expected[:11])
    errors = wall_errors(image_, wall, true, Sampling(coloured=every, lattice=lattice))
    samples = errors.samples
    np.testing.assert_array_equal(errors.steps, steps)
    away = ~steps & (true.rectangle >= 0)
    n_away = np.count_nonzero(away[1:])
    np.testing.assert_allclose(samples.depth_m, 0.002, atol=1e-7)
    assert len(samples.depth_m) == len(samples.sigma_m) == n_away
    assert len(samples.step_depth_m) == 10 * 20 - n_away
    assert np.isnan(errors.depth_m[[0, 11]]).all()
    # Sixteen cells per row are away from steps; six rows are right, one is wrong by 10.
    assert np.count_nonzero(samples.colour == 100.0) == 16
    assert len(samples.colour) == 8 * 16
    np.testing.assert_allclose(errors.grey[5, :8], 10.0)
    assert np.isnan(errors.grey[10:]).all()
    painted = (image_.mask == OrthoMask.PAINTED) & (true.rectangle >= 0)
    assert samples.n_seen == np.count_nonzero(true.seen & lattice)
    assert samples.n_seen_painted == np.count_nonzero(true.seen & lattice & painted)
    assert samples.n_seen_shown - samples.n_seen_painted == np.count_nonzero(lattice[7])
    some = wall_errors(image_, wall, true, Sampling(coloured=~every, lattice=every)).samples
    assert len(some.colour) == 0
    assert len(some.depth_m) == n_away


def samples_of(**given: Any) -> WallSamples:
    none = np.zeros(0)
    usual = {
        "depth_m": none, "sigma_m": none, "step_depth_m": none, "colour": none,
        "shift_m": np.zeros((0, 2)), "shift_cells": np.zeros((0, 2)),
        "n_seen": 0, "n_seen_painted": 0, "n_seen_shown": 0,
    }  # fmt: skip
    return WallSamples(**{**usual, **given})


def numbers_of(samples: WallSamples, *, sources_are_traced: bool = False) -> dict[str, float]:
    found = sample_findings(samples, 2, sources_are_traced=sources_are_traced)
    return {item.name: item.value for item in found}


def test_numbers_follow_their_definitions() -> None:
    shift_cells = np.array([[0.1, 0.2], [0.1, 0.1], [0.2, 0.1], [0.1, -0.1], [9.0, 0.0]])
    samples = samples_of(
        depth_m=np.array([0.001, -0.002, 0.003, 0.001]),
        sigma_m=np.array([0.0004, 0.0005, 0.0011, np.nan]),
        step_depth_m=np.array([0.01, 0.02]),
        colour=np.array([4.0, 16.0]),
        shift_m=0.01 * shift_cells,
        shift_cells=shift_cells,
        n_seen=8, n_seen_painted=6, n_seen_shown=7,
    )  # fmt: skip
    found = numbers_of(samples)
    kept = 10.0 * shift_cells[:4]
    expected = {
        "depth_median_mm": 1.0,
        "depth_nmad_mm": 1.4826 * 1.0,
        "depth_rmse_mm": np.sqrt(15.0 / 4.0),
        "depth_within_3sigma": 2.0 / 3.0,
        "depth_step_rmse_mm": np.sqrt(250.0),
        "colour_rmse_grey": np.sqrt(10.0),
        "n_patches": 5.0,
        "rmse_u_mm": np.sqrt((kept[:, 0] ** 2).mean()),
        "rmse_v_mm": np.sqrt((kept[:, 1] ** 2).mean()),
        "mean_u_mm": kept[:, 0].mean(),
        "mean_v_mm": kept[:, 1].mean(),
        "displaced_share": 0.2,
        "completeness": 0.75,
        "completeness_filled": 0.875,
    }
    assert found == {name: pytest.approx(value, rel=1e-3) for name, value in expected.items()}
    assert {item.wall for item in sample_findings(samples, 2, sources_are_traced=False)} == {2}
    traced = numbers_of(samples, sources_are_traced=True)
    assert traced["patch_rmse_u_mm"] == found["rmse_u_mm"]
    assert "rmse_u_mm" not in traced
    assert numbers_of(samples_of()) == {"n_patches": 0.0}
    twice = numbers_of(pooled([samples, samples]))
    assert twice == {
        name: pytest.approx(10.0 if name == "n_patches" else value, rel=1e-3)
        for name, value in expected.items()
    }


def test_patches_further_off_than_the_rest_are_displaced() -> None:
    """The limit is four robust standard deviations, but at least a quarter of a cell."""
    still = np.zeros((9, 2))
    for far, share in ((0.24, 0.0), (0.26, 0.1)):
        cells = np.vstack([still, [0.0, far]])
        found = numbers_of(samples_of(shift_cells=cells, shift_m=0.01 * cells))
        assert found["displaced_share"] == pytest.approx(share)
    # With an eleventh value, the median is 1/45 and the median distance from it 2/15.
    spread = np.column_stack([np.linspace(-0.2, 0.2, 10), np.zeros(10)])
    limit = 1.0 / 45.0 + 4.0 * 1.4826 * 2.0 / 15.0
    for far, share in ((limit - 0.01, 0.0), (limit + 0.01, 1.0 / 11.0)):
        cells = np.vstack([spread, [far, 0.0]])
        found = numbers_of(samples_of(shift_cells=cells, shift_m=0.01 * cells))
        assert found["displaced_share"] == pytest.approx(share, abs=1e-9), far


def source_errors() -> SourceErrors:
    """Return errors of ten cells: four on the wall, two at steps, two ghosts, one off target."""
    displacement_m = np.full((1, 10, 2), np.nan)
    displacement_m[0, :4] = [[0.001, 0.0], [-0.002, 0.001], [0.003, 0.0], [0.004, -0.005]]
    displacement_m[0, 4:6] = [[0.01, 0.02], [-0.03, 0.02]]
    displacement_m[0, 6:8] = 0.001
    mask = np.zeros((1, 10), dtype=np.bool_)
    traced, ghosts = mask.copy(), mask.copy()
    # The pixel of the ninth cell has no target.
    traced[0, :9] = True
    ghosts[0, 6:8] = True
    return SourceErrors(
        frame=frame(shape=(1, 10)), displacement_m=displacement_m, traced=traced, ghosts=ghosts,
        n_seen_by_both=8, n_seen_painted=6,
    )  # fmt: skip


def source_numbers_of(*errors: SourceErrors) -> dict[str, float]:
    """Return the findings of walls, or of bands of a wall, together."""
    steps = np.zeros((1, 10), dtype=np.bool_)
    steps[0, 4:6] = True
    samples = pooled([item.samples(steps) for item in errors])
    return {item.name: item.value for item in source_findings(samples, 0)}


def test_shares_within_what_the_orthoimage_states_are_of_both_coordinates() -> None:
    errors = source_errors()
    stated = np.full(errors.traced.shape, 0.002, np.float32)
    known = replace(errors, expected_m=stated)
    # Of 1, -2, 3, 4 mm along u and 0, 1, 0, -5 mm along v, five are within 2 mm, and all except -5
    # mm within 4 mm. Cells at steps, ghosts and cells without a target are not included.
    found = source_numbers_of(known)
    assert found["within_1_sigma_share"] == pytest.approx(5 / 8)
    assert found["within_2_sigma_share"] == pytest.approx(7 / 8)
    stated[...] = np.nan
    assert "within_1_sigma_share" not in source_numbers_of(known)


def test_walls_are_summed_up_together_and_those_without_painted_cells_left_out() -> None:
    errors = source_errors()
    nothing = np.zeros((1, 10), dtype=np.bool_)
    empty = replace(errors, traced=nothing, ghosts=nothing)
    assert source_numbers_of(empty) == {}
    twice, once = source_numbers_of(errors, empty, errors), source_numbers_of(errors)
    for name, value in once.items():
        # Percentiles are interpolated between other cells; cells that the empty band could show are
        # included.
        expected = {"n_traced": 2 * value, "n_ghost_cells": 2 * value}.get(name, value)
        if name == "completeness_seen_by_both":
            expected = 3 * errors.n_seen_painted / (3 * errors.n_seen_by_both)
        if not name.startswith("p99"):
            assert twice[name] == pytest.approx(expected), name
