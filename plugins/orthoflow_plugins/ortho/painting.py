"""Projection of a photo onto a wall, tile by tile: visibility of cells, and their colours."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from threading import Lock
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import Allocate
from orthoflow.geometry.bends import CylinderBend
from orthoflow.geometry.camera_kernels import project_point
from orthoflow.geometry.compiling import compiled, inlined, interpreted
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.geometry.levels import Colours, level_of
from orthoflow.geometry.threads import in_threads
from orthoflow_plugins.ortho.parameters import BackwardParams
from orthoflow_plugins.ortho.surfaces import Surface, cells_seen
from orthoflow_plugins.ortho.visibility_kernels import (
    OCCLUDED,
    PAINTED,
    TileVisibility,
    WallView,
)

Tile = tuple[slice, slice]

TILE_CELLS: Final = 512
# Maximum side of the part of a photo that shows a tile. This limits the part to 27 MB and keeps its
# sides shorter than 32767 pixels, as cv2.remap requires.
_CROP_MOST_PX: Final = 3_000
# Margin around this part. Lanczos interpolation needs 4 pixels, so cropping does not change the
# result.
_REACH_PX: Final = 5
# A narrower filter changes colours by less than one level.
_SIGMA_LEAST_PX: Final = 0.2
_BASE_CELLS: Final = 4.0
# Cells this close to a hidden area are not coloured, because edges are blurred in photos.
EROSION_CELLS: Final = 1
# Twenty bits are enough to rank photos by quality, and halve the compressed size.
_QUALITY_BITS: Final = np.uint32(0xFFFFF000)


@dataclass(frozen=True, kw_only=True)
class CellFootprint:
    """Size and direction of photo pixels in the middle of a tile.

    Attributes:
        pixels_across: width of a cell (along u) in photo pixels.
        pixels_down: height of a cell (along v) in photo pixels.
        photo_gsd_m: size of a photo pixel perpendicular to the ray.
        obliquity_deg: angle between the ray and the normal of the wall.
        n_cells: number of coloured cells.
    """

    pixels_across: float
    pixels_down: float
    photo_gsd_m: float
    obliquity_deg: float
    n_cells: int


@dataclass(kw_only=True)
class Painting:
    """The result of projecting a photo onto a wall.

    Attributes:
        mask: (rows, cols) uint8 `LayerMask`.
        rgb: (rows, cols, 3) with the bit depth of the photo; None if no cell is coloured.
        quality: (rows, cols) float32; None if no cell is coloured.
        footprints: footprint of each tile that has coloured cells; the key is the first row and
            column of the tile.
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
        photo: (height, width, 3) uint8 or uint16; the colours of the result have the same type.
        view: camera of the photo in the axes of the wall.
        surface: the wall.
        buffer: depth buffer of objects in front of the wall.
        params: visibility of cells, and sampling of colours.
        allocate: function that allocates zeroed arrays; it is called for colours and quality only
            if a cell is coloured.
        threads: number of tiles processed at once.
    """
    import cv2

    shape, lock = surface.frame.shape, Lock()
    painting = Painting(mask=np.asarray(allocate("mask", shape, np.uint8), np.uint8))
    # With the additional cell, hidden patches of 2 x 2 cells across the border of the tile are
    # found.
    margin = EROSION_CELLS + 1 if params.visibility == "full" else 0

    def paint_tile(tile: Tile) -> None:
        visible, inner = _visible(view, surface, buffer, tile, margin)
        is_painted = visible.mask == PAINTED
        if not is_painted.any():
            painting.mask[tile] = visible.mask[inner]
            return
        bounds = tuple(
            math.floor(value)
            for places in (visible.u, visible.v)
            for value in cv2.minMaxLoc(places, is_painted.view(np.uint8))[:2]
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
        if params.visibility == "full":
            is_near = near_patches(visible.mask == OCCLUDED, EROSION_CELLS)
            np.copyto(visible.mask, np.uint8(OCCLUDED), where=is_painted & is_near)
            np.copyto(visible.quality, np.float32(0.0), where=is_near)
        painting.mask[tile] = visible.mask[inner]
        sample(
            photo,
            visible,
            inner,
            bounds,
            footprint,
            params,
            into=painting.rgb[tile],
        )
        np.bitwise_and(
            visible.quality[inner].view(np.uint32),
            _QUALITY_BITS,
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
    """Return the visibility of a tile with its margin, and the slices of the tile within it."""
    rows, columns = (
        slice(max(0, part.start - margin), min(size, part.stop + margin))
        for part, size in zip(tile, surface.frame.shape, strict=True)
    )
    visible = cells_seen(view, surface.relief, buffer, rows, columns)
    inner_rows, inner_columns = (
        slice(part.start - around.start, part.stop - around.start)
        for part, around in zip(tile, (rows, columns), strict=True)
    )
    return visible, (inner_rows, inner_columns)


def near_patches(is_hidden: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Return a mask of cells near hidden patches of at least 2 x 2 cells.

    A single hidden cell usually has a wrong depth, which does not affect its neighbours.
    """
    import cv2

    lowest = cv2.erode(is_hidden.view(np.uint8), np.ones((2, 2), dtype=np.uint8), anchor=(0, 0))
    # One dilation restores the patches from their upper left cells and adds the margin.
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
    """Measure the footprint at the middle of the coloured cells of a tile.

    Args:
        view: the camera in the axes of the wall.
        surface: the wall.
        is_painted: (rows, cols) coloured cells of the tile with its margin, at least one.
        tile: rows and columns of the tile on the wall.
        inner: rows and columns of the tile within `is_painted`.
    """
    import cv2

    first_row, first_column = (tile[k].start - inner[k].start for k in range(2))
    painted = is_painted.view(np.uint8)
    in_columns, in_rows = (
        cv2.reduce(painted, axis, cv2.REDUCE_SUM, dtype=cv2.CV_32S).ravel() for axis in range(2)
    )
    n_cells = int(in_rows.sum())
    row = _middle(in_rows, first_row, surface.frame, "v")
    column = _middle(in_columns, first_column, surface.frame, "u")
    around = surface.relief.depth[first_row:, first_column:]
    around = around[: len(painted), : painted.shape[1]]
    depth = cv2.sumElems(cv2.copyTo(around, painted))[0] / n_cells
    base = _BASE_CELLS
    steps = ((0.0, 0.0), (base, 0.0), (0.0, base))
    places = surface.local([(column + a + 0.5, row + b + 0.5) for a, b in steps], depth)
    centre, beside, below = (_project(view.camera, *place) for place in places)
    across, down = (
        math.hypot(beside[k] - centre[k], below[k] - centre[k]) / _BASE_CELLS for k in range(2)
    )
    aside, lift = (
        view.gsd_m * math.hypot(view.column - column, view.row - row),
        view.height_m - depth,
    )
    if surface.frame.bend is not None:
        aside, lift = _aside_and_lift(view, surface, places, depth)
    return CellFootprint(
        # A neighbour of a coloured cell may be outside the lens model, so its position may be NaN.
        pixels_across=across if math.isfinite(across) else 1.0,
        pixels_down=down if math.isfinite(down) else 1.0,
        photo_gsd_m=centre[2] / math.sqrt(view.camera[12] * view.camera[13]),
        obliquity_deg=math.degrees(math.atan2(aside, lift)),
        n_cells=n_cells,
    )


