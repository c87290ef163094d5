"""Rasters of walls as pictures for paper, at the resolution of print and in bounded memory."""

from __future__ import annotations

import cmath
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import StoreError
from orthoflow.files.drawings.papers import Part, nice_step
from orthoflow.files.geotiff import RasterParts
from orthoflow.geometry.levels import Colours, eight_bits
from orthoflow.geometry.robust import median_deviation

PRINT_DPI: Final = 400.0
_MM_PER_INCH: Final = 25.4
# Cells read at a time.
_BAND_CELLS: Final = 1 << 23
# A picture of up to this many pixels is lossless; beyond, a sheet would be too large to send.
_LOSSLESS_PX: Final = 8_000_000
_JPEG_QUALITY: Final = 95
_CONTOUR_PITCH_MM: Final = 0.5
_SHORTEST_CONTOUR_MM: Final = 6.0
_OVERVIEW_PX: Final = 1000
# Contours lie so many standard deviations of the noise apart, at least.
_CLEAR_OF_NOISE: Final = 4.0
# Values of one surface differ by so many; they are averaged over a Gaussian of so many cells.
_SAME_SURFACE: Final = 5.0
_CALM_CELLS: Final = 4.0
# The side of a square of cells that may be level, and the share of an interval that it rises then.
_LEVEL_CELLS: Final = 5
_LEVEL_SHARE: Final = 0.02
# A contour must be this many times as long as its number is wide, or it has none.
_LEAST_WIDTHS: Final = 5.0
_APART_MM: Final = 12.0
_TRIED: Final = (0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875)
# Minimum ratio of the chord to the length of the line below a number, which would be beside it
# otherwise.
_STRAIGHT: Final = 0.9


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """Values for black and white, the noise of values, and the interval of contours."""

    low: float
    high: float
    noise: float = 0.0

    @property
    def interval(self) -> float:
        """Interval of contours, a round number, about ten over the range.

        At least 1 mm, and so much that noise does not reach from one contour to the next.
        """
        return nice_step(max((self.high - self.low) / 12.0, 1e-3, _CLEAR_OF_NOISE * self.noise))


def encode_part(raster: Path, part: Part, *, scale: int, is_flipped: bool = False) -> bytes:
    """Encode a part of a wall's raster as a picture, white where empty.

    Cells are unchanged if print resolves them, otherwise averaged to 400 pixels per inch.

    Args:
        raster: GeoTIFF of one band, which is stretched to grey, or of three.
        part: of the raster.
        scale: n of 1 : n.
        is_flipped: the rows of the raster go up the paper; `part` refers to the drawing.

    Returns:
        PNG, or JPEG if large.
    """
    import cv2

    with RasterParts(raster) as source:
        part = _flipped(part, source) if is_flipped else part
        cells = np.array([part.left_m, part.top_m, part.right_m, part.bottom_m]) / source.gsd_m
        cells = np.clip(cells, 0.0, [*source.shape[::-1], *source.shape[::-1]])
        shape = _printed_shape(part, cells, scale)
        stretch = stretch_of(raster) if source.bands == 1 else None
        # Blue first, as OpenCV has it: a copy of an A0 sheet would take 750 MB.
        picture = np.full((*shape, 3), 255, dtype=np.uint8)
        for rows, values, shown in _bands(source, cells, shape):
            colours = _grey(values, stretch) if stretch else eight_bits(cast("Colours", values))
            picture[rows][shown] = colours[shown][:, ::-1]
    picture = np.ascontiguousarray(picture[::-1]) if is_flipped else picture
    if shape[0] * shape[1] <= _LOSSLESS_PX:
        return cv2.imencode(".png", picture)[1].tobytes()
    sampling = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY, *sampling]
    return cv2.imencode(".jpg", picture, options)[1].tobytes()


def _flipped(part: Part, source: RasterParts) -> Part:
    """The same part, relative to the opposite edge of the raster."""
    high_m = source.shape[0] * source.gsd_m
    return replace(part, top_m=high_m - part.bottom_m, bottom_m=high_m - part.top_m)


def stretch_of(raster: Path) -> Stretch:
    """Return the values of one band for black and white: its 2nd and 98th percentile.

    Their noise is that of an overview.
    """
    with RasterParts(raster) as source:
        rows, columns = source.shape
        shape = (min(rows, _OVERVIEW_PX), min(columns, _OVERVIEW_PX))
        values, shown = source.read((0.0, 0.0, float(columns), float(rows)), shape)
    known = values[shown & np.isfinite(values)].astype(np.float64)
    if not known.size:
        return Stretch(low=0.0, high=1.0)
    low, high = (float(value) for value in np.percentile(known, (2.0, 98.0)))
    noise = noise_of(np.where(shown, values, np.nan).astype(np.float32))
    return Stretch(low=low, high=max(high, low + 1e-6), noise=noise)


