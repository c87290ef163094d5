"""Relief of a wall from its depth raster: shading, contour lines, depths in colour."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.papers import whole_of
from orthoflow.files.drawings.printed_pictures import calmed, contours, noise_of, stretch_of
from orthoflow.files.geotiff import RasterParts
from orthoflow.files.polygons import Feature, write_features
from orthoflow.geometry import WallFrame

NOTHING: Final = 0
_BAND_ROWS: Final = 1024
_AROUND_ROWS: Final = 8
# Half the side of a patch from which noise is estimated, cells.
_PATCH: Final = 128
_FIGURE_PX: Final = 1600
# Contours as in a drawing at this scale: smoothed over half a millimetre of its paper.
_CONTOUR_SCALE: Final = 20
# In front of the plane, behind it.
_CONTOUR_COLOURS: Final = ("#5a0014", "#00204a")


@dataclass(frozen=True, kw_only=True)
class Light:
    """The direction of a distant light in front of a wall.

    Attributes:
        azimuth_deg: its direction on the wall, clockwise from the top; 315 is top left.
        altitude_deg: angle between its rays and the wall's plane; small ones emphasise relief.
    """

    azimuth_deg: float = 315.0
    altitude_deg: float = 25.0


def shaded(
    depths_m: NDArray[np.floating], gsd_m: float, light: Light, noise_m: float = 0.0
) -> NDArray[np.uint8]:
    """Shade a depth raster, 1 to 255 by Lambert's cosine law; 0 without a depth.

    Args:
        depths_m: (rows, cols) metres towards the viewer, NaN without data.
        gsd_m: side of a cell.
        light: direction of the light.
        noise_m: standard deviation of depths, which are averaged with those that differ by it.

    A surface parallel to the wall's plane has the sine of the light's altitude.
    """
    depths = calmed(np.asarray(depths_m, dtype=np.float32), noise_m)
    down, right = (_slope(depths, axis) / np.float32(gsd_m) for axis in (0, 1))
    azimuth, altitude = np.radians([light.azimuth_deg, light.altitude_deg])
    # Towards the light: right and up on the wall, and towards the viewer.
    towards = (np.sin(azimuth), np.cos(azimuth))
    slope = -right * np.float32(towards[0]) + down * np.float32(towards[1])
    cosine = np.cos(altitude) * slope + np.sin(altitude)
    cosine /= np.sqrt(1.0 + right**2 + down**2)
    grey = 1.0 + 254.0 * np.clip(cosine, 0.0, 1.0)
    known = np.isfinite(depths)
    return np.where(known, np.nan_to_num(grey), NOTHING).astype(np.uint8)


def _slope(depths: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Return the change per cell: the mean to both neighbours, to one beside a hole, or zero."""
    steps = np.diff(depths, axis=axis)
    before = np.concatenate([np.full_like(depths.take([0], axis), np.nan), steps], axis=axis)
    behind = np.concatenate([steps, np.full_like(depths.take([0], axis), np.nan)], axis=axis)
    n_known = np.isfinite(before).astype(np.float32) + np.isfinite(behind)
    total = np.nan_to_num(before) + np.nan_to_num(behind)
    return np.asarray(total / np.maximum(n_known, 1.0))


def write_relief(depth: Path, path: Path, light: Light) -> None:
    """Write the shaded relief of a depth raster as a GeoTIFF with the same position, band by band.

    Raises:
        InputError: the depth raster cannot be read.
    """
    import rasterio
    from rasterio.windows import Window

    with RasterParts(depth) as source, rasterio.open(depth) as placed:
        rows, columns = source.shape
        noise_m = _noise_m(source)
        profile = {**placed.profile, "dtype": "uint8", "nodata": NOTHING, "predictor": 2}
        with rasterio.open(path, "w", **profile) as target:
            for first in range(0, rows, _BAND_ROWS):
                last = min(rows, first + _BAND_ROWS)
                # Slopes and means need more rows on either side.
                top, bottom = max(0, first - _AROUND_ROWS), min(rows, last + _AROUND_ROWS)
                box = (0.0, float(top), float(columns), float(bottom))
                depths, _ = source.read(box, (bottom - top, columns))
                band = shaded(np.asarray(depths, np.float32), source.gsd_m, light, noise_m)
                kept = band[first - top : first - top + last - first]
                target.write(kept, 1, window=Window(0, first, columns, last - first))
            target.update_tags(
                light_azimuth_deg=f"{light.azimuth_deg:g}",
                light_altitude_deg=f"{light.altitude_deg:g}",
            )


