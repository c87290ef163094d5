"""Pictures of walls: rasters for print and CAD, contours, elevations, and relief.

Rasters are read in parts to limit the memory that is needed.
"""

from __future__ import annotations

import cmath
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawing import in_column_style, picture_figure
from orthoflow.files.drawings import pens
from orthoflow.files.drawings.sheet_contents import (
    Axes,
    Drawing,
    LegendRow,
    Part,
    Picture,
    Placed,
    SheetText,
    View,
    nice_step,
    up_words,
    whole_of,
)
from orthoflow.files.drawings.words import Language, Phrase, label, numerals
from orthoflow.files.geotiff import RasterParts, writing
from orthoflow.files.polygons import Feature, write_features
from orthoflow.geometry import WallFrame
from orthoflow.geometry.frames import basis_from_up
from orthoflow.geometry.levels import Colours, eight_bits
from orthoflow.geometry.robust import median_deviation
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

PRINT_DPI: Final = 400.0
_MM_PER_INCH: Final = 25.4
# Number of cells that are read at a time.
_BAND_CELLS: Final = 1 << 23
# Pictures up to this size are lossless; larger ones would make the files too large to send.
LOSSLESS_PX: Final = 8_000_000
_JPEG_QUALITY: Final = 95
_CONTOUR_PITCH_MM: Final = 0.5
_SHORTEST_CONTOUR_MM: Final = 6.0
_OVERVIEW_PX: Final = 1000
# Minimum contour interval, in standard deviations of the noise.
_CLEAR_OF_NOISE: Final = 4.0
# For the smoothing of depths: maximum difference between depths that are averaged, in standard
# deviations, and sigma of the Gaussian, in cells.
_SAME_SURFACE: Final = 5.0
_CALM_CELLS: Final = 4.0
# Side of the square of cells in which a surface is tested for being level, and the permitted rise
# relative to the contour interval.
_LEVEL_CELLS: Final = 5
_LEVEL_SHARE: Final = 0.02
# Minimum length of a contour with a number, in widths of the number.
_LEAST_WIDTHS: Final = 5.0
_APART_MM: Final = 12.0
_TRIED: Final = (0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875)
# Minimum ratio of the chord to the length of the part of a contour that a number covers; on a more
# curved part, the number would be next to the line.
_STRAIGHT: Final = 0.9


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """The values shown as black and white, the noise of the values, and the contour interval."""

    low: float
    high: float
    noise: float = 0.0

    @property
    def interval(self) -> float:
        """Contour interval: a round number that gives about ten levels over the range.

        The interval is at least 1 mm and four standard deviations of the noise.
        """
        return nice_step(max((self.high - self.low) / 12.0, 1e-3, _CLEAR_OF_NOISE * self.noise))


def encode_part(raster: Path, part: Part, *, scale: int, is_flipped: bool = False) -> bytes:
    """Encode a part of a wall's raster as a picture, white in empty cells.

    Rasters with more than 400 cells per inch of paper are averaged to 400; others are unchanged.

    Args:
        raster: GeoTIFF with three bands, or with one, which is stretched to grey.
        part: part of the raster.
        scale: denominator n of the scale 1 : n.
        is_flipped: whether the rows of the raster go up the paper; `part` refers to the drawing.

    Returns:
        The picture as PNG, or as JPEG if it is large.
    """
    import cv2

    with RasterParts(raster) as source:
        part = _flipped(part, source) if is_flipped else part
        cells = np.array([part.left_m, part.top_m, part.right_m, part.bottom_m]) / source.gsd_m
        cells = np.clip(cells, 0.0, [*source.shape[::-1], *source.shape[::-1]])
        shape = _printed_shape(part, cells, scale)
        stretch = stretch_of(raster) if source.bands == 1 else None
        # Channels are in OpenCV's order (blue first), because converting an A0 sheet would take
        # another 750 MB.
        picture = np.full((*shape, 3), 255, dtype=np.uint8)
        for rows, values, shown in _bands(source, cells, shape):
            colours = _grey(values, stretch) if stretch else eight_bits(cast("Colours", values))
            picture[rows][shown] = colours[shown][:, ::-1]
    picture = np.ascontiguousarray(picture[::-1]) if is_flipped else picture
    if shape[0] * shape[1] <= LOSSLESS_PX:
        return cv2.imencode(".png", picture)[1].tobytes()
    sampling = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY, *sampling]
    return cv2.imencode(".jpg", picture, options)[1].tobytes()