def noise_of(values: NDArray[np.float32]) -> float:
    """Estimate the standard deviation of noise, which neighbouring cells (rows, cols) do not share.

    What runs smoothly from cell to cell is no noise, nor are edges, which few cells have.
    """
    between = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:]
    away = values[1:-1, 1:-1] - 0.25 * between
    known = away[np.isfinite(away)].astype(np.float64)
    return median_deviation(known) / math.sqrt(1.25) if known.size else 0.0


def calmed(values: NDArray[np.float32], noise: float) -> NDArray[np.float32]:
    """Average values with neighbours from which they differ by noise alone: edges stay sharp.

    Args:
        values: (rows, cols), NaN where unknown, which stays so.
        noise: their standard deviation.
    """
    import cv2

    if noise <= 0.0:
        return values
    known = np.isfinite(values)
    # Too far away from all others to be averaged with them.
    filled = np.where(known, values, np.float32(values[known].max() + 20.0 * noise))
    calm = cv2.bilateralFilter(filled, -1, _SAME_SURFACE * noise, _CALM_CELLS)
    return np.where(known, calm, np.float32(np.nan))


def _is_level(values: NDArray[np.float32], least: float) -> NDArray[np.bool_]:
    """Return where all values around a cell differ by less."""
    import cv2

    around = np.ones((_LEVEL_CELLS, _LEVEL_CELLS), dtype=np.uint8)
    filled = np.where(np.isfinite(values), values, np.float32(1e9))
    return np.asarray(cv2.dilate(filled, around) - cv2.erode(filled, around) < least)


def contours(
    raster: Path, part: Part, *, scale: int, interval_m: float, is_flipped: bool = False
) -> list[tuple[float, NDArray[np.float64]]]:
    """Return contours of a depth raster, each a level in metres and a line.

    Lines are (n, 2) metres on the wall, to the right and down from the corner of the raster, or of
    the drawing if the raster's rows go up the paper. Levels begin half an interval from the plane,
    because on the plane itself they would only show noise. Depths are averaged over half a
    millimetre of paper, and with those that differ by noise alone. There is no line where they are
    level within it, or where lines would be more than 12 cm apart: it would only wander. Lines
    shorter than six millimetres are omitted.
    """
    from contourpy import contour_generator

    with RasterParts(raster) as source:
        part = _flipped(part, source) if is_flipped else part
        high_m = source.shape[0] * source.gsd_m
        box = np.array([part.left_m, part.top_m, part.right_m, part.bottom_m]) / source.gsd_m
        pitch_m = max(source.gsd_m, 1e-3 * _CONTOUR_PITCH_MM * scale)
        columns, rows = (max(2, round(edge / pitch_m)) for edge in part.size_m)
        limits = np.clip(np.round(box), 0, [*source.shape[::-1], *source.shape[::-1]])
        left, top, right, bottom = (float(edge) for edge in limits)
        shape = (min(rows, int(bottom - top)), min(columns, int(right - left)))
        if min(shape) < 2:
            return []
        depths, shown = source.read((left, top, right, bottom), shape)
        gsd_m = source.gsd_m
    known = shown & np.isfinite(depths)
    if not known.any():
        return []
    x = gsd_m * (left + (np.arange(shape[1]) + 0.5) * (right - left) / shape[1])
    y = gsd_m * (top + (np.arange(shape[0]) + 0.5) * (bottom - top) / shape[0])
    surface = np.where(known, depths, np.nan).astype(np.float32)
    noise = noise_of(surface)
    surface = calmed(surface, noise)
    # Of noise alone, one averaged cell in ten thousand rises by more.
    drawn = known & ~_is_level(surface, max(0.6 * noise, _LEVEL_SHARE * interval_m))
    generator = contour_generator(x, y, np.ma.array(surface.astype(np.float64), mask=~drawn))
    low, high = (
        math.floor(float(edge) / interval_m) for edge in np.percentile(depths[known], (1.0, 99.0))
    )
    found = []
    for step in range(low, high + 1):
        level = (step + 0.5) * interval_m
        for line in generator.lines(level):
            points = np.asarray(line, dtype=np.float64)
            length_m = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
            if 1e3 * length_m / scale >= _SHORTEST_CONTOUR_MM:
                if is_flipped:
                    points[:, 1] = high_m - points[:, 1]
                found.append((level, points))
    return found


