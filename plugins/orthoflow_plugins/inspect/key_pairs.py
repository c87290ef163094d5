"""Pairs of SURF key points in two pictures of one surface on one grid, refined to sub-pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.opencv_border import from_opencv
from orthoflow.geometry.threads import in_order
from orthoflow_plugins.inspect.patches import (
    PATCH_CELLS,
    GreyImage,
    refine_shifts,
    unrefined,
)

# Cells per key point at most: more are noise.
_CELLS_PER_POINT: Final = 200
_POINTS_LEAST, _POINTS_MOST = 500, 40_000
_SCALES_DIFFER_MOST: Final = 1.5
_RATIO_MOST: Final = 0.9
_CONTRAST_CELLS: Final = 24.0
_LEAST_CONTRAST_GREY: Final = 2.0
_LEAST_VALID_SHARE: Final = 0.6
_LEAST_CORRELATION: Final = 0.6
_SIGMA_MOST_CELLS: Final = 0.5
# A pair is believed when so many of its nearest ones agree with it.
_NEIGHBOURS: Final = 16
_WITNESS_CELLS: Final = 8.0
_AGREEING: Final = 2
_AGREEING_SHARE: Final = 0.25
_AGREE_CELLS: Final = 1.0


@dataclass(frozen=True, kw_only=True)
class KeyPairs:
    """Where the same is seen in two pictures.

    Attributes:
        places: (n, 2) float64 (column, row) in the shown picture.
        shift: (n, 2) float64 cells along u and v, shown - reference, refined.
        found: (n, 2) float64 the same as SURF alone gives it.
        n_points: key points of the two pictures.
        n_matched: pairs of like descriptors, right or wrong.
    """

    places: NDArray[np.float64]
    shift: NDArray[np.float64]
    found: NDArray[np.float64]
    n_points: tuple[int, int]
    n_matched: int

    def __len__(self) -> int:
        return len(self.places)


def no_pairs() -> KeyPairs:
    """Give the pairs of pictures in which nothing was looked for."""
    nothing = np.zeros((0, 2))
    return KeyPairs(places=nothing, shift=nothing, found=nothing, n_points=(0, 0), n_matched=0)


@dataclass(frozen=True, kw_only=True)
class _KeyPoints:
    """SURF key points: places (n, 2), scale (n,), sign of the Laplacian (n,), descriptors."""

    places: NDArray[np.float64]
    scale: NDArray[np.float64]
    sign: NDArray[np.float64]
    descriptors: NDArray[np.float64]


def find_key_pairs(
    shown: GreyImage, reference: GreyImage, *, radius_cells: float, threads: int = 1
) -> KeyPairs:
    """Find pairs within a radius.

    Both pictures are levelled to one contrast in their surroundings first, because laser and
    camera see different brightness. Descriptors are matched mutually among key points of like
    scale and sign; patches of 32 x 32 cells about a pair are then matched by least squares, and
    pairs whose patches do not correlate, or that no neighbour agrees with, are left out.

    Args:
        shown: the picture to judge.
        reference: what it should show.
        radius_cells: largest distance that is looked for.
        threads: the pairs do not hang on their number.
    """
    first, second = in_order(_levelled, (shown, reference), threads=threads)
    points = tuple(in_order(_key_points, (first, second), threads=threads))
    matches = _matches(points[0], points[1], radius_cells)
    places = points[0].places[matches[:, 0]]
    found = places - points[1].places[matches[:, 1]]
    refined = refine_shifts(
        first,
        second,
        unrefined(np.round(places), found),
        sigma_most_cells=_SIGMA_MOST_CELLS,
        threads=threads,
    )
    alike = refined.correlation >= _LEAST_CORRELATION
    places, shift = refined.centre[alike], refined.shift[alike]
    kept = _agreed(places, shift)
    return KeyPairs(
        places=places[kept],
        shift=shift[kept],
        found=refined.found[alike][kept],
        n_points=(len(points[0].places), len(points[1].places)),
        n_matched=len(matches),
    )


def _agreed(places: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which pairs agree with some of their nearest ones: chance agrees with nobody."""
    from scipy.spatial import cKDTree

    n_near = min(_NEIGHBOURS, len(places) - 1)
    if n_near < _AGREEING:
        return np.zeros(len(places), dtype=np.bool_)
    away, near = cKDTree(places).query(places, k=n_near + 1)
    apart = np.linalg.norm(shift[near] - shift[:, None], axis=2)
    # The same place found at several scales is one witness, not several.
    agrees = (apart <= _AGREE_CELLS) & (away > _WITNESS_CELLS)
    # A motif that repeats lets two or three pairs err alike, but not a quarter of a neighbourhood.
    needed = max(_AGREEING, _AGREEING_SHARE * n_near)
    agreed = np.ones(len(places), dtype=np.bool_)
    # Witnesses must be believed themselves.
    while True:
        kept: NDArray[np.bool_] = np.count_nonzero(agrees & agreed[near], axis=1) >= needed
        if np.array_equal(kept, agreed):
            return agreed
        agreed = kept