def _flipped(part: Part, source: RasterParts) -> Part:
    """Return the same part, measured from the opposite edge of the raster."""
    high_m = source.shape[0] * source.gsd_m
    return replace(part, top_m=high_m - part.bottom_m, bottom_m=high_m - part.top_m)


def stretch_of(raster: Path) -> Stretch:
    """Return the values of a band to show as black and white: its 2nd and 98th percentiles.

    The noise is estimated from an overview.
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
    """Estimate the standard deviation of noise that is uncorrelated between cells (rows, cols).

    Smooth variation does not count as noise, nor do edges, which affect few cells.
    """
    between = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:]
    away = values[1:-1, 1:-1] - 0.25 * between
    known = away[np.isfinite(away)].astype(np.float64)
    return median_deviation(known) / math.sqrt(1.25) if known.size else 0.0


def calmed(values: NDArray[np.float32], noise: float) -> NDArray[np.float32]:
    """Average each value with the neighbours that differ from it only by noise; edges stay sharp.

    Args:
        values: (rows, cols), NaN if unknown; NaN is preserved.
        noise: standard deviation of the noise.
    """
    import cv2

    if noise <= 0.0:
        return values
    known = np.isfinite(values)
    # Fill unknown cells with a value too far from all known values to be averaged with them.
    filled = np.where(known, values, np.float32(values[known].max() + 20.0 * noise))
    calm = cv2.bilateralFilter(filled, -1, _SAME_SURFACE * noise, _CALM_CELLS)
    return np.where(known, calm, np.float32(np.nan))


def _is_level(values: NDArray[np.float32], least: float) -> NDArray[np.bool_]:
    """Return the cells in whose neighbourhood all values differ by less than a limit."""
    import cv2

    around = np.ones((_LEVEL_CELLS, _LEVEL_CELLS), dtype=np.uint8)
    filled = np.where(np.isfinite(values), values, np.float32(1e9))
    return np.asarray(cv2.dilate(filled, around) - cv2.erode(filled, around) < least)


def contours(
    raster: Path, part: Part, *, scale: int, interval_m: float, is_flipped: bool = False
) -> list[tuple[float, NDArray[np.float64]]]:
    """Return contours of a depth raster, each with its level in metres and its line.

    Lines are (n, 2) metres on the wall, to the right and down from the corner of the raster, or of
    the drawing if the rows of the raster go up the paper. The first level is half an interval from
    the plane, because a contour on the plane itself would only show noise. Each depth is averaged
    over 0.5 mm on paper with those that differ from it only by noise. Contours shorter than 6 mm
    are omitted, and so are contours where the surface is level within the noise or where they would
    be more than 12 cm apart, since their position would be arbitrary.
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
    # With noise alone, one averaged cell in ten thousand exceeds the first limit.
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
    """Return a position for a number on a line (centre and rotation in degrees), or None.

    The number is rotated counter-clockwise such that it is not upside down.

    Args:
        points_mm: the line, (n, 2) on the paper.
        wide_mm: width of the number.
        placed_mm: centres of other numbers, (2,) each.
    """
    # As complex numbers: the real part points right, the imaginary part up.
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
    """Write an orthoimage as PNG, one pixel per cell, with empty cells transparent.

    Raises:
        StoreError: the file cannot be written.
    """
    import rasterio
    from rasterio.shutil import copy
    from rasterio.windows import Window

    with RasterParts(raster) as source, tempfile.TemporaryDirectory() as folder, writing(path):
        rows, columns = source.shape
        # GDAL's PNG driver can only copy an existing file, which it does row by row.
        aside = Path(folder) / "picture.tif"
        profile = {"count": 4, "dtype": "uint8", "transform": rasterio.Affine(2, 0, 0, 0, -2, 0)}
        whole = np.array([0.0, 0.0, columns, rows])
        with rasterio.open(aside, "w", width=columns, height=rows, **profile) as target:
            for band, values, shown in _bands(source, whole, source.shape):
                # Transparent cells are white, for programs that do not support transparency.
                pixels = np.full((*shown.shape, 4), 255, dtype=np.uint8)
                pixels[..., :3][shown] = eight_bits(cast("Colours", values))[shown]
                pixels[..., 3] = np.where(shown, 255, 0)
                window = Window(0, band.start, columns, len(shown))
                target.write(pixels.transpose(2, 0, 1), window=window)
        with rasterio.Env(GDAL_PAM_ENABLED="NO"):
            copy(aside, path, driver="PNG", ZLEVEL="4")