def _middle(
    counts: NDArray[np.number], first: int, frame: WallFrame, axis: Literal["u", "v"]
) -> float:
    """Return the mean row or column of cells, given the number in each from the first one on."""
    if isinstance(frame.bend, CylinderBend) and frame.bend.along == axis:
        n_cells = frame.width if axis == "u" else frame.height
        radius_cells = abs(frame.bend.radius_m) / frame.gsd_m
        if n_cells > math.pi * radius_cells:
            # A photo may show both ends of a surface that is nearly closed.
            angles = (first + np.arange(counts.size)) / radius_cells
            angle = math.atan2(float(counts @ np.sin(angles)), float(counts @ np.cos(angles)))
            return angle % math.tau * radius_cells
    return float(counts @ np.arange(counts.size)) / float(counts.sum()) + first


def _aside_and_lift(
    view: WallView, surface: Surface, places: list[tuple[float, ...]], depth: float
) -> tuple[float, float]:
    """Return distances of the camera along a curved wall and above it, from the first of places."""
    here, across, down = np.array(places)
    eye = (view.column + 0.5) * view.gsd_m, (view.row + 0.5) * view.gsd_m, view.height_m
    normal = np.cross(across - here, down - here)
    ray, normal = np.array(eye) - here, normal / np.linalg.norm(normal)
    lift = float(ray @ normal)
    return float(np.linalg.norm(ray - lift * normal)), lift


