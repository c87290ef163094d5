"""What stands out of an accumulator, who votes, and what planes leave over."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.plane import sample as sampling
from orthoflow_plugins.plane.accumulators import (
    PlanProposer,
    ResidualCounts,
    Voting,
    contrast,
    parabola,
    plan_centre_m,
    vote_counts,
    voters,
)
from orthoflow_plugins.plane.kernels import Boxes, PlanCounts, PlanGrid, blocked, box_blocks
from orthoflow_plugins.plane.sample import PreparedCloud, Sample, Unassigned, prepare

from orthoflow.geometry.point_kernels import read_only
from tests import scenes
from tests.plane_scenes import Rectangle, cloud_of
from tests.plane_scenes import sampled as points_of

GRID = PlanGrid(
    basis=scenes.random_rotation(np.random.default_rng(5)),
    low_m=np.array([-2.0, 3.0, -1.0]),
    cell_m=0.5,
    shape=(6, 4, 3),
)


def level_cloud(surfaces: tuple[Rectangle, ...], *, parts: int) -> PreparedCloud:
    """Points with 2 mm of noise on some surfaces, counted in plan, z up."""
    return prepare(
        cloud_of(points_of(surfaces, noise_m=0.002)),
        np.eye(3),
        cell_m=0.05,
        least_share=0.005,
        parts=parts,
        counts_plan=True,
    )


@pytest.mark.parametrize("half", [0, 1, 2])
def test_contrast_is_a_window_less_the_emptier_one_beside_it(half: int) -> None:
    votes = np.random.default_rng(half).integers(0, 20, (3, 17))
    found = contrast(votes, half)
    assert found.shape == votes.shape
    apart = 2 * half + 2
    for row, line in zip(votes, found, strict=True):
        for place in range(len(row)):
            windows = [
                sum(
                    int(row[k])
                    for k in range(middle - half, middle + half + 1)
                    if 0 <= k < len(row)
                )
                for middle in (place - apart, place, place + apart)
            ]
            assert line[place] == windows[1] - min(windows[0], windows[2])


@pytest.mark.parametrize("shift", [-0.4, 0.0, 0.25])
def test_a_parabola_tells_where_between_bins_its_top_is(shift: float) -> None:
    values = 9.0 - 2.0 * (np.arange(7) - 3.0 - shift) ** 2
    assert parabola(values, 3) == pytest.approx(shift)


def test_maxima_at_an_end_or_without_a_bend_stay_where_they_are() -> None:
    rising = np.array([1.0, 2.0, 5.0, 4.0])
    assert parabola(rising, 0) == parabola(rising, 3) == 0.0
    assert parabola(np.array([2.0, 1.0, 9.0]), 1) == 0.0
    assert parabola(np.array([1.0, 2.0, 3.0]), 1) == 0.0
    # No further than the side of the bin.
    assert parabola(np.array([0.0, 1.0, 1.9]), 1) == 0.5
    assert parabola(np.array([1.9, 1.0, 0.0]), 1) == -0.5


def test_cells_vote_with_their_points_or_alike() -> None:
    counts = np.array([[0, 4, 0], [9, 0, 2], [0, 0, 7]])
    assert vote_counts(counts, "counts") is counts
    # Four cells, 5.5 points on average.
    np.testing.assert_array_equal(vote_counts(counts, "unit"), np.where(counts > 0, 6, 0))
    np.testing.assert_array_equal(vote_counts(np.zeros_like(counts), "unit"), 0)
    few = np.array([[1, 0], [0, 0]])
    np.testing.assert_array_equal(vote_counts(few, "unit"), few)


def test_edges_of_the_density_vote_alone() -> None:
    counts = np.zeros((40, 40), dtype=np.int64)
    counts[10:30, 10:30] = 50
    votes = vote_counts(counts, "canny")
    assert set(np.unique(votes)) == {0, 50}
    rows, columns = np.nonzero(votes)
    inner = (rows > 12) & (rows < 27) & (columns > 12) & (columns < 27)
    assert not inner.any()
    # Of the four sides, two have their edge within the density.
    assert len(rows) >= 38
    assert not vote_counts(np.zeros((5, 5), dtype=np.int64), "canny").any()


@pytest.mark.parametrize(("step_grey", "is_edge"), [(38, False), (42, True), (120, True)])
def test_densities_of_which_one_is_much_the_denser_have_an_edge_between_them(
    step_grey: int, is_edge: bool
) -> None:
    """Grey is the logarithm of the points, white the densest; steps of 40 stand out."""
    counts = np.full((30, 40), 100_000, dtype=np.int64)
    counts[:, :20] = round(np.expm1(np.log1p(100_000) * (255 - step_grey) / 255))
    rows, columns = np.nonzero(vote_counts(counts, "canny"))
    assert set(columns.tolist()) <= {19, 20}
    assert len(rows) >= 28 if is_edge else not len(rows)


def test_voters_stand_in_the_middle_of_their_cells() -> None:
    votes = np.zeros((6, 4), dtype=np.int64)
    votes[0, 0], votes[5, 1] = 3, -2
    found = voters(GRID, votes)
    np.testing.assert_allclose(found.centre_m, [-0.5, 4.0])
    np.testing.assert_allclose(plan_centre_m(GRID), [-0.5, 4.0])
    np.testing.assert_allclose(found.places_m + found.centre_m, [[-1.75, 3.25], [0.75, 3.75]])
    np.testing.assert_array_equal(found.votes, [3, -2])


def sampled(n_represented: float) -> tuple[ResidualCounts, PlanCounts, np.ndarray, np.ndarray]:
    """Points in known cells and storeys, some outside; the plan has twice as many of each."""
    rng = np.random.default_rng(1)
    places = rng.integers(-1, np.array(GRID.shape) + 1, (900, 3))
    offsets_m = (GRID.low_m + GRID.cell_m * (places + rng.uniform(0.1, 0.9, (900, 3)))) @ GRID.basis
    columns = read_only(*np.ascontiguousarray(offsets_m.T.astype(np.float32)))
    points = blocked(columns, box_blocks(columns, parts=1).boxes)
    sample = Sample(
        index=np.arange(900), offsets_m=offsets_m, points=points, n_represented=n_represented
    )
    cells, heights = counted(places)
    plan = PlanCounts(
        cells=2 * cells, heights=2 * heights, boxed=Boxes(boxes=points.boxes, n_unusable=0)
    )
    return ResidualCounts(plan, GRID, sample), plan, places, rng.random(900) < 0.4


def counted(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inside = (places >= 0) & (places < np.array(GRID.shape))
    over = inside[:, 0] & inside[:, 1]
    cells = np.zeros(GRID.shape[:2], dtype=np.int64)
    np.add.at(cells, tuple(places[over, :2].T), 1)
    heights = np.bincount(places[over & inside[:, 2], 2], minlength=GRID.shape[2])
    return cells, heights


def test_of_a_full_sample_each_cell_is_left_what_nobody_took() -> None:
    residuals, plan, places, is_taken = sampled(1.0)
    claims = np.where(is_taken, 3, -1).astype(np.int8)
    cells, heights = counted(places[~is_taken])
    np.testing.assert_array_equal(residuals.cells(claims), 2 * cells)
    np.testing.assert_array_equal(residuals.heights(claims), 2 * heights)
    nobody = np.full(900, -1, dtype=np.int8)
    np.testing.assert_array_equal(residuals.cells(nobody), plan.cells)
    np.testing.assert_array_equal(residuals.heights(np.zeros(900, dtype=np.int8)), 0)


def test_of_a_thin_sample_cells_ask_their_neighbours_too() -> None:
    residuals, plan, places, is_taken = sampled(2.0)
    claims = np.where(is_taken, 0, -1).astype(np.int8)
    every, left = counted(places)[0], counted(places[~is_taken])[0]
    wide = [np.pad(values, 1) for values in (every, left)]
    around = [
        sum(values[i : i + 6, j : j + 4] for i in range(3) for j in range(3)) for values in wide
    ]
    expected = np.rint(plan.cells * (around[1] / around[0]))
    np.testing.assert_array_equal(residuals.cells(claims), expected)


@pytest.mark.parametrize("turn_deg", [2.4, 37.3, 121.0])
def test_a_wall_lies_where_finer_angles_and_bins_put_it(turn_deg: float) -> None:
    """Steps of five degrees, looked at between them; bins of half a cell."""
    turn = np.radians(turn_deg)
    normal, along = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    wall = Rectangle("wall", (*(0.513 * normal), 0.0), (*(3.0 * along), 0.0), (0, 0, 1), 12_000)
    cloud = level_cloud((wall,), parts=1)
    proposer = PlanProposer(
        cloud,
        Voting(angle_step_deg=5.0, least_points=1_000.0, walls=True, levels=False, is_raw=False),
    )
    candidate = proposer.propose(Unassigned.of(cloud))
    assert candidate is not None
    found = candidate.plane
    side = np.sign(found.normal[:2] @ normal)
    assert abs(np.degrees(np.arcsin(found.normal[:2] @ along))) < 0.3
    assert side * found.offset_m == pytest.approx(0.513, abs=0.008)


@pytest.mark.parametrize("turn_deg", [0.0, 37.0, 178.0], ids=lambda turn: f"{turn:.0f}")
def test_what_was_rejected_bars_lines_like_it_from_both_sides(turn_deg: float) -> None:
    turn = np.radians(turn_deg)
    normal, along = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    u_m = (*(2.0 * along), 0.0)
    walls = [Rectangle("wall", (*(far_m * normal), 0.0), u_m, (0, 0, 1), 4_000) for far_m in (0, 1)]
    cloud = level_cloud(tuple(walls), parts=1)
    proposer = PlanProposer(
        cloud,
        Voting(angle_step_deg=1.0, least_points=1_000.0, walls=True, levels=False, is_raw=False),
    )
    candidate = proposer.propose(Unassigned.of(cloud))
    assert candidate is not None
    angle, place = proposer._last
    proposer.reject(candidate)
    assert not proposer._barred_heights.any()
    n_angles, n_bins = proposer._barred.shape
    assert n_angles == 180
    # A line at 180 degrees is the line at 0, its distance counted the other way.
    steps = (np.arange(n_angles) - angle + 90) % 180 - 90
    is_turned = np.abs(np.arange(n_angles) - angle) > 90
    centre = np.where(is_turned, n_bins - 1 - place, place)
    apart = np.abs(np.arange(n_bins) - centre[:, None])
    is_near = (np.abs(steps) <= 2)[:, None] & (apart <= proposer._smear_bins + 1)
    np.testing.assert_array_equal(proposer._barred, is_near)


def test_what_was_rejected_bars_the_heights_about_it() -> None:
    floor = Rectangle("floor", (0, 0, 0.3), (2, 0, 0), (0, 2, 0), 4_000)
    cloud = level_cloud((floor,), parts=1)
    proposer = PlanProposer(
        cloud,
        Voting(angle_step_deg=5.0, least_points=1_000.0, walls=False, levels=True, is_raw=False),
    )
    candidate = proposer.propose(Unassigned.of(cloud))
    assert candidate is not None
    _, storey = proposer._last
    proposer.reject(candidate)
    storeys = np.arange(len(proposer._barred_heights))
    np.testing.assert_array_equal(proposer._barred_heights, np.abs(storeys - storey) <= 2)
    assert not proposer._barred.any()
    assert proposer.propose(Unassigned.of(cloud)) is None
    # There is no picture of votes for walls that nobody looked for.
    assert proposer.first is None


@pytest.mark.parametrize("is_raw", [False, True])
def test_votes_are_points_of_the_cloud_whether_cells_vote_or_points_of_a_sample(
    is_raw: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sampling, "SAMPLE_POINTS", 1_200)
    wall = Rectangle("wall", (0.0, 0.513, 0.0), (3.0, 0, 0), (0, 0, 1), 12_000)
    cloud = level_cloud((wall,), parts=2)
    proposer = PlanProposer(
        cloud,
        Voting(angle_step_deg=5.0, least_points=1_000.0, walls=True, levels=False, is_raw=is_raw),
    )
    found = proposer.propose(Unassigned.of(cloud))
    assert found is not None
    assert 0.95 * 12_000 < found.votes <= 12_000
    assert proposer.first is not None
    # In each direction all points lie somewhere, but for what is rounded.
    np.testing.assert_allclose(proposer.first.votes.sum(axis=1), 12_000, atol=150)