# An area outlined on a picture: its label, and its outline (n, 2) in metres to the right and down
# from the top-left corner of the picture. If there is room, the parts of the label, which are
# separated by ", ", are written on separate lines inside the area.
Area = tuple[str, NDArray[np.float64]]
_MIDDLE: Final = [(1.0, 2.0), (13.0, 2.0)]
_BOX: Final = [(3.0, 0.3), (11.0, 0.3), (11.0, 3.7), (3.0, 3.7)]


def wall_picture(
    raster: Path,
    *,
    is_depth: bool = False,
    is_flipped: bool = False,
    areas: Sequence[Area] = (),
    language: Language = "en",
) -> Picture:
    """Return a picture of a wall.

    Args:
        raster: GeoTIFF.
        is_depth: whether the raster contains depths, which are drawn with contours.
        is_flipped: whether the rows of the raster go up the paper, as for ceilings.
        areas: areas to outline, such as openings of the wall.
        language: language of the legend.
    """

    def draw(placed: Placed) -> None:
        draw_raster(placed, raster, is_flipped=is_flipped)
        if is_depth:
            _draw_contours(placed, raster, is_flipped=is_flipped, language=language)
        _draw_areas(placed, areas)

    legend: list[LegendRow] = []
    if areas:
        symbol = partial(_box, width_mm=pens.MEDIUM_MM, colour=pens.OPENING)
        legend.append((symbol, label("legend_opening", language)))
    if is_depth:
        stretch = stretch_of(raster)
        interval = f"{1e3 * stretch.interval:g}"
        low, high = (f"{1e3 * value:+.0f}" for value in (stretch.low, stretch.high))
        for key, colour in (("legend_before", pens.BEFORE), ("legend_behind", pens.BEHIND)):
            symbol = partial(pens.line, points_mm=_MIDDLE, width_mm=pens.THIN_MM, colour=colour)
            legend.append((symbol, label(key, language, interval=interval)))
        legend.append((_grey_ramp, label("legend_grey", language, low=low, high=high)))
    legend.append((partial(_box, colour=pens.GREY), label("legend_empty", language)))
    return Picture(draw=draw, legend=tuple(legend))


_box: Final = partial(pens.line, points_mm=_BOX, is_closed=True)


def _grey_ramp(canvas: Canvas) -> None:
    for step in range(24):
        pens.box(canvas, (1.0 + 0.5 * step, 0.5, 0.5, 3.0), (step / 23.0,) * 3)


def draw_raster(placed: Placed, raster: Path, *, is_flipped: bool = False) -> None:
    """Draw the part of a raster that a picture shows, with empty cells white."""
    from reportlab.lib.utils import ImageReader

    picture = encode_part(raster, placed.view.part, scale=placed.scale, is_flipped=is_flipped)
    left, bottom, right, top = placed.edges_mm
    placed.canvas.drawImage(
        ImageReader(BytesIO(picture)),
        *(pens.POINTS_PER_MM * number for number in (left, bottom, right - left, top - bottom)),
    )


def _draw_contours(placed: Placed, raster: Path, *, is_flipped: bool, language: Language) -> None:
    found = contours(
        raster,
        placed.view.part,
        scale=placed.scale,
        interval_m=stretch_of(raster).interval,
        is_flipped=is_flipped,
    )
    labelled: list[NDArray[np.float64]] = []
    for level, points in found:
        colour = pens.BEFORE if level > 0.0 else pens.BEHIND
        on_paper = placed.on_paper(points)
        pens.line(placed.canvas, on_paper, width_mm=pens.FINE_MM, colour=colour)
        text = numerals(f"{round(1e3 * level, 6):+g}", language)
        place = label_place(on_paper, pens.text_width_mm(text), labelled)
        if place is not None:
            middle_mm, turned_deg = place
            labelled.append(np.array(middle_mm))
            pens.write_on_white(
                placed.canvas, text, middle_mm, turned_deg=turned_deg, colour=colour
            )


