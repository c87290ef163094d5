"""Evenly distributed key points of images, and matching of their descriptors.

OpenCV's SIFT shifts all key points by a quarter of a pixel to the right and down unless its precise
upscaling is enabled (OpenCV issue 23123; with version 5.0, we measured a shift of 0.25 px for key
points of all sizes). The shift would cause a systematic error of orientations, so it is subtracted
if the default upscaling is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import HALF_PIXEL
from orthoflow.geometry.rows import Rows

# OpenCV's default contrast threshold.
_OPENCV_CONTRAST: Final = 0.04
# Contrast threshold; half of the default still gives correct matches.
_MIN_CONTRAST: Final = 0.02
# Maximum ratio of the curvatures at a key point; OpenCV's default.
_MAX_EDGE_RATIO: Final = 10.0
_SHIFT_BY_UPSCALING_PX: Final = 0.25
# SIFT doubles the size of an image and keeps all scales in memory, which takes 0.23 GB per million
# pixels. Tiles limit the memory needed.
_TILE_PX: Final = 2048
_TILE_OVERLAP_PX: Final = 96
_SPREAD_CELLS: Final = 12
# Images with a shorter side than this are not searched for key points.
_MIN_SIDE_PX: Final = 16
# RootSIFT entries are multiples of 1/512. In this unit, the sums of their products are integers
# below 2^24, so matrix products in float32 are exact, regardless of the order of summation in the
# BLAS library.
_QUANTA: Final = 512.0
# Number of pairs processed at once; their descriptors need 2 x 32 MB.
_PAIRS_AT_ONCE: Final = 65_536
# Number of entries in a block of distances; its 12 MB fit into a processor's cache.
_BLOCK_ENTRIES: Final = 3_000_000


def in_turns(
    cell: NDArray[np.intp], keys: Sequence[NDArray[np.floating] | NDArray[np.intp]], n_most: int
) -> NDArray[np.intp]:
    """Return the indices (k,) of up to `n_most` items, taken from the cells of a grid in turn.

    The selection covers the same area as the items; within a cell, items are taken in sort order.

    Args:
        cell: (n,) cell of each item.
        keys: sort keys (n,); the last one is the primary key, as in `numpy.lexsort`.
        n_most: maximum number of items.
    """
    order = np.lexsort((*keys, cell))
    turn = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])
    taken = order[np.lexsort((*(key[order] for key in keys), turn))]
    return np.asarray(taken[:n_most], dtype=np.intp)


def root_sift(raw: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert SIFT descriptors (n, 128) to RootSIFT as integers (Arandjelovic & Zisserman 2012).

    Euclidean distances between the results correspond to Hellinger distances between the originals.
    """
    total = np.maximum(raw.sum(axis=1, keepdims=True), 1e-9)
    rooted: NDArray[np.float32] = np.rint(np.sqrt(raw / total) * _QUANTA).astype(np.float32)
    return rooted


@dataclass(frozen=True, kw_only=True)
class Features(Rows):
    """Key points of an image; for any n, the first n are strong and evenly distributed.

    Attributes:
        pixels: (n, 2) float64 (u, v), first pixel centre at (0.5, 0.5).
        sizes_px: (n,) float64 diameter of the described neighbourhood.
        angles_deg: (n,) float64 main direction of the gradient, clockwise from u.
        descriptors: (n, 128) float32 RootSIFT or SIFT, integer values.
    """

    pixels: NDArray[np.float64]
    sizes_px: NDArray[np.float64]
    angles_deg: NDArray[np.float64]
    descriptors: NDArray[np.float32]

    @classmethod
    def none(cls) -> Features:
        """Return an empty set of key points."""
        return cls(
            pixels=np.empty((0, 2)),
            sizes_px=np.empty(0),
            angles_deg=np.empty(0),
            descriptors=np.empty((0, 128), dtype=np.float32),
        )

    def undescribed(self) -> Features:
        """Return the key points without their descriptors, which need most of the memory."""
        return replace(self, descriptors=self.descriptors[:, :0].copy())

    def strongest(self, n_most: int) -> Features:
        """Return the first `n_most` key points without copying."""
        return self.take(slice(n_most))

    def scaled(self, factor: float) -> Features:
        """Return the same key points in the image enlarged by `factor`."""
        return replace(self, pixels=self.pixels * factor, sizes_px=self.sizes_px * factor)

    def mirrored(self, width_px: float) -> Features:
        """Return the key points of the image, of the given width, mirrored left to right.

        Mirroring reverses the order of the rows in the 4 x 4 fields of a descriptor and the sense
        of rotation of its 8 directions, both relative to the main direction.
        """
        fields = self.descriptors.reshape(-1, 4, 4, 8)[:, ::-1]
        turned = fields[..., (8 - np.arange(8)) % 8]
        return replace(
            self,
            pixels=np.array([width_px, 0.0]) + self.pixels * np.array([-1.0, 1.0]),
            angles_deg=(180.0 - self.angles_deg) % 360.0,
            descriptors=np.ascontiguousarray(turned.reshape(-1, 128)),
        )


