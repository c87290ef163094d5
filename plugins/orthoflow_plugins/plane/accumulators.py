"""The modified 2D Hough transform of markiewicz2015, and the histogram along up beside it.

The plan (a map of the cloud, 2 cm cells) votes for lines; a cell has as many votes as points, since
with one vote per cell floors and ceilings drown every wall (their Figure 10). From each maximum the
level of its surroundings at the same angle is subtracted: that level is what surfaces cut across
leave, and with it goes the advantage of the longest diagonal through the room.

To count all points anew after each plane would cost a pass over the cloud. The sample knows which
share of a cell's points a plane took; where it is all of the cloud, it knows that exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.threads import in_threads
from orthoflow_plugins.plane.candidates import Candidate
from orthoflow_plugins.plane.kernels import PlanCounts, PlanGrid
from orthoflow_plugins.plane.neighbouring import summed_around
from orthoflow_plugins.plane.sample import PreparedCloud, Sample, Unassigned
from orthoflow_plugins.plane.vote_kernels import VOTE_SHARES, vote_image, vote_lines, vote_points

# How loud a cell of the plan is: its points, one if it has any, or one on an edge of the density.
Accumulation = Literal["counts", "unit", "canny"]

# A candidate's votes may fall short of the share a plane needs by this much: it may be smeared over
# several bins until it is refined.
VOTE_CAUTION: Final = 0.25
_NOT_AGAIN_ANGLES: Final = 2
# Thresholds of the edge detector on the density image of 8 bits.
_EDGE_LOW: Final = 60
_EDGE_HIGH: Final = 160


@dataclass(frozen=True, kw_only=True)
class Accumulator:
    """Parameter space of the lines in a plan.

    Attributes:
        angles_rad: (a,) direction of the lines' normals in the (e1, e2) frame, 0 to pi.
        low_m: lower edge of the first bin, as a distance from `centre_m`.
        centre_m: (2,) centre of the plan in the (e1, e2) frame of the cloud's offsets.
        votes: (a, bins) points that speak for each line.
    """

    angles_rad: NDArray[np.float64]
    low_m: float
    centre_m: NDArray[np.float64]
    votes: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Voting:
    """How a plan votes.

    Attributes:
        angle_step_deg: step between the directions that are voted for.
        least_points: points that a plane needs.
        walls: propose lines of the plan.
        levels: propose heights.
        accumulator: how loud a cell is.
        is_raw: points of the sample vote with their own coordinates instead of the cells.
    """

    angle_step_deg: float
    least_points: float
    walls: bool
    levels: bool
    accumulator: Accumulation = "counts"
    is_raw: bool


class PlanProposer:
    """Proposes walls from the maxima of the accumulator and levels from those of the heights.

    Attributes:
        first: the accumulator of the untouched cloud.
    """

    def __init__(self, cloud: PreparedCloud, voting: Voting) -> None:
        """Get ready to propose.

        Args:
            cloud: the cloud, counted over its plan.
            voting: how it votes.

        Raises:
            ValueError: the points were not counted over the plan.
        """
        grid = cloud.grid
        if cloud.plan is None:
            raise ValueError("the points of the cloud were not counted over its plan")
        self._cloud = cloud
        self._plan = cloud.plan
        self._cells = np.zeros(grid.shape[:2], dtype=np.int64)
        self._heights = cloud.plan.heights
        self._voters: Voters | None = None
        self._grid = grid
        self._voting = voting
        self._least_votes = VOTE_CAUTION * voting.least_points
        self._points_per_vote = cloud.sample.n_represented if voting.is_raw else 1.0
        n_angles = round(180.0 / voting.angle_step_deg)
        self._angles_rad = np.arange(n_angles, dtype=np.float64) * (math.pi / n_angles)
        half_m = 0.5 * grid.cell_m * math.hypot(grid.shape[0], grid.shape[1])
        self._reach_bins = math.ceil(half_m / grid.cell_m) + 1
        # Half an angle step off, a wall's ends lie in other bins than its middle.
        self._smear_bins = max(1, round(0.3 * half_m * math.pi / n_angles / grid.cell_m))
        self._barred = np.zeros((n_angles, 2 * self._reach_bins), dtype=bool)
        self._barred_heights = np.zeros(grid.shape[2], dtype=bool)
        self._counted_for = -1
        self._votes = np.zeros((n_angles, 2 * self._reach_bins), dtype=np.int64)
        self._scores = np.zeros((0, 0))
        self._last = (-1, -1)
        self.first: Accumulator | None = None

    def propose(self, unassigned: Unassigned) -> Candidate | None:
        """Name the better of the best line and the best height."""
        self._count(unassigned)
        line_score, angle, place = -math.inf, -1, -1
        if self._voting.walls:
            scores = np.where(self._barred, -np.inf, self._scores)
            best = np.unravel_index(int(np.argmax(scores)), scores.shape)
            angle, place = int(best[0]), int(best[1])
            line_score = float(scores[angle, place])
        height_score, storey = -math.inf, -1
        if self._voting.levels:
            heights = contrast(self._heights[None, :], 1)[0]
            heights = np.where(self._barred_heights, -np.inf, heights)
            storey = int(np.argmax(heights))
            height_score = float(heights[storey])
        if max(line_score, height_score) < self._least_votes:
            return None
        if height_score > line_score:
            self._last = (-1, storey)
            return self._level(storey, height_score)
        self._last = (angle, place)
        return self._wall(angle, place, line_score)

    def reject(self, candidate: Candidate) -> None:
        """Bar the surroundings of the last maximum."""
        angle, place = self._last
        reach = self._smear_bins + 1
        if angle < 0:
            self._barred_heights[max(0, place - 2) : place + 3] = True
            return
        n_angles, n_bins = self._barred.shape
        for step in range(-_NOT_AGAIN_ANGLES, _NOT_AGAIN_ANGLES + 1):
            # A line at 180 degrees is the line at 0 with its distance counted the other way.
            wrapped = not 0 <= angle + step < n_angles
            centre = n_bins - 1 - place if wrapped else place
            row = self._barred[(angle + step) % n_angles]
            row[max(0, centre - reach) : centre + reach + 1] = True

    def _count(self, unassigned: Unassigned) -> None:
        """See what is left, and let it vote, unless nothing was taken since the last time."""
        if self._counted_for == unassigned.n_points:
            return
        self._counted_for = unassigned.n_points
        before = self._cells
        if unassigned.n_points == len(unassigned.claims):
            self._cells, self._heights = self._plan.cells, self._plan.heights
        else:
            self._heights = self._residuals.heights(unassigned.claims)
            self._cells = self._residuals.cells(unassigned.claims)
        self._voters = None
        if not self._voting.walls:
            return
        if self._voting.is_raw:
            self._vote_raw(unassigned)
        elif self._voting.accumulator == "counts":
            # Votes are sums: what was taken away takes its votes back.
            self._add(self._cells - before)
        else:
            self._votes = np.zeros(self._votes.shape, dtype=np.int64)
            self._add(vote_counts(self._cells, self._voting.accumulator))
        if self.first is None:
            self.first = Accumulator(
                angles_rad=self._angles_rad,
                low_m=-self._reach_bins * self._grid.cell_m,
                centre_m=plan_centre_m(self._grid),
                votes=np.rint(self._votes / VOTE_SHARES * self._points_per_vote).astype(np.int64),
            )
        contrasts = contrast(self._votes, self._smear_bins) / VOTE_SHARES
        self._scores = contrasts * self._points_per_vote

    @cached_property
    def _residuals(self) -> ResidualCounts:
        """What planes leave over; who looks for one plane only never asks."""
        return ResidualCounts(self._plan, self._grid, self._cloud.sample)

    def _add(self, votes: NDArray[np.int64]) -> None:
        """Let the cells of the plan (e1, e2) vote for all lines through them."""
        image = votes.astype(np.int32)
        in_threads([partial(vote_image, image, angles, table) for angles, table in self._shares()])

    def _vote_raw(self, unassigned: Unassigned) -> None:
        """Let every free point of the sample vote for all lines through it."""
        bin_m = self._grid.cell_m
        low_m = -self._reach_bins * bin_m
        plan = np.column_stack([self._grid.basis[:2], plan_centre_m(self._grid)])
        points = unassigned.free().points
        self._votes = np.zeros(self._votes.shape, dtype=np.int64)
        in_threads(
            [
                partial(vote_points, points, plan, angles, low_m, bin_m, table)
                for angles, table in self._shares()
            ]
        )
        self._votes *= VOTE_SHARES

    def _shares(self) -> list[tuple[NDArray[np.float64], NDArray[np.int64]]]:
        """Angles and their rows of the votes, one share per thread."""
        parts = self._cloud.parts
        return list(
            zip(
                np.array_split(self._angles_rad, parts),
                np.array_split(self._votes, parts),
                strict=True,
            )
        )

    def _wall(self, angle: int, place: int, score: float) -> Candidate:
        """Look around a maximum with finer angles and half-cell bins."""
        cells = self._voters
        if cells is None:
            cells = voters(self._grid, vote_counts(self._cells, self._voting.accumulator))
            self._voters = cells
        places_m = cells.places_m
        bin_m = self._grid.cell_m
        distance_m = (place + 0.5 - self._reach_bins) * bin_m
        step = math.pi / len(self._angles_rad)
        reach_m = (self._smear_bins + 3) * bin_m
        fine_step = max(step / 40.0, 0.5 / self._reach_bins)
        n_fine = max(1, math.ceil(step / fine_step))
        angles = self._angles_rad[angle] + np.arange(-n_fine, n_fine + 1) * (step / n_fine)
        fine = np.zeros((len(angles), 4 * (self._smear_bins + 3)), dtype=np.int64)
        # A point moves by up to half the plan times a step; cells further off cannot matter.
        direction = np.array([math.cos(self._angles_rad[angle]), math.sin(self._angles_rad[angle])])
        near_m = reach_m + step * self._reach_bins * bin_m
        near = np.abs(places_m @ direction - distance_m) < near_m
        low_m = distance_m - reach_m
        vote_lines(places_m[near], cells.votes[near], angles, low_m, 0.5 * bin_m, fine)
        scores = contrast(fine, 1)
        best, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
        shift = parabola(scores[best], int(column))
        normal_plan = np.array([math.cos(angles[best]), math.sin(angles[best])])
        offset_m = (
            low_m + (column + 0.5 + shift) * 0.5 * bin_m + float(normal_plan @ cells.centre_m)
        )
        normal = normal_plan @ self._grid.basis[:2]
        return Candidate(
            plane=Plane(normal=normal / np.linalg.norm(normal), offset_m=offset_m),
            family="wall",
            votes=score,
        )

    def _level(self, storey: int, score: float) -> Candidate:
        height_m = self._grid.low_m[2] + (storey + 0.5) * self._grid.cell_m
        up = self._grid.basis[2]
        plane = Plane(normal=up / np.linalg.norm(up), offset_m=float(height_m))
        return Candidate(plane=plane, family="level", votes=score)


class ResidualCounts:
    """The points of a cloud per plan cell and storey that no plane of the sample has taken."""

    def __init__(self, plan: PlanCounts, grid: PlanGrid, sample: Sample) -> None:
        """See in which cell and storey each point of the sample lies.

        Args:
            plan: counts of all points.
            grid: where the cells lie.
            sample: the sample of the cloud.
        """
        self._plan = plan
        framed = sample.offsets_m @ grid.basis.T - grid.low_m
        places = np.floor(framed / grid.cell_m)
        shape = np.array(grid.shape)
        inside = (places >= 0) & (places < shape)
        over = inside[:, 0] & inside[:, 1]
        within = over & inside[:, 2]
        places = np.where(over[:, None], places, 0.0).astype(np.int64)
        n_cells = grid.shape[0] * grid.shape[1]
        # The last place is for points outside.
        self._cell = np.where(over, places[:, 0] * grid.shape[1] + places[:, 1], n_cells)
        self._storey = np.where(within, places[:, 2], grid.shape[2])
        # A sample has too few points per cell to ask one alone.
        self._asks_around = sample.n_represented > 1.0
        self._cells_asked = self._counted(self._cell, plan.cells.shape)
        self._heights_asked = self._counted(self._storey, plan.heights.shape)

    def cells(self, claims: NDArray[np.int8]) -> NDArray[np.int64]:
        """(e1, e2) points left per plan cell, given the claims of the sample."""
        return self._left(self._plan.cells, self._cell, self._cells_asked, claims)

    def heights(self, claims: NDArray[np.int8]) -> NDArray[np.int64]:
        """(storeys,) points left per storey, given the claims of the sample."""
        return self._left(self._plan.heights, self._storey, self._heights_asked, claims)

    def _counted(self, place: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.int64]:
        counts = np.bincount(place, minlength=math.prod(shape) + 1)[:-1].reshape(shape)
        return summed_around(counts) if self._asks_around else counts

    def _left(
        self,
        counts: NDArray[np.int64],
        place: NDArray[np.int64],
        asked: NDArray[np.int64],
        claims: NDArray[np.int8],
    ) -> NDArray[np.int64]:
        left = asked - self._counted(place[claims >= 0], counts.shape)
        share = np.divide(left, asked, out=np.ones(counts.shape), where=asked > 0)
        remaining: NDArray[np.int64] = np.rint(counts * share).astype(np.int64)
        return remaining


@dataclass(frozen=True, kw_only=True)
class Voters:
    """The cells of a plan that vote.

    Attributes:
        places_m: (m, 2) float32 centres in the (e1, e2) frame, relative to `centre_m`.
        votes: (m,) int64 votes of each.
        centre_m: (2,) centre of the plan in that frame of the cloud's offsets.
    """

    places_m: NDArray[np.float32]
    votes: NDArray[np.int64]
    centre_m: NDArray[np.float64]


def plan_centre_m(grid: PlanGrid) -> NDArray[np.float64]:
    """(2,) centre of the plan in the (e1, e2) frame of the cloud's offsets."""
    return grid.low_m[:2] + 0.5 * grid.cell_m * np.array(grid.shape[:2])


