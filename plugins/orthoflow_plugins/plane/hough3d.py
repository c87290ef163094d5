"""`plane.hough3d`: planes in any direction from voxels that vote in a 3D accumulator.

Directions are evenly distributed over the hemisphere. At phi = 90 degrees, every omega describes
the same plane, so a regular table of omega and phi would count a floor 180 times. Here the number
of directions for each phi is proportional to the length of its circle, and the pole occurs once.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.threads import in_threads
from orthoflow.sdk import Method, StepContext
from orthoflow_plugins.plane.detector import (
    DETECTOR_METRICS,
    PAPER,
    Candidate,
    Constraint,
    DetectorIn,
    DetectorOut,
    DetectorParams,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.search import Claim, Search

# Sections of the accumulator in markiewicz2015, Figure 13; degrees.
_CUTS_DEG: Final = (0.0, 45.0, 90.0)
# Directions within this angle represent each other, and those within the second are excluded after
# a rejected candidate; in steps between directions.
_STANDS_FOR_STEPS: Final = 1.5
_NOT_AGAIN_STEPS: Final = 2.2
# Slopes tested around a maximum, in steps between directions: coarse, then fine.
_FINE_STEPS: Final = ((-1.0, -0.5, 0.0, 0.5, 1.0), (-0.4, -0.2, 0.0, 0.2, 0.4))
# Maximum number of entries of all tables together; larger scenes have larger bins.
_TABLE_MOST: Final = 120_000_000
# Best scores, votes over omega and over phi by angle, and maximum distance; see `sections_of`.
_Sections = tuple[
    NDArray[np.float64], dict[float, NDArray[np.float64]], dict[float, NDArray[np.float64]], float
]


class Hough3d(Method):
    """Find planes by the 3D Hough transform of markiewicz2015: voxels vote with their points.

    r = x cos(phi) cos(omega) + y cos(phi) sin(omega) + z sin(phi). For each omega, the voxels are
    first summed in a vertical image, whose occupied cells then vote for all phi. Directions are
    evenly distributed over the hemisphere, so that a floor is counted once and not for every omega.

    `search: coarse-to-fine` votes with twice `cell_m` and twice `angle_step_deg` and refines each
    maximum; `full` votes with both as given. The other stages are common to all detectors: planes
    are refined on a sample and fitted to all points, and their points are removed. `scoring: votes`
    proposes the maximum itself, as in the paper.
    """

    id = "plane.hough3d"
    result_version = 2
    determinism = "exact"
    metrics = DETECTOR_METRICS
    citations = (
        PAPER,
        (
            "Borrmann, Elseberg, Lingemann, Nuechter 2011: The 3D Hough Transform for plane "
            "detection in point clouds, doi:10.1007/3DRes.02(2011)3 (accumulators safe at the pole)"
        ),
    )

    class Params(DetectorParams):
        """Parameters; the defaults suit rooms and facades scanned at millimetres."""

        cell_m: float = Field(
            0.02, gt=0.0, le=1.0, description="Size of the voxels and of the distance bins."
        )
        angle_step_deg: float = Field(
            1.0, ge=0.25, le=15.0, description="Angle between successive normal directions."
        )
        search: Literal["coarse-to-fine", "full"] = Field(
            "coarse-to-fine",
            description="coarse-to-fine: vote with twice the cell size and angle step, then "
            "refine the maxima; full: vote with the given values.",
        )
        scoring: Literal["contrast", "votes"] = Field(
            "contrast",
            description="Score of a plane. contrast: its votes minus those on its emptier side, "
            "refined with finer angles and bins; votes: only the votes of its bin, as in "
            "markiewicz2015.",
        )
        coordinates: Literal["cells", "raw"] = Field(
            "cells",
            description="Positions that vote. cells: voxels; raw: single points of the sample.",
        )

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.figures import draw_sections, draw_space
        from orthoflow_plugins.plane.search import detect

        cloud, proposer_of = inputs.cloud, partial(SpaceProposer, params=params)
        out, proposer = detect(cloud, params, ctx, proposer_of, method=self.id)
        draw_space(ctx, *proposer.sections(), out.planes)
        draw_sections(ctx, out.planes, cloud, cell_m=params.cell_m)
        return out


class SpaceProposer:
    """Proposes planes from the maxima of a 3D accumulator.

    The accumulator is linear: when points are removed, the votes of their voxels are subtracted,
    and the other voxels need not vote again. Voxels whose centre is close enough to a plane are
    removed completely; the paper sets their counters to zero. This needs no pass over the points.

    Attributes:
        middles_m: (3, m) float32 centres of the voxels with points, relative to the centre of the
            box, in the (e1, e2, up) frame.
        left: (m,) int32 number of points in each voxel that belong to no plane.
    """

    def __init__(self, search: Search, params: Hough3d.Params) -> None:
        """Count the points of the cloud per voxel; voting starts later."""
        from orthoflow_plugins.plane.voxels import VoxelTable

        cloud, coarser = search.cloud, 1.0 if params.search == "full" else 2.0
        self._params, self._parts = params, cloud.parts
        self._is_raw, self._is_plain = params.coordinates == "raw", params.scoring == "votes"
        self._least_points = params.min_share * len(cloud.claims)
        self._points_per_vote = cloud.sample.n_represented if self._is_raw else 1.0
        table = VoxelTable.over(cloud, coarser * params.cell_m, n_sums=1)
        self._basis, self._voxel_m = cloud.grid.basis, table.grid.cell_m
        self._middle_m = cloud.grid.low_m + 0.5 * cloud.grid.extent_m
        self._extent_m = cloud.grid.extent_m
        middles_m = (table.places + 0.5) * self._voxel_m - 0.5 * self._extent_m
        self.middles_m = np.ascontiguousarray(middles_m.T, dtype=np.float32)
        self.left = table.sums[:, 0].astype(np.int32)
        self._directions = directions_over(
            coarser * params.angle_step_deg, params.constraint, params.max_tilt_deg
        )
        self._half_m = 0.5 * float(np.linalg.norm(self._extent_m))
        n_rows = len(self._directions.normals)
        self._bin_m = max(self._voxel_m, 2.0 * self._half_m * n_rows / _TABLE_MOST)
        n_bins = 2 * (math.ceil(self._half_m / self._bin_m) + 1)
        self._smear_bins = max(
            1, round(0.3 * self._half_m * self._directions.step_rad / self._bin_m)
        )
        self._votes = np.zeros((n_rows, n_bins), dtype=np.int32)
        self._barred = np.zeros((n_rows, n_bins), dtype=np.uint8)
        self._scores, self._places = np.zeros((2, n_rows), dtype=np.int64)
        self._unscored = np.arange(n_rows)
        self._voted_for, self._n_taken, self._last = -1, 0, (0, 0)
        self._first: _Sections | None = None

    def propose(self, search: Search) -> Candidate | None:
        """Return the plane with the best score."""
        from orthoflow_plugins.plane.votes import VOTE_CAUTION, VOTE_SHARES

        if self._voted_for != search.n_points:
            self._vote(search)
            self._voted_for = search.n_points
        self._score()
        direction = int(np.argmax(self._scores))
        score = float(self._scores[direction]) / VOTE_SHARES * self._points_per_vote
        if score < VOTE_CAUTION * self._least_points:
            return None
        place = int(self._places[direction])
        self._last = (direction, place)
        normal = self._directions.normals[direction]
        point = (place + 0.5 - 0.5 * self._votes.shape[1]) * self._bin_m * normal
        if not self._is_plain:
            normal, point = self._refined(normal, float(normal @ point))
        # Transform from the frame of the box to offsets.
        world = normal / np.linalg.norm(normal) @ self._basis
        world = world / np.linalg.norm(world)
        on_plane = (point + self._middle_m) @ self._basis
        plane = Plane(normal=world, offset_m=float(world @ on_plane))
        return Candidate(plane=plane, constraint=self._params.constraint)

    def reject(self, candidate: Candidate) -> None:
        """Exclude the surroundings of the last maximum."""
        del candidate
        direction, place = self._last
        n_bins = self._votes.shape[1]
        cosines = self._directions.normals @ self._directions.normals[direction]
        reach = self._smear_bins + 1
        near = np.cos(_NOT_AGAIN_STEPS * self._directions.step_rad)
        self._unscored = np.flatnonzero(np.abs(cosines) > near)
        for row in self._unscored:
            # On the opposite side of the hemisphere, distances change sign.
            middle = place if cosines[row] > 0.0 else n_bins - 1 - place
            self._barred[row, max(0, middle - reach) : middle + reach + 1] = 1

    def sections(self) -> _Sections:
        """Return sections of the accumulator of the whole cloud; requires a first proposal."""
        if self._first is None:
            raise ValueError("no plane was proposed yet")
        return self._first

    def _vote(self, search: Search) -> None:
        """Subtract the votes of voxels that were assigned to planes since the last update."""
        from orthoflow_plugins.plane.votes import vote_planes

        taken = np.zeros(len(self.left), dtype=bool)
        for claim in search.taken[self._n_taken :]:
            taken |= self._is_within(claim)
        self._n_taken = len(search.taken)
        index = np.flatnonzero(taken & (self.left > 0))
        # In the same memory layout as all voxels, so that the kernel is compiled only once.
        places_m, weights = np.take(self.middles_m, index, axis=1), -self.left[index]
        self.left[index] = 0
        if self._is_raw:
            self._votes[:] = 0
            framed = self._basis @ search.free()[0].T - self._middle_m[:, None]
            places_m = framed.astype(np.float32, order="C")
            weights = np.ones(places_m.shape[1], dtype=np.int32)
        elif self._voted_for < 0:
            places_m, weights = self.middles_m, self.left
        extent = self._extent_m / self._bin_m
        shape = (math.ceil(extent[2]) + 2, math.ceil(math.hypot(extent[0], extent[1])) + 2)
        starts = self._directions.starts

        def vote(turns: NDArray[np.int64]) -> None:
            first, last = int(starts[turns[0]]), int(starts[turns[-1] + 1])
            vote_planes(
                places_m,
                weights,
                self._directions.angles_rad[first:last],
                starts[turns[0] : turns[-1] + 2] - first,
                np.zeros(shape, dtype=np.int32),
                self._bin_m,
                self._votes[first:last],
            )

        _in_shares(vote, np.array_split(np.arange(len(starts) - 1), self._parts))
        self._unscored = np.arange(len(self._votes))

    def _score(self) -> None:
        """Find the best bin of each direction whose votes or excluded bins have changed."""
        from orthoflow_plugins.plane.votes import VOTE_SHARES, best_bins

        half, tables = 0 if self._is_plain else self._smear_bins, (self._scores, self._places)

        def score(rows: NDArray[np.int64]) -> None:
            best_bins(self._votes, rows, half, self._is_plain, self._barred, *tables)

        _in_shares(score, np.array_split(self._unscored, self._parts))
        self._unscored = self._unscored[:0]
        if self._first is None:
            scores = self._scores / VOTE_SHARES
            self._first = sections_of(self._directions, self._votes, scores, bin_m=self._bin_m)

    def _refined(
        self, normal: NDArray[np.float64], distance_m: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Refine a maximum with finer slopes and half bins, using the voxels near it.

        Returns a normal (not a unit vector) and a point relative to the centre of the box.
        """
        from orthoflow_plugins.plane.votes import sharpest, vote_places

        axes = wall_axes(normal, np.array([0.0, 0.0, 1.0]))
        reach_m, step_rad = (self._smear_bins + 3) * self._bin_m, self._directions.step_rad
        heights_m = normal.astype(np.float32) @ self.middles_m - np.float32(distance_m)
        near = (np.abs(heights_m) < reach_m + step_rad * self._half_m) & (self.left > 0)
        near_m, weights = self.middles_m[:, near], self.left[near]
        local = np.vstack([axes, normal]).astype(np.float32) @ near_m
        local[2] -= np.float32(distance_m)
        middle = np.median(local[:2], axis=1) if local.size else np.zeros(2)
        local[:2] -= middle[:, None].astype(np.float32)
        bin_m, best, place = 0.5 * self._bin_m, np.zeros(2), 0.0

        def vote(share: tuple[NDArray[np.float64], NDArray[np.int32]]) -> None:
            vote_places(local, weights, share[0], -reach_m, bin_m, share[1])

        for steps in _FINE_STEPS:
            slopes = best + step_rad * np.array(list(itertools.product(steps, steps)))
            normals = np.column_stack([-slopes, np.ones(len(slopes))])
            fine = np.zeros((len(slopes), 4 * (self._smear_bins + 3)), dtype=np.int32)
            shares = (np.array_split(table, self._parts) for table in (normals, fine))
            _in_shares(vote, list(zip(*shares, strict=True)))
            row, place = sharpest(fine)
            best = slopes[row]
        height_m = place * bin_m - reach_m
        return normal - best @ axes, (distance_m + height_m) * normal + middle @ axes

    def _is_within(self, claim: Claim) -> NDArray[np.bool_]:
        """Return (m,) whether occupied voxels are within the tolerance and rectangle of a plane."""
        slab, bounds = claim
        within = np.ones(len(self.left), dtype=bool)
        for row in range(3):
            axis = self._basis @ slab[4 * row : 4 * row + 3]
            shift = slab[4 * row + 3] - float(axis @ self._middle_m)
            along_m = axis.astype(np.float32) @ self.middles_m
            # A voxel that intersects the plane contains points of it, even if the voxel is large.
            half_m = 0.5 * self._voxel_m * float(np.abs(axis).sum())
            reach_m = max(bounds[0], half_m)
            low_m = -reach_m if row == 0 else bounds[2 * row - 1] - half_m
            high_m = reach_m if row == 0 else bounds[2 * row] + half_m
            within &= (along_m >= shift + low_m) & (along_m <= shift + high_m)
        return within


