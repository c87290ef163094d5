"""`plane.hough2d`: walls from the plan of a cloud, floors and ceilings from its heights.

The cells of the plan (a map of the cloud, 2 cm cells) vote for lines. The number of points in a
cell is its number of votes, because with one vote per cell, floors and ceilings hide all walls
(markiewicz2015, Figure 10). From each maximum, the level of its surroundings at the same angle is
subtracted. This level is due to surfaces that the line crosses, and would favour the longest
diagonal of the room.

Recounting all points after each plane would need a pass over the cloud. Instead, the share of a
cell's points that belong to a plane is estimated from the sample. For a small cloud, the sample is
the whole cloud.
"""

from __future__ import annotations

import math
from collections.abc import Callable
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
    from orthoflow_plugins.plane.search import Search

# Number of angles excluded on each side of a rejected candidate.
_NOT_AGAIN_ANGLES: Final = 2
# Thresholds of the edge detector for the 8-bit density image.
_EDGE_LOW: Final = 60
_EDGE_HIGH: Final = 160


class Hough2d(Method):
    """Find walls, floors and ceilings by markiewicz2015's modified 2D Hough transform.

    Points are counted in the cells of a plan. Every occupied cell votes for all lines through it,
    with as many votes as it has points. The best line is refined on a sample of the points with a
    tolerance that decreases from `tolerance_m` to `fit_tolerance_m`. It is bounded by a rectangle
    and its points are removed; their share of each cell is estimated from the sample. When all
    planes are found, they are fitted to all points in one pass (total least squares of cell means;
    for clouds above 24 million points, a random sample is used); a second pass labels all points.

    Floors, ceilings and other horizontal planes are found in the histogram of heights. They compete
    with walls by number of votes and are refitted in 3D.

    The covariance of (normal, offset) accounts for errors common to neighbouring points. It is
    estimated from the scatter of tiles of 10 to 80 cm; the size with the largest variance is used.

    For comparison, `accumulator: unit` gives every occupied cell one vote (no clear maximum, as in
    the paper), and `canny` one to cells on edges of the density image. With `coordinates: raw`, the
    points of the sample vote with their coordinates, which takes longer and finds the same planes.
    `scoring: votes` proposes the maximum itself, as in the paper.
    """

    id = "plane.hough2d"
    result_version = 2
    determinism = "exact"
    metrics = DETECTOR_METRICS
    citations = (PAPER,)

    class Params(DetectorParams):
        """Parameters; the defaults suit rooms and facades scanned at millimetres."""

        cell_m: float = Field(
            0.02,
            gt=0.0,
            le=1.0,
            description="Size of the cells of the plan and of the distance bins.",
        )
        angle_step_deg: float = Field(
            1.0, ge=0.1, le=15.0, description="Angle between successive line directions."
        )
        accumulator: Literal["counts", "unit", "canny"] = Field(
            "counts",
            description="Votes of a cell. counts: its number of points; unit: one; canny: one if "
            "it is on an edge of the point density, otherwise none.",
        )
        scoring: Literal["contrast", "votes"] = Field(
            "contrast",
            description="Score of a line. contrast: its votes minus those on its emptier side, "
            "refined with finer angles and bins; votes: only the votes of its bin, as in "
            "markiewicz2015.",
        )
        coordinates: Literal["cells", "raw"] = Field(
            "cells",
            description="Positions that vote. cells: cells of the plan; raw: single points of "
            "the sample.",
        )

        @model_validator(mode="after")
        def _points_have_one_vote(self) -> Self:
            if self.coordinates == "raw" and self.accumulator != "counts":
                raise ValueError(
                    f"coordinates: raw needs accumulator: counts, got {self.accumulator}"
                )
            return self

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.figures import draw_accumulator
        from orthoflow_plugins.plane.search import detect

        cloud, proposer_of = inputs.cloud, partial(PlanProposer, params=params)
        out, proposer = detect(
            cloud, params, ctx, proposer_of, method=self.id, plan_cell_m=params.cell_m
        )
        draw_accumulator(ctx, proposer, out.planes, cloud)
        return out