def sample(
    photo: Colours,
    visible: TileVisibility,
    inner: Tile,
    bounds: tuple[int, ...],
    footprint: CellFootprint,
    params: BackwardParams,
    *,
    into: Colours,
) -> None:
    """Sample the colours of a tile; cells that are not visible become black.

    Args:
        photo: (height, width, 3) uint8 or uint16.
        visible: visibility of the tile with its margin; all positions are finite.
        inner: rows and columns of the tile in `visible`.
        bounds: first column, last column, first row and last row of the pixels needed.
        footprint: size of a cell in pixels.
        params: sampling of colours.
        into: (rows, cols, 3) colours of the tile, overwritten.
    """
    import cv2

    resampling, is_nearest = params.resampling, params.resampling == "nearest"
    sigmas = [
        0.5 * math.sqrt(max(0.0, pixels * pixels - 1.0)) if not is_nearest else 0.0
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
    if resampling == "bilinear":
        sample_bilinear(crop, (first_column, first_row), visible, inner, into)
        return
    if is_nearest:
        # Take the pixel that contains the position, so that OpenCV does not need to round.
        u, v = (np.floor(places[inner]) for places in (visible.u, visible.v))
        u, v = u - np.float32(first_column), v - np.float32(first_row)
    else:
        # OpenCV has its origin at the centre of the first pixel.
        u = visible.u[inner] - np.float32(first_column + 0.5)
        v = visible.v[inner] - np.float32(first_row + 0.5)
    flags = {
        "nearest": cv2.INTER_NEAREST,
        "cubic": cv2.INTER_CUBIC,
        "lanczos": cv2.INTER_LANCZOS4,
    }
    into[...] = cv2.remap(crop, u, v, flags[resampling], borderMode=cv2.BORDER_REPLICATE)
    into[visible.mask[inner] != PAINTED] = 0


def sample_bilinear(
    photo: Colours,
    corner: tuple[int, int],
    visible: TileVisibility,
    inner: Tile,
    colours: Colours,
) -> None:
    """Sample colours bilinearly; cells that are not visible become black.

    The border of the photo is replicated. `cv2.remap` is not used because it rounds positions to
    1/32 pixel and takes twice as long.

    Args:
        photo: (height, width, 3), a part of the photo.
        corner: column and row of the first pixel of this part in the whole photo.
        visible: visibility of the tile with its margin; positions are those in the whole photo.
        inner: rows and columns of the tile in `visible`.
        colours: (rows, cols, 3) of the tile, overwritten.
    """
    import cv2

    # The kernel reads each pixel as one number, and needs at least 2 x 2 pixels.
    if min(photo.shape[:2]) < 2:
        photo = cv2.copyMakeBorder(photo, 0, 1, 0, 1, cv2.BORDER_REPLICATE)  # type: ignore[assignment]
    four = np.asarray(cv2.cvtColor(photo, cv2.COLOR_RGB2RGBA), dtype=photo.dtype)
    words = four.view(np.uint32) if photo.dtype == np.uint8 else four.view(np.uint64)
    mixed = np.empty(colours.shape[:2], dtype=words.dtype)
    centre = (np.float32(corner[0] + 0.5), np.float32(corner[1] + 0.5))
    _mix_pixels(words[..., 0], centre, visible, (inner[0].start, inner[1].start), mixed)
    channels = mixed.view(photo.dtype).reshape(*mixed.shape, 4)
    cv2.cvtColor(channels, cv2.COLOR_RGBA2RGB, dst=colours)


@compiled
def _mix_pixels(
    pixels: NDArray[np.uint32 | np.uint64],
    centre: tuple[np.float32, np.float32],
    visible: TileVisibility,
    first: tuple[int, int],
    mixed: NDArray[np.uint32 | np.uint64],
) -> None:
    """Interpolate between pixels, each stored as one number with four channels; ignore the fourth.

    Each loop has no branches and writes to one array only, so that the compiler can vectorise it,
    except for the loops that fetch pixels.

    Args:
        pixels: (rows, cols), at least 2 x 2.
        centre: column and row, in the whole photo, of the centre of the first pixel.
        visible: positions of the cells.
        first: row and column of the first cell in `visible`.
        mixed: (rows, cols) colours of the cells, overwritten.
    """
    f, word, n_columns = np.float32, pixels.dtype.type, mixed.shape[1]
    bits = word(2 * pixels.itemsize)
    level = (word(1) << bits) - word(1)
    u0, v0, zero, painted = centre[0], centre[1], f(0.0), np.uint8(PAINTED)
    last_u, last_v = f(pixels.shape[1] - 1), f(pixels.shape[0] - 1)
    last_left, last_upper = np.int32(pixels.shape[1] - 2), np.int32(pixels.shape[0] - 2)
    width, flat = np.int32(pixels.shape[1]), pixels.reshape(-1)
    shares, places = np.empty((2, n_columns), dtype=f), np.empty(n_columns, dtype=np.int32)
    corners = np.empty((4, n_columns), dtype=pixels.dtype)
    across, down = shares[0], shares[1]
    ones, rights, belows, lasts = corners[0], corners[1], corners[2], corners[3]
    begin, end = first[1], first[1] + n_columns
    for i in range(mixed.shape[0]):
        row, into = first[0] + i, mixed[i]
        us, vs = visible.u[row, begin:end], visible.v[row, begin:end]
        states = visible.mask[row, begin:end]
        for j in range(n_columns):
            at = min(max(us[j] - u0, zero), last_u)
            across[j] = at - f(min(np.int32(at), last_left))
        for j in range(n_columns):
            at = min(max(vs[j] - v0, zero), last_v)
            down[j] = at - f(min(np.int32(at), last_upper))
        for j in range(n_columns):
            left = min(np.int32(min(max(us[j] - u0, zero), last_u)), last_left)
            upper = min(np.int32(min(max(vs[j] - v0, zero), last_v)), last_upper)
            places[j] = upper * width + left
        for j in range(n_columns):
            place = np.uintp(places[j])
            ones[j], rights[j] = flat[place], flat[place + np.uintp(1)]
        for j in range(n_columns):
            place = np.uintp(places[j] + width)
            belows[j], lasts[j] = flat[place], flat[place + np.uintp(1)]
        for j in range(n_columns):
            four = (ones[j], rights[j], belows[j], lasts[j])
            red = word(_mixed(four, across[j], down[j], word(0), level))
            green = word(_mixed(four, across[j], down[j], bits, level)) << bits
            blue = word(_mixed(four, across[j], down[j], bits + bits, level)) << (bits + bits)
            into[j] = red | green | blue if states[j] == painted else word(0)


@inlined
def _mixed(four, across, down, shift, level):  # type: ignore[no-untyped-def]  # numba infers the types
    f = np.float32
    above, below = f(four[0] >> shift & level), f(four[2] >> shift & level)
    above += (f(four[1] >> shift & level) - above) * across
    below += (f(four[3] >> shift & level) - below) * across
    return np.int32(above + (below - above) * down + f(0.5))
