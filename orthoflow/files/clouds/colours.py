"""Colours of points by plane, intensity or distance from the plane."""

from __future__ import annotations

import colorsys
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import PointCloud

# Hues by the golden ratio: planes with close numbers have different colours.
_HUE_STEP: Final = 0.618033988749895
_SATURATION: Final = 0.6
UNKNOWN: Final = (128, 128, 128)
# The darkest intensity keeps this share of its plane's colour.
_DARKEST: Final = 0.4
_PIECES: Final = 64
_PIECE: Final = 4096
# Behind the plane, on it, in front of it.
BEHIND: Final = (33, 102, 172)
ON_PLANE: Final = (247, 247, 247)
BEFORE: Final = (178, 24, 43)


def plane_colour(index: int) -> tuple[int, int, int]:
    """Return the colour (red, green, blue) of a plane by its position in `Planes`; -1 is grey.

    >>> plane_colour(-1), plane_colour(0)
    ((128, 128, 128), (255, 102, 102))
    """
    if index < 0:
        return UNKNOWN
    red, green, blue = colorsys.hsv_to_rgb((index * _HUE_STEP) % 1.0, _SATURATION, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def plane_colours(
    plane: NDArray[np.int16], palette: NDArray[np.float64], grey: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return colours (n, 3) of points on planes, darkened by their grey (n,), 0..1.

    Args:
        plane: (n,) number of the plane, -1 for none.
        palette: (p + 1, 3) `plane_colour` of -1, 0, 1 ...
        grey: of the points.
    """
    shade = _DARKEST + (1.0 - _DARKEST) * grey
    return np.rint(palette[plane + 1] * shade[:, None]).astype(np.uint8)


def deviation_colours(deviation_m: NDArray[np.float32], full_m: float) -> NDArray[np.uint8]:
    """Return colours (n, 3) of signed distances: blue behind, white on, red in front; grey for NaN.

    >>> deviation_colours(np.array([-0.01, 0.0, 0.02, np.nan], dtype=np.float32), 0.01).tolist()
    [[33, 102, 172], [247, 247, 247], [178, 24, 43], [128, 128, 128]]
    """
    share = np.clip(deviation_m / full_m, -1.0, 1.0).astype(np.float64)
    ends = np.where(share[:, None] < 0.0, np.array(BEHIND), np.array(BEFORE))
    weight = np.abs(np.nan_to_num(share))[:, None]
    mixed = np.rint((1.0 - weight) * np.array(ON_PLANE) + weight * ends)
    return np.where(np.isnan(share)[:, None], UNKNOWN, mixed).astype(np.uint8)


def round_scale_m(largest_m: float) -> float:
    """Return the next of 1, 2, 5, 10 ... mm, for a readable scale.

    >>> round_scale_m(0.0031), round_scale_m(0.0), round_scale_m(0.09)
    (0.005, 0.001, 0.1)
    """
    for power in range(-3, 6):
        for step in (1, 2, 5):
            if largest_m <= (scale_m := float(f"{step}e{power}")):
                return scale_m
    return 1e6


def greys(cloud: PointCloud, part: slice) -> NDArray[np.float64]:
    """Return the brightness (n,) of points: root of intensity, else mean of the colours, else 1."""
    if cloud.intensity is not None:
        intensity = np.nan_to_num(np.asarray(cloud.intensity[part], dtype=np.float64))
        return np.sqrt(np.maximum(intensity, 0.0))
    if cloud.rgb is not None:
        grey: NDArray[np.float64] = np.asarray(cloud.rgb[part], dtype=np.float64).mean(axis=1)
        return grey / 255.0
    return np.ones(len(cloud.x[part]))


def grey_range(cloud: PointCloud) -> tuple[float, float]:
    """Return the range of grey of most points, estimated from pieces all over the cloud."""
    if (cloud.intensity is None and cloud.rgb is None) or not len(cloud):
        return 0.0, 1.0
    sample = np.concatenate([greys(cloud, piece) for piece in sampled_pieces(len(cloud))])
    low, high = np.percentile(sample, (1.0, 99.0))
    return float(low), float(high)


def sampled_pieces(n_points: int) -> list[slice]:
    """Return short disjoint pieces all over a cloud; all of a small one."""
    firsts = range(0, n_points, max(_PIECE, n_points // _PIECES))
    return [slice(k, min(k + _PIECE, n_points)) for k in firsts]
