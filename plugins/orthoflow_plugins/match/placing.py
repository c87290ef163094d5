"""Coarse poses from structure, for photos that cannot be matched with a wall by key points.

A high correlation of the structure in nine parts of a photo does not prove the position of the
photo, since repeating motifs also correlate elsewhere. Therefore, overlapping patches are matched
independently at the most likely positions. A position is probably correct if most of the patches
fit one pose.

A repetition of the motif, or another wall with the same tiles, may still fit best. Photos share
many more key points with each other than with the laser intensity. A position is therefore accepted
if another photo, at its own position, shows the same key points at the same places on the wall.
This only fails if both positions are wrong by the same displacement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.files.images import photo_grey, photo_rgb, reduced
from orthoflow.geometry.cameras import LensFreedom, ViewingCamera
from orthoflow.geometry.key_points import Features, find_features
from orthoflow.geometry.resection import SeenPoints, adjust
from orthoflow.geometry.threads import in_order
from orthoflow.products import Photo, Photos, Wall
from orthoflow_plugins.match.channels import HALF_PATCH_CELLS, Channels
from orthoflow_plugins.match.displacements import Displacements, measure
from orthoflow_plugins.match.key_points import PairingParams, PhotoPairs, mapped, pair_photo
from orthoflow_plugins.match.pictures import CLIP_LIMIT, equalised, one_by_one, points_on_wall
from orthoflow_plugins.match.structures import (
    PHOTO_SIDE_PX,
    Place,
    WallStructure,
    likely_places,
    structure_of,
)
from orthoflow_plugins.match.ties import TiePiece, piece_on_wall
from orthoflow_plugins.match.tracing import agrees_around, fitted_pose
from orthoflow_plugins.match.warping import project_walls, warp_photo

# Number of positions of a photo, over all walls, that are examined patch by patch.
_PLACES: Final = 4
# Number of candidate positions on each wall at each rotation of the photo.
_PLACES_EACH: Final = 4
# Search radius of each round, in coarse cells.
_RADII: Final = (6, 4, 3, 3)
# Longer side of the reduced photo from which all patches are resampled.
_SIDE_PX: Final = 1200
_APART_CELLS: Final = 5
_MIN_SCORE: Final = 0.3
_MIN_DISTINCT: Final = 0.03
# Minimum number of tie points in a round from which a pose is computed.
_MIN_FIT: Final = 8
# A position is dropped if it has fewer than _TIES_FEW tie points, or if less than _SHARE_FEW of the
# patches agree.
_TIES_FEW: Final = 20
_SHARE_FEW: Final = 0.05
# In simulated rooms, wrong positions had leads of up to 6.1 with 15 % of the patches agreeing.
# Correct positions had leads of at least 6.2, or at least 5.5 with 30 % of the patches agreeing.
_MIN_LEAD: Final = 6.5
_MIN_LEAD_OF_MANY: Final = 5.5
_MANY_SHARE: Final = 0.25
_MIN_TIES: Final = 40
_MIN_SHARE: Final = 0.08
_OVER_NEXT: Final = 1.5
# Standard deviation of the position of a matched patch, in coarse cells.
_SIGMA_CELLS: Final = 0.5
# Anticlockwise quarter turns that make a photo upright, by EXIF orientation.
_QUARTERS: Final = {3: 2, 4: 2, 5: 3, 6: 3, 7: 1, 8: 1}
# Two poses count as the same position if they displace the wall in the photo by less than this
# share of the longer side of the photo.
_SAME_SHARE: Final = 0.1
_LONGEST_SIDE_PX: Final = 1600
_PARAMS: Final = PairingParams(max_features=4000, ratio=0.8, max_side_px=_LONGEST_SIDE_PX)
# Minimum number of common key points, since fewer may come from a repeated motif.
_MIN_SHARED: Final = 24
# Maximum distance, in coarse cells, between the positions on the wall that two photos give for a
# common key point.
_CONFIRMED_CELLS: Final = 3.0
# The same limit for photos that only have a homography, which ignores relief.
_APART_ROUGHLY_CELLS: Final = 6.0
_MIN_AGREEING: Final = 0.6
# Minimum number of coarse cells that overlapping photos have in common.
_OVERLAP_CELLS: Final = 200
# A group of agreeing photos is accepted if it contains at least this many photos, or a photo whose
# position is clear without the others.
_MANY: Final = 3


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A possible position of a photo on a wall.

    Attributes:
        piece: tie points of this position.
        camera: the pose from the tie points.
        lead: lead of the position before patches were matched, as in `Place`.
        share: share of patches, among those in the overlap, that agree with the pose.
        radius_px: search radius of the patches, in photo pixels.
        is_clear: whether this position is far better than all others.
    """

    piece: TiePiece
    camera: ViewingCamera
    lead: float
    share: float
    radius_px: float
    is_clear: bool = False


