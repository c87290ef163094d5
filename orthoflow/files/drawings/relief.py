"""Relief of a wall from its depth raster: raking light, contour lines, depths in colour."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.papers import Part
from orthoflow.files.drawings.printed_pictures import contours, stretch_of
from orthoflow.files.geotiff import RasterParts
from orthoflow.files.sidecars import write_json
from orthoflow.geometry import WallFrame

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable

NOTHING: Final = 0
_BAND_ROWS: Final = 1024
_FIGURE_PX: Final = 1600
# Contours as those of a drawing at this scale: half a millimetre of its paper smooths them.
_CONTOUR_SCALE: Final = 20


@dataclass(frozen=True, kw_only=True)
class Light:
    """Where a distant light stands before a wall.

    Attributes:
        azimuth_deg: direction it comes from on the wall, clockwise from above; 315 is top left.
        altitude_deg: angle between its rays and the wall's plane; small ones rake.
    """

    azimuth_deg: float = 315.0
    altitude_deg: float = 25.0


def shaded(depths_m: NDArray[np.floating], gsd_m: float, light: Light) -> NDArray[np.uint8]:
    """Shade a depth raster, 1 to 255 by Lambert's cosine law; 0 where a depth is missing.

    Args:
        depths_m: (rows, cols) metres towards the viewer, NaN for nothing.
        gsd_m: side of a cell.
        light: where it comes from.

    A surface parallel to the wall's plane has the sine of the light's altitude.
    """
    depths = np.asarray(depths_m, dtype=np.float32)
    down, right = (_slope(depths, axis) / np.float32(gsd_m) for axis in (0, 1))
    azimuth, altitude = np.radians([light.azimuth_deg, light.altitude_deg])
    # To the light: right and up on the wall, and towards the viewer.
    towards = (np.sin(azimuth), np.cos(azimuth))
    slope = -right * np.float32(towards[0]) + down * np.float32(towards[1])
    cosine = np.cos(altitude) * slope + np.sin(altitude)
    cosine /= np.sqrt(1.0 + right**2 + down**2)
    grey = 1.0 + 254.0 * np.clip(cosine, 0.0, 1.0)
    known = np.isfinite(depths)
    return np.where(known, np.nan_to_num(grey), NOTHING).astype(np.uint8)


def _slope(depths: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Change per cell: the mean of those to both neighbours, of one beside a hole, else zero."""
    steps = np.diff(depths, axis=axis)
    before = np.concatenate([np.full_like(depths.take([0], axis), np.nan), steps], axis=axis)
    behind = np.concatenate([steps, np.full_like(depths.take([0], axis), np.nan)], axis=axis)
    n_known = np.isfinite(before).astype(np.float32) + np.isfinite(behind)
    total = np.nan_to_num(before) + np.nan_to_num(behind)
    return np.asarray(total / np.maximum(n_known, 1.0))


def write_relief(depth: Path, path: Path, light: Light) -> None:
    """Write the shaded relief of a depth raster as a GeoTIFF in the same place, band by band.

    Raises:
        InputError: the depth raster cannot be read.
    """
    import rasterio
    from rasterio.windows import Window

    with RasterParts(depth) as source, rasterio.open(depth) as placed:
        rows, columns = source.shape
        profile = {**placed.profile, "dtype": "uint8", "nodata": NOTHING, "predictor": 2}
        with rasterio.open(path, "w", **profile) as target:
            for first in range(0, rows, _BAND_ROWS):
                last = min(rows, first + _BAND_ROWS)
                # Slopes look one row further on either side.
                top, bottom = max(0, first - 1), min(rows, last + 1)
                box = (0.0, float(top), float(columns), float(bottom))
                depths, _ = source.read(box, (bottom - top, columns))
                band = shaded(np.asarray(depths, np.float32), source.gsd_m, light)
                kept = band[first - top : first - top + last - first]
                target.write(kept, 1, window=Window(0, first, columns, last - first))
            target.update_tags(
                light_azimuth_deg=f"{light.azimuth_deg:g}",
                light_altitude_deg=f"{light.altitude_deg:g}",
            )


def write_contours(depth: Path, frame: WallFrame, path: Path) -> float:
    """Write contour lines as GeoJSON in X and Y of the raster's GeoTIFF; return their interval.

    Each line has `depth_mm`, positive towards the viewer.
    """
    whole = Part(
        left_m=0.0,
        top_m=0.0,
        right_m=frame.width * frame.gsd_m,
        bottom_m=frame.height * frame.gsd_m,
    )
    interval_m = stretch_of(depth).interval
    lines = contours(depth, whole, scale=_CONTOUR_SCALE, interval_m=interval_m)
    write_json(
        path,
        {
            "type": "FeatureCollection",
            "features": [
                {
                    "type": "Feature",
                    "properties": {"depth_mm": round(1e3 * level, 3)},
                    "geometry": {
                        "type": "LineString",
                        "coordinates": np.round(
                            frame.raster_from_wall(points / frame.gsd_m), 4
                        ).tolist(),
                    },
                }
                for level, points in lines
            ],
        },
    )
    return interval_m


def write_depth_figure(depth: Path, path: Path, light: Light) -> None:
    """Write a PNG: depths in colour over the raking light, with a legend in millimetres."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    with RasterParts(depth) as source:
        rows, columns = source.shape
        factor = max(1.0, max(rows, columns) / _FIGURE_PX)
        shape = (max(2, round(rows / factor)), max(2, round(columns / factor)))
        depths, shown = source.read((0.0, 0.0, float(columns), float(rows)), shape)
        left, top = source.corner_m
        extent = (left, left + columns * source.gsd_m, top - rows * source.gsd_m, top)
        gsd_m = source.gsd_m * factor
    values = np.where(shown, np.asarray(depths, np.float32), np.nan)
    stretch = stretch_of(depth)
    half_mm = 1e3 * max(abs(stretch.low), abs(stretch.high))
    grey = shaded(values, gsd_m, light)
    colours = colormaps["RdBu_r"](np.clip(0.5 + 500.0 * values / half_mm, 0.0, 1.0))[..., :3]
    mixed = np.clip(colours * (0.35 + 0.65 * grey[..., None] / grey.max(initial=1)), 0.0, 1.0)
    mixed[grey == NOTHING] = 1.0
    wide = 9.0
    high = min(12.0, max(2.5, wide * rows / columns + 0.8))
    figure = Figure(figsize=(wide, high), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(mixed, extent=extent, interpolation="nearest")
    axes.set_xlabel("X, m")
    axes.set_ylabel("Y, m (height of upright walls)")
    axes.set_aspect("equal")
    scale = figure.colorbar(
        _scale(half_mm), ax=axes, label="depth towards the viewer, mm", shrink=0.9
    )
    scale.outline.set_linewidth(0.5)
    figure.savefig(path, dpi=150, metadata={"Software": None})


def _scale(half_mm: float) -> ScalarMappable:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    return ScalarMappable(norm=Normalize(-half_mm, half_mm), cmap="RdBu_r")
