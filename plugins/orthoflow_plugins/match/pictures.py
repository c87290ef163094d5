"""Pictures for matching: photos and wall rasters with equalised contrast, and points on walls."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.robust import depth_noise_m
from orthoflow.geometry.threads import in_order
from orthoflow.products import Photos, Wall, Walls

# Maximum number of threads; each picture needs up to a gigabyte of memory.
_MAX_AT_ONCE: Final = 4
CLIP_LIMIT: Final = 3.0
"""Limit of local contrast equalisation (CLAHE)."""
_TILES: Final = 8
_CELL_SIGMA: Final = 1.0 / np.sqrt(12.0)
# The depths around a point form a relief edge if their range exceeds this many cell sizes.
_SMOOTH_CELLS: Final = 1.0
# Maximum and minimum number of smooth cells from which the typical point spread is estimated.
_MAX_SPREADS: Final = 100_000
_MIN_SPREADS: Final = 100
# Standard deviation of depths, in cells, if it cannot be estimated.
_UNKNOWN_SIGMA_CELLS: Final = 0.5
# Smoothed depths of cells at this distance are nearly independent.
_APART_CELLS: Final = 10
# Smaller depth differences are due to rounding.
_LEAST_NOISE_M: Final = 1e-5


def require_photos(photos: Photos) -> None:
    """Check that there are photos.

    Raises:
        MethodError: there are no photos.
    """
    if not photos.photos:
        raise MethodError("there are no photos to match with the walls: give at least one photo")


def require_intensity(walls: Walls) -> None:
    """Check that at least one wall has intensity or colour.

    Raises:
        MethodError: there are no walls, or none has intensity or colour.
    """
    if not walls.walls:
        raise MethodError("there are no walls to match photos with: select planes to raster")
    if all(wall.intensity is None for wall in walls.walls):
        raise MethodError(
            "the scan has neither intensity nor colour, so photos cannot be "
            "matched with its walls: export the scan with intensity"
        )


def wall_picture(
    wall: Wall, *, clip_limit: float, void_margin_cells: int
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]] | None:
    """Return the intensity of a wall as a picture without gaps; None if it has no intensity.

    Args:
        wall: the wall.
        clip_limit: clip limit of the local equalisation; 0 only stretches the grey levels.
        void_margin_cells: half the side of the neighbourhood that must be mostly measured.

    Returns:
        Grey values (rows, cols) with void cells interpolated, and a mask of cells whose
        neighbourhood is mostly measured.
    """
    import cv2

    if wall.intensity is None:
        return None
    known = np.isfinite(wall.intensity)
    if not known.any():
        return None
    low, high = np.percentile(wall.intensity[known], (0.5, 99.5))
    scaled = (wall.intensity - low) / max(float(high - low), 1e-9)
    filled = filled_smoothly(np.where(known, np.clip(scaled, 0.0, 1.0), np.nan))
    # Each cell contains only a few scan points, whose speckle would hide the texture.
    grey = np.asarray(cv2.medianBlur(np.rint(filled * 255.0).astype(np.uint8), 3), dtype=np.uint8)
    side = 2 * void_margin_cells + 1
    share = cv2.blur(known.astype(np.float32), (side, side), borderType=cv2.BORDER_REPLICATE)
    return equalised(grey, clip_limit), np.asarray(share > 0.7) & known


def filled_smoothly(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Interpolate NaN values by push-pull: the farther from known values, the more coarsely."""
    import cv2

    known = np.isfinite(values)
    result = np.where(known, values, 0.0).astype(np.float32)
    weight = known.astype(np.float32)
    if known.all() or max(values.shape) < 2:
        return result
    size = (values.shape[1], values.shape[0])
    half = ((size[0] + 1) // 2, (size[1] + 1) // 2)
    small_weight = cv2.resize(weight, half, interpolation=cv2.INTER_AREA)
    small = cv2.resize(result * weight, half, interpolation=cv2.INTER_AREA)
    with np.errstate(divide="ignore", invalid="ignore"):
        coarse = np.where(small_weight > 0.0, small / small_weight, np.nan)
    grown = cv2.resize(filled_smoothly(coarse), size, interpolation=cv2.INTER_LINEAR)
    return np.where(known, result, grown).astype(np.float32)


def equalised(grey: NDArray[np.uint8], clip_limit: float) -> NDArray[np.uint8]:
    """Equalise contrast locally (CLAHE); a limit of 0 returns the picture unchanged."""
    import cv2

    if clip_limit == 0.0 or min(grey.shape) < 2 * _TILES:
        return grey
    clahe = cv2.createCLAHE(clipLimit=clip_limit, tileGridSize=(_TILES, _TILES))
    return np.asarray(clahe.apply(grey), dtype=np.uint8)


def points_on_wall(
    wall: Wall, pixels_wall: NDArray[np.float64], *, spread: Spread | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return the surface points at positions (n, 2) = (column, row) in the raster of a wall.

    The depth is interpolated where the surface is smooth. At a relief edge, the depth is that of
    the nearest cell, and its standard deviation includes the height of the step.

    Args:
        wall: the wall.
        pixels_wall: the positions.
        spread: result of `usual_spread` for the wall; computed if None.

    Returns:
        World points (n, 3) in metres, NaN where the depth is unknown; the standard deviations (n,)
        of the depths in metres; and a mask (n,) of positions with a known depth.
    """
    columns, rows = pixels_wall[:, 0] - 0.5, pixels_wall[:, 1] - 0.5
    height, width = wall.frame.shape
    centre_column = np.clip(np.rint(columns).astype(np.intp), 0, width - 1)
    centre_row = np.clip(np.rint(rows).astype(np.intp), 0, height - 1)
    nearest = wall.depth_m[centre_row, centre_column].astype(np.float64)
    range_m = _spread_about(wall, centre_row, centre_column)
    smooth = range_m < _SMOOTH_CELLS * wall.frame.gsd_m
    depth = np.where(smooth, _bilinear(wall.depth_m, columns, rows), nearest)
    depth = np.where(np.isfinite(depth), depth, nearest)
    gsd_m, cell = wall.frame.gsd_m, (centre_row, centre_column)
    usual, share = usual_spread(wall) if spread is None else spread
    count = np.maximum(wall.count[cell].astype(np.float64), 1.0)
    own = wall.sigma_m[cell].astype(np.float64)
    own = np.where(np.isfinite(own) & (count > 1.0), own, usual)
    # The depth of a cell is a mean or median of points at arbitrary positions in the cell.
    noise = share * np.maximum(own / np.sqrt(count), 0.3 * usual)
    step = np.where(smooth, 0.0, range_m)
    sigma = np.sqrt(noise**2 + (0.5 * _CELL_SIGMA * gsd_m) ** 2 + (step * _CELL_SIGMA) ** 2)
    return wall.frame.world_from_wall(pixels_wall, depth), sigma, np.isfinite(nearest)


class Spread(NamedTuple):
    """Scatter of points on smooth surfaces of a wall.

    Attributes:
        usual_m: median of the standard deviations of the depths in a cell.
        share: ratio of the depth errors of cells to those of means of their points; less than 1 if
            the raster was smoothed.
    """

    usual_m: float
    share: float


def usual_spread(wall: Wall) -> Spread:
    """Return the usual scatter of the points in a cell on smooth surfaces.

    Cells at relief steps are excluded. If the point spacing exceeds the cell size, most cells with
    several points are at such steps, and the spread would be the height of the step.
    """
    gsd_m = wall.frame.gsd_m
    rows, columns = np.nonzero(np.isfinite(wall.sigma_m))
    every = max(1, len(rows) // _MAX_SPREADS)
    rows, columns = rows[::every], columns[::every]
    is_even = _spread_about(wall, rows, columns) < _SMOOTH_CELLS * gsd_m
    if is_even.sum() < _MIN_SPREADS:
        return Spread(_UNKNOWN_SIGMA_CELLS * gsd_m, 1.0)
    usual_m = float(np.median(wall.sigma_m[rows[is_even], columns[is_even]]))
    noise_m = depth_noise_m(wall.depth_m[::_APART_CELLS, ::_APART_CELLS])
    counts = wall.count[:: max(1, wall.count.size // _MAX_SPREADS)]
    mean_m = usual_m / math.sqrt(float(np.median(counts[counts > 0])))
    # Without noise, the depths are synthetic, or no cells are known at this distance.
    is_known = min(noise_m, mean_m) > _LEAST_NOISE_M
    return Spread(usual_m, min(1.0, noise_m / mean_m) if is_known else 1.0)


def _spread_about(
    wall: Wall, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return the range (n,) of depths in the 3 x 3 cells around each cell."""
    height, width = wall.frame.shape
    nearest = wall.depth_m[rows, columns].astype(np.float64)
    steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    around_rows = np.clip(rows[:, None] + steps[:, 0], 0, height - 1)
    around_columns = np.clip(columns[:, None] + steps[:, 1], 0, width - 1)
    around = wall.depth_m[around_rows, around_columns].astype(np.float64)
    around = np.where(np.isfinite(around), around, nearest[:, None])
    return np.asarray(around.max(axis=1) - around.min(axis=1))


def _bilinear(
    raster: NDArray[np.float32], columns: NDArray[np.float64], rows: NDArray[np.float64]
) -> NDArray[np.float64]:
    height, width = raster.shape
    columns = np.clip(columns, 0.0, width - 1.0)
    rows = np.clip(rows, 0.0, height - 1.0)
    left = np.minimum(columns.astype(np.intp), max(width - 2, 0))
    top = np.minimum(rows.astype(np.intp), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    a, b = columns - left, rows - top
    upper = (1 - a) * raster[top, left] + a * raster[top, right]
    lower = (1 - a) * raster[bottom, left] + a * raster[bottom, right]
    result: NDArray[np.float64] = (1 - b) * upper + b * lower
    return result


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def one_by_one(
    function: Callable[[_Item], _Result], items: Sequence[_Item], cores: int
) -> Iterator[_Result]:
    """Yield the results of a function in order, computed by several threads.

    Several pictures are processed at once, since the threads of OpenCV have little effect on
    pictures of this size.
    """
    import cv2

    workers = max(1, min(cores, _MAX_AT_ONCE))
    cv2.setNumThreads(max(1, cores // workers))
    yield from in_order(function, items, threads=workers)
