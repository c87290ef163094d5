"""Ties between photos and walls, from key points or measured by hand.

`preset: paper` matches as in markiewicz2015 (3.5, 3.6, 4.3): with OpenCV's default SIFT, and with
matches selected as in openMVG, reference [36] of the paper. The match of a key point on the wall is
the nearest descriptor in the photo if the ratio of the distances to the nearest and to the second
nearest descriptor is below a limit (0.8 in the documentation of openMVG). Without poses, all key
points of a wall are matched; with poses, those in the part that the photo shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import photo_grey, used_pixels
from orthoflow.geometry.key_points import Features, best_matches, find_features
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Camera, JsonValue, Photos, TieRole, Ties, TieWall, Wall, Walls
from orthoflow.sdk import DiagnosticSpec
from orthoflow_plugins.match.key_points import wall_features
from orthoflow_plugins.match.pictures import (
    Spread,
    one_by_one,
    points_on_wall,
    require_intensity,
)
from orthoflow_plugins.match.warping import Projection, project_walls

if TYPE_CHECKING:
    from orthoflow.sdk import StepContext

# Standard deviation of the position of a SIFT key point: the minimum, in pixels of the image, and
# the ratio to the size of the key point.
_MIN_SIGMA_PX: Final = 0.35
_SIGMA_PER_SIZE: Final = 0.06
# Key points are dropped if the standard deviation of the depth is larger than this, as it is at
# relief edges.
_MAX_SIGMA_CELLS: Final = 3.0
# The ratio in the documentation of openMVG.
_PAPER_RATIO: Final = 0.8
# Maximum number of key points in a picture.
_PAPER_FEATURES: Final = 50_000
BY_HAND_ALONE: Final = DiagnosticSpec(
    code="scan-without-texture",
    severity="warning",
    text="the scan has neither intensity nor colour, so photos cannot be matched with it: only "
    "ties measured by hand are used",
)


@dataclass(frozen=True, kw_only=True)
class TiePiece(SeenPoints):
    """Ties of one photo with one wall.

    Attributes:
        photo: index of the photo.
        wall: index of the wall.
        role: role of the ties.
    """

    photo: int
    wall: int
    role: TieRole = TieRole.CONTROL


_NOTHING: Final = TiePiece(
    photo=0,
    wall=0,
    pixels_photo=np.empty((0, 2)),
    points_world=np.empty((0, 3)),
    sigma_px=np.empty(0),
    sigma_m=np.empty(0),
)


def piece_on_wall(
    at: tuple[int, int],
    wall: Wall,
    pixels_photo: NDArray[np.float64],
    cells: NDArray[np.float64],
    sigma_px: NDArray[np.float64],
    *,
    spread: Spread | None = None,
    role: TieRole = TieRole.CONTROL,
) -> TiePiece:
    """Return the ties of one photo with one wall, except those without a finite pixel or depth.

    Args:
        at: index of the photo and of the wall.
        wall: the wall.
        pixels_photo: (n, 2) pixels of the photo.
        cells: (n, 2) (column, row) in the raster of the wall, with the first cell centre at (0.5,
            0.5).
        sigma_px: (n,) standard deviation of a pixel coordinate.
        spread: as in `points_on_wall`.
        role: role of the ties.
    """
    points_world, sigma_m, known = points_on_wall(wall, cells, spread=spread)
    piece = TiePiece(
        photo=at[0],
        wall=at[1],
        pixels_photo=pixels_photo,
        points_world=points_world,
        sigma_px=sigma_px,
        sigma_m=sigma_m,
        role=role,
    )
    return piece.take(known & np.isfinite(pixels_photo).all(axis=1))


def key_point_ties(
    at: tuple[int, int],
    wall: Wall,
    sets: tuple[Features, Features],
    *,
    scale: float = 1.0,
    role: TieRole = TieRole.CONTROL,
) -> TiePiece:
    """Return the ties of one photo with one wall, except those whose depth is uncertain or unknown.

    Args:
        at: index of the photo and of the wall.
        wall: the wall.
        sets: matched key points in the photo (pixels of the full image) and on the wall.
        scale: factor by which the photo was reduced to find the key points.
        role: role of the ties.
    """
    in_photo, on_wall = sets
    known = points_on_wall(wall, on_wall.pixels)[2]
    in_photo, on_wall = in_photo.take(known), on_wall.take(known)
    sigma_px = _sigma_px(in_photo.sizes_px * scale) / scale
    piece = piece_on_wall(at, wall, in_photo.pixels, on_wall.pixels, sigma_px, role=role)
    gsd_m = wall.frame.gsd_m
    piece = replace(piece, sigma_m=np.hypot(piece.sigma_m, gsd_m * _sigma_px(on_wall.sizes_px)))
    return piece.take(piece.sigma_m < _MAX_SIGMA_CELLS * gsd_m)


def paper_ties(
    photos: Photos,
    walls: Walls,
    cameras: Mapping[str, Camera] | None,
    ratio: float | None,
    ctx: StepContext,
) -> tuple[list[TiePiece], list[Features | None]]:
    """Find the best matches of each photo with each wall as in markiewicz2015.

    Args:
        photos: the photos.
        walls: the walls.
        cameras: cameras by photo name. Photos without a pose are not matched, nor are key points of
            a wall outside the photo. If None, all photos and key points are matched.
        ratio: maximum ratio between the distances of the best and the second-best match; if None,
            the ratio of openMVG is used.
        ctx: context for progress.

    Returns:
        The ties, and the key points of each wall, which are None for walls without intensity.
    """

    def look(wall: Wall) -> Features | None:
        return wall_features(wall, _PAPER_FEATURES, as_opencv=True)

    on_walls = list(one_by_one(look, walls.walls, ctx.cores))
    pieces: list[TiePiece] = []
    for index, photo in enumerate(photos.photos):
        shown: list[Projection | None] = []
        if cameras is not None:
            if photo.name not in cameras:
                continue
            shown = project_walls(cameras[photo.name].viewing(), walls.walls)
        ctx.progress(index / len(photos.photos), photo.name)
        in_photo = find_features(photo_grey(photo), _PAPER_FEATURES, as_opencv=True)
        for place, (wall, features) in enumerate(zip(walls.walls, on_walls, strict=True)):
            chosen = features
            if features is not None and cameras is not None:
                chosen = _within(features, shown[place], wall)
            if chosen is None or not len(chosen) or not len(in_photo):
                continue
            best = best_matches(
                chosen.descriptors, in_photo.descriptors, ratio=ratio or _PAPER_RATIO
            )
            pairs = in_photo.take(best.second), chosen.take(best.first)
            pieces.append(key_point_ties((index, place), wall, pairs))
    return pieces, on_walls


def _within(features: Features, shown: Projection | None, wall: Wall) -> Features | None:
    """Select the key points in the part of a wall that a photo shows."""
    if shown is None:
        return None
    mask = np.zeros(wall.frame.shape, dtype=np.bool_)
    mask[shown.part] = np.isfinite(shown.u)
    columns, rows = np.clip(features.pixels.astype(np.intp), 0, np.array(mask.shape[::-1]) - 1).T
    return features.take(mask[rows, columns])


def ties_of(
    pieces: Sequence[TiePiece],
    photos: Photos,
    walls: Walls,
    details: dict[str, JsonValue],
    *,
    search_radius_px: tuple[float | None, ...] = (),
) -> Ties:
    """Join pieces into one product, in their order, and drop ties in masked parts of photos.

    Args:
        pieces: the ties.
        photos: all photos.
        walls: all walls.
        details: details for the report.
        search_radius_px: one per photo, as in `Ties`.
    """
    masks = [used_pixels(photo) for photo in photos.photos]
    kept: list[TiePiece] = [_NOTHING]
    for piece in pieces:
        used = masks[piece.photo]
        if used is None:
            kept.append(piece)
            continue
        most = np.array(used.shape[::-1]) - 1
        columns, rows = np.clip(piece.pixels_photo.astype(np.int64), 0, most).T
        kept.append(piece.take(used[rows, columns]))
    counts = [len(piece) for piece in kept]
    seen = TiePiece.joined(kept)
    return Ties(
        photo_names=tuple(photo.name for photo in photos.photos),
        photo=np.repeat(np.array([piece.photo for piece in kept], dtype=np.int32), counts),
        wall=np.repeat(np.array([piece.wall for piece in kept], dtype=np.int32), counts),
        pixels_photo=seen.pixels_photo,
        points_world=seen.points_world,
        sigma_px=seen.sigma_px,
        sigma_m=seen.sigma_m,
        role=np.repeat(np.array([piece.role for piece in kept], dtype=np.uint8), counts),
        residual_px=np.full((len(seen), 2), np.nan),
        walls=tuple(TieWall.of(wall) for wall in walls.walls),
        search_radius_px=search_radius_px,
        details=details,
    )


def joined(pieces: Sequence[TiePiece]) -> SeenPoints:
    """Join the ties of all pieces."""
    return TiePiece.joined([_NOTHING, *pieces])


def parted(pieces: Sequence[TiePiece], kept: NDArray[np.bool_]) -> list[TiePiece]:
    """Select ties of all pieces by one mask (n,) over the joined ties."""
    parts = np.split(kept, np.cumsum([len(piece) for piece in pieces])[:-1])
    return [piece.take(part) for piece, part in zip(pieces, parts, strict=True)]


def without_twins(pieces: Sequence[TiePiece]) -> list[TiePiece]:
    """Drop duplicate ties between a key point and the same surface in overlapping walls.

    Rasters of neighbouring planes may contain the same surface, whose ties would count twice in the
    orientation. The tie with the smallest `sigma_m` is kept.
    """
    if len(pieces) < 2:
        return list(pieces)
    seen = joined(pieces)
    pixels, points, sigma_m = seen.pixels_photo, seen.points_world, seen.sigma_m
    order = np.lexsort((sigma_m, pixels[:, 1].round(3), pixels[:, 0].round(3)))
    kept = np.ones(len(pixels), dtype=np.bool_)
    first = 0
    for here, nth in enumerate(order):
        if np.abs(pixels[nth] - pixels[order[first]]).max() > 1e-3:
            first = here
            continue
        rivals = order[first:here]
        rivals = rivals[kept[rivals]]
        distance = np.linalg.norm(points[rivals] - points[nth], axis=1)
        kept[nth] = not (distance < 4.0 * (sigma_m[rivals] + sigma_m[nth])).any()
    return parted(pieces, kept)


def ties_by_hand_alone(
    hand: Ties | None, photos: Photos, walls: Walls, ctx: StepContext
) -> Ties | None:
    """Return the ties measured by hand if no wall has intensity.

    Returns:
        The ties, or None if a wall has intensity.

    Raises:
        MethodError: no wall has intensity, and there are no ties measured by hand.
    """
    if hand is None or any(wall.intensity is not None for wall in walls.walls):
        require_intensity(walls)
        return None
    ctx.report(BY_HAND_ALONE)
    return with_ties_by_hand(ties_of([], photos, walls, {}), hand, walls, ctx)


def with_ties_by_hand(ties: Ties, hand: Ties | None, walls: Walls, ctx: StepContext) -> Ties:
    """Append ties measured by hand to those from matching.

    Args:
        ties: ties of all photos, with their walls.
        hand: ties measured by hand in photos with the same names, or None.
        walls: the walls of `ties`.
        ctx: context in which the number of ties measured by hand is reported.
    """
    if hand is None or not len(hand.photo):
        return ties
    place = {name: index for index, name in enumerate(ties.photo_names)}
    known = np.array([place.get(name, -1) for name in hand.photo_names], dtype=np.int32)
    kept = np.flatnonzero(known[hand.photo] >= 0)
    ctx.metric("n_by_hand", len(kept), "1")
    own_walls = walls.nearest(hand.points_world[kept])
    # The arrays of the product are collected by name and have various types.
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(ties, name), getattr(hand, name)[kept]])
        for name in ("pixels_photo", "points_world", "sigma_px", "sigma_m", "role")
    }
    return replace(
        ties,
        photo=np.concatenate([ties.photo, known[hand.photo[kept]]]),
        wall=np.concatenate([ties.wall, own_walls]),
        **columns,
        residual_px=np.concatenate([ties.residual_px, np.full((len(kept), 2), np.nan)]),
        by_hand=np.repeat(np.array([0, 1], dtype=np.uint8), [len(ties.photo), len(kept)]),
    )


def _sigma_px(sizes_px: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.maximum(_MIN_SIGMA_PX, _SIGMA_PER_SIZE * sizes_px)
