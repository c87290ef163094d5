"""Hypotheses that turned out to be no planes, which stay out until points near them are taken."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow_plugins.plane.hypotheses import Hypotheses

# A hypothesis this near to one that turned out to be none is not proposed again.
_ALIKE_DEG: Final = 2.0
_ALIKE_TOLERANCES: Final = 1.0
# What was no plane among other points may be one among those that remain, if so many are gone.
_LOST_SHARE: Final = 0.05


def alike(first: Hypotheses, second: Hypotheses, tolerance_m: float) -> NDArray[np.bool_]:
    """(f, s) whether hypotheses are much the same as others."""
    cosines = first.normals @ second.normals.T
    apart_m = np.abs(first.offsets_m[:, None] - np.copysign(1.0, cosines) * second.offsets_m)
    near: NDArray[np.bool_] = (np.abs(cosines) > math.cos(math.radians(_ALIKE_DEG))) & (
        apart_m < _ALIKE_TOLERANCES * tolerance_m
    )
    return near


class Rejections:
    """Hypotheses that were examined in vain.

    An examination asks the points near a hypothesis: as long as no plane takes any of them it would
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
        self._rejected = self._rejected.joined(hypothesis)
        self._n_near = np.append(self._n_near, self._count(hypothesis))

    def take(self, is_free: NDArray[np.bool_]) -> None:
        """Hear which of the points (m,) are left, and forget those that lost some of theirs."""
        self._is_free = is_free
        if len(self._rejected) == 0:
            return
        n_near = self._count(self._rejected)
        stays = n_near >= (1.0 - _LOST_SHARE) * self._n_near
        self._rejected, self._n_near = self._rejected.chosen(stays), self._n_near[stays]

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