# `...`, because each pass divides its work into shares of another type.
def _in_shares(task: Callable[..., None], shares: Sequence[object]) -> None:
    in_threads([partial(task, share) for share in shares])


@dataclass(frozen=True, kw_only=True)
class Directions:
    """Directions of normals in the (e1, e2, up) frame, grouped by omega.

    Attributes:
        angles_rad: (d, 2) omega 0..pi and phi -pi/2..pi/2.
        starts: (o + 1,) index of the first direction of each omega.
        normals: (d, 3) unit vectors.
        step_rad: angle between neighbouring directions.
    """

    angles_rad: NDArray[np.float64]
    starts: NDArray[np.int64]
    normals: NDArray[np.float64]
    step_rad: float


def directions_over(step_deg: float, constraint: Constraint, max_tilt_deg: float) -> Directions:
    """Return directions over the hemisphere, or the part of it that a constraint needs."""
    n_turns = round(180.0 / step_deg)
    step_rad = math.pi / n_turns
    phis = -0.5 * math.pi + step_rad * np.arange(1, n_turns + 1)
    limit_rad = math.radians(max_tilt_deg) + step_rad
    if constraint == "vertical":
        phis = phis[np.abs(phis) <= limit_rad]
    elif constraint == "horizontal":
        phis = phis[0.5 * math.pi - np.abs(phis) <= limit_rad]
    # The pole is the last phi; its cosine is zero except for rounding, so it has one omega.
    n_around = np.maximum(1, np.ceil(n_turns * np.cos(phis) - 1e-9)).astype(np.int64)
    rows = []
    starts = [0]
    for turn in range(n_turns):
        begins = turn * n_around // n_turns != (turn - 1) * n_around // n_turns
        rows += [(turn * step_rad, phi) for phi in phis[begins]]
        starts.append(len(rows))
    angles = np.array(rows)
    omega, phi = angles.T
    return Directions(
        angles_rad=angles,
        starts=np.array(starts, dtype=np.int64),
        normals=np.ascontiguousarray(_normals(omega, phi).T),
        step_rad=step_rad,
    )


