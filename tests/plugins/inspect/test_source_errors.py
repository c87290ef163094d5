"""Findings about painted cells, from displacements that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from orthoflow_plugins.inspect.findings import pooled
from orthoflow_plugins.inspect.source_errors import SourceErrors, source_findings

from tests.inspect_scenes import frame


def source_errors() -> SourceErrors:
    """Ten cells in a row: four traced on the wall, two at steps, ghosts, one of nothing."""
    where = frame(shape=(1, 10))
    displacement_m = np.full((1, 10, 2), np.nan)
    displacement_m[0, :4] = [[0.001, 0.0], [-0.002, 0.001], [0.003, 0.0], [0.004, -0.005]]
    displacement_m[0, 4:6] = [[0.01, 0.02], [-0.03, 0.02]]
    displacement_m[0, 6:8] = 0.001
    mask = np.zeros((1, 10), dtype=np.bool_)
    traced, ghosts = mask.copy(), mask.copy()
    # The ninth looks at nothing.
    traced[0, :9] = True
    ghosts[0, 6:8] = True
    return SourceErrors(
        frame=where, displacement_m=displacement_m, traced=traced, ghosts=ghosts,
        n_seen_by_both=8, n_seen_painted=6,
    )  # fmt: skip


def numbers_of(*errors: SourceErrors) -> dict[str, float]:
    """Findings of walls, or of bands of one, together."""
    steps = np.zeros((1, 10), dtype=np.bool_)
    steps[0, 4:6] = True
    samples = pooled([item.samples(steps) for item in errors])
    return {item.name: item.value for item in source_findings(samples, 0)}


def test_shares_within_what_the_orthoimage_states_are_of_both_coordinates() -> None:
    errors = source_errors()
    stated = np.full(errors.traced.shape, 0.002, np.float32)
    known = replace(errors, expected_m=stated)
    # Of 1, -2, 3, 4 mm along u and 0, 1, 0, -5 mm along v, five are within 2 mm and all but 5 mm
    # within 4 mm. Cells at steps, ghosts and those without a place do not count.
    found = numbers_of(known)
    assert found["within_1_sigma_share"] == pytest.approx(5 / 8)
    assert found["within_2_sigma_share"] == pytest.approx(7 / 8)
    stated[...] = np.nan
    assert "within_1_sigma_share" not in numbers_of(known)


def test_walls_are_summed_up_together_and_those_without_painted_cells_left_out() -> None:
    errors = source_errors()
    nothing = np.zeros((1, 10), dtype=np.bool_)
    empty = replace(errors, traced=nothing, ghosts=nothing)
    assert numbers_of(empty) == {}
    twice, once = numbers_of(errors, empty, errors), numbers_of(errors)
    for name, value in once.items():
        # Percentiles lie between other cells; what the empty band could show counts.
        expected = {"n_traced": 2 * value, "n_ghost_cells": 2 * value}.get(name, value)
        if name == "completeness_seen_by_both":
            expected = 3 * errors.n_seen_painted / (3 * errors.n_seen_by_both)
        if not name.startswith("p99"):
            assert twice[name] == pytest.approx(expected), name
