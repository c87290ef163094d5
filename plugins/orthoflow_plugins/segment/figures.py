"""Figures of openings: a wall with the outlines found on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_webp
from orthoflow.products import OpeningKind

_LONGEST_PX: Final = 1400
_SMALLEST_PX: Final = 500
_KIND_RGB: Final[Mapping[OpeningKind, tuple[int, int, int]]] = {
    "through": (30, 110, 230),
    "niche": (235, 120, 0),
    "no data": (200, 30, 160),
}
CAPTION: Final = (
    "blue: rays passed through, orange: a back was measured, purple: no returns. Sides "
    "should lie on "
    "the edges of what is seen; a side that cuts across something, or an outline round nothing, "
    "is wrong."
)


def outline_map(
    grey: NDArray[np.float32],
    outlines: Sequence[tuple[OpeningKind, NDArray[np.float64]]],
) -> bytes:
    """Draw outlines with their numbers over a pale picture of the wall.

    Args:
        grey: (rows, cols) 0..1, NaN where nothing is shown.
        outlines: kind and (n, 2) column and row of the corners, each.
    """
    import cv2

    longest = max(grey.shape)
    scale = float(np.clip(1.0, _SMALLEST_PX / longest, _LONGEST_PX / longest))
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_NEAREST
    pale = 70.0 + 180.0 * np.clip(np.nan_to_num(grey, nan=0.0), 0.0, 1.0)
    small = np.asarray(cv2.resize(pale.astype(np.uint8), size, interpolation=way), dtype=np.uint8)
    picture = np.repeat(small[:, :, None], 3, axis=2)
    for number, (kind, corners) in enumerate(outlines):
        places = np.rint(scale * corners).astype(np.int32)
        cv2.polylines(
            picture,
            [places],
            isClosed=True,
            color=_KIND_RGB[kind],
            thickness=2,
            lineType=cv2.LINE_AA,
        )
        left, top = (int(value) for value in places.min(axis=0))
        cv2.putText(
            picture,
            str(number),
            (left + 6, top + 22),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.7,
            _KIND_RGB[kind],
            2,
            cv2.LINE_AA,
        )
    return encode_webp(picture)
