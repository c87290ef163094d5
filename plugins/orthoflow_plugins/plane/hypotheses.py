"""Random planes through a few points of a sample: how they are drawn, what they are worth.

Three points drawn from all of a room are on one small wall once in a million draws. The sample is
put along a space-filling curve, and the points of a hypothesis come from one stretch of it, of a
length that is drawn too: short stretches find small planes, long ones fix large planes well.

What a hypothesis is worth follows from the histogram of its points' distances.

- count (Max-Consensus): the points within the tolerance.
- msac: a point within the tolerance counts 1 - (distance / tolerance)^2 (Torr and Zisserman 2000).
- a-contrario (AC-RANSAC): minus the logarithm of the number of false alarms that the tolerance with
  the fewest gives; the tolerance is an outcome (Moisan and Stival 2004; Moisan, Moulon, Monasse
  2012). The chance that a point of the background lies within a distance of the plane is the share
  of the scene's box that the slab fills.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.rows import Rows

Model = Literal["3d", "2d"]
Scoring = Literal["count", "msac", "a-contrario"]

# Points that fix a plane, and a line in the plan.
MODEL_POINTS: Final[dict[str, int]] = {"3d": 3, "2d": 2}
# Stretches hold at least so many points, and each length is half of the one before.
_STRETCH_LEAST: Final = 32
# Triangles flatter than this (height over longest side) fix no plane.
_FLATTEST: Final = 0.02
_CURVE_BITS: Final = 10
# Bits of a number spread to every third place, step by step.
_SPREADS: Final = ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249))
# A hypothesis this near to one that turned out to be none is not proposed again.
_ALIKE_DEG: Final = 2.0
_ALIKE_TOLERANCES: Final = 1.0
# What was no plane among other points may be one among those that remain, if so many are gone.
_LOST_SHARE: Final = 0.05


@dataclass(frozen=True, kw_only=True)
class Hypotheses(Rows):
    """Planes in the frame of the points they were drawn from.

    Attributes:
        normals: (h, 3) unit vectors.
        offsets_m: (h,) normal times point.
    """

    normals: NDArray[np.float64]
    offsets_m: NDArray[np.float64]

    def rows(self) -> NDArray[np.float32]:
        """(h, 4) normal and offset, as the compiled scoring takes them."""
        return np.column_stack([self.normals, self.offsets_m]).astype(np.float32)


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
        count: how many are drawn; those that fix no plane are left out.
        model: `3d` through three points, `2d` upright through two.
        up: (3,) unit vector.
        rng: source of chance.
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
    """Order points (m, 3) along a Morton curve, so that neighbours on it are near each other."""
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


@dataclass(frozen=True, kw_only=True)
class Scores:
    """What hypotheses are worth.

    Attributes:
        value: (h,) the larger the better; for a-contrario positive when meaningful.
        tolerance_m: (h,) tolerance within which the points speak for it.
        n_points: (h,) points within that.
    """

    value: NDArray[np.float64]
    tolerance_m: NDArray[np.float64]
    n_points: NDArray[np.int64]


def scores_of(
    histograms: NDArray[np.int32],
    scoring: Scoring,
    *,
    reach_m: float,
    n_points: int,
    extents_m: NDArray[np.float64],
    model_points: int,
) -> Scores:
    """Score hypotheses.

    Args:
        histograms: (h, bins) points per bin of distance, 0..reach.
        scoring: see module.
        reach_m: the tolerance; for a-contrario the largest that is considered.
        n_points: points that were asked.
        extents_m: (h,) extent of the scene's box along each normal.
        model_points: points that fix a model.
    """
    n_bins = histograms.shape[1]
    within = np.cumsum(histograms, axis=1, dtype=np.int64)
    if scoring == "a-contrario":
        return _fewest_false_alarms(within, reach_m, n_points, extents_m, model_points)
    value = within[:, -1].astype(np.float64)
    if scoring == "msac":
        middles = (np.arange(n_bins) + 0.5) / n_bins
        value = histograms @ (1.0 - middles**2)
    return Scores(
        value=value, tolerance_m=np.full(len(value), reach_m), n_points=within[:, -1].copy()
    )


def scores_of_sums(
    sums: NDArray[np.int64], scoring: Scoring, *, n_bins: int, reach_m: float
) -> Scores:
    """Score hypotheses as `scores_of` does, by count or msac, from what `consensus_sums` gives.

    Args:
        sums: (h, 2) see there.
        scoring: count or msac.
        n_bins: bins that the distances were put into.
        reach_m: the tolerance.
    """
    n_points = sums[:, 0].copy()
    value = sums[:, 1] / (4.0 * n_bins**2) if scoring == "msac" else n_points.astype(np.float64)
    return Scores(value=value, tolerance_m=np.full(len(value), reach_m), n_points=n_points)


class Rejections:
    """Hypotheses that turned out to be no planes, which stay out until points near them are taken.

    A verification asks the points near a hypothesis: as long as no plane takes any of them it would
    end as before, so it is spared.
    """

    def __init__(self, points_m: NDArray[np.float64], tolerance_m: float) -> None:
        """Start with none.

        Args:
            points_m: (m, 3) points that tell whether something near a hypothesis was taken.
            tolerance_m: points this near count.
        """
        self._points_m = points_m
        self._tolerance_m = tolerance_m
        self._is_free = np.ones(len(points_m), dtype=bool)
        self.forget()

    def forget(self) -> None:
        """Let everything be proposed again."""
        self._rejected = Hypotheses(normals=np.zeros((0, 3)), offsets_m=np.zeros(0))
        self._n_near = np.zeros(0, dtype=np.int64)

    def add(self, hypothesis: Hypotheses) -> None:
        """Keep one from being proposed again."""
        self._rejected = Hypotheses.joined([self._rejected, hypothesis])
        self._n_near = np.append(self._n_near, self._count(hypothesis))

    def take(self, is_free: NDArray[np.bool_]) -> None:
        """Hear which of the points (m,) are left, and forget those that lost some of theirs."""
        self._is_free = is_free
        if len(self._rejected) == 0:
            return
        n_near = self._count(self._rejected)
        stays = n_near >= (1.0 - _LOST_SHARE) * self._n_near
        self._rejected, self._n_near = self._rejected.take(stays), self._n_near[stays]

    def cover(self, hypotheses: Hypotheses) -> NDArray[np.bool_]:
        """(h,) whether hypotheses are much the same as a rejected one."""
        if len(self._rejected) == 0:
            return np.zeros(len(hypotheses), dtype=bool)
        near = alike(hypotheses, self._rejected, self._tolerance_m)
        covered: NDArray[np.bool_] = np.logical_or.reduce(near, axis=1)
        return covered

    def __len__(self) -> int:
        return len(self._rejected)

    def _count(self, hypotheses: Hypotheses) -> NDArray[np.int64]:
        """(h,) free points near each hypothesis."""
        free_m = self._points_m[self._is_free]
        apart_m = np.abs(free_m @ hypotheses.normals.T - hypotheses.offsets_m)
        n_near: NDArray[np.int64] = np.sum(apart_m <= self._tolerance_m, axis=0, dtype=np.int64)
        return n_near


def alike(first: Hypotheses, second: Hypotheses, tolerance_m: float) -> NDArray[np.bool_]:
    """(f, s) whether hypotheses are much the same as others."""
    cosines = first.normals @ second.normals.T
    apart_m = np.abs(first.offsets_m[:, None] - np.copysign(1.0, cosines) * second.offsets_m)
    return (np.abs(cosines) > math.cos(math.radians(_ALIKE_DEG))) & (
        apart_m < _ALIKE_TOLERANCES * tolerance_m
    )


def _fewest_false_alarms(
    within: NDArray[np.int64],
    reach_m: float,
    n_points: int,
    extents_m: NDArray[np.float64],
    model_points: int,
) -> Scores:
    n_bins = within.shape[1]
    tolerances_m = (np.arange(n_bins) + 1.0) * (reach_m / n_bins)
    k = np.maximum(within, model_points + 1).astype(np.float64)
    chance = np.minimum(2.0 * tolerances_m / np.maximum(extents_m[:, None], 1e-9), 1.0)
    log_alarms = (
        np.log(max(n_points - model_points, 1))
        + _log_choose(float(n_points), k)
        + _log_choose(k, float(model_points))
        + (k - model_points) * np.log(chance)
    )
    log_alarms = np.where(within > model_points, log_alarms, np.inf)
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