def _normals(omega: NDArray[np.float64], phi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors (3, n) by Equation 3 of markiewicz2015."""
    return np.stack([np.cos(phi) * np.cos(omega), np.cos(phi) * np.sin(omega), np.sin(phi)])


def sections_of(
    directions: Directions,
    votes: NDArray[np.int32],
    scores: NDArray[np.float64],
    *,
    bin_m: float,
) -> _Sections:
    """Return sections of an accumulator.

    Args:
        directions: directions of the accumulator.
        votes: (d, b) votes per direction and distance.
        scores: (d,) best score of each direction.
        bin_m: width of a distance bin.

    Returns:
        The best score (o, p) of all distances for each omega (0..180 degrees) and phi (-90..90
        degrees); for each angle of a section in degrees, the votes by omega and distance at this
        phi; the same by phi and distance at this omega; and the maximum distance on each side.
        Values for which there is no direction are NaN.
    """
    n_turns = len(directions.starts) - 1
    best = np.full((n_turns, n_turns + 1), np.nan)
    column = np.rint((directions.angles_rad[:, 1] + 0.5 * math.pi) / directions.step_rad)
    row = np.rint(directions.angles_rad[:, 0] / directions.step_rad)
    best[row.astype(int), column.astype(int)] = scores
    # Each direction represents the angles omega up to the next direction with the same phi.
    last_asked = np.where(np.isnan(best), 0, np.arange(n_turns)[:, None])
    best = np.take_along_axis(best, np.maximum.accumulate(last_asked, axis=0), axis=0)
    omegas = directions.step_rad * np.arange(n_turns, dtype=np.float64)
    phis = directions.step_rad * np.arange(n_turns + 1, dtype=np.float64) - 0.5 * math.pi
    # Distances beyond all points are omitted.
    n_bins = votes.shape[1]
    used = np.flatnonzero(votes.any(axis=0))
    beyond = int(min(used[0], n_bins - 1 - used[-1])) if len(used) else 0
    votes = votes[:, beyond : n_bins - beyond]
    over_omega = {cut: _section(directions, votes, omegas, math.radians(cut)) for cut in _CUTS_DEG}
    over_phi = {cut: _section(directions, votes, math.radians(cut), phis) for cut in _CUTS_DEG}
    return best, over_omega, over_phi, 0.5 * votes.shape[1] * bin_m


def _section(
    directions: Directions, votes: NDArray[np.int32], omega: ArrayLike, phi: ArrayLike
) -> NDArray[np.float64]:
    """Return votes (n, b) for n directions, taken from the nearest one of the accumulator."""
    omegas, phis = np.broadcast_arrays(np.asarray(omega, dtype=float), np.asarray(phi, dtype=float))
    cosines = directions.normals @ _normals(omegas, phis)
    nearest = np.abs(cosines).argmax(axis=0)
    cosine = cosines[nearest, np.arange(len(nearest))]
    section: NDArray[np.float64] = votes[nearest].astype(np.float64)
    # On the opposite side of the hemisphere, distances change sign.
    section[cosine < 0.0] = section[cosine < 0.0, ::-1]
    section[np.abs(cosine) < math.cos(_STANDS_FOR_STEPS * directions.step_rad)] = np.nan
    return section
