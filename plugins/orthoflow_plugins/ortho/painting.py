"""One photo projected onto one wall, tile by tile: the cells it sees, and their colours."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from threading import Lock, local
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import Allocate
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.geometry.levels import Colours, level_of
from orthoflow.geometry.threads import in_threads
from orthoflow_plugins.ortho.painting_kernels import Canvas, hand_over
from orthoflow_plugins.ortho.sampling import CellFootprint, Resampling, footprint_of, sample
from orthoflow_plugins.ortho.surfaces import Surface
from orthoflow_plugins.ortho.views import OCCLUDED, TileVisibility, WallView
from orthoflow_plugins.ortho.visibility_kernels import look_at_cells

TILE_CELLS: Final = 512
# The packed part of a photo for a tile stays below 80 MB; cv2.remap takes sides below 32767.
_CROP_MOST_PX: Final = 3_000


@dataclass(frozen=True, kw_only=True)
class PaintRule:
    """Which of the cells that a photo sees are painted, and how colours are sampled.

    Attributes:
        resampling: interpolation of colours between pixels.
        is_filtered: average over a cell where the photo is finer than the wall.
        erosion_cells: cells this close to a hidden one are not painted.
    """

    resampling: Resampling
    is_filtered: bool
    erosion_cells: int


@dataclass(kw_only=True)
class Painting:
    """The result of painting a photo on a wall.

    Attributes:
        mask: (rows, cols) uint8 `LayerMask`.
        rgb: (rows, cols, 3) in the photo's bits, None when nothing was painted.
        quality: (rows, cols) float32, None when nothing was painted.
        footprints: of the painted tiles, by their first cell.
    """

    mask: NDArray[np.uint8]
    rgb: Colours | None = None
    quality: NDArray[np.float32] | None = None
    footprints: dict[tuple[int, int], CellFootprint] = field(default_factory=dict)


def paint(
    photo: Colours,
    view: WallView,
    surface: Surface,
    buffer: DepthBuffer,
    rule: PaintRule,
    *,
    allocate: Allocate,
    threads: int,
) -> Painting:
    """Project a photo onto a wall.

    Args:
        photo: (height, width, 3), 8 or 16 bits, which the result has, too.
        view: its camera in front of the wall.
        surface: the wall.
        buffer: depth buffer of other objects.
        rule: how.
        allocate: returns the arrays of a layer, zeroed: the mask, and the others once something is
            painted.
        threads: number of tiles painted at once; it does not change the result.
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
    """Paints the tiles of one layer, several at once."""

    def __init__(
        self,
        photo: Colours,
        view: WallView,
        surface: Surface,
        buffer: DepthBuffer,
        rule: PaintRule,
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
        visible, inner = self._look(tile)
        if not visible.summary[4]:
            self.painting.mask[tile] = visible.mask[inner]
            return
        if _crop_side(visible) > _CROP_MOST_PX and visible.mask[inner].size > 1:
            for quarter in _quarters(tile):
                self.paint_tile(quarter)
            return
        footprint = footprint_of(self._view, visible)
        canvas = self._canvas()
        is_near = self._near_hidden(visible)
        sample(
            self._photo,
            visible,
            inner,
            footprint,
            self._rule.resampling,
            is_filtered=self._rule.is_filtered,
            into=canvas.rgb[tile],
        )
        hand_over(visible, is_near, (inner[0].start, inner[1].start), canvas, tile)
        self.painting.footprints[tile[0].start, tile[1].start] = footprint

    def _look(self, tile: tuple[slice, slice]) -> tuple[TileVisibility, tuple[slice, slice]]:
        """Determine the visibility of a tile with its margin; return the tile's position in it."""
        reach = self._rule.erosion_cells
        reach += 1 if reach else 0  # what is a patch shows one cell farther out
        first = [max(0, part.start - reach) for part in tile]
        shape = tuple(
            min(size, part.stop + reach) - start
            for size, part, start in zip(self._surface.frame.shape, tile, first, strict=True)
        )
        visible = self._blank_visibility(shape[0], shape[1])
        look_at_cells(self._view, self._surface.relief, self._buffer, visible, first[0], first[1])
        rows, columns = (
            slice(part.start - start, part.stop - start)
            for part, start in zip(tile, first, strict=True)
        )
        return visible, (rows, columns)

    def _near_hidden(self, visible: TileVisibility) -> NDArray[np.uint8]:
        """Return non-zero where a cell is too close to a hidden patch; empty if none is."""
        if self._rule.erosion_cells:
            is_hidden = visible.mask == OCCLUDED
            if is_hidden.any():
                return _near_patches(is_hidden, self._rule.erosion_cells)
        return np.empty((0, 0), dtype=np.uint8)

    def _blank_visibility(self, rows: int, columns: int) -> TileVisibility:
        """Return arrays for a tile that this thread has used before: fresh memory takes time."""
        if not hasattr(self._scratch, "floats"):
            side = TILE_CELLS + 2 * (self._rule.erosion_cells + 1)
            self._scratch.floats = np.empty((3, side * side), dtype=np.float32)
            self._scratch.mask = np.empty(side * side, dtype=np.uint8)
        u, v, quality = (
            plane[: rows * columns].reshape(rows, columns) for plane in self._scratch.floats
        )
        mask = self._scratch.mask[: rows * columns].reshape(rows, columns)
        return TileVisibility(u=u, v=v, mask=mask, quality=quality, summary=np.empty(8))

    def _canvas(self) -> Canvas:
        with self._lock:
            painting, shape = self.painting, self._surface.frame.shape
            if painting.rgb is None or painting.quality is None:
                level = level_of(self._photo)
                painting.rgb = np.asarray(self._allocate("rgb", (*shape, 3), level), level)
                painting.quality = np.asarray(
                    self._allocate("quality", shape, np.float32), np.float32
                )
            # Kernels accept plain arrays only, not mapped files.
            rgb, quality = painting.rgb.view(np.ndarray), painting.quality.view(np.ndarray)
            return Canvas(mask=painting.mask, quality=quality, rgb=rgb)


def _near_patches(is_hidden: NDArray[np.bool_], reach: int) -> NDArray[np.uint8]:
    """Return cells within a reach of hidden patches of 2 x 2 cells or more.

    A single hidden cell has a wrong depth of its own; its neighbours are unaffected.
    """
    import cv2

    lowest = cv2.erode(is_hidden.view(np.uint8), np.ones((2, 2), dtype=np.uint8), anchor=(0, 0))
    # The patches from their upper left cells, and their surroundings, in one dilation.
    window = np.ones((2 * reach + 2,) * 2, dtype=np.uint8)
    return np.asarray(cv2.dilate(lowest, window, anchor=(reach + 1,) * 2), dtype=np.uint8)


def _crop_side(visible: TileVisibility) -> float:
    u_least, u_most, v_least, v_most = visible.summary[:4]
    return float(max(u_most - u_least, v_most - v_least))


def _quarters(tile: tuple[slice, slice]) -> list[tuple[slice, slice]]:
    halves = [_halves(part) for part in tile]
    return [(rows, columns) for rows in halves[0] for columns in halves[1]]


def _halves(part: slice) -> list[slice]:
    middle = (part.start + part.stop) // 2
    pieces = (slice(part.start, middle), slice(middle, part.stop))
    return [piece for piece in pieces if piece.start < piece.stop]