def places_of(
    index: int, photo: Photo, structures: Sequence[WallStructure | None], cores: int = 1
) -> list[Placed]:
    """Return the possible positions of a photo on the walls, starting with the best.

    Only the first position may be marked as clear. All four orientations are tried if EXIF does not
    give the orientation of the photo.

    Args:
        index: index of the photo.
        photo: the photo.
        structures: structures of the walls, None for walls without usable structure.
        cores: number of threads.
    """
    rgb, longest = photo_rgb(photo), max(photo.width, photo.height)
    small = reduced(rgb, min(1.0, _SIDE_PX / longest))
    tiny = reduced(rgb, min(1.0, PHOTO_SIDE_PX / longest))
    lens, freedom = photo.lens_prior()
    # Coarse tie points do not determine lens parameters other than the focal length.
    freedom = LensFreedom(focal_sigma=freedom.focal_sigma)
    upright = _QUARTERS.get(photo.exif_orientation, 0)
    has_exif = photo.exif_orientation != 1 or photo.exif_focal_px is not None

    def likely(quarters: int) -> list[tuple[int, int, Place]]:
        rotated = np.ascontiguousarray(np.rot90(tiny, quarters))
        return [
            (quarters, wall, place)
            for wall, structure in enumerate(structures)
            if structure is not None
            for place in likely_places(rotated, structure, n_most=_PLACES_EACH)
        ]

    def examined(candidate: tuple[int, int, Place]) -> Placed | None:
        quarters, wall, place = candidate
        structure = structures[wall]
        assert structure is not None  # noqa: S101 - it has places
        camera = _camera_at(place, structure, lens, quarters)
        if camera is None:
            return None
        placed = _tied((index, wall), small, (camera, freedom), structure)
        return None if placed is None else replace(placed, lead=place.lead)

    every = [upright] if has_exif else [upright + quarters for quarters in range(4)]
    candidates = sorted(
        chain(*in_order(likely, every, threads=cores)), key=lambda each: -each[2].lead
    )
    found = in_order(examined, candidates[:_PLACES], threads=cores)
    return _judged([each for each in found if each is not None])


def _judged(found: Sequence[Placed]) -> list[Placed]:
    """Sort positions, drop poor and duplicate ones, and determine whether the best is clear."""
    best_first = sorted(found, key=lambda each: -each.share)
    kept = [
        replace(each, lead=max(other.lead for other in best_first if _is_same(each, other)))
        for nth, each in enumerate(best_first)
        if len(each.piece) >= _TIES_FEW
        and each.share >= _SHARE_FEW
        and not any(_is_same(each, other) for other in best_first[:nth])
    ]
    if not kept:
        return []
    best = kept[0]
    is_clear = (
        all(best.share >= _OVER_NEXT * other.share for other in kept[1:])
        and len(best.piece) >= _MIN_TIES
        and best.share >= _MIN_SHARE
        and best.lead >= (_MIN_LEAD_OF_MANY if best.share >= _MANY_SHARE else _MIN_LEAD)
    )
    return [replace(best, is_clear=is_clear), *(replace(one, is_clear=False) for one in kept[1:])]


