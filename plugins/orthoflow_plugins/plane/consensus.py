"""Proposes the plane that most of the remaining points of a sample agree on, of many drawn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.threads import in_threads
from orthoflow_plugins.plane.candidates import Candidate, Family
from orthoflow_plugins.plane.fitting import refine_plane
from orthoflow_plugins.plane.hypotheses import (
    MODEL_POINTS,
    Hypotheses,
    Model,
    Rejections,
    Scores,
    Scoring,
    alike,
    curve_order,
    draw_hypotheses,
    scores_of,
    scores_of_sums,
)
from orthoflow_plugins.plane.kernels import consensus_sums, distance_histograms
from orthoflow_plugins.plane.sample import Unassigned
from orthoflow_plugins.plane.support import INNER_SHARE

_BINS: Final = 100
# Points of the sample that hypotheses are drawn from, and that they are scored on, at most.
_DRAWN_MOST: Final = 50_000
_ASKED_MOST: Final = 150_000
# Points that all hypotheses are scored on, and those that the better ones are scored on again.
_FIRST_POINTS: Final = 2_000
_SECOND_POINTS: Final = 20_000
_SECOND_SHARE: Final = 0.1
_SECOND_LEAST: Final = 50
# Few points fix a plane badly: it may lean by this much more than what is looked for.
_LEAN_CAUTION_DEG: Final = 5.0
# Points within the tolerance may fall short of what a plane needs: the hypothesis is rough.
_SUPPORT_CAUTION: Final = 0.4
_POLISHED: Final = 4
# So many hypotheses near each other are scored again; the best of them fits better than any one.
_ALIKE_MOST: Final = 5
# Of the points within the tolerance so many must lie in its inner part; chance puts 0.4 there.
_CROWDED_SHARE: Final = 0.5
# Fresh draws after all hypotheses turned out to be none.
_REDRAWS: Final = 2


@dataclass(frozen=True, kw_only=True)
class Search:
    """What consensus is looked for.

    Attributes:
        model: planes through three points, or upright ones through two.
        scoring: what a hypothesis is worth.
        n_hypotheses: drawn for the first plane; for each further one half of them.
        find_m: tolerance.
        family: which planes are looked for.
        tilt_most_deg: how far they may be off vertical or level.
        least_share: share of the sample that a plane needs.
    """

    model: Model
    scoring: Scoring
    n_hypotheses: int
    find_m: float
    family: Family
    tilt_most_deg: float
    least_share: float


@dataclass(frozen=True, kw_only=True)
class _Pool:
    """Hypotheses with what they are worth, the best first, and the points that were asked."""

    hypotheses: Hypotheses
    scores: Scores
    asked_m: NDArray[np.float64]


class ConsensusProposer:
    """Proposes planes that many points of a sample lie on.

    Hypotheses that were good stay for the next plane and are scored anew on what remains.
    """

    def __init__(self, unassigned: Unassigned, search: Search, rng: np.random.Generator) -> None:
        """Get ready to propose.

        Args:
            unassigned: the sample.
            search: what is looked for.
            rng: source of chance.
        """
        self._search = search
        self._rng = rng
        points_m = unassigned.sample.offsets_m
        self._centre_m = np.median(points_m, axis=0)
        # Shuffled once, so that any first part of the free points is an even choice of them.
        self._shuffled = rng.permutation(len(points_m))[:_ASKED_MOST]
        drawn = self._shuffled[:_DRAWN_MOST]
        self._order = drawn[curve_order(points_m[drawn])]
        self._ordered_m = points_m[self._order] - self._centre_m
        corners = unassigned.box_corners_m
        self._box_m = corners.max(axis=0) - corners.min(axis=0)
        self._drawn_for = -1
        self._pool: _Pool | None = None
        self._witnesses = self._shuffled[:_SECOND_POINTS]
        self._rejections = Rejections(points_m[self._witnesses] - self._centre_m, search.find_m)

    def propose(self, unassigned: Unassigned) -> Candidate | None:
        """Name the best hypothesis about the points that remain."""
        if self._drawn_for != unassigned.n_points:
            self._rejections.take(unassigned.claims[self._witnesses] < 0)
            self._drawn_for = unassigned.n_points
            self._draw(unassigned)
        for _ in range(_REDRAWS):
            candidate = self._best(unassigned)
            if candidate is not None:
                return candidate
            self._draw(unassigned)
        return self._best(unassigned)

    def _best(self, unassigned: Unassigned) -> Candidate | None:
        pool = self._pool
        if pool is None:
            return None
        is_barred = self._rejections.cover(pool.hypotheses)
        for place in range(len(pool.hypotheses)):
            if is_barred[place] or not self._is_worth_it(pool.scores, place, unassigned):
                continue
            hypothesis = pool.hypotheses.take(np.array([place]))
            layer = self._crowded_layer(hypothesis, pool.asked_m, unassigned.up)
            if layer is not None:
                return self._candidate(hypothesis, pool.scores, place, layer, unassigned)
            # Not asked about again; the full verification would cost ten times as much.
            self._rejections.add(hypothesis)
            is_barred |= self._alike(pool.hypotheses, hypothesis)[:, 0]
        return None

    def reject(self, candidate: Candidate) -> None:
        """Bar the surroundings of a hypothesis that turned out to be no plane."""
        plane = candidate.plane
        offset_m = plane.offset_m - float(plane.normal @ self._centre_m)
        self._rejections.add(Hypotheses(normals=plane.normal[None], offsets_m=np.array([offset_m])))

    def _draw(self, unassigned: Unassigned) -> None:
        claims = unassigned.claims
        points_m = unassigned.sample.offsets_m
        free = np.flatnonzero(claims[self._order] < 0)
        earlier = self._pool
        self._pool = None
        if len(free) < 3:
            return
        count = self._search.n_hypotheses if earlier is None else self._search.n_hypotheses // 2
        drawn = draw_hypotheses(
            self._ordered_m.take(free, axis=0), count, self._search.model, unassigned.up, self._rng
        )
        hypotheses = drawn if earlier is None else Hypotheses.joined([drawn, earlier.hypotheses])
        hypotheses = hypotheses.take(self._leans_well(hypotheses, unassigned.up))
        hypotheses = hypotheses.take(~self._rejections.cover(hypotheses))
        if len(hypotheses) == 0:
            return
        # Among the first of them there nearly always are enough.
        asked = self._shuffled[: 4 * _SECOND_POINTS]
        asked = asked[claims[asked] < 0]
        if len(asked) < _SECOND_POINTS:
            asked = self._shuffled[claims[self._shuffled] < 0]
        parts = unassigned.parts
        asked_m = points_m.take(asked[:_SECOND_POINTS], axis=0) - self._centre_m
        first = self._score(hypotheses, asked_m[:_FIRST_POINTS], parts)
        n_kept = max(_SECOND_LEAST, round(_SECOND_SHARE * len(hypotheses)))
        kept = self._distinct(hypotheses, np.argsort(-first.value, kind="stable"), n_kept)
        hypotheses = hypotheses.take(kept)
        second = self._score(hypotheses, asked_m, parts)
        ranked = np.argsort(-second.value, kind="stable")
        self._pool = _Pool(
            hypotheses=hypotheses.take(ranked),
            asked_m=asked_m,
            scores=Scores(
                value=second.value[ranked],
                tolerance_m=second.tolerance_m[ranked],
                n_points=second.n_points[ranked],
            ),
        )

    def _score(self, hypotheses: Hypotheses, points_m: NDArray[np.float64], parts: int) -> Scores:
        columns = np.ascontiguousarray(points_m.T, dtype=np.float32)
        rows = hypotheses.rows()
        find_m, scoring = self._search.find_m, self._search.scoring
        if scoring != "a-contrario":
            sums = np.zeros((len(rows), 2), dtype=np.int64)
            pieces = zip(np.array_split(rows, parts), np.array_split(sums, parts), strict=True)
            in_threads(
                [
                    partial(consensus_sums, columns, planes, find_m, _BINS, table)
                    for planes, table in pieces
                ]
            )
            return scores_of_sums(sums, scoring, n_bins=_BINS, reach_m=find_m)
        histograms = np.zeros((len(rows), _BINS), dtype=np.int32)
        tables = zip(np.array_split(rows, parts), np.array_split(histograms, parts), strict=True)
        in_threads(
            [
                partial(distance_histograms, columns, planes, find_m, table)
                for planes, table in tables
            ]
        )
        return scores_of(
            histograms,
            scoring,
            reach_m=find_m,
            n_points=len(points_m),
            extents_m=np.abs(hypotheses.normals) @ self._box_m,
            model_points=MODEL_POINTS[self._search.model],
        )

    def _leans_well(self, hypotheses: Hypotheses, up: NDArray[np.float64]) -> NDArray[np.bool_]:
        tilts_deg = np.degrees(np.arcsin(np.clip(np.abs(hypotheses.normals @ up), 0.0, 1.0)))
        limit_deg = self._search.tilt_most_deg + _LEAN_CAUTION_DEG
        if self._search.family == "any":
            return np.ones(len(hypotheses), dtype=bool)
        wall = self._search.family == "wall"
        leans: NDArray[np.bool_] = tilts_deg <= limit_deg if wall else tilts_deg >= 90 - limit_deg
        return leans

    def _alike(self, hypotheses: Hypotheses, others: Hypotheses) -> NDArray[np.bool_]:
        """(h, o) whether hypotheses are much the same as others."""
        return alike(hypotheses, others, self._search.find_m)

    def _distinct(
        self, hypotheses: Hypotheses, ranked: NDArray[np.intp], n_most: int
    ) -> NDArray[np.intp]:
        """The best of some ranked hypotheses, no more than `_ALIKE_MOST` of them much the same."""
        # The best ones nearly always hold enough that differ.
        for n_asked in (min(len(ranked), _ALIKE_MOST * n_most), len(ranked)):
            asked = ranked[:n_asked]
            some = hypotheses.take(asked)
            near = self._alike(some, some)
            kept: list[int] = []
            alike = np.zeros(n_asked, dtype=np.int64)
            for place in range(n_asked):
                if alike[place] < _ALIKE_MOST and len(kept) < n_most:
                    kept.append(place)
                    alike += near[place]
            if len(kept) == n_most:
                break
        return asked[kept]

    def _is_worth_it(self, scores: Scores, place: int, unassigned: Unassigned) -> bool:
        if self._search.scoring == "a-contrario" and scores.value[place] <= 0.0:
            return False
        asked = min(_SECOND_POINTS, unassigned.n_points)
        share = scores.n_points[place] / max(1, asked)
        n_points = share * unassigned.n_points
        return bool(
            n_points >= _SUPPORT_CAUTION * self._search.least_share * len(unassigned.claims)
        )

    def _crowded_layer(
        self, hypothesis: Hypotheses, asked_m: NDArray[np.float64], up: NDArray[np.float64]
    ) -> Plane | None:
        """The densest layer near a hypothesis, about the centre, if points crowd about it.

        A plane through mouldings and clutter holds many points too, but spread over its slab.
        """
        normal = hypothesis.normals[0] / np.linalg.norm(hypothesis.normals[0])
        start = Plane(normal=normal, offset_m=float(hypothesis.offsets_m[0]))
        find_m = self._search.find_m
        moved = refine_plane(asked_m, start, find_m, freedom="free", up=up)
        if moved is None:
            return None
        sizes_m = np.abs(moved.distances_m(asked_m))
        inner = np.count_nonzero(sizes_m <= INNER_SHARE * find_m)
        crowds = inner >= _CROWDED_SHARE * np.count_nonzero(sizes_m <= find_m)
        return moved if crowds else None

    def _candidate(
        self,
        hypothesis: Hypotheses,
        scores: Scores,
        place: int,
        layer: Plane,
        unassigned: Unassigned,
    ) -> Candidate:
        own_m = None
        if self._search.scoring == "a-contrario":
            hypothesis, own_m = self._polished(hypothesis, scores, place, unassigned)
        normal = hypothesis.normals[0] / np.linalg.norm(hypothesis.normals[0])
        offset_m = float(hypothesis.offsets_m[0]) + float(normal @ self._centre_m)
        return Candidate(
            plane=Plane(normal=normal, offset_m=offset_m),
            family="wall" if self._search.model == "2d" else self._search.family,
            votes=float(scores.value[place]),
            own_tolerance_m=own_m,
            start=Plane(
                normal=layer.normal,
                offset_m=layer.offset_m + float(layer.normal @ self._centre_m),
            ),
        )

    def _polished(
        self, hypothesis: Hypotheses, scores: Scores, place: int, unassigned: Unassigned
    ) -> tuple[Hypotheses, float]:
        """Fit to the points within the own tolerance, find that anew, while it gets better."""
        relative_m = (unassigned.sample.offsets_m - self._centre_m)[unassigned.claims < 0]
        best = self._score(hypothesis, relative_m, 1)
        for _ in range(_POLISHED):
            distances_m = relative_m @ hypothesis.normals[0] - hypothesis.offsets_m[0]
            near_m = relative_m[np.abs(distances_m) <= best.tolerance_m[0]]
            fitted = _fitted(near_m, self._search.model, unassigned.up)
            if fitted is None:
                break
            score = self._score(fitted, relative_m, 1)
            if score.value[0] <= best.value[0]:
                break
            hypothesis, best = fitted, score
        return hypothesis, float(best.tolerance_m[0])


def _fitted(
    points_m: NDArray[np.float64], model: Model, up: NDArray[np.float64]
) -> Hypotheses | None:
    """Plane of least squared distances, upright for the 2D model."""
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