def find_features(
    picture: NDArray[np.uint8],
    max_features: int,
    usable: NDArray[np.bool_] | None = None,
    *,
    as_opencv: bool = False,
) -> Features:
    """Find key points tile by tile; their order depends only on the image.

    Args:
        picture: (rows, cols) grey values.
        max_features: maximum number of key points.
        usable: (rows, cols), False where key points are not allowed; None allows all positions.
        as_opencv: use OpenCV's default SIFT as in markiewicz2015, with a higher contrast threshold
            and SIFT descriptors.
    """
    import cv2

    sift: Any = cv2.SIFT_create(  # type: ignore[attr-defined]  # missing in OpenCV's stubs
        contrastThreshold=_OPENCV_CONTRAST if as_opencv else _MIN_CONTRAST,
        edgeThreshold=_MAX_EDGE_RATIO,
        enable_precise_upscale=not as_opencv,
    )
    shift_px = HALF_PIXEL - (_SHIFT_BY_UPSCALING_PX if as_opencv else 0.0)
    tiles = [
        _in_tile(sift, picture, (row, column), shift_px)
        for row in range(0, picture.shape[0], _TILE_PX)
        for column in range(0, picture.shape[1], _TILE_PX)
    ]
    points = np.vstack([tile[1] for tile in tiles])
    pixels = points[:, :2]
    # OpenCV's threads return key points in arbitrary order, so sort them.
    chosen = np.lexsort(points[:, :4].T)
    if usable is not None:
        most = np.array(usable.shape[::-1]) - 1
        columns, rows = np.clip(pixels[chosen].astype(np.intp), 0, most).T
        chosen = chosen[usable[rows, columns]]
    # Take the strongest key points from the cells of a coarse grid in turn.
    scale = _SPREAD_CELLS / np.array([picture.shape[1], picture.shape[0]])
    cells = np.minimum((pixels[chosen] * scale).astype(np.intp), _SPREAD_CELLS - 1)
    u, v, strengths = points[chosen][:, [0, 1, 4]].T
    chosen = chosen[
        in_turns(cells[:, 1] * _SPREAD_CELLS + cells[:, 0], (v, u, -strengths), max_features)
    ]
    raw = _described(sift, picture, tiles, chosen)
    return Features(
        pixels=pixels[chosen],
        sizes_px=points[chosen, 2],
        angles_deg=points[chosen, 3],
        descriptors=raw if as_opencv else root_sift(raw),
    )


_Tile = tuple[tuple[slice, slice], NDArray[np.float64], list[Any]]
"""Key points in a tile of an image: the searched rows and columns, including a margin; (n, 5) u, v,
size, angle, response; and OpenCV's key points in coordinates of the searched part.
"""


def _in_tile(
    sift: Any, picture: NDArray[np.uint8], corner: tuple[int, int], shift_px: float
) -> _Tile:
    ends = [
        min(limit, start + _TILE_PX) for start, limit in zip(corner, picture.shape, strict=True)
    ]
    low = [max(0, start - _TILE_OVERLAP_PX) for start in corner]
    part = (
        slice(low[0], ends[0] + _TILE_OVERLAP_PX),
        slice(low[1], ends[1] + _TILE_OVERLAP_PX),
    )
    view = np.ascontiguousarray(picture[part])
    found = sift.detect(view, None) if min(view.shape) >= _MIN_SIDE_PX else ()
    points = np.array(
        [(*p.pt, p.size, p.angle, p.response) for p in found], dtype=np.float64
    ).reshape(-1, 5)
    points[:, :2] += np.array([low[1], low[0]]) + shift_px
    ahead = points[:, :2] - np.array([corner[1], corner[0]])
    size = np.array([ends[1] - corner[1], ends[0] - corner[0]])
    own = np.flatnonzero(((ahead >= 0.0) & (ahead < size)).all(axis=1))
    return part, points[own], [found[at] for at in own.tolist()]


