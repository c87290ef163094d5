"""One photo projected onto one wall, tile by tile: the cells it sees, and their colours."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from threading import Lock
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import Allocate
from orthoflow.geometry.camera_kernels import project_point
from orthoflow.geometry.compiling import compiled, interpreted
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.geometry.levels import Colours, level_of
from orthoflow.geometry.threads import in_threads
from orthoflow_plugins.ortho.parameters import BackwardParams, Resampling
from orthoflow_plugins.ortho.surfaces import Surface
from orthoflow_plugins.ortho.visibility_kernels import (
    OCCLUDED,
    PAINTED,
    TileVisibility,
    WallView,
    look_at_cells,
)

Tile = tuple[slice, slice]

TILE_CELLS: Final = 512
# The part of a photo for a tile stays below 27 MB; cv2.remap takes sides below 32767.
_CROP_MOST_PX: Final = 3_000
# Lanczos reaches 4 pixels; it is limited so that a tile's result does not depend on its crop.
_REACH_PX: Final = 5
# A weaker filter changes less than the resolution of 8 or 16 bits.
_SIGMA_LEAST_PX: Final = 0.2
_BASE_CELLS: Final = 4.0
# Twenty bits resolve views well enough, and compress to half the size.
_QUALITY_BITS: Final = np.uint32(0xFFFFF000)


@dataclass(frozen=True, kw_only=True)
class CellFootprint:
    """How a photo sees the middle of a tile.

    Attributes:
        pixels_across: photo pixels (u) that one cell covers.
        pixels_down: photo pixels (v) that one cell covers.
        photo_gsd_m: size of a photo pixel, perpendicular to the ray.
        obliquity_deg: angle between the ray and the wall's normal.
        n_cells: painted cells.
    """

    pixels_across: float
    pixels_down: float
    photo_gsd_m: float
    obliquity_deg: float
    n_cells: int


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
    params: BackwardParams,
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
        params: which cells are painted, and how colours are sampled.
        allocate: returns the arrays of a layer, zeroed: the mask, and the others once something is
            painted.
        threads: number of tiles painted at once; it does not change the result.
    """
    shape, lock = surface.frame.shape, Lock()
    painting = Painting(mask=np.asarray(allocate("mask", shape, np.uint8), np.uint8))
    erosion_cells = params.erosion_cells if params.visibility == "full" else 0
    # What is a patch shows one cell farther out.
    margin = erosion_cells + 1 if erosion_cells else 0

    def paint_tile(tile: Tile) -> None:
        visible, inner = _visible(view, surface, buffer, tile, margin)
        is_painted = visible.mask == PAINTED
        if not is_painted.any():
            painting.mask[tile] = visible.mask[inner]
            return
        # Positions are 0 where nothing is painted.
        bounds = tuple(
            math.floor(value)
            for places in (visible.u, visible.v)
            for value in (np.where(is_painted, places, np.float32(np.inf)).min(), places.max())
        )
        is_wide = max(bounds[1] - bounds[0], bounds[3] - bounds[2]) > _CROP_MOST_PX
        if is_wide and visible.mask[inner].size > 1:
            for quarter in _quarters(tile):
                paint_tile(quarter)
            return
        footprint = footprint_of(view, surface, is_painted, tile, inner)
        with lock:
            if painting.rgb is None or painting.quality is None:
                level = level_of(photo)
                painting.rgb = np.asarray(allocate("rgb", (*shape, 3), level), level)
                painting.quality = np.asarray(allocate("quality", shape, np.float32), np.float32)
        if erosion_cells:
            is_near = near_patches(visible.mask == OCCLUDED, erosion_cells)
            np.putmask(visible.mask, is_painted & is_near, OCCLUDED)
        rgb = sample(
            photo,
            visible.u[inner],
            visible.v[inner],
            bounds,
            footprint,
            params.resampling,
            antialias=params.antialias,
        )
        is_bare = visible.mask[inner] != PAINTED
        rgb[is_bare] = 0
        painting.mask[tile], painting.rgb[tile] = visible.mask[inner], rgb
        np.bitwise_and(
            visible.quality[inner].view(np.uint32),
            np.where(is_bare, np.uint32(0), _QUALITY_BITS),
            out=painting.quality[tile].view(np.uint32),
        )
        painting.footprints[tile[0].start, tile[1].start] = footprint

    tiles = [
        (
            slice(row, min(row + TILE_CELLS, shape[0])),
            slice(column, min(column + TILE_CELLS, shape[1])),
        )
        for row in range(0, shape[0], TILE_CELLS)
        for column in range(0, shape[1], TILE_CELLS)
    ]
    in_threads([partial(paint_tile, tile) for tile in tiles], threads=threads)
    return painting