def _camera_at(
    place: Place, structure: WallStructure, lens: ViewingCamera, quarters: int
) -> ViewingCamera | None:
    """Compute the pose of a photo from the positions of its parts on the wall.

    The initial pose is perpendicular to the wall.

    Args:
        place: position of the photo rotated by `np.rot90`.
        structure: structure of the wall.
        lens: lens of the photo.
        quarters: anticlockwise quarter turns of the rotated photo.
    """
    wall, frame = structure.wall, structure.wall.frame
    # This transforms the axes of the rotated photo to those of the stored photo.
    axes = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), quarters % 4)
    stored_px = np.array([lens.width, lens.height])
    rotated_px = np.abs(axes) @ stored_px
    pixels = ((place.parts_photo - 0.5) * rotated_px) @ axes.T + 0.5 * stored_px
    # The axes point right, down and into the wall.
    at = place.centre_m[None] / frame.gsd_m
    u, v, normal = frame.axes_at(at)[0]
    rotation = np.array([*(axes @ [u, v]), -normal])
    px_per_m = rotated_px[0] / place.width_m
    # Use an origin near the wall, since large survey coordinates would reduce the precision.
    origin = frame.origin_world
    middle = frame.world_from_wall(at)[0] - origin
    start = replace(
        lens,
        rotation=rotation,
        translation=-rotation @ (middle + lens.fx / px_per_m * normal),
    )
    cells = place.parts_m / frame.gsd_m
    lifted, _, known = points_on_wall(wall, cells, spread=structure.spread)
    # Use the plane of the wall where its surface is unknown.
    points = np.where(known[:, None], lifted, frame.world_from_wall(cells))
    seen = SeenPoints(
        pixels_photo=pixels,
        points_world=points - origin,
        sigma_px=np.full(len(points), frame.gsd_m * px_per_m),
        sigma_m=np.full(len(points), frame.gsd_m),
    )
    try:
        return adjust(seen, start, soft_limit=2.0).camera.shifted(-origin)
    except GeometryError:
        return None


def _tied(
    at: tuple[int, int],
    small: NDArray[np.uint8],
    start: tuple[ViewingCamera, LensFreedom],
    structure: WallStructure,
) -> Placed | None:
    """Match patches of a reduced photo with a wall and refine the pose, in several rounds.

    Returns:
        The position, or None if too few patches match.
    """
    wall, origin = structure.wall, structure.wall.frame.origin_world
    camera, freedom = start
    prior = camera
    scale = min(1.0, _SIDE_PX / max(camera.width, camera.height))
    placed: Placed | None = None
    for radius in _RADII:
        projection = project_walls(camera, [wall])[0]
        if projection is None:
            return None
        in_small = replace(
            projection,
            u=projection.u * np.float32(scale),
            v=projection.v * np.float32(scale),
            pixels_per_cell=projection.pixels_per_cell * scale,
        )
        shown = warp_photo(small, in_small)
        other = structure_of(shown / np.float32(255.0), np.asarray(np.isfinite(shown).all(axis=2)))
        own = structure.channels.part(projection.part)
        moved = _measured(own, other, radius)
        piece = piece_on_wall(
            at,
            wall,
            projection.pixels_at(moved.places + moved.shift_cells),
            moved.places + projection.corner + np.float64(0.5),
            np.full(len(moved), _SIGMA_CELLS * projection.pixels_per_cell),
            spread=structure.spread,
        )
        if len(piece) < _MIN_FIT:
            return None
        seen = replace(piece, points_world=piece.points_world - origin)
        try:
            around = camera.shifted(origin)
            camera = fitted_pose(seen, around, lens=(freedom, prior)).shifted(-origin)
        except GeometryError:
            return None
        placed = Placed(
            piece=piece,
            camera=camera,
            lead=0.0,
            share=len(piece) * _APART_CELLS**2 / float((own.known * other.known).sum()),
            radius_px=_RADII[0] * projection.pixels_per_cell,
        )
    return placed


def _measured(first: Channels, second: Channels, radius: int) -> Displacements:
    border = radius + HALF_PATCH_CELLS + 2

    def framed(channels: Channels) -> Channels:
        # Patches at the border of the photo are used if they are mostly known.
        margin = ((border, border), (border, border))
        return Channels(
            values=np.pad(channels.values, (*margin, (0, 0))), known=np.pad(channels.known, margin)
        )

    rows, columns = (
        np.arange(_APART_CELLS // 2, length, _APART_CELLS) for length in first.known.shape
    )
    places = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.intp)
    moved = measure(
        framed(first),
        framed(second),
        places + border,
        radius,
        min_score=_MIN_SCORE,
        min_distinct=_MIN_DISTINCT,
    )
    moved = moved.take(agrees_around(moved))
    return replace(moved, places=moved.places - border)


def _is_same(first: Placed, second: Placed) -> bool:
    """Return whether two poses project the tie points of one of them to about the same pixels."""
    if first.piece.wall != second.piece.wall:
        return False
    camera, pixels = second.camera, first.piece.pixels_photo
    off_px = np.linalg.norm(camera.project(first.piece.points_world)[:, :2] - pixels, axis=1)
    return float(np.median(off_px)) < _SAME_SHARE * max(camera.width, camera.height)


