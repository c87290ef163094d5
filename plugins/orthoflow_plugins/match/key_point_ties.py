"""Ties from pairs of key points: where they are on the wall, and how exact they are."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import TieRole, Wall
from orthoflow_plugins.match.assembling import TiePiece
from orthoflow_plugins.match.features import Features
from orthoflow_plugins.match.pictures import points_on_wall

# How well SIFT places a key point, in pixels of the image it was found in: for the smallest ones,
# and growing with their size.
_SIGMA_LEAST_PX: Final = 0.35
_SIGMA_PER_SIZE: Final = 0.06
# At an edge of the relief a key point belongs to neither side.
_SIGMA_MOST_CELLS: Final = 3.0


def key_point_ties(
    at: tuple[int, int],
    wall: Wall,
    sets: tuple[Features, Features],
    *,
    scale: float = 1.0,
    role: TieRole = TieRole.CONTROL,
) -> TiePiece:
    """Ties of one photo with one wall; pairs whose place on the wall is not known are left out.

    Args:
        at: index of the photo and of the wall.
        wall: the wall.
        sets: the pairs' key points in the photo (pixels of the full image) and on the wall.
        scale: the photo's were found in the photo shrunk by this.
        role: of the ties.
    """
    in_photo, on_wall = sets
    points = points_on_wall(wall, on_wall.pixels)
    wall_sigma_m = wall.frame.gsd_m * _sigma_px(on_wall.sizes_px)
    piece = TiePiece(
        photo=at[0],
        wall=at[1],
        pixels_photo=in_photo.pixels,
        points_world=points.points_world,
        sigma_px=_sigma_px(in_photo.sizes_px * scale) / scale,
        sigma_m=np.hypot(points.sigma_m, wall_sigma_m),
        role=role,
    )
    return piece.take(points.known & (piece.sigma_m < _SIGMA_MOST_CELLS * wall.frame.gsd_m))


def _sigma_px(sizes_px: NDArray[np.float64]) -> NDArray[np.float64]:
    sigma: NDArray[np.float64] = np.maximum(_SIGMA_LEAST_PX, _SIGMA_PER_SIZE * sizes_px)
    return sigma