def _visible(
    view: WallView, surface: Surface, buffer: DepthBuffer, tile: Tile, margin: int
) -> tuple[TileVisibility, Tile]:
    """Determine the visibility of a tile with its margin; return the tile's position in it."""
    rows, columns = (
        slice(max(0, part.start - margin), min(size, part.stop + margin))
        for part, size in zip(tile, surface.frame.shape, strict=True)
    )
    size = (rows.stop - rows.start, columns.stop - columns.start)
    u, v, quality = np.empty((3, *size), dtype=np.float32)
    visible = TileVisibility(u=u, v=v, mask=np.empty(size, dtype=np.uint8), quality=quality)
    look_at_cells(view, surface.relief, buffer, visible, rows.start, columns.start)
    inner_rows, inner_columns = (
        slice(part.start - around.start, part.stop - around.start)
        for part, around in zip(tile, (rows, columns), strict=True)
    )
    return visible, (inner_rows, inner_columns)


def near_patches(is_hidden: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Return cells within a reach of hidden patches of 2 x 2 cells or more.

    A single hidden cell has a wrong depth of its own; its neighbours are unaffected.
    """
    import cv2

    lowest = cv2.erode(is_hidden.view(np.uint8), np.ones((2, 2), dtype=np.uint8), anchor=(0, 0))
    # The patches from their upper left cells, and their surroundings, in one dilation.
    window = np.ones((2 * reach + 2,) * 2, dtype=np.uint8)
    return np.asarray(cv2.dilate(lowest, window, anchor=(reach + 1,) * 2) > 0, dtype=np.bool_)


def _quarters(tile: Tile) -> list[Tile]:
    halves = []
    for part in tile:
        middle = (part.start + part.stop) // 2
        pieces = (slice(part.start, middle), slice(middle, part.stop))
        halves.append([piece for piece in pieces if piece.start < piece.stop])
    return [(rows, columns) for rows in halves[0] for columns in halves[1]]


_project: Callable[..., tuple[float, float, float]] = interpreted(project_point)


def footprint_of(
    view: WallView,
    surface: Surface,
    is_painted: NDArray[np.bool_],
    tile: Tile,
    inner: Tile,
) -> CellFootprint:
    """Measure the middle of the painted cells of a tile that has some.

    Args:
        view: the camera in front of the wall.
        surface: the wall.
        is_painted: (rows, cols) cells of the tile with its margin, some of them true.
        tile: its rows and columns on the wall.
        inner: the same within `is_painted`.
    """
    first_row, first_column = (tile[k].start - inner[k].start for k in range(2))
    around = surface.relief.depth[first_row:, first_column:]
    n_cells, row, column, depth = _middle(is_painted, around)
    row, column = row + first_row, column + first_column
    centre, beside, below = (
        _project(view.camera, (column + a + 0.5) * view.gsd_m, (row + b + 0.5) * view.gsd_m, depth)
        for a, b in ((0.0, 0.0), (_BASE_CELLS, 0.0), (0.0, _BASE_CELLS))
    )
    across, down = (
        math.hypot(beside[k] - centre[k], below[k] - centre[k]) / _BASE_CELLS for k in range(2)
    )
    aside = view.gsd_m * math.hypot(view.column - column, view.row - row)
    return CellFootprint(
        # NaN beyond the lens model, where a neighbour of a painted cell may be.
        pixels_across=across if math.isfinite(across) else 1.0,
        pixels_down=down if math.isfinite(down) else 1.0,
        photo_gsd_m=centre[2] / math.sqrt(view.camera[12] * view.camera[13]),
        obliquity_deg=math.degrees(math.atan2(aside, view.height_m - depth)),
        n_cells=n_cells,
    )


@compiled
def _middle(
    is_painted: NDArray[np.bool_], depths: NDArray[np.float32]
) -> tuple[int, float, float, float]:
    """Return the number of painted cells and the means of their rows, columns and depths."""
    n_cells, rows, columns, total = 0, 0, 0, 0.0
    for row in range(is_painted.shape[0]):
        n_in_row, in_row = 0, 0.0
        for column in range(is_painted.shape[1]):
            if is_painted[row, column]:
                n_in_row += 1
                columns += column
                in_row += float(depths[row, column])
        n_cells += n_in_row
        rows += n_in_row * row
        total += in_row
    return n_cells, rows / n_cells, columns / n_cells, total / n_cells


def sample(
    photo: Colours,
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    bounds: tuple[int, ...],
    footprint: CellFootprint,
    resampling: Resampling,
    *,
    antialias: bool,
) -> Colours:
    """Return the colours (rows, cols, 3) of cells; those outside the bounds are undefined.

    Args:
        photo: (height, width, 3), 8 or 16 bits.
        u: (rows, cols) positions in the photo, finite; v likewise.
        v: see `u`.
        bounds: first and last column, first and last row of the pixels that positions are in.
        footprint: number of pixels that a cell covers.
        resampling: `nearest` takes the pixel's own colour without a filter.
        antialias: average over a cell where the photo is finer than the wall.
    """
    import cv2

    is_nearest = resampling == "nearest"
    sigmas = [
        0.5 * math.sqrt(max(0.0, pixels * pixels - 1.0)) if antialias and not is_nearest else 0.0
        for pixels in (footprint.pixels_across, footprint.pixels_down)
    ]
    reach = 0 if is_nearest else _REACH_PX + math.ceil(4.0 * max(sigmas))
    first_column, first_row = max(0, bounds[0] - reach), max(0, bounds[2] - reach)
    crop = photo[first_row : bounds[3] + reach + 1, first_column : bounds[1] + reach + 1]
    if max(sigmas) > _SIGMA_LEAST_PX:
        crop = np.asarray(
            cv2.GaussianBlur(
                crop,
                (2 * math.ceil(3.0 * sigmas[0]) + 1, 2 * math.ceil(3.0 * sigmas[1]) + 1),
                sigmaX=max(sigmas[0], 1e-3),
                sigmaY=max(sigmas[1], 1e-3),
                borderType=cv2.BORDER_REPLICATE,
            ),
            dtype=crop.dtype,
        )
    if is_nearest:
        rows = np.clip(np.floor(v).astype(np.intp) - first_row, 0, crop.shape[0] - 1)
        columns = np.clip(np.floor(u).astype(np.intp) - first_column, 0, crop.shape[1] - 1)
        return crop[rows, columns]
    # From the centre of the first pixel.
    u = u - np.float32(first_column + 0.5)
    v = v - np.float32(first_row + 0.5)
    if resampling == "bilinear":
        colours = np.empty((*u.shape, 3), dtype=crop.dtype)
        sample_bilinear(np.ascontiguousarray(crop), u, v, colours)
        return colours
    flag = cv2.INTER_CUBIC if resampling == "cubic" else cv2.INTER_LANCZOS4
    colours = cv2.remap(crop, u, v, flag, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(colours, dtype=crop.dtype)


@compiled
def sample_bilinear(
    photo: Colours, u: NDArray[np.float32], v: NDArray[np.float32], colours: Colours
) -> None:
    """Set the colours (rows, cols, 3) at positions of a photo, whose border is extended.

    Args:
        photo: (height, width, 3).
        u: (rows, cols) columns from the centre of the first pixel; v likewise rows.
        v: see `u`.
        colours: overwritten. `cv2.remap` knows positions to a 32nd of a pixel only.
    """
    last_u, last_v, width = photo.shape[1] - 1, photo.shape[0] - 1, photo.shape[1]
    # Flat arrays, and places of a type without sign: numba does not look whether they are negative.
    us, vs, pixels, into = u.reshape(-1), v.reshape(-1), photo.reshape(-1), colours.reshape(-1)
    for cell in range(us.size):
        across = min(max(float(us[cell]), 0.0), float(last_u))
        down = min(max(float(vs[cell]), 0.0), float(last_v))
        left, upper = int(across), int(down)
        across -= left
        down -= upper
        at = 3 * (upper * width + left)
        right = 3 if left < last_u else 0
        lower = 3 * width if upper < last_v else 0
        for channel in range(3):
            first = float(pixels[np.uintp(at + channel)])
            last = float(pixels[np.uintp(at + lower + channel)])
            above = first + (float(pixels[np.uintp(at + right + channel)]) - first) * across
            below = last + (float(pixels[np.uintp(at + lower + right + channel)]) - last) * across
            into[3 * cell + channel] = int(above + (below - above) * down + 0.5)
