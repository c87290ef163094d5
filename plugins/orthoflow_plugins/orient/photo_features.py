"""Key points of a photo to tie it to other photos."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import decode_image
from orthoflow.products import Photo

# Larger photos are shrunk: SIFT takes 0.23 GB per million pixels, and thousands of key points at
# half the resolution tie photos as well as more at full.
_SIDE_MOST_PX: Final = 1600
_CONTRAST_THRESHOLD: Final = 0.02
_SPREAD_CELLS: Final = 16
# Squared RootSIFT entries in units of 1/512: their sums stay below 2^24, so that float32 products
# are exact, whatever the order a BLAS library adds in.
_QUANTA: Final = 512.0


@dataclass(frozen=True, kw_only=True)
class PhotoFeatures:
    """Key points of a photo.

    Attributes:
        pixels: (n, 2) float64 (u, v) of the photo, first pixel centre at (0.5, 0.5).
        scale: pixels of the photo per pixel in which they were found.
        descriptors: (n, 128) float32 RootSIFT, whole numbers.
    """

    pixels: NDArray[np.float64]
    scale: float
    descriptors: NDArray[np.float32]


def no_features() -> PhotoFeatures:
    """Give none."""
    return PhotoFeatures(
        pixels=np.empty((0, 2)), scale=1.0, descriptors=np.empty((0, 128), np.float32)
    )


def photo_features(photo: Photo, n_most: int) -> PhotoFeatures:
    """Find the strongest key points of a photo, spread over it."""
    import cv2

    rgb = decode_image(photo.encoded, f"photo {photo.name}")
    grey = rgb if rgb.ndim == 2 else cv2.cvtColor(rgb[:, :, :3], cv2.COLOR_RGB2GRAY)
    scale = max(1.0, max(grey.shape) / _SIDE_MOST_PX)
    if scale > 1.0:
        size = (round(grey.shape[1] / scale), round(grey.shape[0] / scale))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    ratios = np.array([photo.width / grey.shape[1], photo.height / grey.shape[0]])
    # Without the precise upscaling every key point is off by a quarter of a pixel.
    sift: Any = cv2.SIFT_create(  # type: ignore[attr-defined]  # missing in OpenCV's stubs
        contrastThreshold=_CONTRAST_THRESHOLD, enable_precise_upscale=True
    )
    grey = np.ascontiguousarray(grey)
    found = sift.detect(grey, None)
    if not found:
        return no_features()
    points = np.array([(*p.pt, p.size, p.angle, p.response) for p in found], dtype=np.float64)
    # Threads find key points in any order; the image alone orders them.
    order = np.lexsort(points.T[:4])
    order = order[_spread(points[order], grey.shape, n_most)]
    # Described are those that stay: of a rich picture, one in ten.
    raw = sift.compute(grey, [found[at] for at in order.tolist()])[1]
    # OpenCV's (0, 0) is the centre of the first pixel, ours (0.5, 0.5).
    return PhotoFeatures(
        pixels=(points[order, :2] + 0.5) * ratios,
        scale=scale,
        descriptors=_root(np.asarray(raw, dtype=np.float32)),
    )


def _spread(points: NDArray[np.float64], shape: tuple[int, ...], n_most: int) -> NDArray[np.intp]:
    """Positions of the strongest points, taken in turns from the cells of a coarse grid."""
    cells = (points[:, :2] * _SPREAD_CELLS / [shape[1], shape[0]]).astype(np.intp)
    cells = np.clip(cells, 0, _SPREAD_CELLS - 1)
    cell = cells[:, 1] * _SPREAD_CELLS + cells[:, 0]
    order = np.lexsort((-points[:, 4], cell))
    turn = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])
    taken = order[np.lexsort((-points[order, 4], turn))]
    return np.asarray(taken[:n_most], dtype=np.intp)


def _root(raw: NDArray[np.float32]) -> NDArray[np.float32]:
    """RootSIFT (Arandjelovic & Zisserman 2012): Euclid's distance becomes Hellinger's."""
    total = np.maximum(raw.sum(axis=1, keepdims=True), 1e-9)
    rooted: NDArray[np.float32] = np.rint(np.sqrt(raw / total) * _QUANTA).astype(np.float32)
    return rooted