def _draw_areas(placed: Placed, areas: Sequence[Area]) -> None:
    left, bottom, right, top = placed.edges_mm
    with placed.clipped() as canvas:
        for text, outline_m in areas:
            outline = placed.on_paper(outline_m)
            # A white line under the coloured one makes the outline visible on any picture.
            pens.line(canvas, outline, width_mm=1.0, colour=pens.WHITE, is_closed=True)
            pens.line(canvas, outline, width_mm=pens.MEDIUM_MM, colour=pens.OPENING, is_closed=True)
            low = np.maximum(outline.min(axis=0), (left, bottom))
            high = np.minimum(outline.max(axis=0), (right, top))
            # Write the parts of the text on a white background, from the top, if there is room.
            rows = shown(text).split(", ")
            wide_mm = max(pens.text_width_mm(row) for row in rows) + 2.0
            high_mm = 1.7 * pens.TEXT_MM * len(rows) + 1.0
            if high[0] - low[0] >= wide_mm + 2.0 and high[1] - low[1] >= high_mm + 2.0:
                pens.box(
                    canvas, (low[0] + 1.0, high[1] - 1.0 - high_mm, wide_mm, high_mm), pens.WHITE
                )
                for place, row in enumerate(rows):
                    at = (low[0] + 2.0, high[1] - 1.2 - 1.7 * pens.TEXT_MM * (place + 0.8))
                    pens.write_text(canvas, row, at, colour=pens.OPENING)


_GAP_MM: Final = 8.0
# Space for names below the walls.
_NAMES_MM: Final = 12.0
# Minimum distance between height marks.
_LEVELS_MM: Final = 1.5
# Walls within this angle belong to the same facade.
_PARALLEL_DEG: Final = 10.0


