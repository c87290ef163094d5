"""Photos that no key points find, placed on walls by structure.

That structure agrees in nine parts is no proof: a motif that repeats agrees elsewhere, too. So the
photo is laid on the wall at its likeliest places and a hundred overlapping patches are brought
together there, each for itself; where most fit one pose, the place is right.

But a motif that repeats, or another wall with the same tiles, may win. Photos share many more key
points with each other than with a laser's picture. So a place counts when another photo, at a place
of its own, shows the same things where both places say that they are: two photos that are wrong
would have to be wrong in the same way.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import LensFreedom, ViewingCamera
from orthoflow.geometry.resection import SeenPoints, adjust
from orthoflow.geometry.threads import in_order
from orthoflow.products import Photo, Photos, Wall
from orthoflow_plugins.match.channels import HALF_PATCH_CELLS, Channels
from orthoflow_plugins.match.displacements import Displacements, measure
from orthoflow_plugins.match.key_points import (
    Features,
    PairingParams,
    PhotoPairs,
    find_features,
    mapped,
    pair_photo,
)
from orthoflow_plugins.match.pictures import (
    CLIP_LIMIT,
    equalised,
    one_by_one,
    photo_grey,
    photo_rgb,
    points_on_wall,
    shrunk,
)
from orthoflow_plugins.match.structures import (
    PHOTO_SIDE_PX,
    Place,
    WallStructure,
    closer,
    likely_places,
    structure_of,
)
from orthoflow_plugins.match.ties import TiePiece, piece_on_wall
from orthoflow_plugins.match.tracing import agrees_around, fitted_pose
from orthoflow_plugins.match.warping import project_walls, warp_photo

# So many places of a photo are looked at patch by patch, over all walls: as cameras are held first,
# then among all other turns. Wrong ones mostly end with their first patches.
_PLACES: Final = (4, 12)
# So many are taken from each wall in each turn, and of those that were found roughly so many seen
# closer.
_PLACES_EACH: Final = 4
_CLOSER: Final = 24
# Radius of search of each round, in coarse cells.
_RADII: Final = (6, 4, 3, 3)
# Longer side to which a photo is shrunk, once, for all its patches.
_SIDE_PX: Final = 1200
_APART_CELLS: Final = 5
_MIN_SCORE: Final = 0.3
_MIN_DISTINCT: Final = 0.03
# Ties of a round, to go on with the pose that they give.
_MIN_FIT: Final = 8
# Ties of a place that photos beside it may confirm.
_TIES_FEW: Final = 20
_SHARE_FEW: Final = 0.05
# At wrong places in simulated rooms leads were up to 6.1 where 0.15 of all patches agreed; at right
# ones 6.2 and more, or 0.3 and more of all patches agreed at leads of 5.5 and more.
_MIN_LEAD: Final = 6.5
_MIN_LEAD_OF_MANY: Final = 5.5
_MANY_SHARE: Final = 0.25
_MIN_TIES: Final = 40
_MIN_SHARE: Final = 0.08
_OVER_NEXT: Final = 1.5
# How well a patch fixes a place, in coarse cells.
_SIGMA_CELLS: Final = 0.5
# The focal length of a photo of whose lens nothing is known, over its longer side.
_USUAL_FOCAL: Final = 0.8
# How far focal lengths may be off (of ln f): by EXIF, and where nothing is known.
_EXIF_SIGMA: Final = 0.05
_UNKNOWN_SIGMA: Final = 0.3
# Quarter turns, anticlockwise, that bring a photo upright, by EXIF's orientation.
_QUARTERS: Final = {3: 2, 4: 2, 5: 3, 6: 3, 7: 1, 8: 1}
# Turns of a photo of which nobody says how it was held, anticlockwise from upright in degrees: as
# cameras are held first. Structure is found up to some 9 degrees off.
_QUARTERS_DEG: Final = (0.0, 90.0, -90.0, 180.0)
_OTHERS_DEG: Final = tuple(
    quarter + roll for roll in (15.0, -15.0, 30.0, -30.0, 45.0) for quarter in _QUARTERS_DEG
)
# Two poses that put the wall nearer than that are one place, as a share of the photo's longer side.
_SAME_SHARE: Final = 0.1
_LONGEST_SIDE_PX: Final = 1600
_PARAMS: Final = PairingParams(max_features=4000, ratio=0.8, max_side_px=_LONGEST_SIDE_PX)
# So many key points, in parts that both places show, tell whether the places agree; fewer may be a
# repeated motif.
_MIN_SHARED: Final = 24
# Both places put a shared key point on one spot of the wall, up to so many coarse cells, and more
# where one photo is known by a homography that ignores relief.
_CONFIRMED_CELLS: Final = 3.0
_APART_ROUGHLY_CELLS: Final = 6.0
_MIN_AGREEING: Final = 0.6
# Places overlap where they share so many coarse cells.
_OVERLAP_CELLS: Final = 200
# Photos that agree are right when so many do, or one of them is clear by itself.
_MANY: Final = 3


@dataclass(frozen=True, kw_only=True)
class Placed:
    """Where a photo may be.

    Attributes:
        piece: its ties.
        camera: its pose by them.
        lead: by how many robust deviations the place stands out from others, before patches were
            brought together there.
        share: of the patches that the wall shows, how many agree.
        radius_px: patches were searched so far, in the photo's pixels.
        is_clear: no other place comes near it.
    """

    piece: TiePiece
    camera: ViewingCamera
    lead: float
    share: float
    radius_px: float
    is_clear: bool = False


@dataclass(frozen=True, kw_only=True)
class TurnedPhoto:
    """The middle of a photo, turned in its plane.

    Attributes:
        rgb: (height, width, 3) of it.
        size_px: its width and height in pixels of the photo.
        axes: (2, 2) right and down in the photo, each as right and down of what is turned.
        middle_px: (2,) column and row of the photo that it is turned about.
    """

    rgb: NDArray[np.uint8]
    size_px: tuple[float, float]
    axes: NDArray[np.float64]
    middle_px: tuple[float, float]

    def pixels_photo(self, shares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (n, 2) of the photo where shares (n, 2) of width and height are."""
        return (shares - 0.5) * self.size_px @ self.axes.T + self.middle_px


