"""Seven-parameter transformations: shift, rotation and scale from pairs of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError

# Points whose second-largest spread is a smaller share of the largest lie on one line.
_LINE_SHARE = 1e-6


@dataclass(frozen=True, kw_only=True)
class Similarity:
    """`target = translation + scale * rotation @ source`.

    Attributes:
        scale: dimensionless, positive.
        rotation: (3, 3) float64, det +1.
        translation: (3,) float64 metres.
    """

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def apply(self, points_source: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) in target coordinates."""
        moved: NDArray[np.float64] = self.scale * points_source @ self.rotation.T + self.translation
        return moved


def fit_similarity(
    points_source: NDArray[np.float64], points_target: NDArray[np.float64], *, with_scale: bool
) -> Similarity:
    """Fit target_from_source by least squares, all coordinates alike (Umeyama 1991).

    Args:
        points_source: (n, 3) metres, n >= 3, not on one line.
        points_target: (n, 3) metres, the same points.
        with_scale: seven parameters; else six, with a scale of 1.

    Raises:
        GeometryError: there are too few points, or they lie on one line.
    """
    if len(points_source) < 3 or points_source.shape != points_target.shape:
        raise GeometryError(
            f"a similarity needs at least 3 pairs of points, got {len(points_source)}"
        )
    middle_source, middle_target = points_source.mean(axis=0), points_target.mean(axis=0)
    source, target = points_source - middle_source, points_target - middle_target
    spread = np.linalg.svd(source, compute_uv=False)
    if not spread[1] > _LINE_SHARE * spread[0]:
        raise GeometryError("the points of a similarity lie on one line: it could turn about that")
    u, values, vt = np.linalg.svd(target.T @ source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation: NDArray[np.float64] = u @ np.diag(signs) @ vt
    scale = float(values @ signs / np.sum(source**2)) if with_scale else 1.0
    return Similarity(
        scale=scale,
        rotation=rotation,
        translation=middle_target - scale * rotation @ middle_source,
    )
