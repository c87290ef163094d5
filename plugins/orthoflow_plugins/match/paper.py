"""Matching as markiewicz2015 did (3.5, 3.6, 4.3): SIFT as OpenCV sets it, and the best match.

Every key point of the wall takes its nearest descriptor in the photo, however near it is. Without a
mask that is every key point of the wall; with one, those in the part that the photo shows by its
first pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Photo, Wall, Walls
from orthoflow_plugins.match.descriptors import nearest
from orthoflow_plugins.match.features import FeatureRule, Features, find_features
from orthoflow_plugins.match.pictures import photo_grey, wall_picture
from orthoflow_plugins.match.tie_pieces import TiePiece, key_point_ties
from orthoflow_plugins.match.warping import project_walls

_VOID_MARGIN_CELLS: Final = 3
# OpenCV's own values.
PAPER_FEATURES: Final = FeatureRule(
    n_most=50_000,
    contrast_threshold=0.04,
    edge_threshold=10.0,
    upscales_precisely=False,
    is_rooted=False,
)


def paper_wall_features(wall: Wall) -> Features | None:
    """Key points of a wall's intensity; None where it shows nothing."""
    picture = wall_picture(wall, clip_limit=0.0, void_margin_cells=_VOID_MARGIN_CELLS)
    if picture is None:
        return None
    usable = picture.usable & np.isfinite(wall.depth_m)
    return find_features(picture.grey, PAPER_FEATURES, usable)


def footprints(camera: ViewingCamera, walls: Walls) -> list[NDArray[np.bool_] | None]:
    """Cells of each wall that a photo shows by its pose; None where it shows none."""
    masks: list[NDArray[np.bool_] | None] = []
    for wall, projection in zip(walls.walls, project_walls(camera, walls.walls), strict=True):
        if projection is None:
            masks.append(None)
            continue
        mask = np.zeros(wall.frame.shape, dtype=np.bool_)
        mask[projection.part] = np.isfinite(projection.u)
        masks.append(mask)
    return masks


def paper_pieces(
    index: int,
    photo: Photo,
    on_walls: Sequence[Features | None],
    walls: Walls,
    masks: Sequence[NDArray[np.bool_] | None] | None,
) -> list[TiePiece]:
    """Best matches of a photo with every wall.

    Args:
        index: of the photo.
        photo: the photo.
        on_walls: key points per wall, None where it shows nothing.
        walls: the walls.
        masks: cells of each wall that may be matched, None for none; without, all may.
    """
    in_photo = find_features(photo_grey(photo), PAPER_FEATURES)
    pieces = []
    for place, (wall, features) in enumerate(zip(walls.walls, on_walls, strict=True)):
        chosen = features
        if masks is not None and features is not None:
            chosen = _within(features, masks[place])
        if chosen is None or not len(chosen) or not len(in_photo):
            continue
        best = nearest(chosen.descriptors, in_photo.descriptors)
        pieces.append(key_point_ties((index, place), wall, (in_photo.take(best), chosen)))
    return pieces


def _within(features: Features, mask: NDArray[np.bool_] | None) -> Features | None:
    if mask is None:
        return None
    columns = np.clip(features.pixels[:, 0].astype(np.intp), 0, mask.shape[1] - 1)
    rows = np.clip(features.pixels[:, 1].astype(np.intp), 0, mask.shape[0] - 1)
    return features.take(mask[rows, columns])