class PlanProposer:
    """Proposes walls at maxima of the accumulator, horizontal planes at maxima of the heights.

    Attributes:
        grid: the plan and the height bins.
        plan: (e1, e2) number of points per cell, for the whole cloud.
        centre_m: (2,) centre of the plan in the (e1, e2) frame of the cloud's offsets.
        reach_m: maximum distance of lines from the centre, on each side.
        first: (angles, bins) votes of the whole cloud, VOTE_SHARES each; None if only
            horizontal planes are searched for.
    """

    def __init__(self, search: Search, params: Hough2d.Params) -> None:
        """Prepare the accumulator; the cloud of the search has a counted plan."""
        cloud = search.cloud
        self._cloud, self._params = cloud, params
        self._is_raw = params.coordinates == "raw"
        self._is_plain = params.scoring == "votes"
        self.grid, self.plan = cloud.grid, cloud.plan
        rows, columns, storeys = self.grid.shape
        self._cell_m = self.grid.cell_m
        self.centre_m = self.grid.low_m[:2] + 0.5 * self._cell_m * np.array([rows, columns])
        self._least_points = params.min_share * len(cloud.claims)
        self._points_per_vote = cloud.sample.n_represented if self._is_raw else 1.0
        n_angles = round(180.0 / params.angle_step_deg)
        self._step_rad = math.pi / n_angles
        self._angles_rad = np.arange(n_angles, dtype=np.float64) * self._step_rad
        half_m = 0.5 * self._cell_m * math.hypot(rows, columns)
        self._reach_bins = math.ceil(half_m / self._cell_m) + 1
        self.reach_m = self._reach_bins * self._cell_m
        # At half an angle step, the ends of a wall are in other bins than its centre.
        self._smear_bins = max(1, round(0.3 * half_m * self._step_rad / self._cell_m))
        self._barred = np.zeros((n_angles, 2 * self._reach_bins), dtype=np.uint8)
        self._barred_heights = np.zeros((1, storeys), dtype=np.uint8)
        self._votes = np.zeros(self._barred.shape, dtype=np.int32)
        self._cells, self._heights = np.zeros((rows, columns), dtype=np.int64), cloud.heights
        self._counted_for, self._last = -1, (-1, -1)
        self.first: NDArray[np.int32] | None = None

    def propose(self, search: Search) -> Candidate | None:
        """Return the best line or the best height, whichever has the higher score."""
        from orthoflow_plugins.plane.votes import VOTE_CAUTION, VOTE_SHARES, best_bin

        if self._counted_for != search.n_points:
            self._count(search)
            self._counted_for = search.n_points
        line_score, height_score = -math.inf, -math.inf
        if self._params.constraint != "horizontal":
            half = 0 if self._is_plain else self._smear_bins
            votes, angle, place = best_bin(self._votes, self._barred, half, is_plain=self._is_plain)
            line_score = votes / VOTE_SHARES * self._points_per_vote
        if self._params.constraint != "vertical":
            half, heights = 0 if self._is_plain else 1, self._heights.astype(np.int32)[None]
            height_score, _, storey = best_bin(
                heights, self._barred_heights, half, is_plain=self._is_plain
            )
        if max(line_score, height_score) < VOTE_CAUTION * self._least_points:
            return None
        if height_score > line_score:
            self._last = (-1, storey)
            height_m = float(self.grid.low_m[2] + (storey + 0.5) * self._cell_m)
            plane = Plane(normal=self.grid.basis[2], offset_m=height_m)
            return Candidate(plane=plane, constraint="horizontal")
        self._last = (angle, place)
        angle_rad, distance_m = self._angles_rad[angle], (place + 0.5) * self._cell_m - self.reach_m
        if not self._is_plain:
            angle_rad, distance_m = self._refined(angle_rad, distance_m)
        direction = np.array([math.cos(angle_rad), math.sin(angle_rad)])
        offset_m = distance_m + float(direction @ self.centre_m)
        normal = direction @ self.grid.basis[:2]
        plane = Plane(normal=normal / np.linalg.norm(normal), offset_m=offset_m)
        return Candidate(plane=plane, constraint="vertical")

    def reject(self, candidate: Candidate) -> None:
        """Exclude the surroundings of the last maximum."""
        del candidate
        angle, place = self._last
        if angle < 0:
            self._barred_heights[0, max(0, place - 2) : place + 3] = 1
            return
        reach = self._smear_bins + 1
        n_angles, n_bins = self._barred.shape
        for step in range(-_NOT_AGAIN_ANGLES, _NOT_AGAIN_ANGLES + 1):
            # A line at 180 degrees is the line at 0 with the opposite sign of its distance.
            wrapped = not 0 <= angle + step < n_angles
            centre = n_bins - 1 - place if wrapped else place
            row = self._barred[(angle + step) % n_angles]
            row[max(0, centre - reach) : centre + reach + 1] = 1

    def _count(self, search: Search) -> None:
        """Count the votes of the remaining points."""
        from orthoflow_plugins.plane.votes import VOTE_SHARES, vote_image, vote_places

        before, accumulator = self._cells, self._params.accumulator
        self.__dict__.pop("_voting_cells", None)
        self._cells = self._cloud.plan
        if search.n_points < len(search.claims):
            self._cells, self._heights = self._left(search.claims)
        if self._params.constraint == "horizontal":
            return
        if self._is_raw or accumulator != "counts":
            self._votes[:] = 0
        parts = self._cloud.parts
        shares = [np.array_split(table, parts) for table in (self._angles_rad, self._votes)]
        if self._is_raw:
            places = np.zeros((3, search.n_points), dtype=np.float32)
            places[:2] = self.grid.basis[:2] @ search.free()[0].T - self.centre_m[:, None]
            ones = np.full(search.n_points, VOTE_SHARES, dtype=np.int32)

            def vote(angles_rad: NDArray[np.float64], votes: NDArray[np.int32]) -> None:
                normals = _normals(angles_rad)
                vote_places(places, ones, normals, -self.reach_m, self._cell_m, votes)

        else:
            # Votes are additive, so those of removed points are subtracted.
            cells = vote_counts(self._cells, accumulator) - before * (accumulator == "counts")
            vote = partial(vote_image, cells.astype(np.int32))
        in_threads([partial(vote, *share) for share in zip(*shares, strict=True)])
        if self.first is None:
            self.first = self._votes.copy()

    @cached_property
    def _left(self) -> Callable[[NDArray[np.int16]], tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Return a function from sample claims (m,) to remaining points per cell and height."""
        from orthoflow_plugins.plane.support import summed_around

        sample, counts = self._cloud.sample, (self._cloud.plan, self._cloud.heights[None])
        places = (sample.offsets_m @ self.grid.basis.T - self.grid.low_m) / self._cell_m
        inside = (places >= 0) & (places < np.array(self.grid.shape))
        over = inside[:, 0] & inside[:, 1]
        rows, columns, storeys = np.where(over[:, None], places, 0.0).astype(np.int64).T
        # The last index is for points outside.
        cell = np.where(over, rows * self.grid.shape[1] + columns, counts[0].size)
        storey = np.where(over & inside[:, 2], storeys, counts[1].size)

        def sampled(chosen: NDArray[np.bool_], k: int) -> NDArray[np.int64]:
            found = np.bincount((cell, storey)[k][chosen], minlength=counts[k].size + 1)[:-1]
            found = found.reshape(counts[k].shape)
            # A sample has too few points per cell, so neighbouring cells are summed.
            return summed_around(found) if sample.n_represented > 1.0 else found

        asked = [sampled(np.ones(len(cell), dtype=bool), k) for k in range(2)]

        def left(claims: NDArray[np.int16]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
            free = [
                np.divide(
                    found - sampled(claims >= 0, k),
                    found,
                    out=np.ones(found.shape),
                    where=found > 0,
                )
                for k, found in enumerate(asked)
            ]
            cells, heights = (
                np.rint(own * share).astype(np.int64)
                for own, share in zip(counts, free, strict=True)
            )
            return cells, heights[0]

        return left

    @cached_property
    def _voting_cells(self) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Return centres (3, m) of voting cells relative to the plan's centre, and votes (m,)."""
        votes = vote_counts(self._cells, self._params.accumulator)
        cells = np.nonzero(votes)
        places = np.zeros((3, len(cells[0])), dtype=np.float32)
        for axis in range(2):
            places[axis] = (cells[axis] + 0.5 - 0.5 * votes.shape[axis]) * self._cell_m
        return places, votes[cells].astype(np.int32)

    def _refined(self, angle_rad: float, distance_m: float) -> tuple[float, float]:
        """Refine a maximum with finer angles and half-cell bins."""
        from orthoflow_plugins.plane.votes import sharpest, vote_places

        bin_m, step = self._cell_m, self._step_rad
        places, weights = self._voting_cells
        reach_m = (self._smear_bins + 3) * bin_m
        n_fine = max(1, math.ceil(step / max(step / 40.0, 0.5 / self._reach_bins)))
        angles = np.float64(angle_rad) + np.arange(-n_fine, n_fine + 1) * (step / n_fine)
        fine = np.zeros((len(angles), 4 * (self._smear_bins + 3)), dtype=np.int32)
        # An angle step shifts a line by at most half the plan times the step; cells farther away
        # have no effect.
        direction = np.array([math.cos(angle_rad), math.sin(angle_rad)], dtype=np.float32)
        apart_m = np.abs(direction @ places[:2] - np.float32(distance_m))
        near = np.flatnonzero(apart_m < reach_m + step * self.reach_m)
        low_m, near_by = distance_m - reach_m, places.take(near, axis=1)
        vote_places(near_by, weights[near], _normals(angles), low_m, 0.5 * bin_m, fine)
        best, place = sharpest(fine)
        return float(angles[best]), low_m + place * 0.5 * bin_m


def _normals(angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return directions (a, 3) in the plan."""
    return np.stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros(len(angles_rad))], axis=1)


def vote_counts(
    counts: NDArray[np.int64], accumulator: Literal["counts", "unit", "canny"]
) -> NDArray[np.int64]:
    """Return the votes (e1, e2) of plan cells from their numbers of points (e1, e2).

    With one vote per cell, votes are multiplied by the mean number of points, so that they can be
    compared with the heights, which are counted in points.
    """
    if accumulator == "counts":
        return counts
    chosen = _edges(counts) if accumulator == "canny" else counts != 0
    mean = float(counts[chosen].mean()) if chosen.any() else 1.0
    return chosen * np.int64(max(1, round(mean)))


def _edges(counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the occupied cells on edges of the density image (logarithm of the counts)."""
    import cv2

    grey = np.log1p(np.maximum(counts, 0))
    scaled = np.rint(255.0 * grey / max(float(grey.max()), 1e-9)).astype(np.uint8)
    return (cv2.Canny(scaled, _EDGE_LOW, _EDGE_HIGH) > 0) & (counts > 0)
