"""Matching as markiewicz2015 did (3.5, 3.6, 4.3): SIFT as OpenCV sets it, and the best match.

The best match is that of its reference [36], openMVG: a key point of the wall takes its nearest
descriptor in the photo where the next one is clearly farther (the ratio of distances, 0.8 in
openMVG's documentation); without a ratio, however near it is. Without a mask that is every key
point of the wall; with one, those in the part that the photo shows by its first pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.key_points import best_matches
from orthoflow.products import Photo, Wall, Walls
from orthoflow_plugins.match.features import Features, find_features
from orthoflow_plugins.match.pictures import photo_grey, wall_picture
from orthoflow_plugins.match.ties import TiePiece, key_point_ties
from orthoflow_plugins.match.warping import project_walls

# What openMVG's documentation names for its best match.
_PAPER_RATIO: Final = 0.8
_VOID_MARGIN_CELLS: Final = 3
# So many key points of a picture at most.
_MAX_FEATURES: Final = 50_000


# Any: what a user wrote, before it is checked.
def with_paper_ratio(given: Any) -> Any:
    """Fill in the ratio of `preset: paper` where the parameters of a matcher say none."""
    if isinstance(given, dict) and given.get("preset") == "paper":
        return {"ratio": _PAPER_RATIO, **given}
    return given


def paper_wall_features(wall: Wall) -> Features | None:
    """Key points of a wall's intensity; None where it shows nothing."""
    picture = wall_picture(wall, clip_limit=0.0, void_margin_cells=_VOID_MARGIN_CELLS)
    if picture is None:
        return None
    usable = picture.usable & np.isfinite(wall.depth_m)
    return find_features(picture.grey, _MAX_FEATURES, usable, as_opencv=True)


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
    *,
    max_ratio: float,
) -> list[TiePiece]:
    """Best matches of a photo with every wall.

    Args:
        index: of the photo.
        photo: the photo.
        on_walls: key points per wall, None where it shows nothing.
        walls: the walls.
        masks: cells of each wall that may be matched, None for none; without, all may.
        max_ratio: largest distance of the best match over the second best; 1 for any.
    """
    in_photo = find_features(photo_grey(photo), _MAX_FEATURES, as_opencv=True)
    pieces = []
    for place, (wall, features) in enumerate(zip(walls.walls, on_walls, strict=True)):
        chosen = features
        if masks is not None and features is not None:
            chosen = _within(features, masks[place])
        if chosen is None or not len(chosen) or not len(in_photo):
            continue
        best = best_matches(chosen.descriptors, in_photo.descriptors, ratio=max_ratio)
        pairs = in_photo.take(best.second), chosen.take(best.first)
        pieces.append(key_point_ties((index, place), wall, pairs))
    return pieces


def _within(features: Features, mask: NDArray[np.bool_] | None) -> Features | None:
    if mask is None:
        return None
    columns = np.clip(features.pixels[:, 0].astype(np.intp), 0, mask.shape[1] - 1)
    rows = np.clip(features.pixels[:, 1].astype(np.intp), 0, mask.shape[0] - 1)
    return features.take(mask[rows, columns])
