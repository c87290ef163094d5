"""The modified 2D Hough transform of markiewicz2015, and the histogram along up beside it.

The plan (a map of the cloud, 2 cm cells) votes for lines; a cell has as many votes as points, since
with one vote per cell floors and ceilings drown every wall (their Figure 10). From each maximum the
level of its surroundings at the same angle is subtracted: that level is what surfaces cut across
leave, and with it goes the advantage of the longest diagonal through the room.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.plane_kernels import vote_lines, vote_points
from orthoflow.geometry.shear_kernels import VOTE_SHARES, vote_image
from orthoflow.geometry.threads import in_threads
from orthoflow_plugins.plane.candidates import Candidate
from orthoflow_plugins.plane.leftovers import PlanLeftovers
from orthoflow_plugins.plane.remainders import Remainder
from orthoflow_plugins.plane.voters import (
    Accumulation,
    Voters,
    plan_centre_m,
    vote_counts,
    voters,
)

# A candidate's votes may fall short of the share a plane needs by this much: it may be smeared over
# several bins until it is refined.
_VOTE_CAUTION: Final = 0.25
_NOT_AGAIN_ANGLES: Final = 2


@dataclass(frozen=True, kw_only=True)
class Accumulator:
    """Parameter space of the lines in a plan.

    Attributes:
        angles_rad: (a,) direction of the lines' normals in the (e1, e2) frame, 0 to pi.
        low_m: lower edge of the first bin, as a distance from `centre_m`.
        bin_m: width of a bin.
        centre_m: (2,) centre of the plan in the (e1, e2) frame of the cloud's offsets.
        votes: (a, bins) points that speak for each line.
    """

    angles_rad: NDArray[np.float64]
    low_m: float
    bin_m: float
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
        is_raw: every point votes with its own coordinates instead of its cell.
    """

    angle_step_deg: float
    least_points: float
    walls: bool = True
    levels: bool = True
    accumulator: Accumulation = "counts"
    is_raw: bool = False


class PlanProposer:
    """Proposes walls from the maxima of the accumulator and levels from those of the heights.

    Attributes:
        first: the accumulator of the untouched cloud.
    """

    def __init__(self, whole: Remainder, voting: Voting) -> None:
        """Get ready to propose.

        Args:
            whole: the cloud, counted over its plan.
            voting: how it votes.

        Raises:
            ValueError: the points were not counted over the plan.
        """
        grid = whole.grid
        if whole.plan is None:
            raise ValueError("the points of the cloud were not counted over its plan")
        self._whole = whole
        self._plan = whole.plan
        self._cells = np.zeros(grid.shape[:2], dtype=np.int64)
        self._heights = whole.plan.heights
        self._voters: Voters | None = None
        self._grid = grid
        self._voting = voting
        self._least_votes = _VOTE_CAUTION * voting.least_points
        n_angles = max(4, round(180.0 / voting.angle_step_deg))
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

    def propose(self, remainder: Remainder) -> Candidate | None:
        """Name the better of the best line and the best height."""
        self._count(remainder)
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

    def _count(self, remainder: Remainder) -> None:
        """See what is left, and let it vote, unless nothing was taken since the last time."""
        if self._counted_for == remainder.n_unclaimed:
            return
        self._counted_for = remainder.n_unclaimed
        before = self._cells
        if remainder.n_unclaimed == len(remainder.claims):
            self._cells, self._heights = self._plan.cells, self._plan.heights
        else:
            claims = remainder.sample_claims
            self._heights = self._leftovers.heights(claims)
            self._cells = self._leftovers.cells(claims)
        self._voters = None
        if not self._voting.walls:
            return
        if self._voting.is_raw:
            self._whole.catch_up(remainder)
            self._vote_raw()
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
                bin_m=self._grid.cell_m,
                centre_m=plan_centre_m(self._grid),
                votes=np.rint(self._votes / VOTE_SHARES).astype(np.int64),
            )
        self._scores = contrast(self._votes, self._smear_bins) / VOTE_SHARES

    @cached_property
    def _leftovers(self) -> PlanLeftovers:
        """What planes leave over; who looks for one plane only never asks."""
        return PlanLeftovers(self._plan, self._grid, self._whole)

    def _add(self, votes: NDArray[np.int64]) -> None:
        """Let the cells of the plan (e1, e2) vote for all lines through them."""
        image = votes.astype(np.int32)
        in_threads([partial(vote_image, image, angles, table) for angles, table in self._shares()])

    def _vote_raw(self) -> None:
        """Let every unclaimed point of the cloud vote for all lines through it."""
        bin_m = self._grid.cell_m
        low_m = -self._reach_bins * bin_m
        plan = np.column_stack([self._grid.basis[:2], plan_centre_m(self._grid)])
        points, claims = self._whole.points, self._whole.claims
        self._votes = np.zeros(self._votes.shape, dtype=np.int64)
        in_threads(
            [
                partial(vote_points, points, claims, plan, angles, low_m, bin_m, table)
                for angles, table in self._shares()
            ]
        )
        self._votes *= VOTE_SHARES

    def _shares(self) -> list[tuple[NDArray[np.float64], NDArray[np.int64]]]:
        """Angles and their rows of the votes, one share per thread."""
        parts = self._whole.parts
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
            support=score,
        )

    def _level(self, storey: int, score: float) -> Candidate:
        height_m = self._grid.low_m[2] + (storey + 0.5) * self._grid.cell_m
        up = self._grid.basis[2]
        plane = Plane(normal=up / np.linalg.norm(up), offset_m=float(height_m))
        return Candidate(plane=plane, family="level", support=score)


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
    contrast: NDArray[np.float64] = middle - np.minimum(left, right)
    return contrast


def parabola(values: NDArray[np.float64], place: int) -> float:
    """Say where between bins a maximum lies, -0.5..0.5."""
    if not 0 < place < len(values) - 1:
        return 0.0
    before, here, after = values[place - 1 : place + 2]
    bend = before - 2.0 * here + after
    return 0.0 if bend >= 0.0 else float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))
