"""Small pictures of a cloud: from above, and as the scanner saw it."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_png
from orthoflow.geometry import basis_from_up
from orthoflow.products import PointCloud

_SIDE_PX: Final = 640
_SAMPLE: Final = 250_000
_POLAR_SIDE_PX: Final = 1200
_POLAR_SAMPLE: Final = 2_000_000


def plan_view_png(cloud: PointCloud) -> bytes:
    """Give a PNG of the cloud seen from above, brighter where it is denser (logarithmic)."""
    step = max(1, len(cloud) // _SAMPLE)
    offsets = np.column_stack([cloud.x[::step], cloud.y[::step], cloud.z[::step]])
    plan = offsets.astype(np.float64) @ basis_from_up(cloud.up)[:2].T
    # Percentiles, so that stray points do not shrink the building to a dot.
    low, high = np.percentile(plan, [0.1, 99.9], axis=0)
    span = max(float((high - low).max()), 1e-6)
    size = np.maximum(np.ceil((high - low) / span * _SIDE_PX).astype(int), 1)
    cells = np.floor((plan - low) / span * _SIDE_PX).astype(np.int64)
    is_inside = np.all((cells >= 0) & (cells < size), axis=1)
    columns, rows = cells[is_inside].T
    counts = np.bincount(rows * size[0] + columns, minlength=int(size.prod())).astype(np.float64)
    shades = np.log1p(counts)
    grey = np.rint(255.0 * shades / max(float(shades.max()), 1.0)).astype(np.uint8)
    # Row 0 is at the bottom of a map and at the top of an image.
    return encode_png(np.ascontiguousarray(grey.reshape(size[1], size[0])[::-1]))


def polar_view_png(cloud: PointCloud) -> bytes | None:
    """Give a PNG of the intensity over the rows and columns of the scan with most points.

    This is what the scanner saw, by its own angles (Figure 2 of markiewicz2015): straight edges are
    curved. Where the station is known, up is up and left is left. None where the cloud has no grid
    or no intensity.
    """
    if cloud.row is None or cloud.column is None or cloud.intensity is None or not len(cloud):
        return None
    index = np.arange(0, len(cloud), max(1, len(cloud) // _POLAR_SAMPLE))
    scan = 0
    if cloud.scan is not None:
        scan = int(np.bincount(cloud.scan[index]).argmax())
        index = index[cloud.scan[index] == scan]
    row, column = (array[index].astype(np.int64) for array in (cloud.row, cloud.column))
    row, column = row - row.min(), column - column.min()
    size = np.array([row.max() + 1, column.max() + 1])
    # No more pixels than sampled points fill.
    coarser = max(float(size.max()) / _POLAR_SIDE_PX, math.sqrt(float(size.prod()) / len(index)))
    across = max(1, math.ceil(coarser))
    rows, columns = -(-size // across)
    place = row // across * columns + column // across
    total = np.bincount(place, cloud.intensity[index], minlength=int(rows * columns))
    counts = np.bincount(place, minlength=int(rows * columns))
    mean = total / np.maximum(counts, 1)
    low, high = np.quantile(mean[counts > 0], (0.01, 0.99))
    bright = np.clip((mean - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    # Black is what no point came from.
    grey = np.where(counts > 0, np.rint(32.0 + 223.0 * bright), 0.0).astype(np.uint8)
    upward, leftward = _ways_of_grid(cloud, scan, index, row // across, column // across)
    image = grey.reshape(rows, columns)[:: -1 if upward else 1, :: -1 if leftward else 1]
    return encode_png(np.ascontiguousarray(image))


def _ways_of_grid(
    cloud: PointCloud,
    scan: int,
    index: NDArray[np.int64],
    row: NDArray[np.int64],
    column: NDArray[np.int64],
) -> tuple[bool, bool]:
    """Whether rows run upwards, and columns to the left, as the station sees its points."""
    stations = cloud.stations
    if stations is None or scan >= len(stations) or cloud.stations_source == "view_from":
        return True, False
    offsets = np.column_stack([cloud.x[index], cloud.y[index], cloud.z[index]]).astype(np.float64)
    rays = (offsets - (stations[scan] - cloud.origin)) @ basis_from_up(cloud.up).T
    elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    upward = float(np.cov(row, elevation)[0, 1]) >= 0.0
    # Mean directions of the columns: their steps turn the same way also where a panorama closes.
    east, north = (np.bincount(column, rays[:, axis]) for axis in (0, 1))
    azimuth = np.arctan2(north, east)[np.bincount(column) > 0]
    steps = (np.diff(azimuth) + np.pi) % (2.0 * np.pi) - np.pi
    return upward, bool(len(steps)) and float(np.median(steps)) > 0.0
