"""The 3D Hough transform: voxels vote, each with its points, for all planes through them.

The directions asked about are even over the hemisphere. At phi = 90 degrees every omega is the same
plane: a table of omega by phi counts a floor 180 times. Here each circle of one phi has as many
directions as its length asks for, and the pole is there once.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.threads import in_threads
from orthoflow_plugins.plane.accumulators import VOTE_CAUTION, contrast, parabola
from orthoflow_plugins.plane.candidates import Candidate, Family
from orthoflow_plugins.plane.kernels import (
    BLOCK_POINTS,
    BlockedPoints,
    PlanGrid,
    each_part,
    piece_of,
    plan_frame,
)
from orthoflow_plugins.plane.sample import Claim, PreparedCloud, Unassigned
from orthoflow_plugins.plane.vote_kernels import VOTE_SHARES, best_bins, vote_planes, vote_tilts
from orthoflow_plugins.plane.voxel_kernels import (
    BRICK_SIDE,
    VOXELS,
    coarsened,
    count_voxels,
    voxel_places,
    with_room,
)

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


@dataclass(frozen=True, kw_only=True)
class SpaceVoting:
    """How voxels vote.

    Attributes:
        cell_m: side of a voxel and width of a bin.
        angle_step_deg: step between directions.
        least_points: points that a plane needs.
        family: which planes are proposed.
        tilt_most_deg: how far they may be off vertical or level.
        is_raw: points of the sample vote with their own coordinates instead of the voxels.
    """

    cell_m: float
    angle_step_deg: float
    least_points: float
    family: Family = "any"
    tilt_most_deg: float
    is_raw: bool


class SpaceProposer:
    """Proposes planes from the maxima of a 3D accumulator.

    The accumulator is linear: when points are taken away, their voxels take their votes back,
    instead of all others voting again.

    Attributes:
        first_picture: the accumulator of the untouched cloud.
    """

    def __init__(self, cloud: PreparedCloud, voting: SpaceVoting) -> None:
        """Get ready to propose.

        Args:
            cloud: the cloud.
            voting: how its voxels vote.
        """
        self._voting = voting
        self._parts = cloud.parts
        self._points_per_vote = cloud.sample.n_represented if voting.is_raw else 1.0
        self._voxels = VoxelCounts(cloud, voting.cell_m)
        self._directions = directions_over(
            voting.angle_step_deg, voting.family, voting.tilt_most_deg
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
        self.first_picture: SpacePicture | None = None

    def propose(self, unassigned: Unassigned) -> Candidate | None:
        """Name the plane whose votes stand out most."""
        if self._voted_for != unassigned.n_points:
            self._vote(unassigned)
        self._score()
        direction = int(np.argmax(self._scores))
        score = float(self._scores[direction]) / VOTE_SHARES * self._points_per_vote
        if score < VOTE_CAUTION * self._voting.least_points:
            return None
        self._last = (direction, int(self._places[direction]))
        return self._refined(direction, score)

    def reject(self, candidate: Candidate) -> None:
        """Bar the surroundings of the last maximum."""
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

    def _vote(self, unassigned: Unassigned) -> None:
        changes = self._voxels.take(unassigned.taken)
        if self._voting.is_raw:
            self._votes[:] = 0
            self._add(self._voxels.raw_places(unassigned.free().points))
        elif self._voted_for < 0:
            self._add(Places(places_m=self._voxels.middles_m, weights=self._voxels.left))
        else:
            self._add(changes)
        self._voted_for = unassigned.n_points
        self._unscored = np.arange(len(self._votes))

    def _add(self, places: Places) -> None:
        extent = self._voxels.extent_m / self._bin_m
        shape = (math.ceil(extent[2]) + 2, math.ceil(math.hypot(extent[0], extent[1])) + 2)
        tasks = []
        starts = self._directions.starts
        for turns in np.array_split(np.arange(len(starts) - 1), self._parts):
            first, last = int(starts[turns[0]]), int(starts[turns[-1] + 1])
            tasks.append(
                partial(
                    vote_planes,
                    places.places_m,
                    places.weights,
                    self._directions.angles_rad[first:last],
                    starts[turns[0] : turns[-1] + 2] - first,
                    np.zeros(shape, dtype=np.int32),
                    self._bin_m,
                    self._votes[first:last],
                )
            )
        in_threads(tasks)

    def _vote_tilts(
        self,
        local: NDArray[np.float32],
        weights: NDArray[np.int32],
        slopes: NDArray[np.float64],
        low_m: float,
        fine: NDArray[np.int64],
    ) -> None:
        """Let voxels near a plane vote for those that lean a little from it, in half bins."""
        parts, bin_m = self._parts, 0.5 * self._bin_m
        shares = zip(np.array_split(slopes, parts), np.array_split(fine, parts), strict=True)
        in_threads(
            [
                partial(vote_tilts, local, weights, some, low_m, bin_m, table)
                for some, table in shares
            ]
        )

    def _score(self) -> None:
        """Find the best bin of each direction whose votes or bars changed."""
        tasks = []
        rows = self._unscored
        edges = np.linspace(0, len(rows), self._parts + 1).astype(int)
        for first, last in itertools.pairwise(edges):
            tasks.append(
                partial(
                    best_bins,
                    self._votes,
                    rows[first:last],
                    self._smear_bins,
                    self._barred,
                    self._scores,
                    self._places,
                )
            )
        in_threads(tasks)
        self._unscored = rows[:0]
        if self.first_picture is None:
            self.first_picture = pictured(
                self._directions, self._votes, self._scores / VOTE_SHARES, bin_m=self._bin_m
            )

    def _refined(self, direction: int, score: float) -> Candidate:
        """Look around a maximum with finer slopes and half bins, with the voxels near it."""
        place = int(self._places[direction])
        normal = self._directions.normals[direction]
        up = np.array([0.0, 0.0, 1.0])
        axes = wall_axes(normal, up)
        distance_m = (place + 0.5 - 0.5 * self._votes.shape[1]) * self._bin_m
        reach_m = (self._smear_bins + 3) * self._bin_m
        half_m = 0.5 * float(np.linalg.norm(self._voxels.extent_m))
        near = self._voxels.near(normal, distance_m, reach_m + self._directions.step_rad * half_m)
        local = np.vstack([axes, normal]).astype(np.float32) @ near.places_m
        local[2] -= np.float32(distance_m)
        middle = np.median(local[:2], axis=1) if local.size else np.zeros(2)
        local[:2] -= middle[:, None].astype(np.float32)
        bin_m = 0.5 * self._bin_m
        best = np.zeros(2)
        for steps in _FINE_STEPS:
            slopes = best + self._directions.step_rad * np.array(
                [(a, b) for a in steps for b in steps]
            )
            fine = np.zeros((len(slopes), 4 * (self._smear_bins + 3)), dtype=np.int64)
            self._vote_tilts(local, near.weights, slopes, -reach_m, fine)
            scores = contrast(fine, 1)
            row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
            best = slopes[row]
        shift = parabola(scores[row], int(column))
        height_m = -reach_m + (column + 0.5 + shift) * bin_m
        tilted = normal - best @ axes
        point = (distance_m + height_m) * normal + middle @ axes + self._voxels.middle_m
        world = tilted / np.linalg.norm(tilted) @ self._voxels.basis
        world = world / np.linalg.norm(world)
        return Candidate(
            plane=Plane(normal=world, offset_m=float(world @ (point @ self._voxels.basis))),
            family=self._voting.family,
            votes=score,
        )


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


def directions_over(step_deg: float, family: Family, tilt_most_deg: float) -> Directions:
    """Cover the hemisphere, or the part of it that a family of planes needs."""
    n_turns = round(180.0 / step_deg)
    step_rad = math.pi / n_turns
    phis = -0.5 * math.pi + step_rad * np.arange(1, n_turns + 1)
    limit_rad = math.radians(tilt_most_deg) + step_rad
    if family == "wall":
        phis = phis[np.abs(phis) <= limit_rad]
    elif family == "level":
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
    omega, phi = angles[:, 0], angles[:, 1]
    normals = np.column_stack(
        [np.cos(phi) * np.cos(omega), np.cos(phi) * np.sin(omega), np.sin(phi)]
    )
    return Directions(
        angles_rad=angles,
        starts=np.array(starts, dtype=np.int64),
        normals=normals,
        step_rad=step_rad,
    )


@dataclass(frozen=True, kw_only=True)
class SpacePicture:
    """What an accumulator held.

    Attributes:
        best: (o, p) best contrast of any distance, over omega 0..180 and phi -90..90 degrees; NaN
            where no direction of that phi was asked about.
        over_omega: (3, o, d) votes over omega and distance, for each phi of `sections_deg`; NaN
            where no direction was asked about.
        over_phi: (3, p, d) votes over phi and distance, for each omega of `sections_deg`.
        sections_deg: where it was cut.
        reach_m: distances run from minus this to this, from the middle of the scene's box.
    """

    best: NDArray[np.float64]
    over_omega: NDArray[np.float64]
    over_phi: NDArray[np.float64]
    sections_deg: tuple[float, ...]
    reach_m: float


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
        scores: (d,) best contrast of each direction.
        bin_m: width of a bin of distances.
    """
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


