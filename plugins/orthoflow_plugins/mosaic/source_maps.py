"""A small picture of where each part of an orthoimage comes from (markiewicz2015, Figure 24)."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_webp
from orthoflow.products import Orthoimage

_LONGEST_PX: Final = 900
_COLOURS: Final = {
    "blue": (31, 119, 180),
    "orange": (255, 127, 14),
    "green": (44, 160, 44),
    "red": (214, 39, 40),
    "purple": (148, 103, 189),
    "brown": (140, 86, 75),
    "pink": (227, 119, 194),
    "grey": (127, 127, 127),
    "olive": (188, 189, 34),
    "cyan": (23, 190, 207),
}
_TINT: Final = 0.45


def source_map(image: Orthoimage) -> bytes:
    """Picture of an orthoimage tinted by source, seams in white, nothing in black."""
    step = max(1, -(-max(image.source.shape) // _LONGEST_PX))
    source = image.source[::step, ::step]
    palette = np.array(list(_COLOURS.values()), dtype=np.float64)
    tint = palette[source % len(palette)]
    grey = image.rgb[::step, ::step].mean(axis=2, keepdims=True)
    picture = np.where(source[..., None] >= 0, _TINT * tint + (1.0 - _TINT) * grey, 0.0)
    picture[is_seam(source)] = 255.0
    return encode_webp(np.rint(picture).astype(np.uint8))


def caption(image: Orthoimage) -> str:
    """Say which colour of `source_map` stands for which source."""
    names = list(_COLOURS)
    legend = ", ".join(
        f"{names[index % len(names)]} {name}" for index, name in enumerate(image.sources)
    )
    return f"{image.name}, by source: {legend}; seams in white."


def is_seam(source: NDArray[np.int16]) -> NDArray[np.bool_]:
    """Cells whose right or lower neighbour comes from another source."""
    seam = np.zeros(source.shape, dtype=np.bool_)
    seam[:, :-1] |= _differ(source[:, :-1], source[:, 1:])
    seam[:-1] |= _differ(source[:-1], source[1:])
    return seam


def _differ(one: NDArray[np.int16], other: NDArray[np.int16]) -> NDArray[np.bool_]:
    return np.asarray((one != other) & (one >= 0) & (other >= 0), dtype=np.bool_)
