"""`plane.hough3d`: planes in any direction from voxels that vote in a 3D accumulator.

The directions asked about are even over the hemisphere. At phi = 90 degrees every omega is the same
plane: a table of omega by phi counts a floor 180 times. Here each circle of one phi has as many
directions as its length asks for, and the pole is there once.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

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
    from orthoflow_plugins.plane.cloud import Claim, PreparedCloud, Search
    from orthoflow_plugins.plane.figures import SpacePicture
    from orthoflow_plugins.plane.kernels import BlockedPoints

# What markiewicz2015 cuts its accumulator at, Figure 13; degrees.
_SECTIONS_DEG: Final = (0.0, 45.0, 90.0)
# A direction stands for another one that is nearer than this, in steps between directions.
_STANDS_FOR_STEPS: Final = 1.5
_NOT_AGAIN_STEPS: Final = 2.2
# Slopes tried around a maximum, in steps between directions: first these, then closer ones.
_FINE_STEPS: Final = ((-1.0, -0.5, 0.0, 0.5, 1.0), (-0.4, -0.2, 0.0, 0.2, 0.4))
# More entries than this of all tables together cost more memory than they show; bins grow instead.
_TABLE_MOST: Final = 120_000_000
# Rows that a table of voxels begins with.
_ROWS_FIRST: Final = 2_048


class Hough3d(Method):
    """Find planes by the 3D Hough transform of markiewicz2015: voxels vote with their points.

    r = x cos(phi) cos(omega) + y cos(phi) sin(omega) + z sin(phi). For each omega the voxels are
    first counted in an upright image, whose occupied cells then vote over phi. Directions are even
    over the hemisphere, so that a floor is counted once and not for every omega.

    `search: coarse-to-fine` votes with twice `cell_m` and twice `angle_step_deg` and looks finer
    around each maximum only; `full` votes with both as they are. What follows is common to all
    detectors: refined on a sample, fitted to all points, points taken away. `scoring: votes`
    proposes the plain maximum of the paper's own transform.
    """

    id = "plane.hough3d"
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
        """What may be set; the defaults suit rooms and facades scanned at millimetres."""

        cell_m: float = Field(
            0.02, gt=0.0, le=1.0, description="Side of a voxel and of a distance bin."
        )
        angle_step_deg: float = Field(
            1.0, ge=0.25, le=15.0, description="Step between the directions that are voted for."
        )
        search: Literal["coarse-to-fine", "full"] = Field(
            "coarse-to-fine",
            description="Vote with doubled cells and steps and look finer around maxima, or vote "
            "with all of them.",
        )
        scoring: Literal["contrast", "votes"] = Field(
            "contrast",
            description="What a plane is worth: its votes above those of the emptier side, refined "
            "with finer angles and bins, or the votes of its bin alone, as in markiewicz2015.",
        )
        coordinates: Literal["cells", "raw"] = Field(
            "cells", description="What votes: voxels, or points of the sample by themselves."
        )

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.figures import draw_sections, draw_space
        from orthoflow_plugins.plane.search import detect

        proposer_of = partial(SpaceProposer, params=params)
        detection = detect(inputs.cloud, params, ctx, proposer_of, method=self.id)
        planes = detection.out.planes
        draw_space(ctx, detection.proposer.picture(), planes)
        draw_sections(ctx, planes, inputs.cloud, cell_m=params.cell_m)
        return detection.out


class SpaceProposer:
    """Proposes planes from the maxima of a 3D accumulator.

    The accumulator is linear: when points are taken away, their voxels take their votes back,
    instead of all others voting again.
    """

    def __init__(self, search: Search, params: Hough3d.Params) -> None:
        """Count the points of the search's cloud per voxel; none has voted yet."""
        cloud, coarser = search.cloud, 1.0 if params.search == "full" else 2.0
        self._params, self._parts = params, cloud.parts
        self._is_raw, self._is_plain = params.coordinates == "raw", params.scoring == "votes"
        self._least_points = params.min_share * len(cloud.claims)
        self._points_per_vote = cloud.sample.n_represented if self._is_raw else 1.0
        self._voxels = VoxelCounts(cloud, coarser * params.cell_m)
        self._directions = directions_over(
            coarser * params.angle_step_deg, params.constraint, params.max_tilt_deg
        )
        half_m = 0.5 * float(np.linalg.norm(self._voxels.extent_m))
        n_rows = len(self._directions.normals)
        self._bin_m = max(self._voxels.voxel_m, 2.0 * half_m * n_rows / _TABLE_MOST)
        n_bins = 2 * (math.ceil(half_m / self._bin_m) + 1)
        self._smear_bins = max(1, round(0.3 * half_m * self._directions.step_rad / self._bin_m))
        self._votes = np.zeros((n_rows, n_bins), dtype=np.int32)
        self._barred = np.zeros((n_rows, n_bins), dtype=np.uint8)
        self._scores = np.zeros(n_rows, dtype=np.int64)
        self._places = np.zeros(n_rows, dtype=np.int64)
        self._voted_for = -1
        self._unscored = np.arange(n_rows)
        self._last = (0, 0)
        self._picture: SpacePicture | None = None

    def propose(self, search: Search) -> Candidate | None:
        """Name the plane whose votes stand out most."""
        from orthoflow_plugins.plane.vote_kernels import VOTE_CAUTION, VOTE_SHARES

        if self._voted_for != search.n_points:
            self._vote(search)
        self._score()
        direction = int(np.argmax(self._scores))
        score = float(self._scores[direction]) / VOTE_SHARES * self._points_per_vote
        if score < VOTE_CAUTION * self._least_points:
            return None
        self._last = (direction, int(self._places[direction]))
        return self._refined(direction, score)

    def reject(self, candidate: Candidate) -> None:
        """Bar the surroundings of the last maximum."""
        del candidate
        direction, place = self._last
        n_bins = self._votes.shape[1]
        cosines = self._directions.normals @ self._directions.normals[direction]
        reach = self._smear_bins + 1
        near = np.cos(_NOT_AGAIN_STEPS * self._directions.step_rad)
        self._unscored = np.flatnonzero(np.abs(cosines) > near)
        for row in self._unscored:
            # On the other side of the hemisphere distances count the other way.
            middle = place if cosines[row] > 0.0 else n_bins - 1 - place
            self._barred[row, max(0, middle - reach) : middle + reach + 1] = 1

    def picture(self) -> SpacePicture:
        """Return the cut accumulator of the untouched cloud; the first proposal makes it."""
        if self._picture is None:
            raise ValueError("no plane was proposed yet")
        return self._picture

    def _vote(self, search: Search) -> None:
        changes = self._voxels.take(search.taken)
        if self._is_raw:
            self._votes[:] = 0
            changes = self._voxels.raw_places(search.free().points)
        elif self._voted_for < 0:
            changes = Places(self._voxels.middles_m, self._voxels.left)
        self._add(changes)
        self._voted_for = search.n_points
        self._unscored = np.arange(len(self._votes))

    def _add(self, places: Places) -> None:
        from orthoflow_plugins.plane.vote_kernels import vote_planes

        extent = self._voxels.extent_m / self._bin_m
        shape = (math.ceil(extent[2]) + 2, math.ceil(math.hypot(extent[0], extent[1])) + 2)
        starts = self._directions.starts

        def vote(turns: NDArray[np.int64]) -> None:
            first, last = int(starts[turns[0]]), int(starts[turns[-1] + 1])
            vote_planes(
                *places,
                self._directions.angles_rad[first:last],
                starts[turns[0] : turns[-1] + 2] - first,
                np.zeros(shape, dtype=np.int32),
                self._bin_m,
                self._votes[first:last],
            )

        _in_shares(vote, np.array_split(np.arange(len(starts) - 1), self._parts))

    def _score(self) -> None:
        """Find the best bin of each direction whose votes or bars changed."""
        from orthoflow_plugins.plane.vote_kernels import VOTE_SHARES, best_bins

        rows, half = self._unscored, 0 if self._is_plain else self._smear_bins
        edges = np.linspace(0, len(rows), self._parts + 1).astype(int)

        def score(span: tuple[int, int]) -> None:
            some = rows[span[0] : span[1]]
            tables = (self._barred, self._scores, self._places)
            best_bins(self._votes, some, half, self._is_plain, *tables)

        _in_shares(score, list(itertools.pairwise(edges)))
        self._unscored = rows[:0]
        if self._picture is None:
            scores = self._scores / VOTE_SHARES
            self._picture = pictured(self._directions, self._votes, scores, bin_m=self._bin_m)

    def _refined(self, direction: int, score: float) -> Candidate:
        """Look around a maximum with finer slopes and half bins, with the voxels near it."""
        from orthoflow_plugins.plane.vote_kernels import contrast, parabola, vote_tilts

        place = int(self._places[direction])
        normal = self._directions.normals[direction]
        distance_m = (place + 0.5 - 0.5 * self._votes.shape[1]) * self._bin_m
        if self._is_plain:
            return self._candidate(normal, distance_m * normal, score)
        axes = wall_axes(normal, np.array([0.0, 0.0, 1.0]))
        reach_m = (self._smear_bins + 3) * self._bin_m
        half_m = 0.5 * float(np.linalg.norm(self._voxels.extent_m))
        near = self._voxels.near(normal, distance_m, reach_m + self._directions.step_rad * half_m)
        local = np.vstack([axes, normal]).astype(np.float32) @ near.places_m
        local[2] -= np.float32(distance_m)
        middle = np.median(local[:2], axis=1) if local.size else np.zeros(2)
        local[:2] -= middle[:, None].astype(np.float32)
        bin_m, best = 0.5 * self._bin_m, np.zeros(2)

        def vote(share: tuple[NDArray[np.float64], NDArray[np.int64]]) -> None:
            vote_tilts(local, near.weights, share[0], -reach_m, bin_m, share[1])

        for steps in _FINE_STEPS:
            tilts = np.array(list(itertools.product(steps, steps)))
            slopes = best + self._directions.step_rad * tilts
            fine = np.zeros((len(slopes), 4 * (self._smear_bins + 3)), dtype=np.int64)
            shares = (np.array_split(table, self._parts) for table in (slopes, fine))
            _in_shares(vote, list(zip(*shares, strict=True)))
            scores = contrast(fine, 1)
            row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
            best = slopes[row]
        height_m = -reach_m + (column + 0.5 + parabola(scores[row], int(column))) * bin_m
        point = (distance_m + height_m) * normal + middle @ axes
        return self._candidate(normal - best @ axes, point, score)

    def _candidate(
        self, normal: NDArray[np.float64], point: NDArray[np.float64], score: float
    ) -> Candidate:
        """The plane through a point, both from the middle of the box in its frame."""
        world = normal / np.linalg.norm(normal) @ self._voxels.basis
        world = world / np.linalg.norm(world)
        on_plane = (point + self._voxels.middle_m) @ self._voxels.basis
        return Candidate(
            plane=Plane(normal=world, offset_m=float(world @ on_plane)),
            constraint=self._params.constraint,
            votes=score,
        )


