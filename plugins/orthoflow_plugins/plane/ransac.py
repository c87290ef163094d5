"""`plane.ransac`: planes with the largest consensus in a sample, fitted to all points.

Three points drawn from an entire room are on the same small wall once in a million draws. The
sample is therefore ordered along a space-filling curve, and the points of a hypothesis are drawn
from one section of the curve. Its length is random too: short sections find small planes, long
sections determine large planes well.

The score of a hypothesis is computed from the distances of points.

- count (Max-Consensus): number of points within the tolerance.
- msac: a point within the tolerance counts 1 - (distance / tolerance)^2 (Torr and Zisserman 2000).
- a-contrario (AC-RANSAC): minus the logarithm of the number of false alarms, at the tolerance that
  minimises it, which is returned (Moisan and Stival 2004; Moisan, Moulon, Monasse 2012). The
  probability that a background point is within a distance of the plane is the share of the scene's
  box inside the slab.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from orthoflow.geometry import Plane
from orthoflow.geometry.rows import Rows
from orthoflow.geometry.threads import even_parts, in_threads
from orthoflow.sdk import Method, MetricSpec, StepContext
from orthoflow_plugins.plane.detector import (
    DETECTOR_METRICS,
    PAPER,
    Candidate,
    DetectorIn,
    DetectorOut,
    DetectorParams,
    leans_as_asked,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.search import Search

Model = Literal["3d", "2d"]
Scoring = Literal["count", "msac", "a-contrario"]

# Number of bins for distances from 0 to the tolerance.
_BINS: Final = 100
# Maximum number of points from which hypotheses are drawn, and on which they are scored.
_DRAWN_MOST: Final = 50_000
_ASKED_MOST: Final = 150_000
# Number of points with which all hypotheses are scored, and with which the best are scored again.
_FIRST_POINTS: Final = 2_000
_SECOND_POINTS: Final = 20_000
_SECOND_SHARE: Final = 0.1
_SECOND_LEAST: Final = 50
# Planes through few points are inaccurate, so this additional tilt is tolerated.
_LEAN_CAUTION_DEG: Final = 5.0
# Share of the required points that suffices, because hypotheses are inaccurate.
_SUPPORT_CAUTION: Final = 0.4
_POLISHED: Final = 4
# Maximum number of similar hypotheses that are scored again to find the best of them.
_SIMILAR_MOST: Final = 5
# Minimum share of the points within the tolerance that are in its inner part; 0.4 by chance.
_CROWDED_SHARE: Final = 0.5
# Number of new draws after all hypotheses are rejected.
_REDRAWS: Final = 2
# Minimum number of points of a section; possible lengths are halved repeatedly.
_STRETCH_LEAST: Final = 32
# Minimum ratio of height to longest side of a triangle.
_FLATTEST: Final = 0.02
_CURVE_BITS: Final = 10
# Shifts and masks that move the bits of a number to every third position.
_SPREADS: Final = ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249))
# A hypothesis within this angle and within the tolerance of a rejected one is proposed again only
# if this share of the points near it has been removed.
_SIMILAR_DEG: Final = 2.0
_LOST_SHARE: Final = 0.05


class Ransac(Method):
    """Find planes by random sample consensus: Max-Consensus, MSAC or AC-RANSAC, in 3D or the plan.

    Planes through random points are scored with a sample of the cloud. The best is refined with a
    tolerance that decreases from `tolerance_m` to `fit_tolerance_m`, and enough points must
    concentrate on it. When all planes are found in the sample, they are fitted to all points in one
    pass (for clouds above 24 million points, a random sample is used); a second pass labels all
    points.

    `model: 2d` draws vertical planes through two points of the plan, as in markiewicz2015, and
    finds only walls. `scoring: a-contrario` estimates a tolerance up to `tolerance_m`: the one at
    which the points are least likely to be near the plane by chance. It is stored with each plane,
    and reported as `own_tolerance_mm` for the first; the common fit still uses `fit_tolerance_m`.
    """

    id = "plane.ransac"
    result_version = 2
    determinism = "seeded"
    metrics = (
        *DETECTOR_METRICS,
        MetricSpec("own_tolerance_mm", label="tolerance estimated from the cloud"),
    )
    citations = (
        "Fischler, Bolles 1981: Random sample consensus, doi:10.1145/358669.358692",
        "Torr, Zisserman 2000: MLESAC, doi:10.1006/cviu.1999.0832 (MSAC)",
        (
            "Moisan, Stival 2004: A probabilistic criterion to detect rigid point matches, "
            "doi:10.1023/B:VISI.0000013094.38752.54 (a contrario)"
        ),
        PAPER,
    )

    class Params(DetectorParams):
        """Parameters; the defaults suit rooms and facades scanned at millimetres."""

        model: Model = Field(
            "3d", description="3d: planes through three points; 2d: vertical planes through two."
        )
        scoring: Scoring = Field(
            "msac",
            description="Score of a hypothesis. count: its number of points; msac: this number "
            "weighted by distance; a-contrario: how unlikely so many points are by chance, "
            "at an estimated tolerance.",
        )
        n_hypotheses: int = Field(
            1000,
            ge=10,
            le=1_000_000,
            description="Number of hypotheses for the first plane; half as many for each further "
            "plane.",
        )

        @model_validator(mode="after")
        def _upright_planes_are_walls(self) -> Self:
            if self.model == "2d" and self.constraint == "horizontal":
                raise ValueError("model: 2d finds only vertical planes, got constraint: horizontal")
            return self

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.search import detect

        proposer_of = partial(ConsensusProposer, params=params, rng=ctx.rng)
        return detect(inputs.cloud, params, ctx, proposer_of, method=self.id)[0]


@dataclass(frozen=True, kw_only=True)
class Hypotheses(Rows):
    """Planes in the frame of the points from which they were drawn.

    Attributes:
        normals: (h, 3) unit vectors.
        offsets_m: (h,) product of the normal and a point.
    """

    normals: NDArray[np.float64]
    offsets_m: NDArray[np.float64]

    def are_near(self, others: Hypotheses, tolerance_m: float) -> NDArray[np.bool_]:
        """Return (h, o) whether hypotheses are similar to others."""
        cosines = self.normals @ others.normals.T
        apart_m = np.abs(self.offsets_m[:, None] - np.copysign(1.0, cosines) * others.offsets_m)
        limit = math.cos(math.radians(_SIMILAR_DEG))
        return (np.abs(cosines) > limit) & (apart_m < tolerance_m)

    def plane(self, place: int) -> Plane:
        """Return one of the planes."""
        normal = self.normals[place]
        return Plane(normal=normal / np.linalg.norm(normal), offset_m=float(self.offsets_m[place]))


@dataclass(frozen=True, kw_only=True)
class Scores(Rows):
    """Scores of hypotheses.

    Attributes:
        value: (h,) score, higher is better; for a-contrario, positive if meaningful.
        tolerance_m: (h,) maximum distance of the counted points.
        n_points: (h,) number of counted points.
    """

    value: NDArray[np.float64]
    tolerance_m: NDArray[np.float64]
    n_points: NDArray[np.int64]


class ConsensusProposer:
    """Proposes planes that contain many points of a sample.

    Good hypotheses are kept for the next plane and scored again with the remaining points. Rejected
    ones are excluded until points near them are removed, because the verification depends only on
    these points.
    """

    def __init__(self, search: Search, params: Ransac.Params, rng: np.random.Generator) -> None:
        """Order the sample along a curve; `rng` draws the hypotheses."""
        self._params, self._rng, self._search = params, rng, search
        points_m = search.cloud.sample.offsets_m
        self._centre_m = np.median(points_m, axis=0)
        # Shuffled once, so that any initial part of the free points represents all of them.
        self._shuffled = rng.permutation(len(points_m))[:_ASKED_MOST]
        drawn = self._shuffled[:_DRAWN_MOST]
        self._order = drawn[curve_order(points_m[drawn])]
        self._ordered_m = points_m[self._order] - self._centre_m
        corners = search.box_corners_m
        self._box_m = corners.max(axis=0) - corners.min(axis=0)
        self._drawn_for = -1
        self._hypotheses: Hypotheses | None = None
        # Scores of the hypotheses, the best first, for the points in `_asked_m`.
        self._scores = Scores(value=np.zeros(0), tolerance_m=np.zeros(0), n_points=np.zeros(0, int))
        self._asked_m = points_m[:0]
        self._witnesses = self._shuffled[:_SECOND_POINTS]
        self._witnesses_m = points_m[self._witnesses] - self._centre_m
        self._free_m = self._witnesses_m
        self._rejected = Hypotheses(normals=np.zeros((0, 3)), offsets_m=np.zeros(0))
        self._n_near = np.zeros(0, dtype=np.int64)

    def propose(self, search: Search) -> Candidate | None:
        """Return the best hypothesis for the remaining points."""
        if self._drawn_for != search.n_points:
            self._free_m = self._witnesses_m[search.claims[self._witnesses] < 0]
            stays = self._count_near(self._rejected) >= (1.0 - _LOST_SHARE) * self._n_near
            self._rejected, self._n_near = self._rejected.take(stays), self._n_near[stays]
            self._drawn_for = search.n_points
            self._draw()
        for _ in range(_REDRAWS):
            candidate = self._best()
            if candidate is not None:
                return candidate
            self._draw()
        return self._best()

    def reject(self, candidate: Candidate) -> None:
        """Exclude hypotheses similar to a rejected one."""
        plane = candidate.plane
        offset_m = plane.offset_m - float(plane.normal @ self._centre_m)
        self._bar(Hypotheses(normals=plane.normal[None], offsets_m=np.array([offset_m])))

    def _bar(self, hypothesis: Hypotheses) -> None:
        self._rejected = Hypotheses.joined([self._rejected, hypothesis])
        self._n_near = np.append(self._n_near, self._count_near(hypothesis))

    def _is_barred(self, hypotheses: Hypotheses) -> NDArray[np.bool_]:
        """Return (h,) whether hypotheses are similar to a rejected one."""
        near = hypotheses.are_near(self._rejected, self._search.tolerance_m)
        return np.asarray(np.logical_or.reduce(near, axis=1))

    def _count_near(self, hypotheses: Hypotheses) -> NDArray[np.int64]:
        """Return the number (h,) of free test points near each hypothesis."""
        apart_m = np.abs(self._free_m @ hypotheses.normals.T - hypotheses.offsets_m)
        return np.asarray(np.sum(apart_m <= self._search.tolerance_m, axis=0, dtype=np.int64))

    def _best(self) -> Candidate | None:
        """Return the best hypothesis with enough points that concentrate on its plane.

        A plane through mouldings and clutter has many points too, but they are distributed over its
        slab. Such planes are excluded here, because the full verification takes ten times as long.
        """
        from orthoflow_plugins.plane.fit import refine_plane
        from orthoflow_plugins.plane.support import INNER_SHARE

        hypotheses, search, params = self._hypotheses, self._search, self._params
        if hypotheses is None:
            return None
        is_own = params.scoring == "a-contrario"
        asked = max(1, min(_SECOND_POINTS, search.n_points))
        n_points = self._scores.n_points / asked * search.n_points
        is_open = n_points >= _SUPPORT_CAUTION * search.least_points
        is_open &= (self._scores.value > 0.0) | (not is_own)
        is_open &= ~self._is_barred(hypotheses)
        reach_m = search.tolerance_m
        for place in range(len(hypotheses)):
            if not is_open[place]:
                continue
            hypothesis = hypotheses.take(np.array([place]))
            start, up = hypothesis.plane(0), search.cloud.up
            layer = refine_plane(self._asked_m, start, reach_m, freedom="free", up=up)
            if layer is not None:
                sizes_m = np.abs(layer.distances_m(self._asked_m))
                n_inner = np.count_nonzero(sizes_m <= INNER_SHARE * reach_m)
                if n_inner < _CROWDED_SHARE * np.count_nonzero(sizes_m <= reach_m):
                    layer = None
            if layer is None:
                self._bar(hypothesis)
                is_open &= ~hypotheses.are_near(hypothesis, reach_m)[:, 0]
                continue
            own_m = None
            if is_own:
                hypothesis, own_m = self._polished(hypothesis)
            return Candidate(
                plane=self._in_offsets(hypothesis.plane(0)),
                constraint="vertical" if params.model == "2d" else params.constraint,
                own_tolerance_m=own_m,
                start=self._in_offsets(layer),
            )
        return None

    def _draw(self) -> None:
        """Draw hypotheses; score them and the earlier ones with few points, the best with more."""
        search, params = self._search, self._params
        points_m, claims = search.cloud.sample.offsets_m, search.claims
        free = np.flatnonzero(claims[self._order] < 0)
        earlier, self._hypotheses = self._hypotheses, None
        if len(free) < 3:
            return
        hypotheses = draw_hypotheses(
            self._ordered_m.take(free, axis=0),
            params.n_hypotheses if earlier is None else params.n_hypotheses // 2,
            params.model,
            search.cloud.up,
            self._rng,
        )
        if earlier is not None:
            hypotheses = Hypotheses.joined([hypotheses, earlier])
        limit_deg = params.max_tilt_deg + _LEAN_CAUTION_DEG
        hypotheses = hypotheses.take(
            leans_as_asked(hypotheses.normals, search.cloud.up, params.constraint, limit_deg)
        )
        hypotheses = hypotheses.take(~self._is_barred(hypotheses))
        if len(hypotheses) == 0:
            return
        # These nearly always include enough free points.
        asked = self._shuffled[: 4 * _SECOND_POINTS]
        asked = asked[claims[asked] < 0]
        if len(asked) < _SECOND_POINTS:
            asked = self._shuffled[claims[self._shuffled] < 0]
        self._asked_m = points_m.take(asked[:_SECOND_POINTS], axis=0) - self._centre_m
        first = self._scored(hypotheses, self._asked_m[:_FIRST_POINTS])
        n_kept = max(_SECOND_LEAST, round(_SECOND_SHARE * len(hypotheses)))
        kept = self._distinct(hypotheses, np.argsort(-first.value, kind="stable"), n_kept)
        hypotheses = hypotheses.take(kept)
        scores = self._scored(hypotheses, self._asked_m)
        ranked = np.argsort(-scores.value, kind="stable")
        self._hypotheses, self._scores = hypotheses.take(ranked), scores.take(ranked)

    def _scored(self, hypotheses: Hypotheses, points_m: NDArray[np.float64]) -> Scores:
        from orthoflow_plugins.plane.kernels import consensus_sums

        columns = np.ascontiguousarray(points_m.T, dtype=np.float32)
        rows = np.column_stack([hypotheses.normals, hypotheses.offsets_m]).astype(np.float32)
        reach_m = self._search.tolerance_m
        if self._params.scoring == "a-contrario":
            places = ((np.abs(row[:3] @ columns - row[3]) / reach_m) * _BINS for row in rows)
            histograms = np.array(
                [np.bincount(np.minimum(p, _BINS).astype(int), minlength=_BINS + 1) for p in places]
            )
            extents_m = np.abs(hypotheses.normals) @ self._box_m
            n_corners = 3 if self._params.model == "3d" else 2
            return fewest_false_alarms(
                histograms[:, :_BINS], reach_m, len(points_m), extents_m, n_corners
            )
        sums = np.zeros((len(rows), 2), dtype=np.int64)
        add = partial(consensus_sums, columns)
        shares = even_parts(len(rows), self._search.cloud.parts)
        in_threads([partial(add, rows[k], reach_m, _BINS, sums[k]) for k in shares])
        n_points = sums[:, 0].copy()
        is_msac = self._params.scoring == "msac"
        return Scores(
            value=sums[:, 1] / (4.0 * _BINS**2) if is_msac else n_points.astype(np.float64),
            tolerance_m=np.full(len(rows), reach_m),
            n_points=n_points,
        )

    def _distinct(
        self, hypotheses: Hypotheses, ranked: NDArray[np.intp], n_most: int
    ) -> NDArray[np.intp]:
        """Return the best of ranked hypotheses, with at most `_SIMILAR_MOST` similar ones."""
        # The best ones nearly always include enough different ones.
        for n_asked in (min(len(ranked), _SIMILAR_MOST * n_most), len(ranked)):
            asked = ranked[:n_asked]
            some = hypotheses.take(asked)
            near = some.are_near(some, self._search.tolerance_m)
            kept: list[int] = []
            n_similar = np.zeros(n_asked, dtype=np.int64)
            for place in range(n_asked):
                if n_similar[place] < _SIMILAR_MOST and len(kept) < n_most:
                    kept.append(place)
                    n_similar += near[place]
            if len(kept) == n_most:
                break
        return asked[kept]

    def _in_offsets(self, plane: Plane) -> Plane:
        offset_m = plane.offset_m + float(plane.normal @ self._centre_m)
        return Plane(normal=plane.normal, offset_m=offset_m)

    def _polished(self, hypothesis: Hypotheses) -> tuple[Hypotheses, float]:
        """Fit to the points within the tolerance and re-estimate it, while the score improves."""
        search = self._search
        relative_m = (search.cloud.sample.offsets_m - self._centre_m)[search.claims < 0]
        best = self._scored(hypothesis, relative_m)
        for _ in range(_POLISHED):
            distances_m = relative_m @ hypothesis.normals[0] - hypothesis.offsets_m[0]
            near_m = relative_m[np.abs(distances_m) <= best.tolerance_m[0]]
            fitted = _fitted(near_m, self._params.model, search.cloud.up)
            if fitted is None:
                break
            score = self._scored(fitted, relative_m)
            if score.value[0] <= best.value[0]:
                break
            hypothesis, best = fitted, score
        return hypothesis, float(best.tolerance_m[0])


def draw_hypotheses(
    points_m: NDArray[np.float64],
    count: int,
    model: Model,
    up: NDArray[np.float64],
    rng: np.random.Generator,
) -> Hypotheses:
    """Draw planes through points.

    Args:
        points_m: (m, 3) in curve order.
        count: number of draws; degenerate ones are omitted.
        model: `3d`: through three points; `2d`: vertical, through two points.
        up: (3,) unit vector.
        rng: random numbers.
    """
    n_points = len(points_m)
    n_lengths = max(1, int(np.log2(max(1.0, n_points / _STRETCH_LEAST))) + 1)
    stretch = np.ceil(n_points / 2.0 ** rng.integers(0, n_lengths, count)).astype(np.int64)
    first = (rng.random(count) * (n_points - stretch + 1)).astype(np.int64)
    n_corners = 3 if model == "3d" else 2
    chosen = first[:, None] + (rng.random((count, n_corners)) * stretch[:, None]).astype(np.int64)
    corners = points_m[chosen]
    a = corners[:, 1] - corners[:, 0]
    b = corners[:, 2] - corners[:, 0] if model == "3d" else np.broadcast_to(up, a.shape)
    normals = np.cross(a, b)
    lengths = np.linalg.norm(normals, axis=1)
    longest = np.maximum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
    fixed = lengths > (_FLATTEST * longest**2 if model == "3d" else 1e-6)
    normals = normals[fixed] / lengths[fixed, None]
    return Hypotheses(
        normals=normals, offsets_m=np.einsum("ij,ij->i", normals, corners[fixed].mean(axis=1))
    )


def curve_order(points_m: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the order of points (m, 3) along a Morton curve, whose neighbours are close."""
    low, high = np.quantile(points_m, (0.01, 0.99), axis=0)
    scale = (2**_CURVE_BITS - 1) / max(float((high - low).max()), 1e-9)
    cells = np.clip((points_m - low) * scale, 0, 2**_CURVE_BITS - 1).astype(np.uint32)
    key = np.zeros(len(points_m), dtype=np.uint32)
    for axis in range(3):
        bits = cells[:, axis]
        for shift, mask in _SPREADS:
            bits = (bits | (bits << np.uint32(shift))) & np.uint32(mask)
        key |= bits << np.uint32(axis)
    return np.argsort(key, kind="stable")