def vote_counts(counts: NDArray[np.int64], accumulation: Accumulation) -> NDArray[np.int64]:
    """(e1, e2) votes of each cell of a plan.

    With one vote per cell, votes are multiplied by the points of a mean voter, so that they compare
    with the heights, which are counted in points.

    Args:
        counts: (e1, e2) points per cell.
        accumulation: how loud a cell is.
    """
    if accumulation == "counts":
        return counts
    chosen = _edges(counts) if accumulation == "canny" else counts != 0
    mean = float(counts[chosen].mean()) if chosen.any() else 1.0
    return chosen * np.int64(max(1, round(mean)))


def voters(grid: PlanGrid, votes: NDArray[np.int64]) -> Voters:
    """List the cells (e1, e2) that have votes."""
    first, second = np.nonzero(votes)
    places = np.column_stack(
        [
            (first + 0.5 - 0.5 * grid.shape[0]) * grid.cell_m,
            (second + 0.5 - 0.5 * grid.shape[1]) * grid.cell_m,
        ]
    ).astype(np.float32)
    return Voters(places_m=places, votes=votes[first, second], centre_m=plan_centre_m(grid))


def _edges(counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Occupied cells on edges of the density image, whose grey is the logarithm of the points."""
    import cv2

    grey = np.log1p(np.maximum(counts, 0))
    scaled = np.rint(255.0 * grey / max(float(grey.max()), 1e-9)).astype(np.uint8)
    return (cv2.Canny(scaled, _EDGE_LOW, _EDGE_HIGH) > 0) & (counts > 0)


def contrast(votes: NDArray[np.int64], half: int) -> NDArray[np.float64]:
    """Votes in a window of 2 half + 1 bins above those of the emptier neighbouring window."""
    width = 2 * half + 1
    gap = width + 1
    padded = np.pad(votes, ((0, 0), (half + gap + 1, half + gap)))
    running = np.cumsum(padded, axis=1)
    window = (running[:, width:] - running[:, :-width]).astype(np.float64)
    n_bins = votes.shape[1]
    middle = window[:, gap : gap + n_bins]
    left, right = window[:, :n_bins], window[:, 2 * gap : 2 * gap + n_bins]
    return middle - np.minimum(left, right)


def parabola(values: NDArray[np.float64], place: int) -> float:
    """Say where between bins a maximum lies, -0.5..0.5."""
    if not 0 < place < len(values) - 1:
        return 0.0
    before, here, after = values[place - 1 : place + 2]
    bend = before - 2.0 * here + after
    return 0.0 if bend >= 0.0 else float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))