@dataclass(frozen=True, kw_only=True)
class Places:
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
        grid = cloud.grid
        self.basis = grid.basis
        self.extent_m = np.array(grid.shape) * grid.cell_m
        self.voxel_m = coarsened(voxel_m, self.extent_m)
        self.middle_m = grid.low_m + 0.5 * self.extent_m
        a, b, c = np.ceil(self.extent_m / (BRICK_SIDE * self.voxel_m)).astype(int).tolist()
        shape = (a, b, c)
        self._low_m = grid.low_m
        self._frame = plan_frame(
            PlanGrid(basis=grid.basis, low_m=grid.low_m, cell_m=self.voxel_m, shape=shape)
        )
        tables = [_Table(int(np.prod(shape))) for _ in range(cloud.parts)]

        def count(part: int, piece: slice) -> None:
            tables[part].gather(piece_of(cloud.points, piece), self._frame, shape)

        each_part(len(cloud.claims), cloud.parts, count)
        bricks = np.max([table.bricks for table in tables], axis=0) >= 0
        counts = np.zeros((np.count_nonzero(bricks), VOXELS), dtype=np.int32)
        for table in tables:
            rows = table.bricks[bricks]
            counts[rows >= 0] += table.counts[rows[rows >= 0]]
        occupied = counts != 0
        self.left = counts[occupied]
        self.middles_m = self._middles_m(voxel_places(bricks.reshape(shape), occupied))
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
        return Places(places_m=np.take(self.middles_m, index, axis=1), weights=weights)

    def near(self, axis: NDArray[np.float64], distance_m: float, reach_m: float) -> Places:
        """Voxels with points left whose middle is near a plane of the box's frame."""
        heights = axis.astype(np.float32) @ self.middles_m - np.float32(distance_m)
        index = np.flatnonzero((np.abs(heights) < reach_m) & (self.left > 0))
        return Places(places_m=self.middles_m[:, index], weights=self.left[index])

    def _middles_m(self, places: NDArray[np.int32]) -> NDArray[np.float32]:
        middles_m = np.empty((3, len(places)), dtype=np.float32)
        for axis in range(3):
            shift_m = self._low_m[axis] - self.middle_m[axis]
            middles_m[axis] = (places[:, axis] + 0.5) * self.voxel_m + shift_m
        return middles_m

    def _is_within(self, claim: Claim) -> NDArray[np.bool_]:
        """(m,) whether the occupied voxels are within a plane's tolerance and rectangle."""
        slab, bounds = claim.slab, claim.bounds_m
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

    def raw_places(self, points: BlockedPoints) -> Places:
        """Points with their own coordinates, and one vote each."""
        places_m = np.empty((3, len(points.x)), dtype=np.float32)
        for row, (axis, middle) in enumerate(zip(self.basis, self.middle_m, strict=True)):
            a, b, c = axis.astype(np.float32)
            places_m[row] = a * points.x + b * points.y + c * points.z - np.float32(middle)
        return Places(places_m=places_m, weights=np.ones(len(points.x), dtype=np.int32))


