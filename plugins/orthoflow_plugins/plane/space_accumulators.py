"""The 3D Hough transform: voxels vote, each with its points, for all planes through them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.shear_kernels import VOTE_SHARES
from orthoflow.geometry.threads import in_threads
from orthoflow.geometry.voxel_kernels import best_bins, vote_planes, vote_tilts
from orthoflow_plugins.plane.accumulators import contrast, parabola
from orthoflow_plugins.plane.candidates import Candidate, Family
from orthoflow_plugins.plane.remainders import Remainder
from orthoflow_plugins.plane.space_directions import directions_over
from orthoflow_plugins.plane.space_figures import SpacePicture, pictured
from orthoflow_plugins.plane.voxels import Places, VoxelCounts

# A candidate's votes may fall short of the share a plane needs by this much: it may be smeared over
# several bins until it is refined.
_VOTE_CAUTION: Final = 0.25
_NOT_AGAIN_STEPS: Final = 2.2
# Slopes tried around a maximum, in steps between directions: first these, then closer ones.
_FINE_STEPS: Final = ((-1.0, -0.5, 0.0, 0.5, 1.0), (-0.4, -0.2, 0.0, 0.2, 0.4))
# More entries than this of all tables together cost more memory than they show; bins grow instead.
_TABLE_MOST: Final = 120_000_000


@dataclass(frozen=True, kw_only=True)
class SpaceVoting:
    """How voxels vote.

    Attributes:
        cell_m: side of a voxel and width of a bin.
        angle_step_deg: step between directions.
        least_points: points that a plane needs.
        family: which planes are proposed.
        tilt_most_deg: how far they may be off vertical or level.
        is_raw: every point votes with its own coordinates instead of its voxel.
    """

    cell_m: float
    angle_step_deg: float
    least_points: float
    family: Family = "any"
    tilt_most_deg: float = 10.0
    is_raw: bool = False


class SpaceProposer:
    """Proposes planes from the maxima of a 3D accumulator.

    The accumulator is linear: when points are taken away, their voxels take their votes back,
    instead of all others voting again.

    Attributes:
        first_picture: the accumulator of the untouched cloud.
    """

    def __init__(self, remainder: Remainder, voting: SpaceVoting) -> None:
        """Get ready to propose.

        Args:
            remainder: the cloud.
            voting: how its voxels vote.
        """
        self._voting = voting
        self._whole = remainder
        self._voxels = VoxelCounts(remainder, voting.cell_m)
        self._directions = directions_over(
            voting.angle_step_deg, voting.family, voting.tilt_most_deg
        )
        half_m = 0.5 * float(np.linalg.norm(self._voxels.extent_m))
        n_rows = len(self._directions.normals)
        self._bin_m = max(self._voxels.cell_m, 2.0 * half_m * n_rows / _TABLE_MOST)
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

    def propose(self, remainder: Remainder) -> Candidate | None:
        """Name the plane whose votes stand out most."""
        if self._voted_for != remainder.n_unclaimed:
            self._vote(remainder)
        if len(self._unscored):
            self._score(remainder.parts)
        direction = int(np.argmax(self._scores))
        score = float(self._scores[direction]) / VOTE_SHARES
        if score < _VOTE_CAUTION * self._voting.least_points:
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

    def _vote(self, remainder: Remainder) -> None:
        changes = self._voxels.take(remainder.takings)
        if self._voting.is_raw:
            self._whole.catch_up(remainder)
            self._votes[:] = 0
            self._add(self._voxels.raw_places(self._whole), remainder.parts)
        elif self._voted_for < 0:
            places = Places(places_m=self._voxels.middles_m, weights=self._voxels.left)
            self._add(places, remainder.parts)
        else:
            self._add(changes, remainder.parts)
        self._voted_for = remainder.n_unclaimed
        self._unscored = np.arange(len(self._votes))

    def _add(self, places: Places, parts: int) -> None:
        extent = self._voxels.extent_m / self._bin_m
        shape = (math.ceil(extent[2]) + 2, math.ceil(math.hypot(extent[0], extent[1])) + 2)
        tasks = []
        starts = self._directions.starts
        for turns in np.array_split(np.arange(len(starts) - 1), parts):
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
        parts, bin_m = self._whole.parts, 0.5 * self._bin_m
        shares = zip(np.array_split(slopes, parts), np.array_split(fine, parts), strict=True)
        in_threads(
            [
                partial(vote_tilts, local, weights, some, low_m, bin_m, table)
                for some, table in shares
            ]
        )

    def _score(self, parts: int) -> None:
        """Find the best bin of each direction whose votes or bars changed."""
        tasks = []
        rows = self._unscored
        for first, last in itertools.pairwise(np.linspace(0, len(rows), parts + 1).astype(int)):
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
            support=score,
        )