def turned(rgb: NDArray[np.uint8], degrees: float, scale: float = 1.0) -> TurnedPhoto:
    """Turn a photo (height, width, 3) anticlockwise; of other turns than quarters give the middle.

    What is cut has the shape that the whole would have when turned by the nearest quarters.

    Args:
        rgb: the photo, shrunk by a scale.
        degrees: by so much.
        scale: one pixel of the whole photo is so many of these.
    """
    import cv2

    quarters = round(degrees / 90.0)
    roll_deg = degrees - 90.0 * quarters
    whole = np.ascontiguousarray(np.rot90(rgb, quarters % 4))
    angle = np.radians(degrees)
    # Quarters are exact.
    cos, sin = np.round([np.cos(angle), np.sin(angle)], 15)
    if roll_deg:
        height, width = whole.shape[:2]
        along, across = abs(np.cos(np.radians(roll_deg))), abs(np.sin(np.radians(roll_deg)))
        share = min(
            width / (width * along + height * across), height / (width * across + height * along)
        )
        size = (max(1, int(share * width)), max(1, int(share * height)))
        matrix = cv2.getRotationMatrix2D((0.5 * width - 0.5, 0.5 * height - 0.5), roll_deg, 1.0)
        matrix[:, 2] += [0.5 * (size[0] - width), 0.5 * (size[1] - height)]
        whole = np.asarray(cv2.warpAffine(whole, matrix, size), dtype=np.uint8)
    return TurnedPhoto(
        rgb=whole,
        size_px=(whole.shape[1] / scale, whole.shape[0] / scale),
        axes=np.array([[cos, -sin], [sin, cos]]),
        middle_px=(0.5 * rgb.shape[1] / scale, 0.5 * rgb.shape[0] / scale),
    )


_Likely = tuple[int, Place, TurnedPhoto]
"""A wall, and a place there that a photo may show when it is turned so."""