# Any: what a share of the work is differs from pass to pass.
def _in_shares(task: Callable[..., None], shares: Sequence[object]) -> None:
    in_threads([partial(task, share) for share in shares])


@dataclass(frozen=True, kw_only=True)
class Directions:
    """Directions of normals in the (e1, e2, up) frame, those of one omega together.

    Attributes:
        angles_rad: (d, 2) omega 0..pi and phi -pi/2..pi/2.
        starts: (o + 1,) where those of each omega start.
        normals: (d, 3) unit vectors.
        step_rad: angle between neighbours.
    """

    angles_rad: NDArray[np.float64]
    starts: NDArray[np.int64]
    normals: NDArray[np.float64]
    step_rad: float


def directions_over(step_deg: float, constraint: Constraint, max_tilt_deg: float) -> Directions:
    """Cover the hemisphere, or the part of it that a constraint needs."""
    n_turns = round(180.0 / step_deg)
    step_rad = math.pi / n_turns
    phis = -0.5 * math.pi + step_rad * np.arange(1, n_turns + 1)
    limit_rad = math.radians(max_tilt_deg) + step_rad
    if constraint == "vertical":
        phis = phis[np.abs(phis) <= limit_rad]
    elif constraint == "horizontal":
        phis = phis[0.5 * math.pi - np.abs(phis) <= limit_rad]
    # The pole is the last phi; its cosine is zero but for rounding, so it has one omega.
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
    """(3, n) unit vectors by Equation 3 of markiewicz2015."""
    return np.stack([np.cos(phi) * np.cos(omega), np.cos(phi) * np.sin(omega), np.sin(phi)])