@dataclass(frozen=True, kw_only=True)
class ElevationWall:
    """A wall in an elevation.

    Attributes:
        name: name of the wall.
        frame: frame of the wall's picture.
        raster: GeoTIFF of the picture.
    """

    name: str
    frame: WallFrame
    raster: Path

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the wall in metres."""
        return self.frame.width * self.frame.gsd_m, self.frame.height * self.frame.gsd_m


def unfolded(
    walls: Sequence[ElevationWall], up: NDArray[np.float64]
) -> tuple[tuple[ElevationWall, ...], bool]:
    """Sort walls in the order in which a viewer sees them when turning or walking to the right.

    Inside a room, the viewer turns clockwise in plan view; around a building, the facades follow
    each other counter-clockwise. The order begins after the widest gap in direction.

    Returns:
        The walls, and whether they form a room seen from inside.
    """
    e1, e2, _ = basis_from_up(up)
    middles = np.array([wall.frame.corners_world().mean(axis=0) for wall in walls])
    normals = np.array([wall.frame.facing_world for wall in walls])
    outwards = np.einsum("wi,wi->w", middles - middles.mean(axis=0), normals)
    is_inside = bool(outwards.sum() <= 0.0)
    looks = -normals
    turn = -1.0 if is_inside else 1.0
    angles = turn * np.degrees(np.arctan2(looks @ e2, looks @ e1)) % 360.0
    order = np.argsort(angles)
    gaps = np.diff(np.append(angles[order], angles[order[0]] + 360.0))
    order = np.roll(order, -(int(np.argmax(gaps)) + 1))
    groups: list[list[int]] = []
    for k in order.tolist():
        first = groups[-1][0] if groups else None
        turned_deg = 0.0 if first is None else math.remainder(angles[k] - angles[first], 360.0)
        if first is not None and abs(turned_deg) <= _PARALLEL_DEG:
            groups[-1].append(k)
        else:
            groups.append([k])
    for group in groups:
        right = walls[group[0]].frame.u_world
        group.sort(key=lambda k: float(middles[k] @ right))
    return tuple(walls[k] for group in groups for k in group), is_inside


def elevation(
    walls: Sequence[ElevationWall],
    up: NDArray[np.float64],
    text: SheetText,
    scale: int,
    language: Language = "en",
) -> Drawing:
    """Return a picture of walls side by side, each at its height, with lines at round heights.

    Args:
        walls: walls from left to right.
        up: (3,) unit vector in scan coordinates.
        text: text on the sheets.
        scale: denominator n of the scale 1 : n.
        language: language of labels.
    """
    mm = 1e-3 * scale
    heights = np.array([wall.frame.corners_world() @ up for wall in walls])
    top, low = float(heights.max()), float(heights.min())
    lefts = np.cumsum([0.0, *(wall.size_m[0] + mm * _GAP_MM for wall in walls)])

    def draw(placed: Placed) -> None:
        part = placed.view.part
        end = -math.inf
        for number, (wall, left) in enumerate(zip(walls, lefts.tolist(), strict=False)):
            down = top - float(heights[number].max())
            wide, high = wall.size_m
            # Visible region of the wall on this part of the drawing.
            own = Part(
                left_m=max(part.left_m - left, 0.0),
                top_m=max(part.top_m - down, 0.0),
                right_m=min(part.right_m - left, wide),
                bottom_m=min(part.bottom_m - down, high),
            )
            if min(own.size_m) <= 1e-9:
                continue
            corner = placed.on_paper([(left + own.left_m, down + own.bottom_m)])[0]
            view = View(kind="", part=own, corner_mm=(float(corner[0]), float(corner[1])))
            draw_raster(replace(placed, view=view), wall.raster)
            outline = placed.on_paper([(left + x, down + y) for x, y in own.corners_m])
            pens.line(placed.canvas, outline, width_mm=pens.THIN_MM, is_closed=True)
            # Names that would overlap are omitted: the title block lists all of them.
            long = pens.text_width_mm(wall.name) + 2.0
            x, y = placed.on_paper([(left + own.left_m, top - low)])[0].tolist()
            x = min(x, placed.edges_mm[2] - long)
            if part.bottom_m > top - low and x >= end:
                end = x + long
                pens.write_on_white(placed.canvas, wall.name, (x + 0.5 * long, y - 3.0))

    # Walls with nearly the same top height share a mark.
    levels: list[float] = []
    for down in sorted({*(top - heights.max(axis=1)), *(top - heights.min(axis=1))}):
        if not levels or down - levels[-1] >= mm * _LEVELS_MM:
            levels.append(float(down))
    return Drawing(
        stem="elevation",
        size_m=(float(lefts[-1]) - mm * _GAP_MM, top - low + mm * _NAMES_MM),
        pictures={label("elevation", language): Picture(draw=draw)},
        axes=Axes(
            across=None,
            down=(top, -1.0),
            phrase=Phrase(key="axes_elevation", values={"up": up_words(up)}),
        ),
        text=text,
        scale=scale,
        language=language,
        heights=tuple(levels),
    )


NOTHING: Final = 0
_BAND_ROWS: Final = 1024
_AROUND_ROWS: Final = 8
# Rows above and below the middle of the raster that are used to estimate noise.
_SAMPLED_ROWS: Final = 128
_FIGURE_PX: Final = 1600
# Contours are smoothed as in a drawing at this scale, over 0.5 mm on paper.
_CONTOUR_SCALE: Final = 20
# Colours of contours in front of the plane and behind it.
_CONTOUR_COLOURS: Final = ("#5a0014", "#00204a")


@dataclass(frozen=True, kw_only=True)
class Light:
    """The direction of a distant light in front of a wall.

    Attributes:
        azimuth_deg: direction on the wall that the light comes from, clockwise from the top; 315 is
            top left.
        altitude_deg: angle between the rays and the wall's plane; small angles emphasise relief.
    """

    azimuth_deg: float = 315.0
    altitude_deg: float = 25.0


def shaded(
    depths_m: NDArray[np.floating], gsd_m: float, light: Light, noise_m: float = 0.0
) -> NDArray[np.uint8]:
    """Return a shaded depth raster, 1 to 255 by Lambert's cosine law; 0 if the depth is unknown.

    Args:
        depths_m: (rows, cols) metres towards the viewer, NaN if unknown.
        gsd_m: side length of a cell.
        light: direction of the light.
        noise_m: standard deviation of the depths; depths that differ only by noise are averaged.

    For a surface parallel to the wall's plane, the cosine is the sine of the light's altitude.
    """
    depths = calmed(np.asarray(depths_m, dtype=np.float32), noise_m)
    down, right = (_slope(depths, axis) / np.float32(gsd_m) for axis in (0, 1))
    azimuth, altitude = np.radians([light.azimuth_deg, light.altitude_deg])
    # Direction of the light: right and up on the wall.
    towards = (np.sin(azimuth), np.cos(azimuth))
    slope = -right * np.float32(towards[0]) + down * np.float32(towards[1])
    cosine = np.cos(altitude) * slope + np.sin(altitude)
    cosine /= np.sqrt(1.0 + right**2 + down**2)
    grey = 1.0 + 254.0 * np.clip(cosine, 0.0, 1.0)
    known = np.isfinite(depths)
    return np.where(known, np.nan_to_num(grey), NOTHING).astype(np.uint8)


def _slope(depths: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Return the change per cell: the mean of two sides, a single side next to a hole, or zero."""
    steps = np.diff(depths, axis=axis)
    before = np.concatenate([np.full_like(depths.take([0], axis), np.nan), steps], axis=axis)
    behind = np.concatenate([steps, np.full_like(depths.take([0], axis), np.nan)], axis=axis)
    n_known = np.isfinite(before).astype(np.float32) + np.isfinite(behind)
    total = np.nan_to_num(before) + np.nan_to_num(behind)
    return np.asarray(total / np.maximum(n_known, 1.0))