def _described(
    sift: Any, picture: NDArray[np.uint8], tiles: list[_Tile], chosen: NDArray[np.intp]
) -> NDArray[np.float32]:
    """Compute SIFT descriptors (n, 128) of the chosen key points, which are numbered across tiles.

    Only chosen key points are described: in an image with much texture, only one in ten is kept,
    and description takes longer than detection.
    """
    raw = np.empty((len(chosen), 128), dtype=np.float32)
    first = 0
    for part, _, found in tiles:
        wanted = np.flatnonzero((chosen >= first) & (chosen < first + len(found)))
        if wanted.size:
            points = [found[at - first] for at in chosen[wanted].tolist()]
            raw[wanted] = sift.compute(np.ascontiguousarray(picture[part]), points)[1]
        first += len(found)
    return raw


@dataclass(frozen=True, kw_only=True)
class Matches(Rows):
    """Pairs of matching descriptors.

    Attributes:
        first: (n,) index into the first set.
        second: (n,) index into the second set.
        ratio: (n,) ratio of the descriptor distances of the best and the second best match; 1 if
            there is no second best.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    ratio: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Window:
    """Limits for possible pairs, if the geometry is approximately known.

    Attributes:
        first: (n, 2) positions of the key points of the first set.
        second: (m, 2) expected positions of the key points of the second set in the frame of the
            first.
        radius: maximum difference between the coordinates of a pair, along each axis.
        first_log_size: (n,) float32 log2 of the sizes of the key points.
        second_log_size: (m,) float32 log2 of the expected sizes in the frame of the first.
        first_angle_deg: (n,) float32 angles.
        second_angle_deg: (m,) float32 expected angles in the frame of the first.
        max_log_size: maximum difference between log2 sizes.
        max_angle_deg: maximum difference between angles.
    """

    first: NDArray[np.float32]
    second: NDArray[np.float32]
    radius: float
    first_log_size: NDArray[np.float32]
    second_log_size: NDArray[np.float32]
    first_angle_deg: NDArray[np.float32]
    second_angle_deg: NDArray[np.float32]
    max_log_size: float
    max_angle_deg: float

    def pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the possible pairs as indices into the first and the second set."""
        from scipy.spatial import cKDTree  # noqa: PLC0415 - rarely needed

        near = cKDTree(self.first).sparse_distance_matrix(
            cKDTree(self.second), self.radius, p=np.inf, output_type="ndarray"
        )
        i, j = near["i"].astype(np.intp), near["j"].astype(np.intp)
        log_size = np.abs(self.first_log_size[i] - self.second_log_size[j])
        turn = np.abs(self.first_angle_deg[i] - self.second_angle_deg[j]) % 360.0
        turn = np.minimum(turn, 360.0 - turn)
        possible = (log_size <= self.max_log_size) & (turn <= self.max_angle_deg)
        return i[possible], j[possible]


def mutual_matches(
    first: NDArray[np.float32], second: NDArray[np.float32], *, ratio: float
) -> Matches:
    """Match descriptors that are mutually nearest and pass the ratio test.

    Args:
        first: (n, d) integer values, small enough that products are exact in float32.
        second: (m, d) integer values like `first`.
        ratio: maximum ratio of the descriptor distances of the best and the second best match (Lowe
            2004).
    """
    if not (len(first) and len(second)):
        return _no_matches()
    # Few pairs pass the ratio test, so only these are tested in the other direction.
    distinct = best_matches(first, second, ratio=ratio)
    asked, place = np.unique(distinct.second, return_inverse=True)
    return distinct.take(nearest(second[asked], first)[place] == distinct.first)


def best_matches(
    first: NDArray[np.float32], second: NDArray[np.float32], *, ratio: float
) -> Matches:
    """Match each descriptor of the first set with the nearest one in the second set.

    Args:
        first: (n, d) integer values, small enough that products are exact in float32.
        second: (m, d) integer values like `first`, m > 0.
        ratio: maximum ratio of the descriptor distances of the best and the second best match (Lowe
            2004); 1 accepts all matches.
    """
    found = two_nearest(first, second)
    ratios = _ratio(found.best, found.next_best)
    kept = np.flatnonzero(ratios <= ratio)
    return Matches(first=kept, second=found.index[kept], ratio=ratios[kept])