def _levelled(image: GreyImage) -> GreyImage:
    """Bring local mean and spread of what is valid to 128 and 40; elsewhere 128."""
    valid = image.valid.astype(np.float32)
    grey = np.where(image.valid, image.grey, 0.0).astype(np.float32)
    weight = np.maximum(_smooth(valid), np.float32(1e-3))
    mean = _smooth(grey) / weight
    variance = np.maximum(_smooth(grey * grey) / weight - mean * mean, 0.0)
    spread = np.maximum(np.sqrt(variance), np.float32(_LEAST_CONTRAST_GREY))
    level = np.clip(128.0 + 40.0 * (grey - mean) / spread, 0.0, 255.0)
    return GreyImage(
        grey=np.where(image.valid, level, 128.0).astype(np.float64),
        valid=image.valid,
        region=image.region,
    )


def _smooth(values: NDArray[np.float32]) -> NDArray[np.float32]:
    import cv2

    # Two passes of a box come near a Gaussian and cost nothing at any width.
    side = 2 * round(0.5 * _CONTRAST_CELLS) + 1
    once = cv2.boxFilter(values, -1, (side, side), borderType=cv2.BORDER_CONSTANT)
    twice = cv2.boxFilter(once, -1, (side, side), borderType=cv2.BORDER_CONSTANT)
    return np.asarray(twice, dtype=np.float32)


def _key_points(image: GreyImage) -> _KeyPoints:
    """Key points whose patch lies inside the picture and is mostly valid."""
    from mahotas.features import surf

    n_most = int(np.clip(image.grey.size // _CELLS_PER_POINT, _POINTS_LEAST, _POINTS_MOST))
    found = surf.surf(image.grey, threshold=0.1, max_points=n_most)
    # mahotas gives y, x, scale, score, sign of the Laplacian, angle and 64 numbers; it counts cells
    # from their centres, as OpenCV does.
    places = from_opencv(found[:, 1::-1])
    rows, columns = image.grey.shape
    half = PATCH_CELLS // 2
    inside = np.all((places > half) & (places < (columns - half, rows - half)), axis=1)
    share = _patch_means(image.valid.astype(np.float32), places[inside])
    kept = np.flatnonzero(inside)[share >= _LEAST_VALID_SHARE]
    return _KeyPoints(
        places=places[kept],
        scale=found[kept, 2],
        sign=found[kept, 4],
        descriptors=found[kept, 6:],
    )


def _patch_means(values: NDArray[np.float32], places: NDArray[np.float64]) -> NDArray[np.float32]:
    import cv2

    means = cv2.blur(values, (PATCH_CELLS, PATCH_CELLS), borderType=cv2.BORDER_CONSTANT)
    cells = places.astype(np.int64)
    return np.asarray(np.asarray(means)[cells[:, 1], cells[:, 0]], dtype=np.float32)


def _matches(first: _KeyPoints, second: _KeyPoints, radius: float) -> NDArray[np.int64]:
    """Pairs (m, 2) of rows, each other's best by descriptor and clearly better than the next."""
    from scipy.spatial import cKDTree

    nothing = np.zeros((0, 2), dtype=np.int64)
    if not len(first.places) or not len(second.places):
        return nothing
    near = cKDTree(first.places).sparse_distance_matrix(
        cKDTree(second.places), radius, output_type="ndarray"
    )
    one, other = near["i"], near["j"]
    likes = (first.sign[one] == second.sign[other]) & (
        np.abs(np.log(first.scale[one] / second.scale[other])) <= np.log(_SCALES_DIFFER_MOST)
    )
    one, other = one[likes], other[likes]
    if not len(one):
        return nothing
    apart = _descriptor_distances(first.descriptors, second.descriptors, one, other)
    best = _clear_winners(one, apart, len(first.places))
    back = _clear_winners(other, apart, len(second.places))
    kept = best & back
    return np.column_stack([one[kept], other[kept]]).astype(np.int64)


def _descriptor_distances(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    one: NDArray[np.int64],
    other: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Distances of pairs, a part at a time, so that many pairs need little room."""
    apart = np.empty(len(one))
    for start in range(0, len(one), 1 << 16):
        part = slice(start, start + (1 << 16))
        apart[part] = np.linalg.norm(first[one[part]] - second[other[part]], axis=1)
    return apart


def _clear_winners(
    owner: NDArray[np.int64], apart: NDArray[np.float64], n_owners: int
) -> NDArray[np.bool_]:
    """Which pairs are the nearest of their owner, nearer than its second by the ratio."""
    order = np.lexsort((apart, owner))
    starts = np.flatnonzero(np.diff(owner[order], prepend=-1))
    nearest = np.full(n_owners, np.inf)
    second = np.full(n_owners, np.inf)
    nearest[owner[order[starts]]] = apart[order[starts]]
    has_next = np.append(np.diff(starts) > 1, len(order) - starts[-1] > 1)
    next_ones = starts[has_next] + 1
    second[owner[order[next_ones]]] = apart[order[next_ones]]
    wins: NDArray[np.bool_] = (apart == nearest[owner]) & (apart <= _RATIO_MOST * second[owner])
    return wins
