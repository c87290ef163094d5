"""Key points with RootSIFT descriptors of an image of any size, unbiased and spread out.

OpenCV's SIFT moves every key point by a quarter of a pixel, right and down, unless its precise
upscaling is on (opencv issue 23123; measured with 5.0: 0.25 px, of all sizes). That would be a
systematic error of the orientation, so it is taken off where the upscaling is left as it was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.key_points import in_turns, root_sift
from orthoflow.geometry.opencv_border import HALF_PIXEL
from orthoflow.geometry.rows import Rows

# OpenCV's own contrast, half of which still brings right matches, and its ratio of curvatures.
_OPENCV_CONTRAST: Final = 0.04
_MIN_CONTRAST: Final = 0.02
_MAX_EDGE_RATIO: Final = 10.0
_SHIFT_BY_UPSCALING_PX: Final = 0.25
# SIFT doubles the image and keeps all scales: 0.23 GB per million pixels. A tile bounds it.
_TILE_PX: Final = 2048
_TILE_OVERLAP_PX: Final = 96
_SPREAD_CELLS: Final = 12
# Smaller pictures have no key points.
_MIN_SIDE_PX: Final = 16


@dataclass(frozen=True, kw_only=True)
class Features(Rows):
    """Key points of an image: the first n of them are the n strongest, spread over the image.

    Attributes:
        pixels: (n, 2) float64 (u, v), first pixel centre at (0.5, 0.5).
        sizes_px: (n,) float64 diameter of the described neighbourhood.
        angles_deg: (n,) float64 main direction of the gradient, clockwise from u.
        descriptors: (n, 128) float32 RootSIFT, or SIFT where asked for, whole numbers.
    """

    pixels: NDArray[np.float64]
    sizes_px: NDArray[np.float64]
    angles_deg: NDArray[np.float64]
    descriptors: NDArray[np.float32]

    def undescribed(self) -> Features:
        """Return places and sizes without the descriptors, which are most of the bytes."""
        return replace(self, descriptors=self.descriptors[:, :0].copy())

    def strongest(self, n_most: int) -> Features:
        """Return the first ones, without copying them."""
        return Features(
            pixels=self.pixels[:n_most],
            sizes_px=self.sizes_px[:n_most],
            angles_deg=self.angles_deg[:n_most],
            descriptors=self.descriptors[:n_most],
        )

    def scaled(self, factor: float) -> Features:
        """Return the same key points in the image enlarged by a factor."""
        return Features(
            pixels=self.pixels * factor,
            sizes_px=self.sizes_px * factor,
            angles_deg=self.angles_deg,
            descriptors=self.descriptors,
        )

    def mirrored(self, width_px: float) -> Features:
        """Give the key points as they would be in the image of this width, left and right swapped.

        Mirroring keeps the main direction of a key point as its own: along it, the rows of the
        4 x 4 fields of 8 directions swap, and directions turn the other way.
        """
        fields = self.descriptors.reshape(-1, 4, 4, 8)[:, ::-1]
        turned = fields[..., (8 - np.arange(8)) % 8]
        return Features(
            pixels=np.array([width_px, 0.0]) + self.pixels * np.array([-1.0, 1.0]),
            sizes_px=self.sizes_px,
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
    """Find key points, tile by tile, in an order that depends on the image only.

    Args:
        picture: (rows, cols) grey.
        max_features: at most so many.
        usable: (rows, cols), False where no key point may lie; None allows all.
        as_opencv: SIFT as OpenCV sets it (markiewicz2015): other contrast, descriptors as they are.
    """
    import cv2

    sift: Any = cv2.SIFT_create(  # type: ignore[attr-defined]  # missing in OpenCV's stubs
        contrastThreshold=_OPENCV_CONTRAST if as_opencv else _MIN_CONTRAST,
        edgeThreshold=_MAX_EDGE_RATIO,
        enable_precise_upscale=not as_opencv,
    )
    shift_px = HALF_PIXEL - (_SHIFT_BY_UPSCALING_PX if as_opencv else 0.0)
    parts = [_in_tile(sift, picture, corner, shift_px) for corner in _tiles(picture.shape)]
    points = np.vstack([part.points for part in parts])
    pixels = points[:, :2]
    # Threads find key points in any order; the image alone orders them.
    chosen = np.lexsort(points[:, :4].T)
    if usable is not None:
        chosen = chosen[usable[_cell_of(pixels[chosen], usable.shape)]]
    chosen = chosen[_spread(pixels[chosen], points[chosen, 4], picture.shape, max_features)]
    raw = _described(sift, picture, parts, chosen)
    return Features(
        pixels=pixels[chosen],
        sizes_px=points[chosen, 2],
        angles_deg=points[chosen, 3],
        descriptors=raw if as_opencv else root_sift(raw),
    )


def _tiles(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    return [
        (row, column)
        for row in range(0, shape[0], _TILE_PX)
        for column in range(0, shape[1], _TILE_PX)
    ]


@dataclass(frozen=True, kw_only=True)
class _Tile:
    """Key points that a tile of an image owns.

    Attributes:
        part: rows and columns of the image that were looked at, a margin wider than the tile.
        points: (n, 5) float64 u, v, size, angle, response.
        found: of OpenCV, in the part's own frame.
    """

    part: tuple[slice, slice]
    points: NDArray[np.float64]
    found: list[Any]


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
    own = np.flatnonzero(
        (points[:, 0] >= corner[1])
        & (points[:, 0] < ends[1])
        & (points[:, 1] >= corner[0])
        & (points[:, 1] < ends[0])
    )
    return _Tile(part=part, points=points[own], found=[found[at] for at in own.tolist()])


def _described(
    sift: Any, picture: NDArray[np.uint8], tiles: list[_Tile], chosen: NDArray[np.intp]
) -> NDArray[np.float32]:
    """SIFT descriptors (n, 128) of chosen key points, counted through all tiles.

    Only what is kept is described: of a rich picture that is one key point in ten, and describing
    takes longer than finding.
    """
    raw = np.empty((len(chosen), 128), dtype=np.float32)
    first = 0
    for tile in tiles:
        wanted = np.flatnonzero((chosen >= first) & (chosen < first + len(tile.found)))
        if wanted.size:
            view = np.ascontiguousarray(picture[tile.part])
            points = [tile.found[at - first] for at in chosen[wanted].tolist()]
            raw[wanted] = sift.compute(view, points)[1]
        first += len(tile.found)
    return raw


def _spread(
    pixels: NDArray[np.float64],
    strengths: NDArray[np.float64],
    shape: tuple[int, ...],
    n_most: int,
) -> NDArray[np.intp]:
    """Positions of the strongest points, taken in turns from the cells of a coarse grid."""
    scale = _SPREAD_CELLS / np.array([shape[1], shape[0]])
    cells = np.minimum((pixels * scale).astype(np.intp), _SPREAD_CELLS - 1)
    cell = cells[:, 1] * _SPREAD_CELLS + cells[:, 0]
    return in_turns(cell, (pixels[:, 1], pixels[:, 0], -strengths), n_most)


def _cell_of(
    pixels: NDArray[np.float64], shape: tuple[int, ...]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    columns = np.clip(pixels[:, 0].astype(np.intp), 0, shape[1] - 1)
    rows = np.clip(pixels[:, 1].astype(np.intp), 0, shape[0] - 1)
    return rows, columns
