"""Pair SURF key points of two images on the same grid, and refine them to sub-pixel accuracy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
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

# At most one key point is used per this many cells: weaker key points are noise.
_CELLS_PER_POINT: Final = 200
_POINTS_LEAST, _POINTS_MOST = 500, 40_000
_SCALES_DIFFER_MOST: Final = 1.5
_PAIRS_AT_ONCE: Final = 1 << 16
_RATIO_MOST: Final = 0.9
# Half width of the box filter that normalises contrast; it is applied twice.
_LEVEL_REACH: Final = 12
_LEAST_CONTRAST_GREY: Final = 2.0
_LEAST_VALID_SHARE: Final = 0.6
_LEAST_CORRELATION: Final = 0.6
_SIGMA_MOST_CELLS: Final = 0.5
# A pair is accepted if enough of its nearest neighbours agree with it.
_NEIGHBOURS: Final = 16
_WITNESS_CELLS: Final = 8.0
_AGREEING: Final = 2
_AGREEING_SHARE: Final = 0.25
_AGREE_CELLS: Final = 1.0
_SURF_THRESHOLD: Final = 0.1
# Larger images are processed in tiles, each needing about 2 GB with its margin. The margin holds
# the support of the widest key points, or a patch with its largest displacement.
_WHOLE_CELLS: Final = 1 << 24
_TILE_CELLS: Final = 3072
_SURF_RIM_CELLS: Final = 512
_RIM_CELLS: Final = 96


@dataclass(frozen=True, kw_only=True)
class KeyPairs:
    """Corresponding positions in two images.

    Attributes:
        places: (n, 2) float64 column and row in the shown image.
        shift: (n, 2) float64 refined displacement along u and v in cells, shown minus reference.
        found: (n, 2) float64 displacement before the refinement, as SURF found it.
        n_points: numbers of key points of the two images.
        n_matched: number of matched descriptors, including wrong matches.
    """

    places: NDArray[np.float64]
    shift: NDArray[np.float64]
    found: NDArray[np.float64]
    n_points: tuple[int, int]
    n_matched: int

    def __len__(self) -> int:
        return len(self.places)


def no_pairs() -> KeyPairs:
    """Return an empty result."""
    nothing = np.zeros((0, 2))
    return KeyPairs(places=nothing, shift=nothing, found=nothing, n_points=(0, 0), n_matched=0)


@dataclass(frozen=True, kw_only=True)
class _KeyPoints:
    """SURF key points: positions (n, 2), scale (n,), sign of the Laplacian (n,), descriptors."""

    places: NDArray[np.float64]
    scale: NDArray[np.float64]
    sign: NDArray[np.float64]
    descriptors: NDArray[np.float64]


def find_key_pairs(
    shown: GreyCells, reference: GreyCells, *, radius_cells: float, threads: int = 1
) -> KeyPairs:
    """Find pairs of key points within a radius.

    The local contrast of both images is normalised first, because laser and camera record different
    brightness. Descriptors of key points with similar scale and equal sign are matched mutually.
    Patches of 32 x 32 cells around each pair are then matched by least squares; a pair is dropped
    if its patches do not correlate or if it disagrees with its neighbours. Large images are
    processed tile by tile.

    Args:
        shown: the image to inspect.
        reference: the image to compare it with.
        radius_cells: maximum displacement.
        threads: number of threads; it does not change the pairs.
    """
    first: GreyCells = _Levelled(shown)
    second: GreyCells = _Levelled(reference)
    is_whole = len([*_tiles(shown.shape)]) == 1
    if is_whole:
        first, second = in_order(GreyCells.whole, (first, second), threads=threads)
    # Process large images one after the other, since tiles of both would need too much memory.
    points = tuple(in_order(_key_points, (first, second), threads=threads if is_whole else 1))
    matches = _matches(points[0], points[1], radius_cells)
    places = points[0].places[matches[:, 0]]
    found = places - points[1].places[matches[:, 1]]
    start = unrefined(np.round(places), found)
    rim = math.ceil(radius_cells) + _RIM_CELLS
    refined = _refined(first, second, start, rim=rim, threads=threads)
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
    """Return which pairs agree with enough of their nearest neighbours; chance matches do not."""
    from scipy.spatial import cKDTree

    n_near = min(_NEIGHBOURS, len(places) - 1)
    if n_near < _AGREEING:
        return np.zeros(len(places), dtype=np.bool_)
    away, near = cKDTree(places).query(places, k=n_near + 1)
    apart = np.linalg.norm(shift[near] - shift[:, None], axis=2)
    # Very close pairs are the same point found at several scales, and do not count.
    agrees = (apart <= _AGREE_CELLS) & (away > _WITNESS_CELLS)
    # Repeated texture can make two or three neighbours wrong in the same way, but not a quarter of
    # them.
    needed = max(_AGREEING, _AGREEING_SHARE * n_near)
    agreed = np.ones(len(places), dtype=np.bool_)
    # Repeat until only accepted pairs support each other.
    while True:
        kept: NDArray[np.bool_] = np.count_nonzero(agrees & agreed[near], axis=1) >= needed
        if np.array_equal(kept, agreed):
            return agreed
        agreed = kept


def _refined(
    first: GreyCells, second: GreyCells, start: PatchShifts, *, rim: int, threads: int
) -> PatchShifts:
    """Refine displacements tile by tile, each tile with a margin."""
    parts = [unrefined(*np.zeros((2, 0, 2)))]
    for tile in _tiles(first.shape):
        own = _lies_in(tile, start.centre)
        if not own.any():
            continue
        window = _widened(tile, rim, first.shape)
        corner = np.array([window[1].start, window[0].start])
        one, other = first.cut(window), second.cut(window)
        refined = refine_shifts(
            one,
            other,
            unrefined(start.centre[own] - corner, start.shift[own]),
            sigma_most_cells=_SIGMA_MOST_CELLS,
            threads=threads,
        )
        parts.append(replace(refined, centre=refined.centre + corner))
    return PatchShifts.joined(parts)


def _tiles(shape: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    """Yield the tiles in which an image is processed: a single one unless it is large."""
    return tiles(shape, max(shape) if math.prod(shape) <= _WHOLE_CELLS else _TILE_CELLS)


def _widened(tile: tuple[slice, slice], rim: int, shape: tuple[int, int]) -> tuple[slice, slice]:
    rows, columns = (
        slice(max(0, part.start - rim), min(size, part.stop + rim))
        for part, size in zip(tile, shape, strict=True)
    )
    return rows, columns


def _lies_in(tile: tuple[slice, slice], places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which positions (n, 2) = (column, row) are in a tile."""
    rows, columns = tile
    low, end = (columns.start, rows.start), (columns.stop, rows.stop)
    inside: NDArray[np.bool_] = np.all((places >= low) & (places < end), axis=1)
    return inside


