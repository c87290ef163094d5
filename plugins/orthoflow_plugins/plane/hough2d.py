"""`plane.hough2d`: walls from the plan of the cloud, floors and ceilings from its heights.

The plan (a map of the cloud, 2 cm cells) votes for lines; a cell has as many votes as points, since
with one vote per cell floors and ceilings drown every wall (markiewicz2015, Figure 10). From each
maximum the level of its surroundings at the same angle is subtracted: that level is what surfaces
cut across leave, and with it goes the advantage of the longest diagonal through the room.

To count all points anew after each plane would cost a pass over the cloud. The sample knows which
share of a cell's points a plane took; where it is all of the cloud, it knows that exactly.
"""

from __future__ import annotations

import math
from functools import cached_property, partial
from typing import TYPE_CHECKING, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from orthoflow.geometry import Plane
from orthoflow.geometry.threads import in_threads
from orthoflow.sdk import Method, StepContext
from orthoflow_plugins.plane.detector import (
    DETECTOR_METRICS,
    PAPER,
    Candidate,
    DetectorIn,
    DetectorOut,
    DetectorParams,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.cloud import Search

# Angles on either side of a candidate that was none that are not proposed again.
_NOT_AGAIN_ANGLES: Final = 2
# Thresholds of the edge detector on the density image of 8 bits.
_EDGE_LOW: Final = 60
_EDGE_HIGH: Final = 160
_VOTERS: Final = {
    "counts": "each cell votes with its number of points",
    "unit": "each cell with points has one vote",
    "canny": "each cell on an edge of the density has one vote",
    "raw": "each point of the sample votes with its own coordinates",
}


class Hough2d(Method):
    """Find walls, floors and ceilings by markiewicz2015's modified 2D Hough transform.

    Points are counted in the cells of a plan; every occupied cell votes, with as many votes as it
    has points, for all lines through it. The best line is refined on a sample of the points, with a
    tolerance that shrinks from `tolerance_m` to `fit_tolerance_m`, given a rectangle, and its
    points are taken away: the sample says which share of each cell those are. When all planes are
    found, one pass over all points, of more than 24 million over a part drawn evenly, fits them
    (total least squares of cell means), one labels all points.

    Floors, ceilings and other level planes come from the histogram of heights in the same race and
    are refitted in 3D.

    The covariance of (normal, offset) respects that neighbouring points share errors; it is
    estimated from the scatter of tiles between 10 and 80 cm, the size with the largest variance.

    For comparison: `accumulator: unit` gives every occupied cell one vote (no clear maximum, as the
    paper says), `canny` only the cells on edges of the density image; `coordinates: raw` lets the
    points of the sample vote with their own coordinates, which takes longer for the same planes.
    `scoring: votes` proposes the plain maximum of the paper's own transform.
    """

    id = "plane.hough2d"
    determinism = "exact"
    metrics = DETECTOR_METRICS
    citations = (PAPER,)

    class Params(DetectorParams):
        """What may be set; the defaults suit rooms and facades scanned at millimetres."""

        cell_m: float = Field(
            0.02, gt=0.0, le=1.0, description="Side of a cell of the plan and of a distance bin."
        )
        angle_step_deg: float = Field(
            1.0, ge=0.1, le=15.0, description="Step between the directions that are voted for."
        )
        accumulator: Literal["counts", "unit", "canny"] = Field(
            "counts",
            description="Votes of a cell: its points, one, or one where the density has an edge.",
        )
        scoring: Literal["contrast", "votes"] = Field(
            "contrast",
            description="What a line is worth: its votes above those of the emptier side, refined "
            "with finer angles and bins, or the votes of its bin alone, as in markiewicz2015.",
        )
        coordinates: Literal["cells", "raw"] = Field(
            "cells",
            description="What votes: cells of the plan, or points of the sample by themselves.",
        )

        @model_validator(mode="after")
        def _points_have_one_vote(self) -> Self:
            if self.coordinates == "raw" and self.accumulator != "counts":
                raise ValueError(
                    f"coordinates: raw goes with accumulator: counts only, got {self.accumulator}"
                )
            return self

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.figures import draw_accumulator
        from orthoflow_plugins.plane.search import detect

        cloud = inputs.cloud
        proposer_of = partial(PlanProposer, params=params)
        detection = detect(
            cloud, params, ctx, proposer_of, method=self.id, plan_cell_m=params.cell_m
        )
        draw_accumulator(ctx, detection.proposer, detection.out.planes, cloud)
        return detection.out


class PlanProposer:
    """Proposes walls from the maxima of the accumulator and levels from those of the heights.

    Attributes:
        grid: where the cells of the plan lie.
        plan: (e1, e2) points per cell, and (storeys,) per height, of the untouched cloud.
        centre_m: (2,) centre of the plan in the (e1, e2) frame of the cloud's offsets.
        reach_m: distances of lines from there run from minus this to this.
        first: (angles, bins) votes of the untouched cloud, in points; None for levels alone.
        voters: who voted, to finish a sentence.
    """

    def __init__(self, search: Search, params: Hough2d.Params) -> None:
        """Get ready to propose; the points of the search's cloud were counted over its plan."""
        cloud = search.cloud
        if cloud.plan is None:
            raise ValueError("the points of the cloud were not counted over its plan")
        self._cloud, self._params = cloud, params
        self._votes_walls = params.constraint != "horizontal"
        self._is_raw = params.coordinates == "raw"
        self.voters = _VOTERS["raw" if self._is_raw else params.accumulator]
        self.grid, self.plan = cloud.grid, cloud.plan
        rows, columns, storeys = self.grid.shape
        self._cell_m = self.grid.cell_m
        self.centre_m = self.grid.low_m[:2] + 0.5 * self._cell_m * np.array([rows, columns])
        self._least_points = params.min_share * len(cloud.claims)
        self._points_per_vote = cloud.sample.n_represented if self._is_raw else 1.0
        n_angles = round(180.0 / params.angle_step_deg)
        self._angles_rad = np.arange(n_angles, dtype=np.float64) * (math.pi / n_angles)
        half_m = 0.5 * self._cell_m * math.hypot(rows, columns)
        self._reach_bins = math.ceil(half_m / self._cell_m) + 1
        self.reach_m = self._reach_bins * self._cell_m
        # Half an angle step off, a wall's ends lie in other bins than its middle.
        self._smear_bins = max(1, round(0.3 * half_m * math.pi / n_angles / self._cell_m))
        self._barred = np.zeros((n_angles, 2 * self._reach_bins), dtype=bool)
        self._barred_heights = np.zeros(storeys, dtype=bool)
        self._counted_for = -1
        self._cells = np.zeros((rows, columns), dtype=np.int64)
        self._heights = cloud.plan.heights
        self._votes = np.zeros(self._barred.shape, dtype=np.int64)
        self._scores = np.zeros((0, 0))
        self._last = (-1, -1)
        self.first: NDArray[np.int64] | None = None

    def propose(self, search: Search) -> Candidate | None:
        """Name the better of the best line and the best height."""
        from orthoflow_plugins.plane.vote_kernels import VOTE_CAUTION

        if self._counted_for != search.n_points:
            self._count(search)
            self._counted_for = search.n_points
        line_score, angle, place = -math.inf, -1, -1
        if self._votes_walls:
            scores = np.where(self._barred, -np.inf, self._scores)
            best = np.unravel_index(int(np.argmax(scores)), scores.shape)
            angle, place = int(best[0]), int(best[1])
            line_score = float(scores[angle, place])
        height_score, storey = -math.inf, -1
        if self._params.constraint != "vertical":
            heights = self._scored(self._heights[None, :], 1)[0]
            heights = np.where(self._barred_heights, -np.inf, heights)
            storey = int(np.argmax(heights))
            height_score = float(heights[storey])
        if max(line_score, height_score) < VOTE_CAUTION * self._least_points:
            return None
        if height_score > line_score:
            self._last = (-1, storey)
            height_m = float(self.grid.low_m[2] + (storey + 0.5) * self._cell_m)
            return _candidate(self.grid.basis[2], height_m, "horizontal", height_score)
        self._last = (angle, place)
        return self._wall(angle, place, line_score)

    def reject(self, candidate: Candidate) -> None:
        """Bar the surroundings of the last maximum."""
        del candidate
        angle, place = self._last
        if angle < 0:
            self._barred_heights[max(0, place - 2) : place + 3] = True
            return
        reach = self._smear_bins + 1
        n_angles, n_bins = self._barred.shape
        for step in range(-_NOT_AGAIN_ANGLES, _NOT_AGAIN_ANGLES + 1):
            # A line at 180 degrees is the line at 0 with its distance counted the other way.
            wrapped = not 0 <= angle + step < n_angles
            centre = n_bins - 1 - place if wrapped else place
            row = self._barred[(angle + step) % n_angles]
            row[max(0, centre - reach) : centre + reach + 1] = True

    def _scored(self, votes: NDArray[np.int64], half: int) -> NDArray[np.float64]:
        """What the bins of (rows, bins) votes are worth, in windows of 2 half + 1 bins."""
        from orthoflow_plugins.plane.vote_kernels import contrast

        is_plain = self._params.scoring == "votes"
        return votes.astype(np.float64) if is_plain else contrast(votes, half)

    def _count(self, search: Search) -> None:
        """See what is left, and let it vote."""
        from orthoflow_plugins.plane.vote_kernels import VOTE_SHARES

        before, accumulator = self._cells, self._params.accumulator
        if search.n_points == len(search.claims):
            self._cells, self._heights = self.plan.cells, self.plan.heights
        else:
            cells, heights = self._residuals
            self._heights = heights.left(search.claims)
            self._cells = cells.left(search.claims)
        self.__dict__.pop("_voting_cells", None)
        if not self._votes_walls:
            return
        if self._is_raw:
            self._vote_raw(search)
        elif accumulator == "counts":
            # Votes are sums: what was taken away takes its votes back.
            self._vote(self._cells - before)
        else:
            self._votes = np.zeros(self._votes.shape, dtype=np.int64)
            self._vote(vote_counts(self._cells, accumulator))
        if self.first is None:
            points = self._votes / VOTE_SHARES * self._points_per_vote
            self.first = np.rint(points).astype(np.int64)
        scores = self._scored(self._votes, self._smear_bins) / VOTE_SHARES
        self._scores = scores * self._points_per_vote

    @cached_property
    def _residuals(self) -> tuple[_Residual, _Residual]:
        """What planes leave over of cells and of storeys; who looks for one only never asks."""
        sample = self._cloud.sample
        framed = sample.offsets_m @ self.grid.basis.T - self.grid.low_m
        places = np.floor(framed / self._cell_m)
        inside = (places >= 0) & (places < np.array(self.grid.shape))
        over = inside[:, 0] & inside[:, 1]
        places = np.where(over[:, None], places, 0.0).astype(np.int64)
        rows, columns, storeys = self.grid.shape
        # The last place is for points outside.
        cell = np.where(over, places[:, 0] * columns + places[:, 1], rows * columns)
        storey = np.where(over & inside[:, 2], places[:, 2], storeys)
        # A sample has too few points per cell to ask one alone.
        asks_around = sample.n_represented > 1.0
        return (
            _Residual(self.plan.cells, cell, asks_around=asks_around),
            _Residual(self.plan.heights, storey, asks_around=asks_around),
        )

    @cached_property
    def _voting_cells(self) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """(m, 2) centres of the cells that vote, from the plan's centre, and (m,) their votes."""
        votes = vote_counts(self._cells, self._params.accumulator)
        cells = np.column_stack(np.nonzero(votes))
        places_m = (cells + 0.5 - 0.5 * np.array(votes.shape)) * self._cell_m
        return places_m.astype(np.float32), votes[cells[:, 0], cells[:, 1]]

    def _vote(self, votes: NDArray[np.int64]) -> None:
        """Let the cells of the plan (e1, e2) vote for all lines through them."""
        from orthoflow_plugins.plane.vote_kernels import vote_image

        image = votes.astype(np.int32)
        in_threads([partial(vote_image, image, angles, table) for angles, table in self._shares()])

    def _vote_raw(self, search: Search) -> None:
        """Let every free point of the sample vote for all lines through it."""
        from orthoflow_plugins.plane.vote_kernels import VOTE_SHARES, vote_points

        plan, points = np.column_stack([self.grid.basis[:2], self.centre_m]), search.free().points
        self._votes = np.zeros(self._votes.shape, dtype=np.int64)
        low_m, bin_m = -self.reach_m, self._cell_m
        in_threads(
            [
                partial(vote_points, points, plan, angles, low_m, bin_m, table)
                for angles, table in self._shares()
            ]
        )
        self._votes *= VOTE_SHARES

    def _shares(self) -> zip[tuple[NDArray[np.float64], NDArray[np.int64]]]:
        """Angles and their rows of the votes, one share per thread."""
        parts = self._cloud.parts
        angles = np.array_split(self._angles_rad, parts)
        return zip(angles, np.array_split(self._votes, parts), strict=True)

    def _wall(self, angle: int, place: int, score: float) -> Candidate:
        """Look around a maximum with finer angles and half-cell bins."""
        from orthoflow_plugins.plane.vote_kernels import contrast, parabola, vote_lines

        bin_m = self._cell_m
        distance_m = (place + 0.5 - self._reach_bins) * bin_m
        if self._params.scoring == "votes":
            return self._upright(self._angles_rad[angle], distance_m, score)
        places_m, votes = self._voting_cells
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
        vote_lines(places_m[near], votes[near], angles, low_m, 0.5 * bin_m, fine)
        scores = contrast(fine, 1)
        best, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
        shift = parabola(scores[best], int(column))
        return self._upright(angles[best], low_m + (column + 0.5 + shift) * 0.5 * bin_m, score)

    def _upright(self, angle_rad: float, distance_m: float, score: float) -> Candidate:
        """The wall over a line of the plan, at a distance from the plan's centre."""
        direction = np.array([math.cos(angle_rad), math.sin(angle_rad)])
        offset_m = distance_m + float(direction @ self.centre_m)
        return _candidate(direction @ self.grid.basis[:2], offset_m, "vertical", score)


class _Residual:
    """The points of a cloud per cell, or per storey, that no plane of the sample has taken."""

    def __init__(
        self, counts: NDArray[np.int64], place: NDArray[np.int64], *, asks_around: bool
    ) -> None:
        self._counts, self._place, self._asks_around = counts, place, asks_around
        self._asked = self._sampled(np.ones(len(place), dtype=bool))

    def left(self, claims: NDArray[np.int8]) -> NDArray[np.int64]:
        """Points that are left, given the (m,) claims of the sample."""
        left = self._asked - self._sampled(claims >= 0)
        ones = np.ones(self._counts.shape)
        share = np.divide(left, self._asked, out=ones, where=self._asked > 0)
        return np.asarray(np.rint(self._counts * share).astype(np.int64))

    def _sampled(self, chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
        from orthoflow_plugins.plane.support import summed_around

        counts = np.bincount(self._place[chosen], minlength=self._counts.size + 1)
        counts = counts[:-1].reshape(self._counts.shape)
        return summed_around(counts) if self._asks_around else counts


def _candidate(
    normal: NDArray[np.float64],
    offset_m: float,
    constraint: Literal["vertical", "horizontal"],
    votes: float,
) -> Candidate:
    plane = Plane(normal=normal / np.linalg.norm(normal), offset_m=offset_m)
    return Candidate(plane=plane, constraint=constraint, votes=votes)


def vote_counts(
    counts: NDArray[np.int64], accumulator: Literal["counts", "unit", "canny"]
) -> NDArray[np.int64]:
    """(e1, e2) votes of each cell of a plan, given (e1, e2) its points.

    With one vote per cell, votes are multiplied by the points of a mean voter, so that they compare
    with the heights, which are counted in points.
    """
    if accumulator == "counts":
        return counts
    chosen = _edges(counts) if accumulator == "canny" else counts != 0
    mean = float(counts[chosen].mean()) if chosen.any() else 1.0
    return chosen * np.int64(max(1, round(mean)))


def _edges(counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Occupied cells on edges of the density image, whose grey is the logarithm of the points."""
    import cv2

    grey = np.log1p(np.maximum(counts, 0))
    scaled = np.rint(255.0 * grey / max(float(grey.max()), 1e-9)).astype(np.uint8)
    return (cv2.Canny(scaled, _EDGE_LOW, _EDGE_HIGH) > 0) & (counts > 0)
