"""Places of photos confirmed by what photos show of each other.

Where edges run tells where a photo may be, but a motif that repeats, or another wall with the same
tiles, may win. Photos share many more key points with each other than with a laser's picture. So a
place counts when another photo, at a place of its own, shows the same things where both places say
that they are: two photos that are wrong would have to be wrong in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import Photos, Wall
from orthoflow_plugins.match.features import Features, find_features
from orthoflow_plugins.match.pairing import PairingParams, PhotoPairs, mapped, pair_photo
from orthoflow_plugins.match.pictures import (
    CLIP_LIMIT,
    equalised,
    one_by_one,
    photo_grey,
    shrunk,
)
from orthoflow_plugins.match.placing import Placed, PlacedWalls
from orthoflow_plugins.match.warping import project_walls

_LONGEST_SIDE_PX: Final = 1600
_PARAMS: Final = PairingParams(max_features=4000, ratio=0.8, max_side_px=_LONGEST_SIDE_PX)
# So many key points, in parts that both places show, tell whether the places agree; fewer may be a
# repeated motif.
_MIN_SHARED: Final = 24
# Both places put a shared key point on one spot of the wall, up to so many coarse cells, and more
# where one photo is known by a homography that ignores relief.
_APART_CELLS: Final = 3.0
_APART_ROUGHLY_CELLS: Final = 6.0
_MIN_AGREEING: Final = 0.6
# Places overlap where they share so many coarse cells.
_OVERLAP_CELLS: Final = 200
# Photos that agree are right when so many do, or one of them is clear by itself.
_MANY: Final = 3


@dataclass(frozen=True, kw_only=True)
class _Laid:
    """A photo laid on a wall.

    Attributes:
        photo: index.
        wall: index.
        pixels: (rows, cols, 2) float64 where the wall's coarse cells are in the photo, NaN where
            they are not.
        cell_px: width of a coarse cell in the photo.
        apart_cells: how wrong the place may be.
        placed: the place; None of a photo that key points recognised.
    """

    photo: int
    wall: int
    pixels: NDArray[np.float64]
    cell_px: float
    apart_cells: float
    placed: Placed | None


def confirmed(
    photos: Photos,
    places: Mapping[int, Sequence[Placed]],
    recognised: Mapping[int, PhotoPairs],
    walls: PlacedWalls,
    cores: int = 1,
) -> dict[int, Placed]:
    """Choose the places that photos confirm for each other.

    Args:
        photos: all photos.
        places: by index of a photo that key points did not recognise clearly, where it may be.
        recognised: by index, the pairs of photos that they did recognise; of some in `places`, too,
            as key points may agree by chance.
        walls: all walls.
        cores: photos are compared by so many threads.

    Returns:
        By index of a photo, the place by structure; not of photos whose key points are confirmed.
    """
    if not any(places.values()):
        return {}
    coarse = {at: one.wall for at, one in enumerate(walls.structures()) if one is not None}
    laid = [
        one
        for index, some in places.items()
        for placed in some
        if (one := _laid_by_pose(index, placed, coarse)) is not None
    ]
    for index, pairs in recognised.items():
        laid += _laid_by_homography((index, photos), pairs, coarse, walls.walls)
    near = [
        (a, b)
        for a, b in combinations(range(len(laid)), 2)
        if laid[a].photo != laid[b].photo
        and (laid[a].placed is not None or laid[b].placed is not None)
        and _overlap(laid[a], laid[b])
    ]
    wanted = sorted({(laid[a].photo, laid[b].photo) for a, b in near})
    shared = _shared(photos, wanted, cores)
    agreeing = [
        (a, b) for a, b in near if _agree(laid[a], laid[b], shared[laid[a].photo, laid[b].photo])
    ]
    return _chosen(laid, agreeing)


def _laid_by_pose(index: int, placed: Placed, walls: Mapping[int, Wall]) -> _Laid | None:
    wall = walls[placed.piece.wall]
    projection = project_walls(placed.camera, [wall])[0]
    if projection is None:
        return None
    pixels = np.full((*wall.frame.shape, 2), np.nan)
    pixels[projection.part] = np.stack([projection.u, projection.v], axis=-1)
    return _Laid(
        photo=index,
        wall=placed.piece.wall,
        pixels=pixels,
        cell_px=projection.pixels_per_cell,
        apart_cells=_APART_CELLS,
        placed=placed,
    )


def _laid_by_homography(
    shot: tuple[int, Photos],
    pairs: PhotoPairs,
    coarse: Mapping[int, Wall],
    walls: Sequence[Wall],
) -> list[_Laid]:
    index, photos = shot
    photo = photos.photos[index]
    laid = []
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
        laid.append(
            _Laid(
                photo=index,
                wall=pair.wall,
                pixels=pixels.reshape(rows, columns, 2),
                cell_px=float(np.sqrt(area_px / inside.sum())),
                apart_cells=_APART_ROUGHLY_CELLS,
                placed=None,
            )
        )
    return laid


def _overlap(one: _Laid, other: _Laid) -> bool:
    if one.wall != other.wall:
        return False
    both = np.isfinite(one.pixels[:, :, 0]) & np.isfinite(other.pixels[:, :, 0])
    return int(both.sum()) >= _OVERLAP_CELLS


def _shared(
    photos: Photos, wanted: Sequence[tuple[int, int]], cores: int
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Pixels (n, 2, 2) that two photos share, in the one and in the other, by indices of photos."""
    asked = sorted({index for pair in wanted for index in pair})
    small = dict(zip(asked, one_by_one(lambda k: _small(photos, k), asked, cores), strict=True))

    def shared(pair: tuple[int, int]) -> NDArray[np.float64]:
        one, other = (small[index] for index in pair)
        pairs = pair_photo(one.grey, [other.features], _PARAMS)
        pixels = [
            np.stack(
                [
                    pairs.features.pixels[each.matches.first[each.agreeing]] / one.scale,
                    other.features.pixels[each.matches.second[each.agreeing]] / other.scale,
                ],
                axis=1,
            )
            for each in pairs.pairs
            if each.is_shown
        ]
        return np.concatenate([np.empty((0, 2, 2)), *pixels])

    return dict(zip(wanted, one_by_one(shared, wanted, cores), strict=True))