def pictured(
    directions: Directions,
    votes: NDArray[np.int32],
    scores: NDArray[np.float64],
    *,
    bin_m: float,
) -> SpacePicture:
    """Cut an accumulator.

    Args:
        directions: that it asks about.
        votes: (d, b) votes per direction and distance.
        scores: (d,) best score of each direction.
        bin_m: width of a bin of distances.
    """
    from orthoflow_plugins.plane.figures import SpacePicture

    n_turns = len(directions.starts) - 1
    best = np.full((n_turns, n_turns + 1), np.nan)
    column = np.rint((directions.angles_rad[:, 1] + 0.5 * math.pi) / directions.step_rad)
    row = np.rint(directions.angles_rad[:, 0] / directions.step_rad)
    best[row.astype(int), column.astype(int)] = scores
    # Each direction stands for those of the same phi up to the next one.
    last_asked = np.where(np.isnan(best), 0, np.arange(n_turns)[:, None])
    best = np.take_along_axis(best, np.maximum.accumulate(last_asked, axis=0), axis=0)
    omegas = directions.step_rad * np.arange(n_turns, dtype=np.float64)
    phis = directions.step_rad * np.arange(n_turns + 1, dtype=np.float64) - 0.5 * math.pi
    cuts = np.radians(_SECTIONS_DEG)
    # Distances beyond all points say nothing.
    n_bins = votes.shape[1]
    used = np.flatnonzero(votes.any(axis=0))
    beyond = int(min(used[0], n_bins - 1 - used[-1])) if len(used) else 0
    votes = votes[:, beyond : n_bins - beyond]
    return SpacePicture(
        best=best,
        over_omega=np.stack([_section(directions, votes, omegas, phi) for phi in cuts]),
        over_phi=np.stack([_section(directions, votes, omega, phis) for omega in cuts]),
        sections_deg=_SECTIONS_DEG,
        reach_m=0.5 * votes.shape[1] * bin_m,
    )


