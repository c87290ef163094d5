"""`plane.ransac`: planes with the largest consensus in a sample, fitted to all points.

If three points are drawn from an entire room, they are on the same small wall only once in a
million draws. The sample is therefore sorted along a space-filling curve, and the points of a
hypothesis are drawn from the same section of the curve. The length of the section is random, too:
short sections find small planes, and long sections determine large planes well.

The score of a hypothesis is computed from the distances of points from the plane:

- count (Max-Consensus): the number of points within the tolerance.
- msac: the sum of 1 - (distance / tolerance)^2 over points within the tolerance (Torr and Zisserman
  2000).
- a-contrario (AC-RANSAC): minus the logarithm of the number of false alarms, at the tolerance that
  minimises this number and is also returned (Moisan and Stival 2004; Moisan, Moulon, Monasse 2012).
  The probability that a background point is within a given distance of the plane is the share of
  the scene's box that is inside the slab.
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
from orthoflow.sdk import MetricSpec, StepContext
from orthoflow_plugins.plane.detector import DETECTOR_METRICS, PAPER, Detector
from orthoflow_plugins.plane.proposing import (
    Candidate,
    DetectorParams,
    Proposer,
    leans_as_asked,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.search import Search

Model = Literal["3d", "2d"]
Scoring = Literal["count", "msac", "a-contrario"]

# Number of hypotheses for the first plane; for each further plane, half as many are drawn.
_HYPOTHESES: Final = 1000
# Number of bins for distances from 0 to the tolerance.
_BINS: Final = 100
# Maximum number of points from which hypotheses are drawn, and maximum number of points with which
# they are scored.
_DRAWN_MOST: Final = 50_000
_ASKED_MOST: Final = 150_000
# All hypotheses are scored with _FIRST_POINTS points. The best _SECOND_SHARE of them, but at least
# _SECOND_LEAST, are scored again with _SECOND_POINTS points.
_FIRST_POINTS: Final = 2_000
_SECOND_POINTS: Final = 20_000
_SECOND_SHARE: Final = 0.1
_SECOND_LEAST: Final = 50
# Additional tilt that is tolerated, because planes through a few points are inaccurate.
_LEAN_CAUTION_DEG: Final = 5.0
# Minimum number of points of a hypothesis, as a share of the required number; it is low because
# hypotheses are inaccurate.
_SUPPORT_CAUTION: Final = 0.4
_POLISHED: Final = 4
# Maximum number of similar hypotheses that are scored again to find the best one.
_SIMILAR_MOST: Final = 5
# Minimum share of the points within the tolerance that must be in its inner part; the share
# expected by chance is 0.4.
_CROWDED_SHARE: Final = 0.5
# Number of times that new hypotheses are drawn after all have been rejected.
_REDRAWS: Final = 2
# Minimum number of points in a section of the sorted points. Sections contain all points, half of
# them, a quarter, and so on.
_STRETCH_LEAST: Final = 32
# Minimum ratio of the height of a triangle to its longest side.
_FLATTEST: Final = 0.02
_CURVE_BITS: Final = 10
# Shifts and masks that spread the bits of a number to every third position.
_SPREADS: Final = ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249))
# Two hypotheses are similar if the angle between them is smaller than _SIMILAR_DEG and their
# distance is within the tolerance. After a hypothesis has been rejected, similar ones are proposed
# again only if _LOST_SHARE of the points near it have been removed.
_SIMILAR_DEG: Final = 2.0
_LOST_SHARE: Final = 0.05


class Ransac(Detector):
    """Find planes by random sample consensus: Max-Consensus, MSAC or AC-RANSAC, in 3D or in plan.

    Planes through random points are scored with a sample of the cloud. The best plane is refined
    with a tolerance that decreases from `tolerance_m` to `fit_tolerance_m`, and enough points must
    concentrate on it. When all planes have been found in the sample, they are fitted in one pass to
    all points, or, in clouds of more than 24 million points, to a random sample. A second pass
    labels all points.

    With `model: 2d`, as in markiewicz2015, vertical planes are drawn through two points in plan, so
    that only walls are found. With `scoring: a-contrario`, the tolerance is estimated: it is the
    tolerance, up to `tolerance_m`, at which the points are least likely to be near the plane by
    chance. The estimated tolerance is recorded for each plane, and reported as `own_tolerance_mm`
    for the first plane. The common fit still uses `fit_tolerance_m`.
    """

    id = "plane.ransac"
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
        """Parameters; the defaults suit rooms and facades scanned with millimetre point spacing."""

        model: Model = Field(
            "3d", description="3d: planes through three points; 2d: vertical planes through two."
        )
        scoring: Scoring = Field(
            "msac",
            description="Score of a hypothesis. count: its number of points; msac: this "
            "number weighted by distance; a-contrario: how unlikely it is that so many "
            "points are near the plane by chance, at an estimated tolerance.",
        )

        @model_validator(mode="after")
        def _upright_planes_are_walls(self) -> Self:
            if self.model == "2d" and self.constraint == "horizontal":
                raise ValueError("model: 2d finds only vertical planes, got constraint: horizontal")
            return self

    def proposer(self, search: Search, params: Params, ctx: StepContext) -> ConsensusProposer:
        """Return a proposer that uses the random generator of the step."""
        return ConsensusProposer(search, params, ctx.rng)


@dataclass(frozen=True)
class Scores(Rows):
    """Scores of hypotheses.

    Attributes:
        value: (h,) score; higher is better. For a-contrario, it is positive if the plane is
            meaningful.
        tolerance_m: (h,) maximum distance of the points that are counted.
        n_points: (h,) number of points that are counted.
    """

    value: NDArray[np.float64]
    tolerance_m: NDArray[np.float64]
    n_points: NDArray[np.int64]


class ConsensusProposer(Proposer):
    """Proposes planes through random points that are near many points of a sample.

    Hypotheses are rows (h, 4), each a unit normal and an offset, relative to the median of the
    sample. Good hypotheses are kept for the next plane and scored again with the remaining points.
    Rejected hypotheses are excluded until points near them are removed, because their verification
    depends only on these points.
    """

    def __init__(self, search: Search, params: Ransac.Params, rng: np.random.Generator) -> None:
        """Sort the sample along a curve; `rng` is used to draw hypotheses."""
        self._params, self._rng = params, rng
        points_m = search.cloud.sample.offsets_m
        self._centre_m = np.median(points_m, axis=0)
        self._points_m = points_m - self._centre_m
        # The order is random, so that any first part of the remaining points represents all of
        # them.
        self._shuffled = rng.permutation(len(points_m))[:_ASKED_MOST]
        drawn = self._shuffled[:_DRAWN_MOST]
        self._order = drawn[curve_order(points_m[drawn])]
        corners = search.box_corners_m
        self._box_m = corners.max(axis=0) - corners.min(axis=0)
        # Hypotheses, the best first, and their scores for the points in `_asked_m`.
        self._hypotheses, self._scores = np.zeros((0, 4)), Scores(*np.zeros((3, 0)))
        self._asked_m = self._points_m[:0]
        # Rejected hypotheses, and the number of points that were near each of them when it was
        # rejected.
        self._rejected, self._n_near = np.zeros((0, 4)), np.zeros(0, dtype=np.int64)
        self._drawn_for = -1

    def propose(self, search: Search) -> Candidate | None:
        """Return the best hypothesis for the remaining points."""
        n_draws = 0
        if self._drawn_for != search.n_points:
            stays = self._count_near(self._rejected, search) >= (1.0 - _LOST_SHARE) * self._n_near
            self._rejected, self._n_near = self._rejected[stays], self._n_near[stays]
            self._drawn_for = search.n_points
            self._draw(search)
        while (candidate := self._best(search)) is None and n_draws < _REDRAWS:
            self._draw(search)
            n_draws += 1
        self._searched = search
        return candidate

    def reject(self) -> None:
        """Exclude hypotheses similar to the last one."""
        self._bar(self._last, self._searched)

    def _bar(self, hypothesis: NDArray[np.float64], search: Search) -> None:
        self._rejected = np.vstack([self._rejected, hypothesis])
        self._n_near = np.append(self._n_near, self._count_near(hypothesis[None], search))

    def _count_near(self, hypotheses: NDArray[np.float64], search: Search) -> NDArray[np.int64]:
        asked = self._shuffled[:_SECOND_POINTS]
        free_m = self._points_m.take(asked[search.is_free[asked]], axis=0)
        apart_m = np.abs(free_m @ hypotheses[:, :3].T - hypotheses[:, 3])
        return np.asarray(np.sum(apart_m <= search.cloud.tolerance_m, axis=0, dtype=np.int64))

    def _best(self, search: Search) -> Candidate | None:
        """Return the best hypothesis for which enough points concentrate on its plane.

        A plane through mouldings and clutter is also near many points, but these are distributed
        over the whole slab. Such planes are excluded here, because full verification takes ten
        times as long.
        """
        from orthoflow_plugins.plane.fit import refine_plane
        from orthoflow_plugins.plane.support import INNER_SHARE

        params, reach_m, up = self._params, search.cloud.tolerance_m, search.cloud.up
        n_points = self._scores.n_points / max(1, len(self._asked_m)) * search.n_points
        is_open = n_points >= _SUPPORT_CAUTION * search.least_points
        is_own = params.scoring == "a-contrario"
        is_open &= (self._scores.value > 0.0) | (not is_own)
        is_open &= ~are_near(self._hypotheses, self._rejected, reach_m).any(axis=1)
        for place in range(len(is_open)):
            if not is_open[place]:
                continue
            self._last = self._hypotheses[place]
            layer = refine_plane(self._asked_m, plane_of(self._last), reach_m, freedom="any", up=up)
            is_crowded = False
            if layer is not None:
                sizes_m = np.abs(layer.distances_m(self._asked_m))
                n_inner = np.count_nonzero(sizes_m <= INNER_SHARE * reach_m)
                n_near = np.count_nonzero(sizes_m <= reach_m)
                is_crowded = bool(n_inner >= _CROWDED_SHARE * n_near)
            if layer is None or not is_crowded:
                self._bar(self._last, search)
                is_open &= ~are_near(self._hypotheses, self._last[None], reach_m)[:, 0]
                continue
            hypothesis, own_m = self._polished(search) if is_own else (self._last, None)
            return Candidate(
                plane=self._in_offsets(plane_of(hypothesis)),
                constraint="vertical" if params.model == "2d" else params.constraint,
                own_tolerance_m=own_m,
                start=self._in_offsets(layer),
            )
        return None

    def _draw(self, search: Search) -> None:
        """Draw hypotheses. Score new and earlier ones with few points, and the best with more."""
        is_free, up, params = search.is_free, search.cloud.up, self._params
        free = self._order[is_free[self._order]]
        earlier, self._hypotheses = self._hypotheses, self._hypotheses[:0]
        self._scores = Scores(*np.zeros((3, 0)))
        if len(free) < 3:
            return
        count = _HYPOTHESES // 2 if len(earlier) else _HYPOTHESES
        drawn = draw_hypotheses(
            self._points_m.take(free, axis=0), count, params.model, up, self._rng
        )
        hypotheses = np.vstack([drawn, earlier])
        limit_deg = params.max_tilt_deg + _LEAN_CAUTION_DEG
        chosen = leans_as_asked(hypotheses[:, :3], up, params.constraint, limit_deg)
        chosen &= ~are_near(hypotheses, self._rejected, search.cloud.tolerance_m).any(axis=1)
        hypotheses = hypotheses[chosen]
        asked = self._shuffled[is_free[self._shuffled]][:_SECOND_POINTS]
        self._asked_m = self._points_m.take(asked, axis=0)
        first = self._scored(hypotheses, self._asked_m[:_FIRST_POINTS], search)
        ranked = hypotheses[np.argsort(-first.value, kind="stable")]
        hypotheses = ranked[_distinct(ranked, search.cloud.tolerance_m)]
        scores = self._scored(hypotheses, self._asked_m, search)
        order = np.argsort(-scores.value, kind="stable")
        self._hypotheses = hypotheses[order]
        self._scores = scores.take(order)

    def _scored(
        self, hypotheses: NDArray[np.float64], points_m: NDArray[np.float64], search: Search
    ) -> Scores:
        from orthoflow_plugins.plane.kernels import bin_distances

        rows = hypotheses.astype(np.float32)
        columns = np.ascontiguousarray(points_m.T, dtype=np.float32)
        reach_m, histograms = search.cloud.tolerance_m, np.zeros((len(rows), _BINS), dtype=np.int64)
        shares = even_parts(len(rows), search.cloud.parts)
        in_threads(
            [partial(bin_distances, columns, rows[k], reach_m, histograms[k]) for k in shares]
        )
        if self._params.scoring == "a-contrario":
            extents_m = np.abs(hypotheses[:, :3]) @ self._box_m
            n_corners = 3 if self._params.model == "3d" else 2
            return fewest_false_alarms(histograms, reach_m, len(points_m), extents_m, n_corners)
        ratios = (np.arange(_BINS) + 0.5) / _BINS
        worth = 1.0 - ratios**2 if self._params.scoring == "msac" else np.ones(_BINS)
        return Scores(histograms @ worth, np.full(len(rows), reach_m), histograms.sum(axis=1))

    def _in_offsets(self, plane: Plane) -> Plane:
        offset_m = plane.offset_m + float(plane.normal @ self._centre_m)
        return Plane(normal=plane.normal, offset_m=offset_m)

    def _polished(self, search: Search) -> tuple[NDArray[np.float64], float]:
        """Fit the last hypothesis to the points within its tolerance while its score improves."""
        hypothesis, points_m = self._last, self._points_m[search.is_free]
        best = self._scored(hypothesis[None], points_m, search)
        for _ in range(_POLISHED):
            distances_m = points_m @ hypothesis[:3] - hypothesis[3]
            near_m = points_m[np.abs(distances_m) <= best.tolerance_m[0]]
            fitted = _fitted(near_m, self._params.model, search.cloud.up)
            if fitted is None:
                break
            score = self._scored(fitted[None], points_m, search)
            if score.value[0] <= best.value[0]:
                break
            hypothesis, best = fitted, score
        return hypothesis, float(best.tolerance_m[0])


def plane_of(hypothesis: NDArray[np.float64]) -> Plane:
    """Return the plane of a hypothesis (4,)."""
    normal = hypothesis[:3]
    return Plane(normal=normal / np.linalg.norm(normal), offset_m=float(hypothesis[3]))


def are_near(
    hypotheses: NDArray[np.float64], others: NDArray[np.float64], tolerance_m: float
) -> NDArray[np.bool_]:
    """Return a mask (h, o) of hypotheses (h, 4) that are similar to other hypotheses (o, 4)."""
    cosines = hypotheses[:, :3] @ others[:, :3].T
    apart_m = np.abs(hypotheses[:, 3, None] - np.copysign(1.0, cosines) * others[:, 3])
    return (np.abs(cosines) > math.cos(math.radians(_SIMILAR_DEG))) & (apart_m < tolerance_m)


def _distinct(ranked: NDArray[np.float64], tolerance_m: float) -> list[int]:
    n_most = max(_SECOND_LEAST, round(_SECOND_SHARE * len(ranked)))
    # This part nearly always contains enough different hypotheses.
    asked = ranked[: _SIMILAR_MOST * n_most]
    near = are_near(asked, asked, tolerance_m)
    kept: list[int] = []
    n_similar = np.zeros(len(near), dtype=np.int64)
    for place, similar in enumerate(near):
        if n_similar[place] < _SIMILAR_MOST and len(kept) < n_most:
            kept.append(place)
            n_similar += similar
    return kept


def draw_hypotheses(
    points_m: NDArray[np.float64],
    count: int,
    model: Model,
    up: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Draw planes through random points; return unit normals and offsets (h, 4).

    Args:
        points_m: (m, 3) metres, in the order of `curve_order`.
        count: number of draws; degenerate planes are omitted.
        model: `3d` for planes through three points, `2d` for vertical planes through two points.
        up: (3,) unit vector.
        rng: random generator.
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
    offsets_m = np.einsum("ij,ij->i", normals, corners[fixed].mean(axis=1))
    return np.column_stack([normals, offsets_m])


def curve_order(points_m: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the order of points (m, 3) along a Morton curve, which keeps near points together."""
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
    """Score hypotheses at the tolerance at which points are least likely to be near by chance.

    Args:
        histograms: (h, bins) number of points in bins of distance between 0 and `reach_m`.
        reach_m: maximum tolerance.
        n_points: total number of points.
        extents_m: (h,) extent of the scene's box along each normal.
        n_corners: number of points through which a hypothesis is drawn.
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
    value = -log_alarms[rows, best] / np.log(10.0)
    return Scores(value, tolerances_m[best], within[rows, best])


def _log_choose(
    n: float | NDArray[np.float64], k: float | NDArray[np.float64]
) -> NDArray[np.float64]:
    from scipy.special import gammaln

    apart = gammaln(np.subtract(n, k) + 1.0)
    return gammaln(np.add(n, 1.0)) - gammaln(np.add(k, 1.0)) - apart


def _fitted(
    points_m: NDArray[np.float64], model: Model, up: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the total least squares plane (4,) of points (n, 3); vertical for the 2D model."""
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
    return np.append(normal, normal @ mean)
