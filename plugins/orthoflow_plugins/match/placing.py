"""Photos that no key points find, placed on walls by structure.

That structure agrees in nine parts is no proof: a motif that repeats agrees elsewhere, too. So the
photo is laid on the wall at its likeliest places and a hundred overlapping patches are brought
together there, each for itself; where most fit one pose, the place is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import SeenPoints, adjust
from orthoflow.products import Photo, Wall
from orthoflow_plugins.match.channels import Channels
from orthoflow_plugins.match.displacements import Displacements, SearchRule, measure
from orthoflow_plugins.match.pictures import photo_rgb, points_on_wall
from orthoflow_plugins.match.structures import (
    Place,
    WallStructure,
    likely_places,
    structure_of,
    wall_structure,
)
from orthoflow_plugins.match.tie_pieces import TiePiece
from orthoflow_plugins.match.tracing import agrees_around, between, fitted_pose
from orthoflow_plugins.match.warping import Projection, project_walls, warp_photo

# So many places of a photo are looked at, over all walls.
_PLACES: Final = 3
# Radius of search of each round, in coarse cells.
_RADII: Final = (6, 4, 3, 3)
_HALF_PATCH: Final = 10
_APART_CELLS: Final = 5
_SCORE_LEAST: Final = 0.3
_DISTINCT_LEAST: Final = 0.03
# Ties of a round, to go on with the pose that they give.
_FIT_LEAST: Final = 8
# At wrong places in simulated rooms at most 0.13 of all patches agreed, at a lead of 5.2 and less;
# at right ones at least 0.08, mostly, and leads were 5 to 11.
_LEAD_LEAST: Final = 5.5
_TIES_LEAST: Final = 40
_SHARE_LEAST: Final = 0.08
_OVER_NEXT: Final = 1.5
# How well a patch fixes a place, in coarse cells.
_SIGMA_CELLS: Final = 0.5
# The focal length of a photo of whose lens nothing is known, over its longer side.
_USUAL_FOCAL: Final = 0.8
# Two poses whose photo centres lie nearer on the wall are one place, as a share of the width.
_SAME_SHARE: Final = 0.1


@dataclass(frozen=True, kw_only=True)
class Placed:
    """Where a photo was found.

    Attributes:
        piece: its ties.
        share: of the patches that the wall shows, how many agree.
        radius_px: patches were searched so far, in the photo's pixels.
    """

    piece: TiePiece
    share: float
    radius_px: float


@dataclass(kw_only=True)
class PlacedWalls:
    """Walls that photos are placed on, prepared when the first photo asks."""

    walls: Sequence[Wall]
    _ready: list[WallStructure | None] | None = None
    _lock: Lock = field(default_factory=Lock)

    def structures(self) -> list[WallStructure | None]:
        """Structure of each wall, None where it shows nothing."""
        with self._lock:
            if self._ready is None:
                self._ready = [wall_structure(wall) for wall in self.walls]
            return self._ready


def placed_photo(index: int, photo: Photo, walls: PlacedWalls) -> Placed | None:
    """Place a photo on the walls; None where none shows it beyond doubt.

    Args:
        index: of the photo.
        photo: the photo, roughly upright.
        walls: the walls.
    """
    rgb = photo_rgb(photo)
    places = [
        (at, structure, place)
        for at, structure in enumerate(walls.structures())
        if structure is not None
        for place in likely_places(rgb, structure, n_most=_PLACES)
    ]
    lens = _lens_before(photo)
    found: list[tuple[float, Placed]] = []
    for at, structure, place in sorted(places, key=lambda each: -each[2].lead)[:_PLACES]:
        camera = _camera_at(place, structure.wall, lens)
        placed = None if camera is None else _tied((index, at), rgb, camera, structure)
        if placed is not None:
            found.append((place.lead, placed))
    if not found:
        return None
    lead, best = max(found, key=lambda each: each[1].share)
    rivals = [placed.share for _, placed in found if not _is_same(best.piece, placed.piece)]
    is_clear = all(best.share >= _OVER_NEXT * share for share in rivals)
    is_enough = len(best.piece) >= _TIES_LEAST and best.share >= _SHARE_LEAST
    return best if is_clear and is_enough and lead >= _LEAD_LEAST else None


def _lens_before(photo: Photo) -> ViewingCamera:
    """A photo's lens, as far as it is known before any orientation, at the origin."""
    if photo.intrinsics is not None:
        return photo.intrinsics.posed()
    focal_px = photo.exif_focal_px or _USUAL_FOCAL * max(photo.width, photo.height)
    return ViewingCamera(
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


def _camera_at(place: Place, wall: Wall, lens: ViewingCamera) -> ViewingCamera | None:
    """Pose by the places of the photo's parts, from straight before the wall."""
    frame = wall.frame
    # Right, down and into the wall.
    rotation = np.array([frame.u_world, frame.v_world, -frame.normal_world])
    ahead_m = place.width_m * lens.fx / lens.width
    # Around the wall: survey coordinates would cost digits.
    origin = frame.origin_world
    middle = frame.world_from_wall(place.centre_m[None] / frame.gsd_m)[0] - origin
    start = replace(
        lens,
        rotation=rotation,
        translation=-rotation @ (middle + ahead_m * frame.normal_world),
    )
    pixels = place.parts_m / frame.gsd_m
    lifted = points_on_wall(wall, pixels)
    # On the plane where the wall is void.
    points = np.where(lifted.known[:, None], lifted.points_world, frame.world_from_wall(pixels))
    seen = SeenPoints(
        pixels_photo=place.parts_photo * [lens.width, lens.height],
        points_world=points - origin,
        sigma_px=np.full(len(points), frame.gsd_m * lens.width / place.width_m),
        sigma_m=np.full(len(points), frame.gsd_m),
    )
    try:
        return adjust(seen, start, soft_limit=2.0).camera.shifted(-origin)
    except GeometryError:
        return None


def _tied(
    at: tuple[int, int], rgb: NDArray[np.uint8], camera: ViewingCamera, structure: WallStructure
) -> Placed | None:
    """Ties of a photo with a wall, its pose improved round by round."""
    wall, origin = structure.wall, structure.wall.frame.origin_world
    placed: Placed | None = None
    for radius in _RADII:
        projection = project_walls(camera, [wall])[0]
        if projection is None:
            return None
        shown = warp_photo(rgb, projection)
        other = structure_of(shown / np.float32(255.0), np.asarray(np.isfinite(shown).all(axis=2)))
        own = structure.channels.part(projection.part)
        moved = _measured(own, other, radius)
        piece = _piece(at, wall, moved, projection)
        if len(piece) < _FIT_LEAST:
            return None
        placed = Placed(
            piece=piece,
            share=len(piece) * _APART_CELLS**2 / float((own.known * other.known).sum()),
            radius_px=_RADII[0] * projection.pixels_per_cell,
        )
        seen = SeenPoints(
            pixels_photo=piece.pixels_photo,
            points_world=piece.points_world - origin,
            sigma_px=piece.sigma_px,
            sigma_m=piece.sigma_m,
        )
        try:
            camera = fitted_pose(seen, camera.shifted(origin)).shifted(-origin)
        except GeometryError:
            return None
    return placed


def _measured(first: Channels, second: Channels, radius: int) -> Displacements:
    """Displacements of patches all over the part of a wall that a photo shows."""
    border = radius + _HALF_PATCH + 2

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
    rule = SearchRule(
        radius_cells=radius,
        half_patch_cells=_HALF_PATCH,
        score_least=_SCORE_LEAST,
        distinct_least=_DISTINCT_LEAST,
    )
    moved = measure(framed(first), framed(second), places + border, rule)
    moved = moved.take(agrees_around(moved))
    return replace(moved, places=moved.places - border)


def _piece(
    at: tuple[int, int], wall: Wall, moved: Displacements, projection: Projection
) -> TiePiece:
    places = moved.places + moved.shift_cells
    pixels = np.column_stack([between(projection.u, places), between(projection.v, places)])
    points = points_on_wall(wall, moved.places + projection.corner + np.float64(0.5))
    piece = TiePiece(
        photo=at[0],
        wall=at[1],
        pixels_photo=pixels,
        points_world=points.points_world,
        sigma_px=np.full(len(pixels), _SIGMA_CELLS * projection.pixels_per_cell),
        sigma_m=points.sigma_m,
    )
    return piece.take(points.known & np.isfinite(pixels).all(axis=1))


def _is_same(first: TiePiece, second: TiePiece) -> bool:
    """Whether two sets of ties put a photo at one place of the wall."""
    if first.wall != second.wall:
        return False
    one, other = (np.median(piece.points_world, axis=0) for piece in (first, second))
    width_m = float(np.ptp(first.points_world, axis=0).max())
    return float(np.linalg.norm(one - other)) < _SAME_SHARE * width_m