def _noise_m(source: RasterParts) -> float:
    """Return the noise of depths from cell to cell, of patches all over the raster."""
    rows, columns = (float(count) for count in source.shape)
    found = []
    for row, column in product((0.2, 0.5, 0.8), repeat=2):
        top, left = max(0.0, row * rows - _PATCH), max(0.0, column * columns - _PATCH)
        bottom, right = min(rows, row * rows + _PATCH), min(columns, column * columns + _PATCH)
        box = tuple(map(round, (left, top, right, bottom)))
        depths, shown = source.read(
            (box[0], box[1], box[2], box[3]), (box[3] - box[1], box[2] - box[0])
        )
        found.append(noise_of(np.where(shown, depths, np.nan).astype(np.float32)))
    return float(np.median(found))


def write_contours(depth: Path, frame: WallFrame, path: Path) -> float:
    """Write contour lines as GeoJSON in X and Y of the raster's GeoTIFF; return their interval.

    Each line has `depth_mm`, positive towards the viewer.
    """
    interval_m = stretch_of(depth).interval
    features: list[Feature] = [
        {
            "type": "Feature",
            "properties": {"depth_mm": round(1e3 * level, 3)},
            "geometry": {"type": "LineString", "coordinates": np.round(points, 4).tolist()},
        }
        for level, points in _contours(depth, frame, interval_m)
    ]
    write_features(path, features, frame.crs)
    return interval_m


def _contours(
    depth: Path, frame: WallFrame, interval_m: float
) -> list[tuple[float, NDArray[np.float64]]]:
    """Return contours in X and Y (n, 2) of the raster's GeoTIFF."""
    size_m = frame.width * frame.gsd_m, frame.height * frame.gsd_m
    found = contours(depth, whole_of(size_m), scale=_CONTOUR_SCALE, interval_m=interval_m)
    return [(level, frame.raster_from_wall(points / frame.gsd_m)) for level, points in found]


def write_depth_figure(depth: Path, frame: WallFrame, path: Path, light: Light) -> None:
    """Write a PNG: coloured depths with shading, contours, and a legend in millimetres."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import CenteredNorm
    from matplotlib.figure import Figure

    with RasterParts(depth) as source:
        rows, columns = source.shape
        factor = max(1.0, max(rows, columns) / _FIGURE_PX)
        shape = (max(2, round(rows / factor)), max(2, round(columns / factor)))
        depths, shown = source.read((0.0, 0.0, float(columns), float(rows)), shape)
        gsd_m = source.gsd_m * factor
    values = np.where(shown, np.asarray(depths, np.float32), np.nan)
    stretch = stretch_of(depth)
    # The plane is white; equal depths in front of it (red) and behind it (blue) are equally dark.
    norm = CenteredNorm(0.0, halfrange=max(1.0, 1e3 * max(-stretch.low, stretch.high)))
    grey = shaded(values, gsd_m, light, noise_of(values))
    colours = colormaps["RdBu_r"](norm(1e3 * np.nan_to_num(values)))[..., :3]
    mixed = np.clip(colours * (0.35 + 0.65 * grey[..., None] / grey.max(initial=1)), 0.0, 1.0)
    mixed[grey == NOTHING] = 1.0
    corners = frame.raster_from_wall(np.array([[0.0, frame.height], [frame.width, 0.0]]))
    wide = 9.0
    high = min(12.0, max(2.5, wide * rows / columns + 0.8))
    figure = Figure(figsize=(wide, high), layout="constrained")
    axes = figure.add_subplot()
    extent = (corners[0, 0], corners[1, 0], corners[0, 1], corners[1, 1])
    axes.imshow(mixed, extent=extent, interpolation="nearest")
    for level, points in _contours(depth, frame, stretch.interval):
        axes.plot(*points.T, color=_CONTOUR_COLOURS[level < 0.0], linewidth=0.5)
    upright = frame.raster_axes == "wall"
    axes.set_xlabel("X along the wall, m" if upright else "X, m")
    axes.set_ylabel("height, m" if upright else "Y, m")
    axes.set_aspect("equal")
    axes.set_title(f"contour lines every {1e3 * stretch.interval:g} mm", fontsize="medium")
    scale = figure.colorbar(
        ScalarMappable(norm=norm, cmap="RdBu_r"),
        ax=axes,
        label="depth towards the viewer, mm",
        shrink=0.9,
        extend="both",
    )
    scale.outline.set_linewidth(0.5)
    figure.savefig(path, dpi=150, metadata={"Software": None})
