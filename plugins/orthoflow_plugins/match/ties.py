"""Ties by pieces, each piece one photo on one wall: made from key points, joined, without twins.

Ties that a person measured join them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import used_pixels
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.rows import Rows
from orthoflow.products import JsonValue, Photos, TieRole, Ties, TieWall, Wall, Walls
from orthoflow.sdk import DiagnosticSpec
from orthoflow_plugins.match.features import Features
from orthoflow_plugins.match.pictures import points_on_wall, require_intensity

if TYPE_CHECKING:
    from orthoflow.sdk import StepContext

# How well SIFT places a key point, in pixels of the image it was found in: for the smallest ones,
# and growing with their size.
_MIN_SIGMA_PX: Final = 0.35
_SIGMA_PER_SIZE: Final = 0.06
# At an edge of the relief a key point belongs to neither side.
_MAX_SIGMA_CELLS: Final = 3.0
BY_HAND_ALONE: Final = DiagnosticSpec(
    code="scan-without-texture",
    severity="warning",
    text="the scan has neither intensity nor colour that a photo could be matched with: only the "
    "ties measured by hand are used",
)


@dataclass(frozen=True, kw_only=True)
class TiePiece(Rows):
    """Ties of one photo with one wall.

    Attributes:
        photo: index of the photo.
        wall: index of the wall.
        pixels_photo: (n, 2) float64 (u, v), first pixel centre at (0.5, 0.5).
        points_world: (n, 3) float64 metres.
        sigma_px: (n,) float64.
        sigma_m: (n,) float64.
        role: what they are good for.
    """

    photo: int
    wall: int
    pixels_photo: NDArray[np.float64]
    points_world: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    role: TieRole = TieRole.CONTROL


@dataclass(frozen=True, kw_only=True)
class Trace:
    """What tracing a photo on the walls found.

    Attributes:
        photo: index of the photo.
        pieces: ties per wall, outliers left out.
        n_measured: displacements measured in the last round.
        n_outliers: of these, dropped.
        held_out_px: RMS of a residual coordinate of held-out ties, per round.
        content: what was compared.
        camera: the pose that it was traced from.
        settled: the pose in the end.
    """

    photo: int
    pieces: tuple[TiePiece, ...]
    n_measured: int
    n_outliers: int
    held_out_px: tuple[float, ...]
    content: str
    camera: ViewingCamera
    settled: ViewingCamera

    @property
    def n_ties(self) -> int:
        """Ties on all walls."""
        return sum(len(piece) for piece in self.pieces)


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
    return piece.take(points.known & (piece.sigma_m < _MAX_SIGMA_CELLS * wall.frame.gsd_m))


def ties_of(
    pieces: Sequence[TiePiece],
    photos: Photos,
    walls: Walls,
    details: dict[str, JsonValue],
    *,
    search_radius_px: tuple[float | None, ...] = (),
) -> Ties:
    """Join pieces into one product, in their order, without what is masked in its photo.

    Args:
        pieces: the ties.
        photos: all photos.
        walls: all walls.
        details: what people may want to know.
        search_radius_px: one per photo, as `Ties` has it.
    """
    masks = [used_pixels(photo) for photo in photos.photos]
    pieces = [_unmasked(piece, masks[piece.photo]) for piece in pieces]
    counts = [len(piece) for piece in pieces]
    total = sum(counts)

    def column(values: list[int], dtype: type[np.integer]) -> NDArray[np.int32]:
        return np.repeat(np.array(values, dtype=dtype), counts)

    def joined(name: str, width: int) -> NDArray[np.float64]:
        shape = (0, width) if width > 1 else (0,)
        return np.concatenate([np.empty(shape), *(getattr(piece, name) for piece in pieces)])

    return Ties(
        photo_names=tuple(photo.name for photo in photos.photos),
        photo=column([piece.photo for piece in pieces], np.int32),
        wall=column([piece.wall for piece in pieces], np.int32),
        pixels_photo=joined("pixels_photo", 2),
        points_world=joined("points_world", 3),
        sigma_px=joined("sigma_px", 1),
        sigma_m=joined("sigma_m", 1),
        role=np.repeat(np.array([piece.role for piece in pieces], dtype=np.uint8), counts),
        residual_px=np.full((total, 2), np.nan),
        walls=tuple(TieWall.of(wall) for wall in walls.walls),
        search_radius_px=search_radius_px,
        details=details,
    )


def _unmasked(piece: TiePiece, used: NDArray[np.bool_] | None) -> TiePiece:
    """Return the ties of a photo whose pixels may be used."""
    if used is None:
        return piece
    most = np.array(used.shape[::-1]) - 1
    columns, rows = np.clip(piece.pixels_photo.astype(np.int64), 0, most).T
    return piece.take(used[rows, columns])


def without_twins(pieces: Sequence[TiePiece]) -> list[TiePiece]:
    """Keep one of several ties that say the same: one place of a photo on overlapping walls.

    Planes that lie close to each other show the same surface when the rasters reach far; twins
    would count twice in the orientation. The one with the smallest `sigma_m` stays.
    """
    if len(pieces) < 2:
        return list(pieces)
    pixels = np.concatenate([piece.pixels_photo for piece in pieces])
    points = np.concatenate([piece.points_world for piece in pieces])
    sigma_m = np.concatenate([piece.sigma_m for piece in pieces])
    # Twins share key point and surface, up to the rasters' cells.
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
    ends = np.cumsum([len(piece) for piece in pieces])
    return [
        piece.take(kept[end - len(piece) : end]) for piece, end in zip(pieces, ends, strict=True)
    ]


def ties_by_hand_alone(
    hand: Ties | None, photos: Photos, walls: Walls, ctx: StepContext
) -> Ties | None:
    """Return the ties by hand where the walls show nothing that a photo could be matched with.

    Returns:
        None where the walls show something.

    Raises:
        MethodError: the walls show nothing, and nobody measured a tie.
    """
    if hand is None or any(wall.intensity is not None for wall in walls.walls):
        require_intensity(walls)
        return None
    ctx.report(BY_HAND_ALONE)
    return with_ties_by_hand(ties_of([], photos, walls, {}), hand, walls, ctx)


def with_ties_by_hand(ties: Ties, hand: Ties | None, walls: Walls, ctx: StepContext) -> Ties:
    """Put ties that a person measured behind those that matching found.

    Args:
        ties: of all photos, with their walls.
        hand: measured by a person, in the photos of the same names; None for none.
        walls: the walls of `ties`.
        ctx: takes how many they are.
    """
    if hand is None or not len(hand.photo):
        return ties
    place = {name: index for index, name in enumerate(ties.photo_names)}
    known = np.array([place.get(name, -1) for name in hand.photo_names], dtype=np.int32)
    kept = np.flatnonzero(known[hand.photo] >= 0)
    ctx.metric("n_by_hand", len(kept), "1")
    own_walls = walls.nearest(hand.points_world[kept])
    return replace(
        ties,
        photo=np.concatenate([ties.photo, known[hand.photo[kept]]]),
        wall=np.concatenate([ties.wall, own_walls]),
        pixels_photo=np.concatenate([ties.pixels_photo, hand.pixels_photo[kept]]),
        points_world=np.concatenate([ties.points_world, hand.points_world[kept]]),
        sigma_px=np.concatenate([ties.sigma_px, hand.sigma_px[kept]]),
        sigma_m=np.concatenate([ties.sigma_m, hand.sigma_m[kept]]),
        role=np.concatenate([ties.role, hand.role[kept]]),
        residual_px=np.concatenate([ties.residual_px, np.full((len(kept), 2), np.nan)]),
        by_hand=np.repeat(np.array([0, 1], dtype=np.uint8), [len(ties.photo), len(kept)]),
    )


def _sigma_px(sizes_px: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.maximum(_MIN_SIGMA_PX, _SIGMA_PER_SIZE * sizes_px)
