"""One photo laid onto one wall, tile by tile: which cells it sees, and their colours."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from threading import Lock, local
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.layer_kernels import Canvas, hand_over
from orthoflow.geometry.row_bands import Allocate
from orthoflow.geometry.sight_kernels import look_at_cells
from orthoflow.geometry.threads import in_threads
from orthoflow.geometry.visibility_kernels import (
    OCCLUDED,
    DepthBuffer,
    Relief,
    Sight,
    WallView,
)
from orthoflow_plugins.ortho.dsm_backward_sampling import (
    Footprint,
    Resampling,
    footprint_of,
    sample,
)

TILE_CELLS: Final = 512
# What is packed of a photo for a tile stays below 80 MB; cv2.remap takes sides below 32767.
_CROP_MOST_PX: Final = 3_000


@dataclass(frozen=True, kw_only=True)
class SightRule:
    """What counts as seen, and how colours are taken.

    Attributes:
        resampling: how colours between pixels are made.
        is_filtered: average over what a cell covers where the photo is finer than the wall.
        incidence_max_deg: cells seen more obliquely count as hidden.
        erosion_cells: cells so near to a hidden one are not painted.
        border_share: quality falls to 0 over this share of the photo's shorter side.
    """

    resampling: Resampling
    is_filtered: bool
    incidence_max_deg: float
    erosion_cells: int
    border_share: float


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A wall as it is looked at.

    Attributes:
        frame: where the cells lie.
        relief: their depths, and what they hide.
        front_m: up to this depth the relief holds all points there are.
        tolerance_m: how far a surface must be above a ray to hide it.
    """

    frame: WallFrame
    relief: Relief
    front_m: float
    tolerance_m: float


@dataclass(kw_only=True)
class Painting:
    """What a photo painted on a wall.

    Attributes:
        mask: (rows, cols) uint8 `LayerMask`.
        rgb: (rows, cols, 3) uint8, None when nothing was painted.
        quality: (rows, cols) float32, None when nothing was painted.
        footprints: of the tiles that were painted, by their first cell.
    """

    mask: NDArray[np.uint8]
    rgb: NDArray[np.uint8] | None = None
    quality: NDArray[np.float32] | None = None
    footprints: dict[tuple[int, int], Footprint] = field(default_factory=dict)


def view_of(camera: ViewingCamera, surface: Surface, rule: SightRule) -> WallView:
    """Give a camera in the axes of a wall; survey coordinates lose nothing on the way."""
    frame = surface.frame
    axes = np.column_stack([frame.u_world, frame.v_world, frame.normal_world])
    near = camera.shifted(frame.origin_world)
    flat = near.flat.copy()
    flat[:9] = (near.rotation @ axes).ravel()
    centre = axes.T @ near.centre_world
    return WallView(
        camera=flat,
        column=float(centre[0]) / frame.gsd_m - 0.5,
        row=float(centre[1]) / frame.gsd_m - 0.5,
        height_m=float(centre[2]),
        gsd_m=float(frame.gsd_m),
        front_m=float(surface.front_m),
        tolerance_m=float(surface.tolerance_m),
        cosine_least=math.cos(math.radians(rule.incidence_max_deg)),
        border_px=max(1.0, rule.border_share * min(camera.width, camera.height)),
        # The nearest pixel is another one a hundredth of a pixel farther on.
        is_exact=rule.resampling == "nearest",
    )


def paint(
    photo: NDArray[np.uint8],
    view: WallView,
    surface: Surface,
    buffer: DepthBuffer,
    rule: SightRule,
    *,
    allocate: Allocate,
    threads: int,
) -> Painting:
    """Lay a photo onto a wall.

    Args:
        photo: (height, width, 3).
        view: its camera before the wall.
        surface: the wall.
        buffer: what else stands before the camera.
        rule: how.
        allocate: gives the arrays of a layer, zeroed: the mask, and the others once something is
            painted.
        threads: how many tiles are painted at once; it does not show in the result.
    """
    brush = _Brush(photo, view, surface, buffer, rule, allocate)
    rows, columns = surface.frame.shape
    tiles = [
        (slice(row, min(row + TILE_CELLS, rows)), slice(column, min(column + TILE_CELLS, columns)))
        for row in range(0, rows, TILE_CELLS)
        for column in range(0, columns, TILE_CELLS)
    ]
    in_threads([partial(brush.paint_tile, tile) for tile in tiles], threads=threads)
    return brush.painting


