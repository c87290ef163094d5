"""Masks of photos: which of their pixels may be used; what is masked stands in nobody's way."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import decode_image
from orthoflow.products import Photo

if TYPE_CHECKING:
    from orthoflow.geometry.depth_buffer_kernels import DepthBuffer

# Masks are black and white; what their compression made of it is one or the other.
_USED_LEAST: Final = 128
_LONGEST_SIDE_PX: Final = 2048


def decode_mask(encoded: bytes, name: str) -> NDArray[np.bool_]:
    """Decode a picture of black and white: True (height, width) where pixels may be used.

    Raises:
        InputError: the bytes are no picture.
    """
    return np.asarray(decode_image(encoded, name).max(axis=2) >= _USED_LEAST, dtype=np.bool_)


def used_pixels(photo: Photo) -> NDArray[np.bool_] | None:
    """Which pixels (height, width) of a photo may be used; None where all may."""
    return None if photo.mask is None else decode_mask(photo.mask, f"the mask of {photo.name}")


def before_masks(buffer: DepthBuffer, photo: Photo) -> DepthBuffer:
    """Put what is masked of a photo right before its lens, so that it shows nothing behind."""
    used = used_pixels(photo)
    if used is None:
        return buffer
    nearest, reduction = buffer.nearest, int(buffer.reduction)
    if nearest.shape == (1, 1):
        reduction = max(1, -(-max(used.shape) // _LONGEST_SIDE_PX))
        shape = [-(-side // reduction) for side in used.shape]
        nearest = np.full(shape, buffer.nearest[0, 0], dtype=np.float32)
    rows, columns = (np.arange(0, side, reduction) for side in used.shape)
    whole = np.logical_and.reduceat(np.logical_and.reduceat(used, rows, axis=0), columns, axis=1)
    # Nearer than anything, also before a camera that stands within the slab of a wall.
    nearest = np.where(whole, nearest, np.float32(-np.inf))
    return buffer._replace(nearest=np.ascontiguousarray(nearest), reduction=float(reduction))