def write_relief(depth: Path, path: Path, light: Light) -> None:
    """Write the shaded relief of a depth raster as a GeoTIFF on the same grid, band by band.

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
                # Slopes and averages need additional rows on both sides.
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
    rows, columns = source.shape
    top, bottom = max(0, rows // 2 - _SAMPLED_ROWS), min(rows, rows // 2 + _SAMPLED_ROWS)
    box = (0.0, float(top), float(columns), float(bottom))
    depths, shown = source.read(box, (bottom - top, columns))
    return noise_of(np.where(shown, depths, np.nan).astype(np.float32))


def write_contours(depth: Path, frame: WallFrame, path: Path) -> float:
    """Write contour lines as GeoJSON in X and Y of the raster's GeoTIFF; return their interval.

    Each line has the property `depth_mm`, positive towards the viewer.
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
    size_m = frame.width * frame.gsd_m, frame.height * frame.gsd_m
    found = contours(depth, whole_of(size_m), scale=_CONTOUR_SCALE, interval_m=interval_m)
    return [(level, frame.raster_from_wall(points / frame.gsd_m)) for level, points in found]


def write_depth_figure(depth: Path, frame: WallFrame, path: Path, light: Light) -> None:
    """Write a PNG: coloured depths with shading, contours, and a legend in millimetres."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import CenteredNorm

    with RasterParts(depth) as source:
        rows, columns = source.shape
        factor = max(1.0, max(rows, columns) / _FIGURE_PX)
        shape = (max(2, round(rows / factor)), max(2, round(columns / factor)))
        depths, shown = source.read((0.0, 0.0, float(columns), float(rows)), shape)
        gsd_m = source.gsd_m * factor
    values = np.where(shown, np.asarray(depths, np.float32), np.nan)
    stretch = stretch_of(depth)
    # The plane is white; equal distances in front of it (red) and behind it (blue) are equally
    # dark.
    norm = CenteredNorm(0.0, halfrange=max(1.0, 1e3 * max(-stretch.low, stretch.high)))
    grey = shaded(values, gsd_m, light, noise_of(values))
    colours = colormaps["RdBu_r"](norm(1e3 * np.nan_to_num(values)))[..., :3]
    mixed = np.clip(colours * (0.35 + 0.65 * grey[..., None] / grey.max(initial=1)), 0.0, 1.0)
    mixed[grey == NOTHING] = 1.0
    with in_column_style():
        figure, axes = picture_figure(
            np.rint(255.0 * mixed).astype(np.uint8), extra_inches=0.45, frame=frame
        )
        for level, points in _contours(depth, frame, stretch.interval):
            cells = frame.wall_from_raster(points)
            axes.plot(*cells.T, color=_CONTOUR_COLOURS[level < 0.0], linewidth=0.3)
        figure.colorbar(
            ScalarMappable(norm, "RdBu_r"),
            ax=axes,
            label="depth towards the viewer, mm; contour lines every "
            f"{1e3 * stretch.interval:g} mm",
            location="bottom",
            aspect=40,
            extend="both",
        )
        figure.savefig(path, metadata={"Software": None})
