"""Colours of a photo at the cells of a tile: anti-aliased, in the photo's own grey levels."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.camera_kernels import project_point
from orthoflow.geometry.compiling import interpreted
from orthoflow.geometry.levels import Colours, eight_bits, sixteen_bits
from orthoflow.geometry.opencv_border import HALF_PIXEL
from orthoflow_plugins.ortho.painting_kernels import (
    Patch,
    pack_pixels,
    sample_bilinear,
    sample_deep,
)
from orthoflow_plugins.ortho.views import TileVisibility, WallView

Resampling = Literal["nearest", "bilinear", "cubic", "lanczos"]

# Lanczos reaches 4 pixels; it is limited so that a tile's result does not depend on its crop.
_REACH_PX: Final = 5
# A weaker filter changes less than the resolution of 8 or 16 bits.
_SIGMA_LEAST_PX: Final = 0.2
_BASE_CELLS: Final = 4.0


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


def footprint_of(view: WallView, visible: TileVisibility) -> CellFootprint:
    """Measure the middle of the painted cells of a tile that has some."""
    n_cells = float(visible.summary[4])
    column, row, depth = (float(total) / n_cells for total in visible.summary[5:])
    centre, beside, below = (
        _project(view.camera, (column + a + 0.5) * view.gsd_m, (row + b + 0.5) * view.gsd_m, depth)
        for a, b in ((0.0, 0.0), (_BASE_CELLS, 0.0), (0.0, _BASE_CELLS))
    )
    across = math.hypot(beside[0] - centre[0], below[0] - centre[0]) / _BASE_CELLS
    down = math.hypot(beside[1] - centre[1], below[1] - centre[1]) / _BASE_CELLS
    lift = view.height_m - depth
    aside = view.gsd_m * math.hypot(view.column - column, view.row - row)
    return CellFootprint(
        # NaN beyond the lens model, where a neighbour of a painted cell may be.
        pixels_across=across if math.isfinite(across) else 1.0,
        pixels_down=down if math.isfinite(down) else 1.0,
        photo_gsd_m=centre[2] / math.sqrt(view.camera[12] * view.camera[13]),
        obliquity_deg=math.degrees(math.atan2(aside, lift)),
        n_cells=int(n_cells),
    )


_project: Callable[..., tuple[float, float, float]] = interpreted(project_point)


def sample(
    photo: Colours,
    visible: TileVisibility,
    inner: tuple[slice, slice],
    footprint: CellFootprint,
    resampling: Resampling,
    *,
    is_filtered: bool,
    into: Colours,
) -> Colours:
    """Return colours (rows, cols, 3) of a tile's cells; those of unpainted cells are undefined.

    Args:
        photo: (height, width, 3), 8 or 16 bits.
        visible: positions in the photo of the cells of the tile and its margin; overwritten.
        inner: rows and columns of `visible` that are the tile's.
        footprint: number of pixels that a cell covers.
        resampling: `nearest` takes the pixel's own colour without a filter.
        is_filtered: average over a cell where the photo is finer than the wall.
        into: (rows, cols, 3), of the same depth, output, which is returned.
    """
    import cv2

    if resampling == "nearest":
        crop, corner = _crop(photo, visible, reach=0)
        # Whole positions: the pixel that contains a position, so that OpenCV rounds nothing.
        u, v = (np.floor(places, out=places) for places in (visible.u[inner], visible.v[inner]))
        return _remapped(crop, u, v, corner, resampling, into)
    sigmas = [
        0.5 * math.sqrt(max(0.0, pixels * pixels - 1.0)) if is_filtered else 0.0
        for pixels in (footprint.pixels_across, footprint.pixels_down)
    ]
    crop, corner = _crop(photo, visible, reach=_REACH_PX + math.ceil(4.0 * max(sigmas)))
    if max(sigmas) > _SIGMA_LEAST_PX:
        sizes = [2 * math.ceil(3.0 * sigma) + 1 for sigma in sigmas]
        blurred = cv2.GaussianBlur(
            crop,
            (sizes[0], sizes[1]),
            sigmaX=max(sigmas[0], 1e-3),
            sigmaY=max(sigmas[1], 1e-3),
            borderType=cv2.BORDER_REPLICATE,
        )
        crop = np.asarray(blurred, dtype=crop.dtype)
    half = np.float32(HALF_PIXEL)
    centre = (corner[0] + half, corner[1] + half)
    patch = Patch(inner[0].start, inner[1].start, into.shape[0], into.shape[1])
    if resampling == "bilinear" and crop.dtype == np.uint16:
        places = (visible.u, visible.v)
        sample_deep(sixteen_bits(crop), places, centre, patch, sixteen_bits(into))
        return into
    if resampling == "bilinear":
        packed = np.empty((crop.shape[0] + 1, crop.shape[1] + 1), dtype=np.uint64)
        pack_pixels(eight_bits(crop), packed)
        sample_bilinear(packed, (visible.u, visible.v), centre, patch, eight_bits(into))
        return into
    return _remapped(crop, visible.u[inner], visible.v[inner], centre, resampling, into)


def _remapped(
    crop: Colours,
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    corner: tuple[np.float32, np.float32],
    resampling: Resampling,
    into: Colours,
) -> Colours:
    """Return colours at positions relative to a corner; the positions are overwritten."""
    import cv2

    flags = {
        "nearest": cv2.INTER_NEAREST,
        "cubic": cv2.INTER_CUBIC,
        "lanczos": cv2.INTER_LANCZOS4,
    }
    u -= corner[0]
    v -= corner[1]
    flag, border = flags[resampling], cv2.BORDER_REPLICATE
    return np.asarray(cv2.remap(crop, u, v, flag, dst=into, borderMode=border), dtype=into.dtype)


def _crop(
    photo: Colours, visible: TileVisibility, *, reach: int
) -> tuple[Colours, tuple[np.float32, np.float32]]:
    """Return the part of a photo that a tile needs, and its first column and row."""
    u_least, u_most, v_least, v_most = (math.floor(value) for value in visible.summary[:4])
    first_column, first_row = max(0, u_least - reach), max(0, v_least - reach)
    crop = photo[first_row : v_most + reach + 1, first_column : u_most + reach + 1]
    return crop, (np.float32(first_column), np.float32(first_row))
