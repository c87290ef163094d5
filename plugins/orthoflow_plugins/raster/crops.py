"""The requested part of a wall: a rectangle or a polygon, in metres on its raster."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import row_bands
from orthoflow.geometry.rings import signed_area
from orthoflow.products import SurfaceMask, Wall

Rectangle = tuple[float, float, float, float]
Polygon = tuple[tuple[float, float], ...]


@dataclass(frozen=True, kw_only=True)
class CroppedFrame:
    """The grid of a part of a wall.

    Attributes:
        frame: the grid; its cells are some of the whole wall's.
        outline_px: (n, 2) corners of a polygon as (column, row) of the grid, outside of which cells
            are void; None for the whole grid.
    """

    frame: WallFrame
    outline_px: NDArray[np.float64] | None = None


def outline_m(crop: Rectangle | Polygon) -> NDArray[np.float64]:
    """Corners (n, 2) of a crop as (right, down) in metres from the top-left corner of a raster."""
    corners = np.array(crop, dtype=np.float64)
    if corners.ndim == 2:
        return corners
    left, top, right, bottom = corners
    return np.array([[left, top], [left, bottom], [right, bottom], [right, top]])


def area_m2(crop: Rectangle | Polygon) -> float:
    """Return the area of a crop; 0 if its corners span none."""
    corners = outline_m(crop)
    if len(corners) < 3:
        return 0.0
    return abs(signed_area(corners - corners[0]))


def cropped(frame: WallFrame, crop: Rectangle | Polygon) -> CroppedFrame | None:
    """Remove whole columns and rows outside a crop from a grid; None if the crop misses it.

    The remaining cells are unchanged, so that rasters of two crops fit onto each other.
    """
    outline_px = outline_m(crop) / frame.gsd_m
    # A tolerance of a millionth of a cell, as in `frame_over`.
    first = np.floor(outline_px.min(axis=0) + 1e-6).clip(0, None).astype(np.int64)
    last = np.ceil(outline_px.max(axis=0) - 1e-6).astype(np.int64)
    width, height = np.minimum(last, [frame.width, frame.height]) - first
    if width <= 0 or height <= 0:
        return None
    part = replace(
        frame,
        origin_world=frame.world_from_wall(first[None].astype(np.float64))[0],
        width=int(width),
        height=int(height),
        left_m=frame.left_m + float(first[0]) * frame.gsd_m,
    )
    is_polygon = np.ndim(crop) == 2
    return CroppedFrame(frame=part, outline_px=outline_px - first if is_polygon else None)


def blank_outside(wall: Wall, outline_px: NDArray[np.float64]) -> None:
    """Make the cells of a wall void whose centres are outside a polygon of its grid."""
    for rows in row_bands(wall.mask.shape):
        outside = ~_inside(outline_px, rows, wall.frame.width)
        wall.mask[rows][outside] = SurfaceMask.VOID
        wall.count[rows][outside] = 0
        for values in (wall.depth_m, wall.sigma_m, wall.intensity, wall.percentiles_m):
            if values is not None:
                values[rows][outside] = np.nan
        for colours in (wall.rgb, wall.rgb_mask):
            if colours is not None:
                colours[rows][outside] = 0


def _inside(outline_px: NDArray[np.float64], rows: slice, width: int) -> NDArray[np.bool_]:
    """Report which cells (rows, width) have their centre in a polygon (even-odd rule)."""
    columns = np.arange(width) + 0.5
    centres = np.arange(rows.start, rows.stop)[:, None] + 0.5
    inside = np.zeros((rows.stop - rows.start, width), dtype=np.bool_)
    for (x, y), (next_x, next_y) in zip(outline_px, np.roll(outline_px, -1, axis=0), strict=True):
        crosses = (y > centres) != (next_y > centres)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = x + (centres - y) * (next_x - x) / (next_y - y)
        inside ^= crosses & (columns < at)
    return inside