def mutual_matches_within(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    window: Window,
    *,
    ratio: float,
) -> Matches:
    """Match descriptors like `mutual_matches`, but consider only the pairs that a window allows.

    Args:
        first: (n, d) integer values, small enough that products are exact in float32.
        second: (m, d) integer values like `first`.
        window: limits for all pairs, including the second best match.
        ratio: maximum ratio of the descriptor distances of the best and the second best match.
    """
    if not (len(first) and len(second)):
        return _no_matches()
    i, j = window.pairs()
    distances = _distances(first, second, i, j)
    order = np.lexsort((j, distances, i))
    starts = np.flatnonzero(np.diff(i[order], prepend=-1))
    best, following = order[starts], starts + 1
    has_next = np.append(starts[1:], len(order)) > following
    next_best = np.full(len(best), np.inf, dtype=np.float32)
    next_best[has_next] = distances[order[following[has_next]]]
    ratios = _ratio(distances[best], next_best)
    backwards = np.lexsort((i, distances, j))
    back = backwards[np.flatnonzero(np.diff(j[backwards], prepend=-1))]
    is_back = np.zeros(len(i), dtype=np.bool_)
    is_back[back] = True
    kept = is_back[best] & (ratios <= ratio)
    return Matches(first=i[best[kept]], second=j[best[kept]], ratio=ratios[kept])


@dataclass(frozen=True, kw_only=True)
class TwoNearest:
    """The two nearest descriptors of a set for each query descriptor.

    Attributes:
        index: (n,) index of the nearest descriptor.
        best: (n,) float32 squared distance to the nearest.
        next_best: (n,) float32 squared distance to the second nearest; inf if there is none.
    """

    index: NDArray[np.intp]
    best: NDArray[np.float32]
    next_best: NDArray[np.float32]


def two_nearest(asked: NDArray[np.float32], among: NDArray[np.float32]) -> TwoNearest:
    """Find the two nearest descriptors in `among` (m, d), m > 0, for each of `asked` (n, d).

    Both arrays have integer values, small enough that products are exact in float32.
    """
    left, right = _left(asked), _right(among)
    index = np.zeros(len(asked), dtype=np.intp)
    best, next_best = np.empty((2, len(asked)), dtype=np.float32)
    for rows in _blocks(len(asked), len(among)):
        distances = left[rows] @ right
        own, column = np.arange(len(distances)), distances.argmin(axis=1)
        index[rows], best[rows] = column, distances[own, column]
        distances[own, column] = np.inf
        next_best[rows] = distances.min(axis=1)
    return TwoNearest(index=index, best=best, next_best=next_best)


def nearest(asked: NDArray[np.float32], among: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return the index (n,) of the nearest in `among` (m, d), m > 0, for each of `asked` (n, d)."""
    left, right = _left(asked), _right(among)
    parts = [(left[rows] @ right).argmin(axis=1) for rows in _blocks(len(asked), len(among))]
    return np.concatenate([np.empty(0, dtype=np.intp), *parts])


def _distances(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    i: NDArray[np.intp],
    j: NDArray[np.intp],
) -> NDArray[np.float32]:
    distances = np.empty(len(i), dtype=np.float32)
    for start in range(0, len(i), _PAIRS_AT_ONCE):
        some = slice(start, start + _PAIRS_AT_ONCE)
        apart = first[i[some]] - second[j[some]]
        distances[some] = np.einsum("ij,ij->i", apart, apart)
    return distances


def _ratio(best: NDArray[np.float32], next_best: NDArray[np.float32]) -> NDArray[np.float64]:
    ratio = np.sqrt(np.maximum(best, 0.0) / np.maximum(next_best, 1e-12)).astype(np.float64)
    # A single candidate has no second best match, and of two identical candidates, neither is
    # distinct.
    ratio[~np.isfinite(next_best) | (next_best <= 0.0)] = 1.0
    return ratio


def _no_matches() -> Matches:
    nothing = np.empty(0, dtype=np.intp)
    return Matches(first=nothing, second=nothing, ratio=np.empty(0))


def _left(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a matrix whose product with the result of `_right` contains squared distances.

    Each distance is the product of a row (-2 a, |a|^2, 1) and a column (b, 1, |b|^2).
    """
    squares = (descriptors * descriptors).sum(axis=1)
    return np.column_stack([-2.0 * descriptors, squares, np.ones_like(squares)])


def _right(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    squares = (descriptors * descriptors).sum(axis=1)
    return np.vstack([descriptors.T, np.ones_like(squares), squares])


def _blocks(n_rows: int, n_columns: int) -> list[slice]:
    rows = max(1, _BLOCK_ENTRIES // n_columns)
    return [slice(start, min(start + rows, n_rows)) for start in range(0, n_rows, rows)]