@dataclass(frozen=True, kw_only=True)
class _Small:
    """A photo shrunk by a scale, and its key points there."""

    grey: NDArray[np.uint8]
    features: Features
    scale: float


def _small(photos: Photos, index: int) -> _Small:
    grey = photo_grey(photos.photos[index])
    scale = min(1.0, _LONGEST_SIDE_PX / max(grey.shape))
    small = shrunk(grey, scale)
    return _Small(
        grey=small,
        features=find_features(equalised(small, CLIP_LIMIT), _PARAMS.max_features),
        scale=scale,
    )


def _agree(one: _Laid, other: _Laid, shared: NDArray[np.float64]) -> bool:
    """Whether two photos show the same where both lie on one spot of the wall."""
    from scipy.spatial import cKDTree

    both = np.isfinite(one.pixels[:, :, 0]) & np.isfinite(other.pixels[:, :, 0])
    here, there = one.pixels[both], other.pixels[both]
    distance, nearest = (np.asarray(found) for found in cKDTree(here).query(shared[:, 0]))
    is_shown = distance <= one.cell_px
    if int(is_shown.sum()) < _MIN_SHARED:
        return False
    off = there[nearest[is_shown]] - shared[is_shown, 1]
    off_cells = np.linalg.norm(off, axis=1) / other.cell_px
    limit = max(one.apart_cells, other.apart_cells)
    return bool((off_cells <= limit).mean() >= _MIN_AGREEING)


def _chosen(laid: Sequence[_Laid], agreeing: Sequence[tuple[int, int]]) -> dict[int, Placed]:
    """Take the places of the largest groups that agree, each photo once."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not agreeing:
        return {}
    pairs = np.array(agreeing).T
    graph = coo_array((np.ones(pairs.shape[1]), pairs), shape=(len(laid), len(laid)))
    group = connected_components(graph, directed=False)[1]
    chosen: dict[int, Placed] = {}
    groups: list[list[int]] = [
        np.flatnonzero(group == label).tolist() for label in np.unique(group[pairs])
    ]
    for members in sorted(groups, key=lambda some: (-_weight(laid, some), some[0])):
        if not _is_enough(laid, members):
            continue
        by_photo: dict[int, Placed] = {}
        recognised = {laid[member].photo for member in members if laid[member].placed is None}
        for member in members:
            placed = laid[member].placed
            # Key points that others confirm need no structure.
            if placed is None or laid[member].photo in recognised:
                continue
            rival = by_photo.get(laid[member].photo)
            if rival is None or placed.share > rival.share:
                by_photo[laid[member].photo] = placed
        # A group that puts a photo elsewhere than a heavier one does is wrong as a whole.
        if not any(photo in chosen for photo in by_photo):
            chosen.update(by_photo)
    return chosen


def _weight(laid: Sequence[_Laid], members: Sequence[int]) -> float:
    """How much speaks for a group: photos that key points recognised, then patches that agree."""
    is_anchored = any(laid[member].placed is None for member in members)
    shares = [placed.share for member in members if (placed := laid[member].placed) is not None]
    return 1e3 * is_anchored + sum(shares)


def _is_enough(laid: Sequence[_Laid], members: Sequence[int]) -> bool:
    some = [laid[member] for member in members]
    return (
        any(each.placed is None or each.placed.is_clear for each in some)
        or len({each.photo for each in some}) >= _MANY
    )
