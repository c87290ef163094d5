"""Hypotheses: how they are drawn, when two are alike, and which stay out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from orthoflow_plugins.plane.hypotheses import (
    Hypotheses,
    Rejections,
    alike,
    curve_order,
    draw_hypotheses,
    scores_of,
    scores_of_sums,
)

UP = np.array([0.0, 0.0, 1.0])


def test_points_are_ordered_along_the_curve_that_interleaves_their_bits() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-3.0, 2.0, (500, 3)) * [1.0, 0.4, 0.7]
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    cells = np.clip((points - low) * 1023 / (high - low).max(), 0, 1023).astype(int)
    keys = [
        sum(
            ((int(cell[axis]) >> bit) & 1) << (3 * bit + axis)
            for bit in range(10)
            for axis in range(3)
        )
        for cell in cells
    ]
    np.testing.assert_array_equal(curve_order(points), np.argsort(keys, kind="stable"))
    np.testing.assert_array_equal(curve_order(np.ones((4, 3))), np.arange(4))


@pytest.mark.parametrize("seed", range(3))
def test_hypotheses_hold_their_points_and_the_flat_ones_are_left_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wall = np.column_stack([rng.uniform(-1, 1, 300), np.full(300, 2.0), rng.uniform(-1, 1, 300)])
    for model in ("3d", "2d"):
        drawn = draw_hypotheses(wall, 400, model, UP, rng)
        np.testing.assert_allclose(np.abs(drawn.normals[:, 1]), 1.0)
        np.testing.assert_allclose(drawn.offsets_m, 2.0 * drawn.normals[:, 1], atol=1e-12)
        assert 300 < len(drawn) <= 400
    # Points of a line: no triangle is high enough, and an upright line fixes no wall.
    line = wall * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0] * rng.uniform(0.0, 1e-3, (300, 1))
    assert len(draw_hypotheses(line, 400, "3d", UP, rng)) < 100
    upright = np.outer(rng.uniform(-1.0, 1.0, 300), UP)
    assert len(draw_hypotheses(upright, 400, "2d", UP, rng)) == 0
    # How large they are does not matter.
    for scale in (0.01, 100.0):
        again = [
            len(draw_hypotheses(scale * some, 400, "3d", UP, np.random.default_rng(seed)))
            for some in (wall, line)
        ]
        assert again[0] > 300
        assert again[1] < 100
    rows = drawn.rows()
    assert rows.dtype == np.float32
    np.testing.assert_allclose(rows, np.column_stack([drawn.normals, drawn.offsets_m]), atol=1e-6)


def test_points_of_a_hypothesis_come_from_one_stretch() -> None:
    """Stretches of 1024 points, and of half as many down to 32: six lengths, as often each."""
    rng = np.random.default_rng(0)
    heights = rng.uniform(0.0, 1e3, 1_024)
    points = np.column_stack([np.arange(1_024.0), heights, np.zeros(1_024)])
    drawn = draw_hypotheses(points, 3_000, "2d", UP, rng)
    on_plane = np.abs(points @ drawn.normals.T - drawn.offsets_m) < 1e-9
    assert (on_plane.sum(axis=0) == 2).mean() > 0.99
    first, last = on_plane.argmax(axis=0), 1_023 - on_plane[::-1].argmax(axis=0)
    apart = (last - first)[on_plane.sum(axis=0) == 2]
    lengths = 1_024 / 2.0 ** np.arange(6)
    for limit in (32, 128, 512):
        # Two even places of a length are nearer than a limit with 1 - (1 - limit / length)^2.
        nearer = 1.0 - (1.0 - np.minimum(limit / lengths, 1.0)) ** 2
        assert np.mean(apart < limit) == pytest.approx(nearer.mean(), abs=0.035)
    # Wherever a stretch begins.
    assert np.mean(first + last) / 2.0 == pytest.approx(512.0, abs=20.0)


def of(*rows: tuple[float, float]) -> Hypotheses:
    """Upright planes by the direction of their normal (degrees) and their offset."""
    angles = np.radians([row[0] for row in rows])
    normals = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(rows))])
    return Hypotheses(normals=normals, offsets_m=np.array([row[1] for row in rows]))


def test_planes_within_two_degrees_and_a_tolerance_are_alike_whichever_way_they_face() -> None:
    first = of((0.0, 1.0))
    others = of((1.9, 1.0), (2.1, 1.0), (0.0, 1.09), (0.0, 1.11), (180.0, -1.0), (180.0, 1.0))
    np.testing.assert_array_equal(
        alike(first, others, 0.1), [[True, False, True, False, True, False]]
    )


def test_what_was_rejected_stays_out_until_points_near_it_are_taken() -> None:
    x = np.linspace(-1.0, 1.0, 201)
    points = np.column_stack([x, np.zeros(201), np.zeros(201)])
    rejections = Rejections(points, 0.1)
    asked = of((0.0, 0.005), (1.0, 0.05), (0.0, 0.5))
    assert not rejections.cover(asked).any()
    rejections.take(np.ones(201, dtype=bool))
    rejections.add(of((0.0, 0.0)))
    rejections.add(of((90.0, 3.0)))
    assert len(rejections) == 2
    np.testing.assert_array_equal(rejections.cover(asked), [True, True, False])
    # 21 points within a decimetre: of them a twentieth may go.
    near = np.flatnonzero(np.abs(x) <= 0.1 + 1e-9)
    assert len(near) == 21
    free = np.ones(201, dtype=bool)
    free[near[:1]] = free[0] = False
    rejections.take(free)
    assert len(rejections) == 2
    free[near[:2]] = False
    rejections.take(free)
    # The other one had no points to lose.
    assert len(rejections) == 1
    assert not rejections.cover(asked).any()
    # A single one covers as well as two do, and loses its points alike.
    rejections.forget()
    assert len(rejections) == 0
    rejections.take(np.ones(201, dtype=bool))
    rejections.add(of((0.0, 0.0)))
    np.testing.assert_array_equal(rejections.cover(asked), [True, True, False])
    rejections.take(free)
    assert len(rejections) == 0


def test_scores_are_the_same_from_histograms_and_from_sums() -> None:
    rng = np.random.default_rng(0)
    histograms = rng.integers(0, 9, (5, 16)).astype(np.int32)
    bins = np.arange(16)
    worth = histograms @ (4 * 16**2 - (2 * bins + 1) ** 2)
    sums = np.column_stack([histograms.sum(axis=1), worth]).astype(np.int64)
    for scoring in ("count", "msac"):
        by_bins = scores_of(
            histograms, scoring, reach_m=0.2, n_points=500, extents_m=np.ones(5), model_points=3
        )
        by_sums = scores_of_sums(sums, scoring, n_bins=16, reach_m=0.2)
        np.testing.assert_allclose(by_bins.value, by_sums.value)
        np.testing.assert_array_equal(by_bins.n_points, by_sums.n_points)
        np.testing.assert_array_equal(by_sums.tolerance_m, 0.2)
        np.testing.assert_array_equal(by_bins.tolerance_m, 0.2)
        np.testing.assert_array_equal(by_sums.n_points, histograms.sum(axis=1))


def test_false_alarms_are_those_of_the_formula() -> None:
    """n - m, binomials of n over k and of k over m, and a chance to the power of k - m."""
    rng = np.random.default_rng(1)
    histograms = rng.integers(0, 4, (6, 8)).astype(np.int32)
    histograms[5] = 0
    extents_m = rng.uniform(1.0, 3.0, 6)
    found = scores_of(
        histograms, "a-contrario", reach_m=0.4, n_points=200, extents_m=extents_m, model_points=3
    )
    for h in range(6):
        best = (-math.inf, 0.05, 0)
        k = 0
        for place in range(8):
            k += int(histograms[h, place])
            tolerance_m = 0.05 * (place + 1)
            if k <= 3:
                continue
            alarms = math.log10(197) + math.log10(math.comb(200, k)) + math.log10(math.comb(k, 3))
            alarms += (k - 3) * math.log10(min(1.0, 2.0 * tolerance_m / extents_m[h]))
            best = max(best, (-alarms, tolerance_m, k))
        assert found.value[h] == pytest.approx(best[0])
        assert found.tolerance_m[h] == pytest.approx(best[1])
        assert found.n_points[h] == best[2]