@dataclass(frozen=True)
class _Levelled(GreyCells):
    """An image normalised to local mean 128 and standard deviation 40; invalid cells are 128."""

    cells: GreyCells

    @property
    def shape(self) -> tuple[int, int]:
        return self.cells.shape

    def cut(self, part: tuple[slice, slice]) -> GreyImage:
        window = _widened(part, 2 * _LEVEL_REACH, self.shape)
        rows, columns = (
            slice(inner.start - outer.start, inner.stop - outer.start)
            for inner, outer in zip(part, window, strict=True)
        )
        return _levelled(self.cells.cut(window)).cut((rows, columns))


def _levelled(image: GreyImage) -> GreyImage:
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

    # Two passes of a box filter approximate a Gaussian; the cost does not depend on the width.
    side = 2 * _LEVEL_REACH + 1
    once = cv2.blur(values, (side, side), borderType=cv2.BORDER_CONSTANT)
    twice = cv2.blur(once, (side, side), borderType=cv2.BORDER_CONSTANT)
    return np.asarray(twice, dtype=np.float32)


def _key_points(cells: GreyCells) -> _KeyPoints:
    """Return key points whose patch is inside the image and mostly valid."""
    rows, columns = cells.shape
    half, parts = PATCH_CELLS // 2, []
    for image, corner, found in _strongest(cells):
        # mahotas returns y, x, scale, score, sign of the Laplacian, angle and 64 descriptor values;
        # as in OpenCV, coordinates refer to the centres of cells.
        places = from_opencv(found[:, 1::-1])
        inside = np.all(
            (places + corner > half) & (places + corner < (columns - half, rows - half)), axis=1
        )
        share = _patch_means(image.valid.astype(np.float32), places[inside])
        kept = np.flatnonzero(inside)[share >= _LEAST_VALID_SHARE]
        parts.append((places[kept] + corner, found[kept]))
    found = np.concatenate([item[1] for item in parts])
    return _KeyPoints(
        places=np.concatenate([item[0] for item in parts]),
        scale=found[:, 2],
        sign=found[:, 4],
        descriptors=found[:, 6:],
    )