def places_of(
    index: int, photo: Photo, structures: Sequence[WallStructure | None], cores: int = 1
) -> list[Placed]:
    """Return the places on the walls where a photo may be, the best first.

    Only the first may be clear. A photo of which no EXIF says how it was held is tried in all ways,
    unless a clear place is found as cameras are mostly held.

    Args:
        index: of the photo.
        photo: the photo.
        structures: of the walls, None where one shows nothing.
        cores: ways are tried by so many threads.
    """
    rgb = photo_rgb(photo)
    longer = max(photo.width, photo.height)
    scale = min(1.0, _SIDE_PX / longer)
    small = shrunk(rgb, scale)
    coarse = min(1.0, PHOTO_SIDE_PX / longer)
    tiny = shrunk(rgb, coarse)
    upright_deg = 90.0 * _QUARTERS.get(photo.exif_orientation, 0)
    lens, freedom = _lens_before(photo)

    def likely(turn_deg: float, *, roughly: bool) -> list[_Likely]:
        upright = turned(tiny, upright_deg + turn_deg, coarse)
        return [
            (at, place, upright)
            for at, structure in enumerate(structures)
            if structure is not None
            for place in likely_places(upright.rgb, structure, n_most=_PLACES_EACH, roughly=roughly)
        ]

    def on(wall: int) -> WallStructure:
        structure = structures[wall]
        assert structure is not None  # noqa: S101 - it has places
        return structure

    def seen_closer(each: _Likely) -> _Likely:
        wall, place, upright = each
        return wall, closer(upright.rgb, on(wall), place), upright

    def looked_at(each: _Likely) -> Placed | None:
        wall, place, upright = each
        camera = _camera_at(place, on(wall), lens, upright)
        if camera is None:
            return None
        placed = _tied((index, wall), small, (camera, freedom), on(wall))
        return None if placed is None else replace(placed, lead=place.lead)

    found: list[Placed] = []
    for nth, turns_deg in enumerate(_turns_deg(photo)):
        look = partial(likely, roughly=nth > 0)
        some = _best(chain(*in_order(look, turns_deg, threads=cores)), _CLOSER)
        if nth > 0:
            some = list(in_order(seen_closer, some, threads=cores))
        looked = in_order(looked_at, _best(some, _PLACES[nth]), threads=cores)
        found = _judged([*found, *(each for each in looked if each is not None)])
        if found and found[0].is_clear:
            break
    return found


def _best(some: Iterable[_Likely], n_most: int) -> list[_Likely]:
    return sorted(some, key=lambda each: -each[1].lead)[:n_most]


def _turns_deg(photo: Photo) -> Sequence[Sequence[float]]:
    """Turns from upright in which a photo is tried: first these, then those."""
    if photo.exif_orientation != 1 or photo.exif_focal_px is not None:
        return ((0.0,),)
    # Faces of a panorama have no EXIF, and many show no wall: each turn costs as much as the first.
    is_face = photo.intrinsics is not None and photo.intrinsics.source == "given"
    return (_QUARTERS_DEG,) if is_face else (_QUARTERS_DEG, _OTHERS_DEG)