def label_place(
    points_mm: NDArray[np.float64], wide_mm: float, placed_mm: Sequence[NDArray[np.float64]]
) -> tuple[tuple[float, float], float] | None:
    """Find a position for a number on a line: its centre on the paper, and degrees, or None.

    It is rotated counter-clockwise, so that it is never upside down.

    Args:
        points_mm: the line, (n, 2) on the paper.
        wide_mm: width of the number.
        placed_mm: centres of other numbers, (2,) each.
    """
    # Right and up as real and imaginary parts.
    line = points_mm[:, 0] + 1j * points_mm[:, 1]
    along = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(line)))])
    if along[-1] < _LEAST_WIDTHS * wide_mm:
        return None
    for share in _TRIED:
        middle = share * along[-1]
        ends = np.interp([middle - 0.5 * wide_mm, middle + 0.5 * wide_mm], along, line)
        chord, place = complex(ends[1] - ends[0]), complex(ends.mean())
        if abs(chord) < _STRAIGHT * wide_mm:
            continue
        if any(abs(place - complex(*other)) < _APART_MM for other in placed_mm):
            continue
        turned_deg = math.degrees(cmath.phase(chord))
        if not -90.0 < turned_deg <= 90.0:
            turned_deg -= math.copysign(180.0, turned_deg)
        return (place.real, place.imag), turned_deg
    return None


def _printed_shape(part: Part, cells: NDArray[np.float64], scale: int) -> tuple[int, int]:
    n_cells = (cells[3] - cells[1], cells[2] - cells[0])
    inches = (1e3 * edge / scale / _MM_PER_INCH for edge in part.size_m[::-1])
    rows, columns = (
        max(1, min(math.ceil(count - 1e-6), math.ceil(edge * PRINT_DPI)))
        for count, edge in zip(n_cells, inches, strict=True)
    )
    return rows, columns


def _bands(
    source: RasterParts, cells: NDArray[np.float64], shape: tuple[int, int]
) -> Iterator[tuple[slice, NDArray[np.generic], NDArray[np.bool_]]]:
    left, top, right, bottom = (float(edge) for edge in cells)
    per_row = (bottom - top) / shape[0]
    count = max(1, int(_BAND_CELLS / max(1.0, (right - left) * per_row)))
    for first in range(0, shape[0], count):
        last = min(shape[0], first + count)
        box = (left, top + first * per_row, right, top + last * per_row)
        values, shown = source.read(box, (last - first, shape[1]))
        yield slice(first, last), values, shown


def _grey(values: NDArray[np.generic], stretch: Stretch) -> NDArray[np.uint8]:
    shares = (values.astype(np.float32) - stretch.low) / (stretch.high - stretch.low)
    grey = np.nan_to_num(255.0 * np.clip(shares, 0.0, 1.0), nan=255.0).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


def write_cad_picture(raster: Path, path: Path) -> None:
    """Write an orthoimage as PNG, one pixel per cell, transparent where empty.

    Raises:
        StoreError: the file cannot be written.
    """
    import rasterio
    from rasterio.shutil import copy
    from rasterio.windows import Window

    with RasterParts(raster) as source, tempfile.TemporaryDirectory() as folder:
        rows, columns = source.shape
        # GDAL's PNG driver only copies, row by row.
        aside = Path(folder) / "picture.tif"
        profile = {"count": 4, "dtype": "uint8", "transform": rasterio.Affine(2, 0, 0, 0, -2, 0)}
        whole = np.array([0.0, 0.0, columns, rows])
        try:
            with rasterio.open(aside, "w", width=columns, height=rows, **profile) as target:
                for band, values, shown in _bands(source, whole, source.shape):
                    # White behind transparency, for programs that do not support it.
                    pixels = np.full((*shown.shape, 4), 255, dtype=np.uint8)
                    pixels[..., :3][shown] = eight_bits(cast("Colours", values))[shown]
                    pixels[..., 3] = np.where(shown, 255, 0)
                    window = Window(0, band.start, columns, len(shown))
                    target.write(pixels.transpose(2, 0, 1), window=window)
            with rasterio.Env(GDAL_PAM_ENABLED="NO"):
                copy(aside, path, driver="PNG", ZLEVEL="4")
        except (OSError, rasterio.errors.RasterioError) as error:
            raise StoreError(f"{path.name} cannot be written: {error}; free some space") from error
