"""Matching of SURF key points between two images on the same grid, with sub-pixel refinement."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import from_opencv
from orthoflow.geometry.threads import in_order
from orthoflow_plugins.inspect.patches import (
    PATCH_CELLS,
    GreyCells,
    GreyImage,
    PatchShifts,
    refine_shifts,
    tiles,
    unrefined,
)

# At most one key point per this many cells is used, since weaker key points are noise.
_CELLS_PER_POINT: Final = 200
_POINTS_LEAST, _POINTS_MOST = 500, 40_000
_SCALES_DIFFER_MOST: Final = 1.5
_PAIRS_AT_ONCE: Final = 1 << 16
_RATIO_MOST: Final = 0.9
# Half width of the box filter that normalises the contrast; the filter is applied twice.
_LEVEL_REACH: Final = 12
_LEAST_CONTRAST_GREY: Final = 2.0
_LEAST_VALID_SHARE: Final = 0.6
_LEAST_CORRELATION: Final = 0.6
_SIGMA_MOST_CELLS: Final = 0.5
# Number of nearest neighbours of a pair, enough of which must agree with the pair.
_NEIGHBOURS: Final = 16
_WITNESS_CELLS: Final = 8.0
_AGREEING: Final = 2
_AGREEING_SHARE: Final = 0.25
_AGREE_CELLS: Final = 1.0
_SURF_THRESHOLD: Final = 0.1
# Larger images are processed in tiles with a margin for the support of the largest key points; a
# tile needs about 2 GB of memory.
WHOLE_CELLS: Final = 1 << 24
TILE_CELLS: Final = 3072
RIM_CELLS: Final = 512


@dataclass(frozen=True, kw_only=True)
class SurfPoints:
    """SURF key points: positions (n, 2), scales (n,), signs of the Laplacian (n,), descriptors."""

    places: NDArray[np.float64]
    scale: NDArray[np.float64]
    sign: NDArray[np.float64]
    descriptors: NDArray[np.float64]


def find_key_pairs(
    shown: GreyCells, reference: GreyCells, *, radius_cells: float, threads: int = 1
) -> PatchShifts:
    """Find pairs of corresponding key points in two images.

    The local contrast of both images is normalised first, because laser and camera record different
    brightness. Two key points of similar scale and the same sign are paired if each has the best
    descriptor for the other. Patches of 32 x 32 cells around each pair are then matched by least
    squares. A pair is dropped if its patches do not correlate or if it disagrees with its
    neighbours. Large images are processed tile by tile.

    Args:
        shown: the image to inspect.
        reference: the image with which `shown` is compared.
        radius_cells: maximum displacement.
        threads: number of threads.

    Returns:
        The pairs as patches of the shown image, with their displacements from the reference.
    """
    shape = shown.shape
    is_whole = math.prod(shape) <= WHOLE_CELLS
    found = PatchShifts.joined(
        [
            _pairs_of_tile(shown, reference, tile, radius_cells, threads=threads, is_whole=is_whole)
            for tile in tiles(shape, max(shape) if is_whole else TILE_CELLS)
        ]
    )
    return found.take(agreeing_pairs(found.centre, found.shift))


def _pairs_of_tile(
    shown: GreyCells,
    reference: GreyCells,
    tile: tuple[slice, slice],
    radius_cells: float,
    *,
    threads: int,
    is_whole: bool,
) -> PatchShifts:
    """Find the pairs whose first point is in a tile; key points in the margin are also matched."""
    rows, columns = (
        slice(max(0, part.start - RIM_CELLS), min(size, part.stop + RIM_CELLS))
        for part, size in zip(tile, shown.shape, strict=True)
    )
    corner = np.array([columns.start, rows.start])
    images = [cells.cut((rows, columns)) for cells in (shown, reference)]
    first, second = in_order(_levelled, images, threads=threads)
    share = images[0].grey.size / math.prod(shown.shape)
    # Process only one tile at a time, since two would need too much memory.
    key_points = partial(_key_points, n_most=round(share * _n_most(shown.shape)))
    one, other = in_order(key_points, (first, second), threads=threads if is_whole else 1)
    matches = matched_pairs(one, other, radius_cells)
    places = one.places[matches[:, 0]]
    low, end = ([getattr(part, name) for part in tile[::-1]] for name in ("start", "stop"))
    own = np.all((places + corner >= low) & (places + corner < end), axis=1)
    places, matches = places[own], matches[own]
    refined = refine_shifts(
        first,
        second,
        unrefined(np.round(places), places - other.places[matches[:, 1]]),
        sigma_most_cells=_SIGMA_MOST_CELLS,
        threads=threads,
    )
    refined = refined.take(refined.correlation >= _LEAST_CORRELATION)
    return replace(refined, centre=refined.centre + corner)


def _n_most(shape: tuple[int, int]) -> int:
    return int(np.clip(math.prod(shape) // _CELLS_PER_POINT, _POINTS_LEAST, _POINTS_MOST))


def agreeing_pairs(places: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the pairs that agree with enough neighbours, unlike chance matches."""
    from scipy.spatial import cKDTree

    n_near = min(_NEIGHBOURS, len(places) - 1)
    if n_near < _AGREEING:
        return np.zeros(len(places), dtype=np.bool_)
    away, near = cKDTree(places).query(places, k=n_near + 1)
    apart = np.linalg.norm(shift[near] - shift[:, None], axis=2)
    # Very close pairs are the same point at several scales, and do not count as neighbours.
    agrees = (apart <= _AGREE_CELLS) & (away > _WITNESS_CELLS)
    # With repeated texture, two or three neighbours may be wrong in the same way, but not a quarter
    # of all neighbours.
    needed = max(_AGREEING, _AGREEING_SHARE * n_near)
    agreed = np.ones(len(places), dtype=np.bool_)
    # Repeat until each accepted pair is supported by other accepted pairs.
    while True:
        kept: NDArray[np.bool_] = np.count_nonzero(agrees & agreed[near], axis=1) >= needed
        if np.array_equal(kept, agreed):
            return agreed
        agreed = kept