def _judged(found: Sequence[Placed]) -> list[Placed]:
    """Places that differ and where enough agrees, the best first; it is clear or not."""
    best_first = sorted(found, key=lambda each: -each.share)
    kept = [
        # What stood out in one of two turns next to each other stands out.
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


def _lens_before(photo: Photo) -> tuple[ViewingCamera, LensFreedom]:
    """A photo's lens, as far as it is known before any orientation, at the origin."""
    if photo.intrinsics is not None:
        return photo.intrinsics.posed(), LensFreedom()
    focal_px = photo.exif_focal_px or _USUAL_FOCAL * max(photo.width, photo.height)
    lens = ViewingCamera(
        width=photo.width,
        height=photo.height,
        fx=focal_px,
        fy=focal_px,
        cx=0.5 * photo.width,
        cy=0.5 * photo.height,
        distortion=np.zeros(5),
        rotation=np.eye(3),
        translation=np.zeros(3),
    )
    sigma = _UNKNOWN_SIGMA if photo.exif_focal_px is None else _EXIF_SIGMA
    return lens, LensFreedom(focal_sigma=sigma)


def _camera_at(
    place: Place, structure: WallStructure, lens: ViewingCamera, upright: TurnedPhoto
) -> ViewingCamera | None:
    """Pose by the places of the photo's parts, from straight before the wall."""
    wall, frame = structure.wall, structure.wall.frame
    axes = upright.axes @ np.array([frame.u_world, frame.v_world])
    # Right, down and into the wall.
    rotation = np.array([*axes, -frame.normal_world])
    px_per_m = upright.size_px[0] / place.width_m
    # Around the wall: survey coordinates would cost digits.
    origin = frame.origin_world
    middle = frame.world_from_wall(place.centre_m[None] / frame.gsd_m)[0] - origin
    start = replace(
        lens,
        rotation=rotation,
        translation=-rotation @ (middle + lens.fx / px_per_m * frame.normal_world),
    )
    pixels = place.parts_m / frame.gsd_m
    lifted, _, known = points_on_wall(wall, pixels, usual_m=structure.usual_spread_m)
    # On the plane where the wall is void.
    points = np.where(known[:, None], lifted, frame.world_from_wall(pixels))
    seen = SeenPoints(
        pixels_photo=upright.pixels_photo(place.parts_photo),
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
    """Ties of a photo, given shrunk, with a wall, its pose improved round by round."""
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
            usual_m=structure.usual_spread_m,
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
    """Displacements of patches all over the part of a wall that a photo shows."""
    border = radius + HALF_PATCH_CELLS + 2

    def framed(channels: Channels) -> Channels:
        # Patches at the photo's border count by what is known of them.
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
    """Whether two poses put what a photo's ties show in one place of the photo."""
    if first.piece.wall != second.piece.wall:
        return False
    camera, pixels = second.camera, first.piece.pixels_photo
    off_px = np.linalg.norm(camera.project(first.piece.points_world)[:, :2] - pixels, axis=1)
    return float(np.median(off_px)) < _SAME_SHARE * max(camera.width, camera.height)


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

    @property
    def shown(self) -> NDArray[np.bool_]:
        """Coarse cells (rows, cols) of the wall that the photo shows."""
        return np.isfinite(self.pixels[:, :, 0])


def confirmed(
    photos: Photos,
    places: Mapping[int, Sequence[Placed]],
    recognised: Mapping[int, PhotoPairs],
    on: tuple[Sequence[Wall], Sequence[WallStructure | None]],
    cores: int = 1,
) -> dict[int, Placed]:
    """Choose the places that photos confirm for each other.

    Args:
        photos: all photos.
        places: by index of a photo that key points did not recognise clearly, where it may be.
        recognised: by index, the pairs of photos that they did recognise; of some in `places`, too,
            as key points may agree by chance.
        on: all walls, and their structures.
        cores: photos are compared by so many threads.

    Returns:
        By index of a photo, the place by structure; not of photos whose key points are confirmed.
    """
    if not any(places.values()):
        return {}
    walls, structures = on
    coarse = {at: one.wall for at, one in enumerate(structures) if one is not None}
    laid = [
        one
        for index, some in places.items()
        for placed in some
        if (one := _laid_by_pose(index, placed, coarse)) is not None
    ]
    for index, pairs in recognised.items():
        laid += _laid_by_homography((index, photos), pairs, coarse, walls)
    near = [
        (a, b)
        for a, b in combinations(range(len(laid)), 2)
        if laid[a].photo != laid[b].photo
        and (laid[a].placed is not None or laid[b].placed is not None)
        and laid[a].wall == laid[b].wall
        and (laid[a].shown & laid[b].shown).sum() >= _OVERLAP_CELLS
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
        apart_cells=_CONFIRMED_CELLS,
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


def _shared(
    photos: Photos, wanted: Sequence[tuple[int, int]], cores: int
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Pixels (n, 2, 2) that two photos share, in the one and in the other, by indices of photos."""
    asked = sorted({index for pair in wanted for index in pair})

    def look(index: int) -> tuple[NDArray[np.uint8], Features, float]:
        grey = photo_grey(photos.photos[index])
        scale = min(1.0, _LONGEST_SIDE_PX / max(grey.shape))
        small = shrunk(grey, scale)
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


def _agree(one: _Laid, other: _Laid, shared: NDArray[np.float64]) -> bool:
    """Whether two photos show the same where both lie on one spot of the wall."""
    from scipy.spatial import cKDTree

    both = one.shown & other.shown
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

    def weight(members: list[int]) -> float:
        """How much speaks for a group: photos that key points recognised, then shares."""
        is_anchored = any(laid[member].placed is None for member in members)
        return 1e3 * is_anchored + sum(one.share for m in members if (one := laid[m].placed))

    for members in sorted(groups, key=lambda some: (-weight(some), some[0])):
        some = [laid[member] for member in members]
        is_clear = any(each.placed is None or each.placed.is_clear for each in some)
        if not is_clear and len({each.photo for each in some}) < _MANY:
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