def fewest_false_alarms(
    histograms: NDArray[np.int64],
    reach_m: float,
    n_points: int,
    extents_m: NDArray[np.float64],
    n_corners: int,
) -> Scores:
    """Score hypotheses at the tolerance at which their points are least likely by chance.

    Args:
        histograms: (h, bins) number of points per distance bin, 0..reach.
        reach_m: maximum tolerance.
        n_points: total number of points.
        extents_m: (h,) extent of the scene's box along each normal.
        n_corners: number of points that determine a hypothesis.
    """
    within = np.cumsum(histograms, axis=1, dtype=np.int64)
    n_bins = within.shape[1]
    tolerances_m = (np.arange(n_bins) + 1.0) * (reach_m / n_bins)
    k = np.maximum(within, n_corners + 1).astype(np.float64)
    chance = np.minimum(2.0 * tolerances_m / np.maximum(extents_m[:, None], 1e-9), 1.0)
    log_alarms = (
        np.log(max(n_points - n_corners, 1))
        + _log_choose(float(n_points), k)
        + _log_choose(k, float(n_corners))
        + (k - n_corners) * np.log(chance)
    )
    log_alarms = np.where(within > n_corners, log_alarms, np.inf)
    best = np.argmin(log_alarms, axis=1)
    rows = np.arange(len(within))
    return Scores(
        value=-log_alarms[rows, best] / np.log(10.0),
        tolerance_m=tolerances_m[best],
        n_points=within[rows, best],
    )


def _log_choose(
    n: float | NDArray[np.float64], k: float | NDArray[np.float64]
) -> NDArray[np.float64]:
    from scipy.special import gammaln

    apart = gammaln(np.subtract(n, k) + 1.0)
    return gammaln(np.add(n, 1.0)) - gammaln(np.add(k, 1.0)) - apart


def _fitted(
    points_m: NDArray[np.float64], model: Model, up: NDArray[np.float64]
) -> Hypotheses | None:
    """Return the total least squares plane; vertical for the 2D model."""
    if len(points_m) < 4:
        return None
    mean = points_m.mean(axis=0)
    centred = points_m - mean
    if model == "2d":
        centred = centred - np.outer(centred @ up, up)
    values, directions = np.linalg.eigh(centred.T @ centred)
    normal = directions[:, 1 if model == "2d" else 0]
    if values[1] <= 0.0 or abs(float(normal @ up)) > 1.0:
        return None
    return Hypotheses(normals=normal[None], offsets_m=np.array([float(normal @ mean)]))