@dataclass(frozen=True, kw_only=True)
class _Footprint:
    """The part of a wall that a photo shows, according to a possible position or to key points.

    Attributes:
        photo: index of the photo.
        wall: index of the wall.
        pixels: (rows, cols, 2) float64 photo pixels of the coarse cells, NaN outside the photo.
        cell_px: width of a coarse cell in photo pixels.
        tolerance_cells: tolerance of the position, in coarse cells.
        placed: the possible position; None for a photo with matched key points.
    """

    photo: int
    wall: int
    pixels: NDArray[np.float64]
    cell_px: float
    tolerance_cells: float
    placed: Placed | None

    @property
    def shown(self) -> NDArray[np.bool_]:
        """Mask (rows, cols) of the coarse cells that are in the photo."""
        return np.isfinite(self.pixels[:, :, 0])


def confirmed(
    photos: Photos,
    places: Mapping[int, Sequence[Placed]],
    recognised: Mapping[int, PhotoPairs],
    on: tuple[Sequence[Wall], Sequence[WallStructure | None]],
    cores: int = 1,
) -> dict[int, Placed]:
    """Select the positions of photos that confirm each other.

    Args:
        photos: all photos.
        places: possible positions of photos without clear matches, by index.
        recognised: key point matches of photos with walls, by index. These photos may also be in
            `places`, since key points may agree by chance.
        on: all walls, and their structures.
        cores: number of threads.

    Returns:
        The confirmed position of each photo, by its index; photos with confirmed key points are
        omitted.
    """
    if not any(places.values()):
        return {}
    walls, structures = on
    coarse = {at: one.wall for at, one in enumerate(structures) if one is not None}
    footprints = [
        one
        for index, some in places.items()
        for placed in some
        if (one := _footprint_by_pose(index, placed, coarse)) is not None
    ]
    for index, pairs in recognised.items():
        footprints += _footprints_by_homography((index, photos), pairs, coarse, walls)
    near = [
        (a, b)
        for a, b in combinations(range(len(footprints)), 2)
        if footprints[a].photo != footprints[b].photo
        and (footprints[a].placed is not None or footprints[b].placed is not None)
        and footprints[a].wall == footprints[b].wall
        and (footprints[a].shown & footprints[b].shown).sum() >= _OVERLAP_CELLS
    ]
    wanted = sorted({(footprints[a].photo, footprints[b].photo) for a, b in near})
    shared = _shared(photos, wanted, cores)
    agreeing = [
        (a, b)
        for a, b in near
        if _agree(footprints[a], footprints[b], shared[footprints[a].photo, footprints[b].photo])
    ]
    return _chosen(footprints, agreeing)


def _footprint_by_pose(index: int, placed: Placed, walls: Mapping[int, Wall]) -> _Footprint | None:
    wall = walls[placed.piece.wall]
    projection = project_walls(placed.camera, [wall])[0]
    if projection is None:
        return None
    pixels = np.full((*wall.frame.shape, 2), np.nan)
    pixels[projection.part] = np.stack([projection.u, projection.v], axis=-1)
    return _Footprint(
        photo=index,
        wall=placed.piece.wall,
        pixels=pixels,
        cell_px=projection.pixels_per_cell,
        tolerance_cells=_CONFIRMED_CELLS,
        placed=placed,
    )


def _footprints_by_homography(
    shot: tuple[int, Photos],
    pairs: PhotoPairs,
    coarse: Mapping[int, Wall],
    walls: Sequence[Wall],
) -> list[_Footprint]:
    index, photos = shot
    photo = photos.photos[index]
    footprints = []
    for pair in pairs.pairs:
        if pair.homography is None or pair.wall not in coarse:
            continue
        wall = coarse[pair.wall]
        rows, columns = wall.frame.shape
        cells = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1)
        factor = wall.frame.gsd_m / walls[pair.wall].frame.gsd_m
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = mapped(pair.homography, cells.reshape(-1, 2) * factor)
        inside = ((pixels >= 0.0) & (pixels < [photo.width, photo.height])).all(axis=1)
        if inside.sum() < _OVERLAP_CELLS:
            continue
        pixels[~inside] = np.nan
        area_px = float(np.ptp(pixels[inside], axis=0).prod())
        footprints.append(
            _Footprint(
                photo=index,
                wall=pair.wall,
                pixels=pixels.reshape(rows, columns, 2),
                cell_px=float(np.sqrt(area_px / inside.sum())),
                tolerance_cells=_APART_ROUGHLY_CELLS,
                placed=None,
            )
        )
    return footprints