def _section(
    directions: Directions, votes: NDArray[np.int32], omega: ArrayLike, phi: ArrayLike
) -> NDArray[np.float64]:
    """(n, b) votes for each of n directions, those of the nearest one that was asked about."""
    omegas, phis = np.broadcast_arrays(np.asarray(omega, dtype=float), np.asarray(phi, dtype=float))
    cosines = directions.normals @ _normals(omegas, phis)
    nearest = np.abs(cosines).argmax(axis=0)
    cosine = cosines[nearest, np.arange(len(nearest))]
    section: NDArray[np.float64] = votes[nearest].astype(np.float64)
    # On the other side of the hemisphere distances count the other way.
    section[cosine < 0.0] = section[cosine < 0.0, ::-1]
    section[np.abs(cosine) < math.cos(_STANDS_FOR_STEPS * directions.step_rad)] = np.nan
    return section


class Places(NamedTuple):
    """Where votes come from.

    Attributes:
        places_m: (3, m) float32 e1, e2 and height from the middle of the box.
        weights: (m,) int32 votes of each.
    """

    places_m: NDArray[np.float32]
    weights: NDArray[np.int32]


class VoxelCounts:
    """Counts the points of a cloud per voxel, in one pass.

    Attributes:
        voxel_m: side of a voxel.
        middle_m: (3,) middle of the box in the (e1, e2, up) frame of the cloud's offsets.
        extent_m: (3,) size of the box.
        basis: (3, 3) rows e1, e2, up.
        middles_m: (3, m) float32 middles of the voxels with points, from the middle of the box.
        left: (m,) int32 points in them that no plane has taken.
    """

    def __init__(self, cloud: PreparedCloud, voxel_m: float) -> None:
        """Count all points; voxels grow where a scene would have too many."""
        from orthoflow_plugins.plane.kernels import PlanGrid, each_part, piece_of, plan_frame
        from orthoflow_plugins.plane.voxel_kernels import (
            BRICK_SIDE,
            VOXELS,
            coarsened,
            voxel_places,
        )

        grid = cloud.grid
        self.basis = grid.basis
        self.extent_m = np.array(grid.shape) * grid.cell_m
        self.voxel_m = coarsened(voxel_m, self.extent_m)
        self.middle_m = grid.low_m + 0.5 * self.extent_m
        a, b, c = np.ceil(self.extent_m / (BRICK_SIDE * self.voxel_m)).astype(int).tolist()
        shape = (a, b, c)
        frame = plan_frame(
            PlanGrid(basis=grid.basis, low_m=grid.low_m, cell_m=self.voxel_m, shape=shape)
        )
        tables: list[tuple[NDArray[np.int32], NDArray[np.int32]]] = [_NO_TABLE] * cloud.parts

        def count(part: int, piece: slice) -> None:
            tables[part] = _counted(piece_of(cloud.points, piece), frame, shape)

        each_part(len(cloud.claims), cloud.parts, count)
        has_points = np.max([bricks for bricks, _ in tables], axis=0) >= 0
        counts = np.zeros((np.count_nonzero(has_points), VOXELS), dtype=np.int32)
        for bricks, own in tables:
            rows = bricks[has_points]
            counts[rows >= 0] += own[rows[rows >= 0]]
        occupied = counts != 0
        self.left = counts[occupied]
        places = voxel_places(has_points.reshape(shape), occupied)
        shift_m = (grid.low_m - self.middle_m)[:, None]
        self.middles_m = ((places.T + 0.5) * self.voxel_m + shift_m).astype(np.float32, order="C")
        self._n_taken = 0

    def take(self, claims: list[Claim]) -> Places:
        """Take points away for the planes that are new, and give what they took, negative.

        A plane takes a voxel whose middle is near enough, as a whole: that is the paper's zeroing
        of counters, and costs no pass over the points.
        """
        taken = np.zeros(len(self.left), dtype=bool)
        for claim in claims[self._n_taken :]:
            taken |= self._is_within(claim)
        self._n_taken = len(claims)
        index = np.flatnonzero(taken & (self.left > 0))
        weights = -self.left[index]
        self.left[index] = 0
        # In rows as all voxels are, not in columns: voting would be compiled once more.
        return Places(np.take(self.middles_m, index, axis=1), weights)

    def near(self, axis: NDArray[np.float64], distance_m: float, reach_m: float) -> Places:
        """Voxels with points left whose middle is near a plane of the box's frame."""
        heights = axis.astype(np.float32) @ self.middles_m - np.float32(distance_m)
        index = np.flatnonzero((np.abs(heights) < reach_m) & (self.left > 0))
        return Places(self.middles_m[:, index], self.left[index])

    def raw_places(self, points: BlockedPoints) -> Places:
        """Points with their own coordinates, and one vote each."""
        places_m = np.empty((3, len(points.x)), dtype=np.float32)
        for row, (axis, middle) in enumerate(zip(self.basis, self.middle_m, strict=True)):
            a, b, c = axis.astype(np.float32)
            places_m[row] = a * points.x + b * points.y + c * points.z - np.float32(middle)
        return Places(places_m, np.ones(len(points.x), dtype=np.int32))

    def _is_within(self, claim: Claim) -> NDArray[np.bool_]:
        """(m,) whether the occupied voxels are within a plane's tolerance and rectangle."""
        slab, bounds = claim
        within = np.ones(len(self.left), dtype=bool)
        for row in range(3):
            axis = self.basis @ slab[4 * row : 4 * row + 3]
            shift = slab[4 * row + 3] - float(axis @ self.middle_m)
            along_m = axis.astype(np.float32) @ self.middles_m
            # A voxel that the plane runs through holds points of it, however large it is.
            half_m = 0.5 * self.voxel_m * float(np.abs(axis).sum())
            reach_m = max(bounds[0], half_m)
            low_m = -reach_m if row == 0 else bounds[2 * row - 1] - half_m
            high_m = reach_m if row == 0 else bounds[2 * row] + half_m
            within &= (along_m >= shift + low_m) & (along_m <= shift + high_m)
        return within


_NO_TABLE: Final = (np.zeros(0, dtype=np.int32), np.zeros((0, 0), dtype=np.int32))


def _counted(
    points: BlockedPoints, frame: NDArray[np.float32], shape: tuple[int, int, int]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Row of each brick, -1 for none, and (rows, voxels) points, of one part of the pass."""
    from orthoflow_plugins.plane.kernels import BLOCK_POINTS
    from orthoflow_plugins.plane.voxel_kernels import VOXELS, count_voxels, with_room

    bricks = np.full(math.prod(shape), -1, dtype=np.int32)
    counts = np.zeros((_ROWS_FIRST, VOXELS), dtype=np.int32)
    n_used, start = np.zeros(1, dtype=np.int64), 0
    while start < len(points.x):
        counts = with_room(counts, int(n_used[0]), BLOCK_POINTS)
        start = count_voxels(points, start, frame, shape, bricks, counts, n_used)
    return bricks, counts
