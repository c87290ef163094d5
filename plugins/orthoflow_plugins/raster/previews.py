"""Small pictures of a wall for the report."""

from __future__ import annotations

from typing import Final

import numpy as np

from orthoflow.files.images import encode_webp
from orthoflow.products import SurfaceMask, Wall

_LONGEST_PX: Final = 1400


def depth_preview(wall: Wall) -> bytes:
    """Picture of a wall's depth: its inner 98 % spread over a colour scale, void in grey."""
    import cv2

    step = max(1, -(-max(wall.mask.shape) // _LONGEST_PX))
    depth, mask = wall.depth_m[::step, ::step], wall.mask[::step, ::step]
    is_void = mask == SurfaceMask.VOID
    known = depth[~is_void]
    low, high = np.percentile(known, [1.0, 99.0]) if known.size else (0.0, 1.0)
    scaled = (np.nan_to_num(depth) - low) / max(high - low, 1e-6)
    levels = np.clip(255.0 * scaled, 0.0, 255.0).astype(np.uint8)
    picture = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)
    picture[is_void] = 128
    return encode_webp(np.asarray(picture, dtype=np.uint8)[:, :, ::-1])
