"""Centres of black and white quadrant targets, accurate to a few hundredths of a cell."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import to_opencv
from orthoflow_plugins.inspect.patches import GreyCells, GreyImage

_ROUNDS: Final = 20
_CONVERGED_CELLS: Final = 1e-3
_LEAST_VALID_SHARE: Final = 0.5
# Minimum correlation between a target and its copy rotated by 180 deg, and between a target and its
# negative rotated by 90 deg.
_LEAST_ALIKE: Final = 0.6
_SMOOTH_CELLS: Final = 1.2
_LEAST_WEIGHT: Final = 0.2


def find_crossing(
    picture: GreyCells, near: NDArray[np.float64], *, search_cells: float, radius_cells: float
) -> NDArray[np.float64] | None:
    """Find the centre of a target near a position.

    The centre is a saddle point of the smoothed image. Its cell is found first, as the one with the
    lowest determinant of the Hessian. The centre is then moved by least squares until the image is
    symmetric under a rotation by 180 degrees about this point. All four edges contribute, and their
    directions are irrelevant.

    Args:
        picture: grey levels with valid cells.
        near: (2,) column and row of the position.
        search_cells: search radius.
        radius_cells: radius of the target, or of its inner part if only that part is used.

    Returns:
        (2,) float64 column and row where the quadrants meet, or None if there is no target.
    """
    margin = int(np.ceil(search_cells + radius_cells)) + 3
    corner = np.floor(near).astype(np.int64) - margin
    window = _window(picture, corner, 2 * margin + 1)
    start = _saddle(window, near - corner, search_cells, radius_cells)
    if start is None:
        return None
    place = _symmetric(window, start, radius_cells)
    if place is None or np.linalg.norm(place - (near - corner)) > search_cells + 1.0:
        return None
    alike = _turned_correlation(window, place, radius_cells, half=True)
    swapped = -_turned_correlation(window, place, radius_cells, half=False)
    return None if min(alike, swapped) < _LEAST_ALIKE else place + corner


def _window(picture: GreyCells, corner: NDArray[np.int64], side: int) -> GreyImage:
    """Return a square with voids filled from their surroundings; invalid outside the image."""
    part = picture.square(corner, side)
    return _closed(np.where(part.valid, part.grey, 0.0), part.valid)


def _closed(grey: NDArray[np.float64], valid: NDArray[np.bool_]) -> GreyImage:
    """Smooth an image by fitting a plane to the valid grey levels around each cell.

    A mean would be biased towards the side of an edge with fewer holes (Knutsson and Westin 1993,
    normalised convolution of first order).
    """
    from scipy.ndimage import correlate1d

    steps = np.arange(-4, 5) / _SMOOTH_CELLS
    gauss = np.exp(-0.5 * steps**2)
    powers = [gauss * steps**power for power in range(3)]

    def moment(values: NDArray[np.float64], down: int, right: int) -> NDArray[np.float64]:
        along = correlate1d(values, powers[down], axis=0, mode="constant")
        return correlate1d(along, powers[right], axis=1, mode="constant")

    weight = valid.astype(np.float64)
    orders = ((0, 0), (1, 0), (0, 1))
    normal = np.empty((*grey.shape, 3, 3))
    for i, one in enumerate(orders):
        for j, other in enumerate(orders):
            normal[..., i, j] = moment(weight, one[0] + other[0], one[1] + other[1])
    right_side = np.stack([moment(weight * grey, *order) for order in orders], axis=-1)
    total = normal[..., 0, 0]
    enough = total > _LEAST_WEIGHT * gauss.sum() ** 2
    # Regularise, so that the equations can be solved far from all valid cells.
    normal += 1e-6 * np.eye(3)
    level = np.linalg.solve(normal, right_side[..., None])[..., 0, 0]
    return GreyImage(grey=np.where(enough, level, 0.0), valid=enough, region=valid)


def _saddle(
    window: GreyImage, near: NDArray[np.float64], search: float, radius: float
) -> NDArray[np.float64] | None:
    """Return the cell (2,) = (column, row) of the strongest saddle within the search radius."""
    from scipy.ndimage import gaussian_filter

    width = max(1.5, 0.3 * radius)
    share = gaussian_filter(window.valid.astype(np.float64), width)
    middle = float(np.mean(window.grey[window.valid])) if window.valid.any() else 0.0
    level = np.where(window.valid, window.grey, middle)
    second = [gaussian_filter(level, width, order=order) for order in ((2, 0), (0, 2), (1, 1))]
    strength = second[2] ** 2 - second[0] * second[1]
    rows, columns = np.mgrid[: level.shape[0], : level.shape[1]] + 0.5
    outside = np.hypot(columns - near[0], rows - near[1]) > search
    strength[outside | (share < _LEAST_VALID_SHARE)] = -np.inf
    best = np.unravel_index(int(np.argmax(strength)), strength.shape)
    if not strength[best] > 0.0:
        return None
    return np.array([best[1] + 0.5, best[0] + 0.5])


def _symmetric(
    window: GreyImage, start: NDArray[np.float64], radius: float
) -> NDArray[np.float64] | None:
    """Move the centre to the point of best 180 degree symmetry; None if it diverges."""
    from scipy.ndimage import map_coordinates

    aside = _disc(radius)
    slopes = [np.gradient(window.grey, axis=axis) for axis in (1, 0)]
    place = start.copy()
    for _ in range(_ROUNDS):
        # In scipy, as in OpenCV, integer coordinates are the centres of cells.
        ways = [to_opencv(place + sign * aside).T[::-1] for sign in (1.0, -1.0)]
        greys = [map_coordinates(window.grey, way, order=3, mode="nearest") for way in ways]
        valid = [
            map_coordinates(window.valid.astype(np.float64), way, order=1, cval=0.0) > 0.99
            for way in ways
        ]
        both = valid[0] & valid[1]
        if np.count_nonzero(both) < _LEAST_VALID_SHARE * len(aside):
            return None
        design = np.column_stack(
            [
                map_coordinates(slope, ways[0], order=1, mode="nearest")
                - map_coordinates(slope, ways[1], order=1, mode="nearest")
                for slope in slopes
            ]
        )[both]
        step = np.linalg.lstsq(design, (greys[1] - greys[0])[both], rcond=None)[0]
        place = place + np.clip(step, -1.0, 1.0)
        if np.linalg.norm(place - start) > radius:
            return None
        if np.abs(step).max() < _CONVERGED_CELLS:
            break
    return np.asarray(place)


def _turned_correlation(
    window: GreyImage, place: NDArray[np.float64], radius: float, *, half: bool
) -> float:
    from scipy.ndimage import map_coordinates

    aside = _disc(radius)
    turned = -aside if half else np.column_stack([-aside[:, 1], aside[:, 0]])
    one, other = (
        map_coordinates(window.grey, to_opencv(place + way).T[::-1], order=1, mode="nearest")
        for way in (aside, turned)
    )
    spread = float(np.std(one) * np.std(other))
    return float(np.mean((one - one.mean()) * (other - other.mean()))) / max(spread, 1e-12)


def _disc(radius: float) -> NDArray[np.float64]:
    """Return offsets (n, 2) within a disc."""
    side = np.arange(-np.floor(radius), np.floor(radius) + 1.0)
    columns, rows = np.meshgrid(side, side)
    inside = np.hypot(columns, rows) <= radius
    return np.column_stack([columns[inside], rows[inside]])
