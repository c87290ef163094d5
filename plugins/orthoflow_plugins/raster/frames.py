"""Rasters of walls: cropping, and maps of horizontal planes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError, MethodError
from orthoflow.files.polygons import filled
from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import row_bands
from orthoflow.geometry.frames import LEVEL_LIMIT_DEG, signed_area
from orthoflow.products import Planes, SurfaceMask, Wall
from orthoflow.sdk import DiagnosticSpec, StepContext

Rectangle = tuple[float, float, float, float]
Polygon = tuple[tuple[float, float], ...]

_UP: Final = np.array([0.0, 0.0, 1.0])
# Maximum displacement, in cells, of a point in the map of a tilted plane.
_OFF_CELLS_MOST: Final = 0.5
TILTED: Final = DiagnosticSpec(
    code="map-of-a-tilted-plane",
    severity="warning",
    text="{subject} is tilted by {tilt_deg:.2g} deg, which would shift points by up to "
    "{off_mm:.2g} mm in a map: its raster remains in its plane",
    remedy="use plane.given with horizontal, or a smaller buffer",
    rank_by="off_mm",
)
NO_MAP: Final = DiagnosticSpec(
    code="map-without-a-level-plane",
    severity="warning",
    text="crs {crs} applies to no raster: none of the planes is horizontal and seen from above",
    remedy="omit {step}.crs, or select a floor",
)


def outline_m(crop: Rectangle | Polygon) -> NDArray[np.float64]:
    """Return the corners (n, 2) of a crop, metres right of and below the top-left corner."""
    corners = np.array(crop, dtype=np.float64)
    if corners.ndim == 2:
        return corners
    left, top, right, bottom = corners
    return np.array([[left, top], [left, bottom], [right, bottom], [right, top]])


def area_m2(crop: Rectangle | Polygon) -> float:
    """Return the area of a crop; 0 if its corners are collinear."""
    corners = outline_m(crop)
    if len(corners) < 3:
        return 0.0
    return abs(signed_area(corners - corners[0]))


def cropped(frame: WallFrame, crop: Rectangle | Polygon) -> WallFrame | None:
    """Remove the columns and rows outside a crop from a frame; return None if no cell is inside.

    Cells keep their positions, so that the cells of different crops coincide.
    """
    outline_px = outline_m(crop) / frame.gsd_m
    # The tolerance is 1e-6 cells, as in `frame_over`.
    first = np.floor(outline_px.min(axis=0) + 1e-6).clip(0, None).astype(np.int64)
    last = np.ceil(outline_px.max(axis=0) - 1e-6).astype(np.int64)
    width, height = np.minimum(last, [frame.width, frame.height]) - first
    if width <= 0 or height <= 0:
        return None
    part = frame.part(first.astype(np.float64), width=int(width), height=int(height))
    return replace(part, left_m=frame.left_m + float(first[0]) * frame.gsd_m)


def blank_outside(wall: Wall, crop: Rectangle | Polygon) -> None:
    """Set cells of a cropped wall to void if their centres are outside the crop (even-odd rule)."""
    corners = outline_m(crop) / wall.frame.gsd_m
    # Make the corners relative to the first cell of the cropped grid.
    corners -= np.floor(corners.min(axis=0) + 1e-6).clip(0, None)
    for rows in row_bands(wall.mask.shape):
        blank(wall, rows, ~filled((corners - [0.0, rows.start],), wall.mask[rows].shape))


def blank(wall: Wall, rows: slice, cells: NDArray[np.bool_]) -> None:
    """Set cells, given as a mask of some rows, to void."""
    wall.mask[rows][cells] = SurfaceMask.VOID
    for values in (wall.depth_m, wall.sigma_m, wall.intensity, wall.percentiles_m):
        if values is not None:
            values[rows][cells] = np.nan
    for numbers in (wall.count, wall.rgb, wall.rgb_mask):
        if numbers is not None:
            numbers[rows][cells] = 0


def mapped(
    frames: Mapping[int, WallFrame], planes: Planes, crs: str, *, reach_m: float, ctx: StepContext
) -> dict[int, WallFrame]:
    """Replace the frames of horizontal planes by frames in the map; other frames are unchanged.

    Args:
        frames: frame of each plane by index.
        planes: the planes.
        crs: coordinate system of the cloud, with x as easting and y as northing.
        reach_m: maximum distance of points from a plane, which determines the displacement if the
            plane is tilted.
        ctx: receives warnings.

    Raises:
        MethodError: the coordinate system does not exist, or z does not point up.
    """
    from orthoflow.files.geotiff import require_map_crs

    try:
        require_map_crs(crs)
    except InputError as error:
        raise MethodError(f"crs: {error}") from error
    if not np.allclose(planes.up, _UP, atol=1e-9):
        raise MethodError(
            f"crs {crs} needs a cloud with x east, y north and z up, got up {planes.up.tolist()}: "
            "transform it with register.similarity, or omit crs"
        )
    placed = dict(frames)
    for index, frame in frames.items():
        east, north, up = frame.normal_world.tolist()
        tilt_rad = math.atan2(math.hypot(east, north), up)
        if math.degrees(tilt_rad) > LEVEL_LIMIT_DEG:
            continue
        # Maximum displacement of a point, due to its depth and to the foreshortening of the plane.
        extent_m = frame.gsd_m * math.hypot(frame.width, frame.height)
        off_m = reach_m * math.sin(tilt_rad) + extent_m * (1.0 - math.cos(tilt_rad))
        if off_m > _OFF_CELLS_MOST * frame.gsd_m:
            name, tilt_deg = planes.names[index], math.degrees(tilt_rad)
            ctx.report(TILTED, subject=name, tilt_deg=tilt_deg, off_mm=1e3 * off_m)
            continue
        # The raster has whole cells, so it extends beyond the rectangle, by the same length on
        # opposite sides.
        middle = frame.wall_from_world(planes.corners[index].mean(axis=0)[None])[0, :2]
        beyond = middle - 0.5 * np.array([frame.width, frame.height])
        origin = frame.world_from_wall(beyond[None])[0]
        placed[index] = replace(frame, origin_world=origin, map_crs=crs)
    if not any(frame.map_crs for frame in placed.values()):
        ctx.report(NO_MAP, crs=crs)
    return placed
