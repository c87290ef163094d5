"""Hough transform of `plane.hough2d` and `plane.hough3d`: positions vote for planes.

The points of the sample are counted in cells. Each cell votes for the planes through it: for each
direction of the normal, it votes for the bin that contains its distance. The 2D transform of
markiewicz2015 is the special case of horizontal normals and cells without height. Floors and
ceilings are found with the vertical normal as the only direction.

Votes are additive: after points have been removed, only the cells that lost points vote again, with
the change in their numbers of votes.

For each horizontal direction, the cells are counted in a vertical image whose axes are the distance
along this direction and the height. The occupied pixels of this image, which are far fewer than the
cells in space, then vote for all inclinations.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.threads import in_threads
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.figures import draw_accumulator, draw_sections, draw_space
from orthoflow_plugins.plane.proposing import Accumulator, Candidate, Constraint, Proposer
from orthoflow_plugins.plane.search import Search

# Minimum number of votes for a candidate, as a share of the required number of points. It is low
# because votes may be distributed over several bins until the candidate is refined.
_VOTE_CAUTION: Final = 0.25
# Angles as multiples of the angle between neighbouring directions. After a candidate has been
# rejected, directions within _NOT_AGAIN_STEPS are excluded near its distance. In sections,
# directions within _STANDS_FOR_STEPS represent each other.
_NOT_AGAIN_STEPS: Final = 2.2
_STANDS_FOR_STEPS: Final = 1.5
# Slopes tested around a maximum, in steps between directions, and factors by which they are reduced
# in successive rounds.
_SLOPES: Final = (-1.0, -0.5, 0.0, 0.5, 1.0)
_FINER: Final = (1.0, 0.4, 0.15)
# Maximum number of entries in the table of votes, and of pixels in the vertical image. For larger
# scenes, cells and bins are larger.
_TABLE_MOST: Final = 120_000_000
_IMAGE_MOST: Final = 4_000_000
# Thresholds of the edge detector, for the 8-bit density image.
_EDGE_LOW: Final = 60
_EDGE_HIGH: Final = 160
# Angles, in degrees, of the sections of the accumulator in Figure 13 of markiewicz2015.
_CUTS_DEG: Final = (0.0, 45.0, 90.0)
# Result of `sections_of`: best scores, sections over omega and over phi, and maximum distance.
Sections = tuple[
    NDArray[np.float64], dict[float, NDArray[np.float64]], dict[float, NDArray[np.float64]], float
]


# A group of normals: factors for the coordinates of points, angles, orientation of the planes, and
# rule for the votes of a cell.
Group = tuple[NDArray[np.float64], NDArray[np.float64], Constraint, Accumulator]


class Voters:
    """Positions that vote for the planes with some normals.

    Attributes:
        positions_m: (3, m) float32 e1, e2 and height from the centre of the box.
        votes: (m,) int64 current number of votes of each position.
        angles_rad: (d, 2) omega and phi of the normals, grouped by omega.
        constraint: orientation to which the planes are restricted.
        slopes: (k, 2) slopes along u and v of the plane that are tested around a maximum.
        smear_bins: number of bins on each side of a maximum over which the votes for a plane are
            distributed.
    """

    def __init__(
        self,
        points_m: NDArray[np.float64],
        bin_m: float,
        angles_rad: NDArray[np.float64],
        step_rad: float,
        constraint: Constraint,
        accumulator: Accumulator | Literal["raw"],
    ) -> None:
        """Count the sample points in each cell.

        Args:
            points_m: (s, 3) points of the sample relative to the centre of the box; NaN outside the
                box.
            bin_m: side of a cell.
            angles_rad: see `Voters`.
            step_rad: angle between neighbouring normals.
            constraint: see `Voters`.
            accumulator: rule for the votes of a cell; with `raw`, points vote instead of cells.
        """
        self.angles_rad, self.constraint, self._accumulator = angles_rad, constraint, accumulator
        inside = np.isfinite(points_m[:, 0])
        positions_m: NDArray[np.float64] = points_m[inside]
        self._position_of_point = np.full(len(points_m), -1)
        number = np.arange(len(positions_m))
        if accumulator != "raw":
            self._cells = np.floor(positions_m / bin_m).astype(np.int64)
            keys = (self._cells + 2**20) @ np.array([2**42, 2**21, 1])
            _, first, number = np.unique(keys, return_index=True, return_inverse=True)
            self._cells = self._cells[first]
            positions_m = np.asarray((self._cells + 0.5) * bin_m, dtype=np.float64)
        self._position_of_point[inside] = number
        self.positions_m = np.ascontiguousarray(positions_m.T, dtype=np.float32)
        self.votes = np.zeros(len(positions_m), dtype=np.int64)
        # A single normal is not refined, and horizontal normals are refined only about the vertical
        # axis.
        is_turned = (len(angles_rad) > 1, bool(angles_rad[:-1, 1].any()))
        slopes = (step_rad * np.array(_SLOPES if turned else (0.0,)) for turned in is_turned)
        self.slopes = np.stack(np.meshgrid(*slopes), axis=-1).reshape(-1, 2)
        # If the normal is wrong by half a step, the ends of a plane are in other bins than its
        # centre.
        reach_m = float(np.linalg.norm(positions_m, axis=1).max(initial=0.0))
        self.smear_bins = max(1, round(0.3 * reach_m * float(self.slopes.max()) / bin_m))

    def recount(self, is_free: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Count the points of the sample that are not yet assigned to a plane.

        Returns:
            The positions (3, k) whose votes have changed, and the changes (k,).
        """
        free = self._position_of_point[is_free & (self._position_of_point >= 0)]
        counts = np.bincount(free, minlength=len(self.votes))
        change = self._votes_of(counts) - self.votes
        self.votes += change
        index = np.flatnonzero(change)
        return np.take(self.positions_m, index, axis=1), change[index].astype(np.int32)

    def _votes_of(self, counts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers of votes (m,) of positions, given their numbers of points (m,).

        If each cell has one vote, votes are multiplied by the mean number of points per cell, so
        that they can be compared with the votes for heights, which are numbers of points.
        """
        if self._accumulator in {"counts", "raw"}:
            return counts
        chosen = counts > 0
        if self._accumulator == "canny":
            import cv2

            row, column = (self._cells - self._cells.min(axis=0)).T[:2]
            # The density image contains the logarithms of the numbers of points.
            grey = np.zeros((row.max() + 1, column.max() + 1))
            grey[row, column] = np.log1p(counts)
            scaled = np.rint(255.0 * grey / max(float(grey.max()), 1e-9)).astype(np.uint8)
            chosen &= cv2.Canny(scaled, _EDGE_LOW, _EDGE_HIGH)[row, column] > 0
        mean = float(counts[chosen].mean()) if chosen.any() else 1.0
        return chosen * np.int64(max(1, round(mean)))


# The type of `params` is Any, because `Hough2d.Params` and `Hough3d.Params` are in modules that
# import this one.
class HoughProposer(Proposer):
    """Proposes planes at the maxima of an accumulator.

    Attributes:
        bin_m: width of a distance bin and side of a cell.
        votes: (d, bins) votes for each direction and distance; the middle edge of the bins is the
            distance of the centre of the box.
    """

    def __init__(
        self,
        search: Search,
        params: Any,
        cell_m: float,
        step_rad: float,
        *groups: Group,
    ) -> None:
        """Count the sample points in each cell; votes are computed by `propose`.

        Args:
            search: the search.
            params: parameters of the method.
            cell_m: side of a cell; it is increased if the scene would need too many cells.
            step_rad: angle between neighbouring normals.
            groups: groups of normals (see `Group`).
        """
        cloud = search.cloud
        self._basis, self._parts, self._step_rad = cloud.basis, cloud.parts, step_rad
        self._params, self._is_plain = params, params.scoring == "votes"
        self._middle_m = cloud.low_m + 0.5 * cloud.extent_m
        self._half_m = 0.5 * float(np.linalg.norm(cloud.extent_m))
        self._points_m = cloud.sample.offsets_m @ cloud.basis.T - self._middle_m
        self._points_m[(np.abs(self._points_m) >= 0.5 * cloud.extent_m).any(axis=1)] = np.nan
        angles = np.concatenate([group[1] for group in groups])
        image_m2 = float(cloud.extent_m[2] * np.hypot(*cloud.extent_m[:2]))
        table_m = 2.0 * self._half_m * len(angles)
        self.bin_m = max(cell_m, math.sqrt(image_m2 / _IMAGE_MOST), table_m / _TABLE_MOST)
        self._voters = [
            Voters(
                self._points_m * factors,
                self.bin_m,
                own_angles,
                step_rad,
                constraint,
                "raw" if params.coordinates == "raw" else accumulator,
            )
            for factors, own_angles, constraint, accumulator in groups
        ]
        self._edges = np.cumsum([0, *(len(own.angles_rad) for own in self._voters)])
        self._group = np.repeat(np.arange(len(groups)), np.diff(self._edges))
        self._normals = normals_of(*angles.T)
        shape = (len(angles), 2 * (math.ceil(self._half_m / self.bin_m) + 1))
        self.votes = np.zeros(shape, dtype=np.int32)
        self._barred = np.zeros(shape, dtype=np.uint8)
        self._scores, self._places = np.zeros((2, len(angles)), dtype=np.int64)
        self._unscored = np.arange(len(angles))
        self._voted_for, self._last = -1, (0, 0)

    def keep_first(self) -> None:
        """Keep the votes before any plane is removed, for drawing."""

    def propose(self, search: Search) -> Candidate | None:
        """Return the plane with the best score."""
        if self._voted_for != search.n_points:
            self._vote(search)
        self._score()
        if self._voted_for < 0:
            self.keep_first()
        self._voted_for = search.n_points
        row = int(np.argmax(self._scores))
        if self._scores[row] < _VOTE_CAUTION * search.least_points:
            return None
        self._last = row, int(self._places[row])
        normal = self._normals[row]
        distance_m = (self._last[1] + 0.5 - 0.5 * self.votes.shape[1]) * self.bin_m
        point = distance_m * normal
        if not self._is_plain:
            normal, point = self._refined(row, distance_m)
        # Transform from the frame of the box to offsets, and normalise again because of rounding.
        world = normal / np.linalg.norm(normal) @ self._basis
        world = world / np.linalg.norm(world)
        offset_m = float(world @ ((point + self._middle_m) @ self._basis))
        constraint = self._voters[self._group[row]].constraint
        return Candidate(plane=Plane(normal=world, offset_m=offset_m), constraint=constraint)

    def reject(self) -> None:
        """Exclude the last maximum and its neighbourhood."""
        row, place = self._last
        cosines = self._normals @ self._normals[row]
        reach, n_bins = self._voters[self._group[row]].smear_bins + 1, self.votes.shape[1]
        near = np.abs(cosines) > math.cos(_NOT_AGAIN_STEPS * self._step_rad)
        self._unscored = np.flatnonzero(near & (self._group == self._group[row]))
        for other in self._unscored:
            # If a normal has the opposite direction, distances change sign.
            middle = place if cosines[other] > 0.0 else n_bins - 1 - place
            self._barred[other, max(0, middle - reach) : middle + reach + 1] = 1

    def _vote(self, search: Search) -> None:
        tasks = []
        for group, voters in enumerate(self._voters):
            positions_m, change = voters.recount(search.is_free)
            reach = np.abs(voters.positions_m).max(axis=1, initial=0.0) / self.bin_m
            # Use even numbers, so that the centre of the box is between two pixels.
            shape = 2 * np.ceil([reach[2], math.hypot(reach[0], reach[1])]).astype(int) + 2
            angles, votes = voters.angles_rad, self.votes[self._edges[group] :]
            edges = np.flatnonzero(np.diff(angles[:, 0], prepend=-1.0, append=-1.0))
            for part in np.array_split(np.arange(len(edges) - 1), self._parts):
                if not len(part):
                    continue
                first, end = edges[part[0]], edges[part[-1] + 1]
                own = (angles[first:end], edges[part[0] : part[-1] + 2] - first)
                image = np.zeros(shape, dtype=np.int32)
                arguments = (positions_m, change, *own, image, self.bin_m, votes[first:end])
                tasks.append(partial(vote_planes, *arguments))
        in_threads(tasks, threads=self._parts)
        self._unscored = np.arange(len(self.votes))

    def _score(self) -> None:
        tasks, tables = [], (self._barred, self._scores, self._places)
        for group, voters in enumerate(self._voters):
            half = 0 if self._is_plain else voters.smear_bins
            rows = self._unscored[self._group[self._unscored] == group]
            score = partial(best_bins, self.votes)
            tasks += [
                partial(score, own, half, self._is_plain, *tables)
                for own in np.array_split(rows, self._parts)
            ]
        in_threads(tasks, threads=self._parts)
        self._unscored = self._unscored[:0]

    def _refined(
        self, row: int, distance_m: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Refine a maximum with finer slopes and half-width bins, using the positions near it.

        The function returns a normal, which is not a unit vector, and a point relative to the
        centre of the box.
        """
        voters, normal = self._voters[self._group[row]], self._normals[row]
        axes = wall_axes(normal, np.array([0.0, 0.0, 1.0]))
        n_reach, bin_m = voters.smear_bins + 3, 0.5 * self.bin_m
        reach_m = n_reach * self.bin_m
        local = np.vstack([axes, normal]).astype(np.float32) @ voters.positions_m
        local[2] -= np.float32(distance_m)
        near = np.abs(local[2]) < reach_m + self._step_rad * self._half_m
        index = np.flatnonzero(near & (voters.votes > 0))
        local, weights = np.take(local, index, axis=1), voters.votes[index].astype(np.int32)
        middle = np.median(local[:2], axis=1) if local.size else np.zeros(2)
        local[:2] -= middle[:, None].astype(np.float32)
        best, place = np.zeros(2), 0.0
        for finer in _FINER:
            slopes = best + finer * voters.slopes
            normals = np.column_stack([-slopes, np.ones(len(slopes))])
            votes = np.zeros((len(slopes), 4 * n_reach), dtype=np.int32)
            vote_places(local, weights, normals, -reach_m, bin_m, votes)
            chosen, place = sharpest(votes)
            best = slopes[chosen]
        height_m = place * bin_m - reach_m
        return normal - best @ axes, (distance_m + height_m) * normal + middle @ axes


class PlanProposer(HoughProposer):
    """Proposes walls from the votes of plan cells, and horizontal planes from those of heights.

    Attributes:
        first: (angles, bins) votes for walls before any plane was removed; None if only horizontal
            planes are searched for.
    """

    first: NDArray[np.int32] | None = None

    def __init__(self, search: Search, params: Any) -> None:
        """Count the sample points in each cell of the plan and in each bin of height."""
        n_turns = round(180.0 / params.angle_step_deg)
        step_rad = math.pi / n_turns
        walls = np.column_stack([step_rad * np.arange(n_turns), np.zeros(n_turns)])
        in_plan, above = np.array([1.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
        level = np.array([[0.0, 0.5 * math.pi]])
        groups: list[Group] = [
            (in_plan, walls, "vertical", params.accumulator),
            (above, level, "horizontal", "counts"),
        ]
        if params.constraint != "any":
            groups = [group for group in groups if group[2] == params.constraint]
        super().__init__(search, params, params.cell_m, step_rad, *groups)

    def keep_first(self) -> None:
        """Keep the votes for walls, for drawing."""
        if self._voters[0].constraint == "vertical":
            self.first = self.votes[: len(self._voters[0].angles_rad)].copy()

    def draw(self, ctx: StepContext, planes: Planes, cloud: PointCloud) -> None:
        """Draw the plan and the votes for lines."""
        if self.first is not None:
            points_m, centre_m = self._points_m[:, :2], self._middle_m[:2]
            draw_accumulator(ctx, points_m, self.first, centre_m, self.bin_m, planes, cloud)


class SpaceProposer(HoughProposer):
    """Proposes planes of any orientation at maxima of the votes of voxels."""

    def __init__(self, search: Search, params: Any) -> None:
        """Count the sample points in each voxel."""
        coarser = 1.0 if params.search == "full" else 2.0
        n_turns = round(180.0 / (coarser * params.angle_step_deg))
        step_rad = math.pi / n_turns
        angles = directions_over(n_turns, params.constraint, params.max_tilt_deg)
        group: Group = (np.ones(3), angles, params.constraint, "counts")
        super().__init__(search, params, coarser * params.cell_m, step_rad, group)

    def keep_first(self) -> None:
        """Keep sections of the accumulator, for drawing."""
        angles_rad = self._voters[0].angles_rad
        self._sections = sections_of(
            angles_rad, self._step_rad, self.votes, self._scores, self.bin_m
        )

    def draw(self, ctx: StepContext, planes: Planes, cloud: PointCloud) -> None:
        """Draw sections of the accumulator and of the voxels."""
        draw_space(ctx, *self._sections, planes)
        draw_sections(ctx, planes, cloud, cell_m=self._params.cell_m)


def directions_over(
    n_turns: int, constraint: Constraint, max_tilt_deg: float
) -> NDArray[np.float64]:
    """Return directions that are evenly distributed over the hemisphere or the required part of it.

    At phi = 90 degrees, all values of omega describe the same plane, so a regular table would
    contain a floor once for each omega. Here, the number of directions for each phi is proportional
    to cos(phi), and the pole occurs only once.

    Args:
        n_turns: number of steps between directions in half a turn.
        constraint: orientation to which the planes are restricted.
        max_tilt_deg: maximum deviation from `constraint`.

    Returns:
        (d, 2) with the columns omega, 0 to pi, and phi, -pi/2 to pi/2; grouped by omega.
    """
    step_rad = math.pi / n_turns
    phis = -0.5 * math.pi + step_rad * np.arange(1, n_turns + 1)
    limit_rad = math.radians(max_tilt_deg) + step_rad
    if constraint == "vertical":
        phis = phis[np.abs(phis) <= limit_rad]
    elif constraint == "horizontal":
        phis = phis[0.5 * math.pi - np.abs(phis) <= limit_rad]
    # The last phi is the pole. Its cosine is zero except for rounding, so the pole has a single
    # omega.
    n_around = np.maximum(1, np.ceil(n_turns * np.cos(phis) - 1e-9)).astype(np.int64)
    turns = np.arange(n_turns)[:, None]
    begins = turns * n_around // n_turns != (turns - 1) * n_around // n_turns
    turn, place = np.nonzero(begins)
    return np.column_stack([turn * step_rad, phis[place]])


def normals_of(omega: ArrayLike, phi: ArrayLike) -> NDArray[np.float64]:
    """Return the unit vectors (n, 3) of angles, by Equation 3 of markiewicz2015."""
    omega, phi = np.broadcast_arrays(np.asarray(omega, dtype=float), np.asarray(phi, dtype=float))
    level = np.cos(phi)
    return np.stack([level * np.cos(omega), level * np.sin(omega), np.sin(phi)], axis=1)


def sections_of(
    angles_rad: NDArray[np.float64],
    step_rad: float,
    votes: NDArray[np.int32],
    scores: NDArray[np.int64],
    bin_m: float,
) -> Sections:
    """Return sections of an accumulator.

    Args:
        angles_rad: (d, 2) omega and phi of the directions.
        step_rad: angle between neighbouring directions.
        votes: (d, b) votes for each direction and distance.
        scores: (d,) best score of each direction.
        bin_m: width of a distance bin.

    Returns:
        Four values: the best scores (o, p) over all distances, for each omega (0 to 180 degrees)
        and phi (-90 to 90 degrees); sections at a constant phi, by phi in degrees, with the votes
        for each omega and distance; sections at a constant omega, by omega in degrees, with the
        votes for each phi and distance; and the maximum distance on each side. Values for which
        there is no direction are NaN.
    """
    n_turns = round(math.pi / step_rad)
    best = np.full((n_turns, n_turns + 1), np.nan)
    row, column = np.rint((angles_rad + np.array([0.0, 0.5 * math.pi])) / step_rad).astype(int).T
    best[row, column] = scores
    # A direction also represents the larger values of omega, up to the next direction with the same
    # phi.
    last_asked = np.where(np.isnan(best), 0, np.arange(n_turns)[:, None])
    best = np.take_along_axis(best, np.maximum.accumulate(last_asked, axis=0), axis=0)
    omegas, phis = step_rad * np.arange(n_turns), step_rad * np.arange(n_turns + 1) - 0.5 * math.pi
    # Omit distances without any votes at both ends.
    n_bins, used = votes.shape[1], np.flatnonzero(votes.any(axis=0))
    beyond = int(min(used[0], n_bins - 1 - used[-1])) if len(used) else 0
    votes, normals = votes[:, beyond : n_bins - beyond], normals_of(*angles_rad.T)

    def section(omega: ArrayLike, phi: ArrayLike) -> NDArray[np.float64]:
        cosines = normals @ normals_of(omega, phi).T
        nearest = np.abs(cosines).argmax(axis=0)
        cosine = cosines[nearest, np.arange(len(nearest))]
        taken: NDArray[np.float64] = votes[nearest].astype(np.float64)
        # If a normal has the opposite direction, distances change sign.
        taken[cosine < 0.0] = taken[cosine < 0.0, ::-1]
        taken[np.abs(cosine) < math.cos(_STANDS_FOR_STEPS * step_rad)] = np.nan
        return taken

    over_omega = {cut: section(omegas, math.radians(cut)) for cut in _CUTS_DEG}
    over_phi = {cut: section(math.radians(cut), phis) for cut in _CUTS_DEG}
    return best, over_omega, over_phi, 0.5 * votes.shape[1] * bin_m


@kernel_part
def _vote(
    places: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    weights: NDArray[np.int32],
    normal: tuple[float, float, float],
    shift: float,
    bins: NDArray[np.int32],
    votes: NDArray[np.int32],
) -> None:
    """Add the votes of positions for the planes with a given normal.

    Args:
        places: coordinates (m,) of the positions along three axes.
        weights: (m,) votes of each position.
        normal: factors of the coordinates; the sum of the products is a distance in bins.
        shift: number of bins added to this sum.
        bins: (m,) scratch space.
        votes: (bins,) updated.
    """
    us, vs, heights = places
    a, b, c = np.float32(normal[0]), np.float32(normal[1]), np.float32(normal[2])
    zero, none, top, d = np.float32(0.0), np.int32(-1), np.float32(votes.size), np.float32(shift)
    # The loop has no branches, so that the compiler can vectorise it.
    for i in range(weights.size):
        place = c * heights[i] + a * us[i] + b * vs[i] + d
        within = (place >= zero) & (place < top)
        bins[i] = np.int32(place if within else zero) if within else none
    for i in range(weights.size):
        if bins[i] >= 0:
            votes[bins[i]] += weights[i]


@compiled
def vote_places(
    places: NDArray[np.float32],
    weights: NDArray[np.int32],
    normals: NDArray[np.float64],
    low_m: float,
    bin_m: float,
    votes: NDArray[np.int32],
) -> None:
    """Add the votes of positions for the planes with given normals.

    Args:
        places: (3, m) metres.
        weights: (m,) votes of each position.
        normals: (t, 3) normals, along which distances are measured, as in Equation 4 of
            markiewicz2015.
        low_m: lower edge of the first bin; positions outside the bins do not vote.
        bin_m: width of a bin.
        votes: (t, bins) updated.
    """
    bins = np.empty(places.shape[1], dtype=np.int32)
    rows = (places[0], places[1], places[2])
    for t in range(normals.shape[0]):
        normal = (normals[t, 0] / bin_m, normals[t, 1] / bin_m, normals[t, 2] / bin_m)
        _vote(rows, weights, normal, -low_m / bin_m, bins, votes[t])


@compiled
def vote_planes(
    places: NDArray[np.float32],
    weights: NDArray[np.int32],
    angles: NDArray[np.float64],
    starts: NDArray[np.int64],
    image: NDArray[np.int32],
    bin_m: float,
    votes: NDArray[np.int32],
) -> None:
    """Add the votes of positions for all planes through them, in two stages.

    For each horizontal direction, the positions are counted in a vertical image whose axes are the
    distance along this direction and the height. The occupied pixels of the image then vote for
    each phi.

    Args:
        places: (3, m) e1, e2 and height, metres from the centre of the box.
        weights: (m,) votes of each position; negative ones subtract votes.
        angles: (d, 2) omega and phi of each direction in radians, grouped by omega.
        starts: (o + 1,) index of the first direction of each omega.
        image: (rows, columns) scratch space, filled with zeros; its centre corresponds to the
            centre of the box.
        bin_m: side of a pixel of the image, and width of a bin.
        votes: (d, bins) updated; the middle edge of the bins is the distance 0.
    """
    n_places, (n_rows, n_columns) = weights.size, image.shape
    bins, counts = np.empty(n_places, dtype=np.int32), np.empty(n_places, dtype=np.int32)
    across = np.empty(n_places, dtype=np.float32)
    heights = np.empty(n_places, dtype=np.float32)
    for turn in range(starts.size - 1):
        omega = angles[starts[turn], 0]
        a, b = np.float32(math.cos(omega) / bin_m), np.float32(math.sin(omega) / bin_m)
        per_m = np.float32(1.0 / bin_m)
        half_rows, half_columns = np.float32(0.5 * n_rows), np.float32(0.5 * n_columns)
        for i in range(n_places):
            column = np.int32(a * places[0, i] + b * places[1, i] + half_columns)
            row = np.int32(places[2, i] * per_m + half_rows)
            bins[i] = row * np.int32(n_columns) + column
        flat = image.reshape(image.size)
        for i in range(n_places):
            flat[bins[i]] += weights[i]
        n_cells = 0
        for i in range(n_places):
            # The first position in a pixel collects all votes of the pixel.
            if flat[bins[i]] != 0:
                counts[n_cells] = flat[bins[i]]
                across[n_cells] = np.float32(bins[i] % n_columns) + np.float32(0.5) - half_columns
                heights[n_cells] = np.float32(bins[i] // n_columns) + np.float32(0.5) - half_rows
                flat[bins[i]] = 0
                n_cells += 1
        cells = (across[:n_cells], across[:n_cells], heights[:n_cells])
        for d in range(starts[turn], starts[turn + 1]):
            normal = (math.cos(angles[d, 1]), 0.0, math.sin(angles[d, 1]))
            _vote(cells, counts[:n_cells], normal, 0.5 * votes.shape[1], bins, votes[d])


@compiled
def best_bins(
    votes: NDArray[np.int32],
    rows: NDArray[np.int64],
    half: int,
    is_plain: bool,  # noqa: FBT001 - compiled code takes no keywords
    barred: NDArray[np.uint8],
    scores: NDArray[np.int64],
    places: NDArray[np.int64],
) -> None:
    """Find the window in each row whose votes most exceed those of the emptier adjacent window.

    Args:
        votes: (d, bins) votes for each direction and distance.
        rows: (m,) rows to search.
        half: a window has 2 half + 1 bins; one bin separates it from adjacent windows.
        is_plain: whether to ignore adjacent windows.
        barred: (d, bins) 1 for bins that must not be the centre of a window.
        scores: (d,) output for these rows: the largest excess.
        places: (d,) output for these rows: the middle bin of the window.
    """
    n_bins = votes.shape[1]
    width = 2 * half + 1
    gap = width + 1
    running = np.zeros(n_bins + 2 * (half + gap) + 1, dtype=np.int64)
    windows = np.empty(n_bins + 2 * gap, dtype=np.int64)
    line = np.empty(n_bins, dtype=np.int64)
    before, middle, after = windows[:n_bins], windows[gap:], windows[2 * gap :]
    # The loops are separate, so that the compiler can vectorise them.
    for d in rows:
        row, is_barred = votes[d], barred[d]
        total = np.int64(0)
        for k in range(n_bins):
            total += row[k]
            running[half + gap + 1 + k] = total
        running[half + gap + 1 + n_bins :] = total
        low, high = running[: windows.size], running[width:]
        for k in range(windows.size):
            windows[k] = high[k] - low[k]
        best = np.int64(-1)
        for k in range(n_bins):
            score = middle[k] - (np.int64(0) if is_plain else min(before[k], after[k]))
            line[k] = np.int64(-1) if is_barred[k] != 0 else score
        for k in range(n_bins):
            best = max(best, line[k])
        scores[d], places[d] = best, 0
        for k in range(n_bins):
            if best >= 0 and line[k] == best:
                places[d] = k
                break


def sharpest(votes: NDArray[np.int32]) -> tuple[int, float]:
    """Return the row of votes (rows, bins) with the best maximum, and its position in bins."""
    scores, places = np.zeros((2, len(votes)), dtype=np.int64)
    barred, is_plain = np.zeros(votes.shape, dtype=np.uint8), False
    best_bins(votes, np.arange(len(votes)), 1, is_plain, barred, scores, places)
    row = int(np.argmax(scores))
    place = int(places[row])
    # Compute the vertex of the parabola through the sums of three bins at the maximum and its
    # neighbours.
    padded = np.pad(votes[row].astype(np.float64), 2)
    before, here, after = np.convolve(padded[place : place + 5], np.ones(3), "valid")
    bend = before - 2.0 * here + after
    shift = 0.0 if bend >= 0.0 else float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))
    return row, place + 0.5 + shift