def _levelled(image: GreyImage) -> GreyImage:
    """Normalise to a local mean of 128 and standard deviation of 40; invalid cells are 128."""
    valid = image.valid.astype(np.float32)
    grey = np.where(image.valid, image.grey, 0.0).astype(np.float32)
    weight = np.maximum(_smooth(valid), np.float32(1e-6))
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

    # Two passes of a box filter approximate a Gaussian at a cost that does not depend on its width.
    side = 2 * _LEVEL_REACH + 1
    once = cv2.blur(values, (side, side), borderType=cv2.BORDER_CONSTANT)
    twice = cv2.blur(once, (side, side), borderType=cv2.BORDER_CONSTANT)
    return np.asarray(twice, dtype=np.float32)


def _key_points(image: GreyImage, *, n_most: int) -> SurfPoints:
    """Return the strongest key points with a patch that is in the image and mostly valid."""
    from mahotas.features import surf

    # mahotas returns y, x, scale, score, sign of the Laplacian, angle and 64 descriptor values. As
    # in OpenCV, integer coordinates are the centres of cells.
    found = surf.surf(image.grey, threshold=_SURF_THRESHOLD, max_points=n_most)
    places = from_opencv(found[:, 1::-1])
    rows, columns = image.shape
    half = PATCH_CELLS // 2
    inside = np.flatnonzero(
        np.all((places > half) & (places < (columns - half, rows - half)), axis=1)
    )
    share = _patch_means(image.valid.astype(np.float32), places[inside])
    kept = inside[share >= _LEAST_VALID_SHARE]
    return SurfPoints(
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


def matched_pairs(first: SurfPoints, second: SurfPoints, radius: float) -> NDArray[np.int64]:
    """Return index pairs (m, 2) of mutually best descriptors that also pass the ratio test."""
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
    """Return the descriptor distances of pairs, computed in parts to limit memory."""
    apart = np.empty(len(one))
    for start in range(0, len(one), _PAIRS_AT_ONCE):
        part = slice(start, start + _PAIRS_AT_ONCE)
        apart[part] = np.linalg.norm(first[one[part]] - second[other[part]], axis=1)
    return apart


def _clear_winners(
    owner: NDArray[np.int64], apart: NDArray[np.float64], n_owners: int
) -> NDArray[np.bool_]:
    """Return a mask of the pairs that are the best of their point and pass the ratio test."""
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