class _Table:
    """Bricks as one part of the pass met them."""

    def __init__(self, n_bricks: int) -> None:
        self.bricks = np.full(n_bricks, -1, dtype=np.int32)
        self.counts = np.zeros((_ROWS_FIRST, VOXELS), dtype=np.int32)
        self._n_used = np.zeros(1, dtype=np.int64)

    def gather(
        self, points: BlockedPoints, frame: NDArray[np.float32], shape: tuple[int, int, int]
    ) -> None:
        """Count points, with more room whenever the table is full."""
        start = 0
        while start < len(points.x):
            self.counts = with_room(self.counts, int(self._n_used[0]), BLOCK_POINTS)
            start = count_voxels(
                points, start, frame, shape, self.bricks, self.counts, self._n_used
            )


def _section(
    directions: Directions,
    votes: NDArray[np.int32],
    omega: ArrayLike,
    phi: ArrayLike,
) -> NDArray[np.float64]:
    """(n, b) votes for each of n directions, those of the nearest one that was asked about."""
    omegas, phis = np.broadcast_arrays(np.asarray(omega, dtype=float), np.asarray(phi, dtype=float))
    wanted = np.stack([np.cos(phis) * np.cos(omegas), np.cos(phis) * np.sin(omegas), np.sin(phis)])
    cosines = directions.normals @ wanted
    nearest = np.abs(cosines).argmax(axis=0)
    cosine = cosines[nearest, np.arange(len(nearest))]
    section: NDArray[np.float64] = votes[nearest].astype(np.float64)
    # On the other side of the hemisphere distances count the other way.
    section[cosine < 0.0] = section[cosine < 0.0, ::-1]
    section[np.abs(cosine) < math.cos(_STANDS_FOR_STEPS * directions.step_rad)] = np.nan
    return section
