"""How ties lie over a photo: cells, quarters, hull, and a share of them withheld evenly."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.rings import signed_area

_STRATA: Final = 6
# Cells per side of a photo within which ties may err together. On simulated rooms ties agree in
# their errors up to some 60 px of 1200: with 6 cells more of that crosses the borders, with 4 too
# few are left to learn from (error over stated, pooled over 94 photos: 1.39 with 6, 1.34 with 5).
GROUPS: Final = 5
# Eight directions (2, 8), counter-clockwise.
_ALL_AROUND: Final = np.array([[1, 1, 0, -1, -1, -1, 0, 1], [0, 1, 1, 1, 0, -1, -1, -1]])


def image_cells(
    pixels_photo: NDArray[np.float64], size_px: tuple[int, int], side: int
) -> NDArray[np.intp]:
    """Cell (n,) of each pixel in a grid of side x side cells over an image (width, height)."""
    scaled = np.floor(pixels_photo * side / np.array(size_px)).astype(np.intp)
    scaled = np.clip(scaled, 0, side - 1)
    cells: NDArray[np.intp] = scaled[:, 1] * side + scaled[:, 0]
    return cells


def withheld(
    pixels_photo: NDArray[np.float64],
    size_px: tuple[int, int],
    share: float,
    rng: np.random.Generator,
) -> NDArray[np.bool_]:
    """Choose the check points (n,): a share of the ties, evenly from all parts of the image.

    The ties are shuffled, ordered by the cell of the image they lie in, and one of every 1 / share
    is taken along that order: each cell gives its share, and the whole is at least `share`.
    """
    shuffled = rng.permutation(len(pixels_photo))
    cells = image_cells(pixels_photo, size_px, _STRATA)
    order = shuffled[np.argsort(cells[shuffled], kind="stable")]
    n_check = math.ceil(share * len(order))
    picked = np.floor((np.arange(n_check) + rng.random()) * len(order) / max(n_check, 1))
    chosen = np.zeros(len(order), dtype=np.bool_)
    chosen[order[np.minimum(picked.astype(np.intp), len(order) - 1)]] = True
    return chosen


def quadrant_counts(
    pixels_photo: NDArray[np.float64], size_px: tuple[int, int]
) -> NDArray[np.intp]:
    """Ties (4,) in the quarters of an image: top-left, top-right, bottom-left, bottom-right."""
    return np.bincount(image_cells(pixels_photo, size_px, 2), minlength=4)


def hull_area(pixels: NDArray[np.float64]) -> float:
    """Area of the convex hull of points (n, 2); 0 for fewer than three or points on a line."""
    unique = np.unique(pixels, axis=0)
    if len(unique) < 3:
        return 0.0
    outer = unique[~_is_inside(unique)]
    lower = _chain(outer)
    upper = _chain(outer[::-1])
    ring = np.vstack([lower[:-1], upper[:-1]])
    return abs(signed_area(ring))


def _is_inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell of points (n, 2), which differ, those within the octagon of the outermost: no corner.

    Of a thousand ties some dozens are left for the chains, which go from point to point.
    """
    corners = points[np.argmax(points @ _ALL_AROUND, axis=0)]
    sides = np.roll(corners, -1, axis=0) - corners
    away = points[:, None] - corners
    turns = sides[:, 0] * away[..., 1] - sides[:, 1] * away[..., 0]
    # Rounding must not let a point count as inside that lies on a side.
    margin = 1e-9 * float(np.ptp(points, axis=0).max()) ** 2
    is_point = ~sides.any(axis=1)
    inside: NDArray[np.bool_] = ((turns > margin) | is_point).all(axis=1)
    return inside


def _chain(ordered: NDArray[np.float64]) -> NDArray[np.float64]:
    """One side of the hull of points ordered by u (Andrew's monotone chain)."""
    chain: list[NDArray[np.float64]] = []
    for point in ordered:
        while len(chain) >= 2:
            first, second = chain[-1] - chain[-2], point - chain[-2]
            if first[0] * second[1] - first[1] * second[0] > 0.0:
                break
            chain.pop()
        chain.append(point)
    return np.array(chain)