def _strongest(
    cells: GreyCells,
) -> Iterator[tuple[GreyImage, NDArray[np.int64], NDArray[np.float64]]]:
    """Yield the strongest key points of an image, tile by tile.

    Yields:
        The tile with its margin, the first column and row of that part, and the key points (n, 70)
        of the tile, with positions relative to the part.
    """
    from mahotas.features import surf

    n_cells = math.prod(cells.shape)
    n_most = int(np.clip(n_cells // _CELLS_PER_POINT, _POINTS_LEAST, _POINTS_MOST))
    windows = [(tile, _widened(tile, _SURF_RIM_CELLS, cells.shape)) for tile in _tiles(cells.shape)]
    if len(windows) == 1:
        image = cells.whole()
        found = surf.surf(image.grey, threshold=_SURF_THRESHOLD, max_points=n_most)
        yield image, np.zeros(2, dtype=np.int64), found
        return
    points = []
    for tile, window in windows:
        corner = np.array([window[1].start, window[0].start])
        found = surf.interest_points(cells.cut(window).grey, threshold=_SURF_THRESHOLD)
        place = from_opencv(found[:, 1::-1]) + corner
        points.append(found[_lies_in(tile, place)])
    strength = np.concatenate([found[:, 3] for found in points])
    is_strong = np.zeros(len(strength), dtype=np.bool_)
    is_strong[np.argsort(-strength, kind="stable")[:n_most]] = True
    first = 0
    for (_, window), found in zip(windows, points, strict=True):
        chosen = found[is_strong[first : first + len(found)]]
        first += len(found)
        image = cells.cut(window)
        corner = np.array([window[1].start, window[0].start])
        yield image, corner, surf.descriptors(image.grey, chosen)


def _patch_means(values: NDArray[np.float32], places: NDArray[np.float64]) -> NDArray[np.float32]:
    import cv2

    means = cv2.blur(values, (PATCH_CELLS, PATCH_CELLS), borderType=cv2.BORDER_CONSTANT)
    cells = places.astype(np.int64)
    return np.asarray(np.asarray(means)[cells[:, 1], cells[:, 0]], dtype=np.float32)


def _matches(first: _KeyPoints, second: _KeyPoints, radius: float) -> NDArray[np.int64]:
    """Return index pairs (m, 2) of mutually best descriptors that pass the ratio test."""
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
    """Return descriptor distances of pairs; computed in parts to limit memory."""
    apart = np.empty(len(one))
    for start in range(0, len(one), _PAIRS_AT_ONCE):
        part = slice(start, start + _PAIRS_AT_ONCE)
        apart[part] = np.linalg.norm(first[one[part]] - second[other[part]], axis=1)
    return apart


def _clear_winners(
    owner: NDArray[np.int64], apart: NDArray[np.float64], n_owners: int
) -> NDArray[np.bool_]:
    """Return which pairs are the nearest of their point and pass the ratio test."""
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