class _Brush:
    """Paints the tiles of one painting, several at once."""

    def __init__(
        self,
        photo: NDArray[np.uint8],
        view: WallView,
        surface: Surface,
        buffer: DepthBuffer,
        rule: SightRule,
        allocate: Allocate,
    ) -> None:
        mask = allocate("mask", surface.frame.shape, np.uint8)
        self.painting = Painting(mask=np.asarray(mask, np.uint8))
        self._photo = photo
        self._view = view
        self._surface = surface
        self._buffer = buffer
        self._rule = rule
        self._allocate = allocate
        self._lock = Lock()
        self._scratch = local()

    def paint_tile(self, tile: tuple[slice, slice]) -> None:
        sight, inner = self._look(tile)
        if not sight.summary[4]:
            self.painting.mask[tile] = sight.mask[inner]
            return
        if _crop_side(sight) > _CROP_MOST_PX and sight.mask[inner].size > 1:
            for quarter in _quarters(tile):
                self.paint_tile(quarter)
            return
        footprint = footprint_of(self._view, sight)
        canvas = self._canvas()
        is_near = self._near_hidden(sight)
        sample(
            self._photo,
            sight,
            inner,
            footprint,
            self._rule.resampling,
            is_filtered=self._rule.is_filtered,
            into=canvas.rgb[tile],
        )
        hand_over(sight, is_near, (inner[0].start, inner[1].start), canvas, tile)
        self.painting.footprints[tile[0].start, tile[1].start] = footprint

    def _look(self, tile: tuple[slice, slice]) -> tuple[Sight, tuple[slice, slice]]:
        """See a tile and so much around it as hides cells of it; say where in that the tile is."""
        reach = self._rule.erosion_cells
        reach += 1 if reach else 0  # what is a patch shows one cell farther out
        first = [max(0, part.start - reach) for part in tile]
        shape = tuple(
            min(size, part.stop + reach) - start
            for size, part, start in zip(self._surface.frame.shape, tile, first, strict=True)
        )
        sight = self._blank_sight(shape[0], shape[1])
        look_at_cells(self._view, self._surface.relief, self._buffer, sight, first[0], first[1])
        rows, columns = (
            slice(part.start - start, part.stop - start)
            for part, start in zip(tile, first, strict=True)
        )
        return sight, (rows, columns)

    def _near_hidden(self, sight: Sight) -> NDArray[np.uint8]:
        """Not 0 where a cell is too near to a hidden patch; empty where none is."""
        if self._rule.erosion_cells:
            is_hidden = sight.mask == OCCLUDED
            if is_hidden.any():
                return _near_patches(is_hidden, self._rule.erosion_cells)
        return np.empty((0, 0), dtype=np.uint8)

    def _blank_sight(self, rows: int, columns: int) -> Sight:
        """Give arrays for a tile that this thread has used before: fresh memory takes time."""
        if not hasattr(self._scratch, "floats"):
            side = TILE_CELLS + 2 * (self._rule.erosion_cells + 1)
            self._scratch.floats = np.empty((3, side * side), dtype=np.float32)
            self._scratch.mask = np.empty(side * side, dtype=np.uint8)
        u, v, quality = (
            plane[: rows * columns].reshape(rows, columns) for plane in self._scratch.floats
        )
        mask = self._scratch.mask[: rows * columns].reshape(rows, columns)
        return Sight(u=u, v=v, mask=mask, quality=quality, summary=np.empty(8))

    def _canvas(self) -> Canvas:
        with self._lock:
            painting, shape = self.painting, self._surface.frame.shape
            if painting.rgb is None or painting.quality is None:
                painting.rgb = np.asarray(self._allocate("rgb", (*shape, 3), np.uint8), np.uint8)
                painting.quality = np.asarray(
                    self._allocate("quality", shape, np.float32), np.float32
                )
            # Kernels know plain arrays only, not mapped files.
            rgb, quality = painting.rgb.view(np.ndarray), painting.quality.view(np.ndarray)
            return Canvas(mask=painting.mask, quality=quality, rgb=rgb)


def _near_patches(is_hidden: NDArray[np.bool_], reach: int) -> NDArray[np.uint8]:
    """Cells within a reach of hidden patches of 2 x 2 cells or more.

    A single hidden cell is one whose own depth is wrong; its neighbours are none the worse.
    """
    import cv2

    lowest = cv2.erode(is_hidden.view(np.uint8), np.ones((2, 2), dtype=np.uint8), anchor=(0, 0))
    # The patches again from their upper left cells, and what is around them, in one.
    window = np.ones((2 * reach + 2,) * 2, dtype=np.uint8)
    return np.asarray(cv2.dilate(lowest, window, anchor=(reach + 1,) * 2), dtype=np.uint8)


def _crop_side(sight: Sight) -> float:
    return float(max(sight.summary[1] - sight.summary[0], sight.summary[3] - sight.summary[2]))


def _quarters(tile: tuple[slice, slice]) -> list[tuple[slice, slice]]:
    halves = [_halves(part) for part in tile]
    return [(rows, columns) for rows in halves[0] for columns in halves[1]]


def _halves(part: slice) -> list[slice]:
    middle = (part.start + part.stop) // 2
    pieces = (slice(part.start, middle), slice(middle, part.stop))
    return [piece for piece in pieces if piece.start < piece.stop]