def _shared(
    photos: Photos, wanted: Sequence[tuple[int, int]], cores: int
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Match key points of photo pairs; return their pixels (n, 2, 2) in both photos."""
    asked = sorted({index for pair in wanted for index in pair})

    def look(index: int) -> tuple[NDArray[np.uint8], Features, float]:
        grey = photo_grey(photos.photos[index])
        scale = min(1.0, _LONGEST_SIDE_PX / max(grey.shape))
        small = reduced(grey, scale)
        features = find_features(equalised(small, CLIP_LIMIT), _PARAMS.max_features)
        return small, features, scale

    looks = dict(zip(asked, one_by_one(look, asked, cores), strict=True))

    def shared(pair: tuple[int, int]) -> NDArray[np.float64]:
        (grey, _, scale), (_, features, other_scale) = (looks[index] for index in pair)
        pairs = pair_photo(grey, [features], _PARAMS)
        pixels = [np.empty((0, 2, 2))]
        for each in pairs.pairs:
            if each.is_shown:
                here = pairs.features.pixels[each.matches.first[each.agreeing]] / scale
                there = features.pixels[each.matches.second[each.agreeing]] / other_scale
                pixels.append(np.stack([here, there], axis=1))
        return np.concatenate(pixels)

    return dict(zip(wanted, one_by_one(shared, wanted, cores), strict=True))


def _agree(one: _Footprint, other: _Footprint, shared: NDArray[np.float64]) -> bool:
    """Return whether two photos show the same key points at the same places on the wall."""
    from scipy.spatial import cKDTree

    both = one.shown & other.shown
    here, there = one.pixels[both], other.pixels[both]
    distance, nearest = (np.asarray(found) for found in cKDTree(here).query(shared[:, 0]))
    is_shown = distance <= one.cell_px
    if int(is_shown.sum()) < _MIN_SHARED:
        return False
    off = there[nearest[is_shown]] - shared[is_shown, 1]
    off_cells = np.linalg.norm(off, axis=1) / other.cell_px
    limit = max(one.tolerance_cells, other.tolerance_cells)
    return bool((off_cells <= limit).mean() >= _MIN_AGREEING)


def _chosen(
    footprints: Sequence[_Footprint], agreeing: Sequence[tuple[int, int]]
) -> dict[int, Placed]:
    """Select the positions of the groups that agree best, one per photo."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not agreeing:
        return {}
    pairs = np.array(agreeing).T
    graph = coo_array((np.ones(pairs.shape[1]), pairs), shape=(len(footprints), len(footprints)))
    group = connected_components(graph, directed=False)[1]
    chosen: dict[int, Placed] = {}
    groups: list[list[int]] = [
        np.flatnonzero(group == label).tolist() for label in np.unique(group[pairs])
    ]

    def rank(members: list[int]) -> float:
        """Rank groups with matched key points first, other groups by the sum of patch shares."""
        is_anchored = any(footprints[member].placed is None for member in members)
        return 1e3 * is_anchored + sum(one.share for m in members if (one := footprints[m].placed))

    for members in sorted(groups, key=lambda some: (-rank(some), some[0])):
        some = [footprints[member] for member in members]
        is_clear = any(each.placed is None or each.placed.is_clear for each in some)
        if not is_clear and len({each.photo for each in some}) < _MANY:
            continue
        by_photo: dict[int, Placed] = {}
        recognised = {
            footprints[member].photo for member in members if footprints[member].placed is None
        }
        for member in members:
            placed = footprints[member].placed
            # A photo with confirmed key points does not need a position from structure.
            if placed is None or footprints[member].photo in recognised:
                continue
            rival = by_photo.get(footprints[member].photo)
            if rival is None or placed.share > rival.share:
                by_photo[footprints[member].photo] = placed
        # If a group contradicts a higher-ranking group, all of its positions are wrong.
        if not any(photo in chosen for photo in by_photo):
            chosen.update(by_photo)
    return chosen
