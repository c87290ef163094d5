"""Images of input data: a cloud seen from above and from its scanner, and contact sheets."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawing import encode_chart, in_column_style, picture_figure
from orthoflow.files.images import encode_png, encode_webp
from orthoflow.geometry import WallFrame, basis_from_up
from orthoflow.products import PointCloud

_PLAN_SIDE_PX: Final = 640
_PLAN_SAMPLE: Final = 250_000
_POLAR_SIDE_PX: Final = 1200
_POLAR_SAMPLE: Final = 2_000_000

# Maximum number of rows, and of columns, of a scan that are drawn as lines on a wall.
_LINES: Final = 24
# Colours in which rows and columns are drawn.
ROW_RGB: Final = (235, 165, 20)
COLUMN_RGB: Final = (20, 150, 215)
_WALL_STEP_DEG: Final = 2.0
_WALL_FARTHEST_M: Final = 1000.0
_WALL_CELL_M: Final = 0.05
_WALL_REACH_M: Final = 0.15
# Neighbouring points of a line are not connected if their distance exceeds the median distance by
# this factor.
_BREAK_STEPS: Final = 6.0

# Width of a journal column at 300 dpi, with 6-point text.
_SHEET_SIDE_PX: Final = 1004
_CELL_PX: Final = 251
_LABEL_PX: Final = 30
_LETTER_PX: Final = 15
_GAP_PX: Final = 6
_MOST: Final = 100
_PAPER: Final = 245
_INK: Final = (40, 40, 40)


@in_column_style()
def plan_chart(cloud: PointCloud) -> bytes:
    """Return an image of the cloud from above, with axes in metres, as WebP."""
    grey, frame = plan_view(cloud)
    return encode_chart(picture_figure(grey, frame=frame)[0])


def plan_view(cloud: PointCloud) -> tuple[NDArray[np.uint8], WallFrame]:
    """Return the density of the cloud from above as grey levels on a logarithmic scale.

    Returns:
        (rows, cols) grey levels, and the frame of the image.
    """
    step = max(1, len(cloud) // _PLAN_SAMPLE)
    offsets = np.column_stack([cloud.x[::step], cloud.y[::step], cloud.z[::step]])
    first, second, up = basis_from_up(cloud.up)
    plan = offsets.astype(np.float64) @ np.column_stack([first, second])
    # With percentiles, stray points do not reduce the scale.
    low, high = np.percentile(plan, [0.1, 99.9], axis=0)
    span = max(float((high - low).max()), 1e-6)
    size = np.maximum(np.ceil((high - low) / span * _PLAN_SIDE_PX).astype(int), 1)
    cells = np.floor((plan - low) / span * _PLAN_SIDE_PX).astype(np.int64)
    is_inside = np.all((cells >= 0) & (cells < size), axis=1)
    columns, rows = cells[is_inside].T
    counts = np.bincount(rows * size[0] + columns, minlength=int(size.prod())).astype(np.float64)
    shades = np.log1p(counts)
    grey = np.rint(255.0 * shades / max(float(shades.max()), 1.0)).astype(np.uint8)
    # Row 0 is at the bottom of a map but at the top of an image.
    gsd_m = span / _PLAN_SIDE_PX
    frame = WallFrame(
        origin_world=cloud.origin + low[0] * first + (low[1] + gsd_m * size[1]) * second,
        u_world=first,
        v_world=-second,
        normal_world=up,
        gsd_m=gsd_m,
        width=int(size[0]),
        height=int(size[1]),
        up=tuple(cloud.up.tolist()),
    )
    return np.ascontiguousarray(grey.reshape(size[1], size[0])[::-1]), frame


def polar_view_png(cloud: PointCloud) -> bytes | None:
    """Return a PNG of the intensity by row and column of the scan with the most points.

    The axes of the image are the angles of the scanner, so straight edges are curved (Figure 2 of
    markiewicz2015). If the station is known, up and left in the image are up and left as seen from
    the station. The result is None if the cloud has no grid or no intensity.
    """
    if cloud.row is None or cloud.column is None or cloud.intensity is None or not len(cloud):
        return None
    scan, index = _largest_scan(cloud)
    index = index[np.isfinite(cloud.intensity[index])]
    if not len(index):
        return None
    row, column = (array[index].astype(np.int64) for array in (cloud.row, cloud.column))
    row, column = row - row.min(), column - column.min()
    size = np.array([row.max() + 1, column.max() + 1])
    # Use no more pixels than there are sampled points.
    coarser = max(float(size.max()) / _POLAR_SIDE_PX, math.sqrt(float(size.prod()) / len(index)))
    across = max(1, math.ceil(coarser))
    rows, columns = -(-size // across)
    place = row // across * columns + column // across
    total = np.bincount(place, cloud.intensity[index], minlength=int(rows * columns))
    counts = np.bincount(place, minlength=int(rows * columns))
    mean = total / np.maximum(counts, 1)
    low, high = np.quantile(mean[counts > 0], (0.01, 0.99))
    bright = np.clip((mean - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    # Pixels without points are black.
    grey = np.where(counts > 0, np.rint(32.0 + 223.0 * bright), 0.0).astype(np.uint8)
    upward, leftward = _ways_of_grid(cloud, scan, index, row // across, column // across)
    image = grey.reshape(rows, columns)[:: -1 if upward else 1, :: -1 if leftward else 1]
    return encode_png(np.ascontiguousarray(image))


def scan_lines_png(cloud: PointCloud) -> bytes | None:
    """Return a PNG of a wall in an orthogonal view, with lines along rows and columns of the scan.

    The image shows the largest vertical plane of the scan with the most points, and all points
    within 15 cm of this plane. Some rows of the scan are drawn as yellow lines and some columns as
    blue lines, as in Figure 2b of markiewicz2015. The lines bend at objects in front of the wall.
    The result is None if the cloud has no grid.
    """
    import cv2

    if cloud.row is None or cloud.column is None or not len(cloud):
        return None
    scan, index = _largest_scan(cloud)
    offsets = np.column_stack([cloud.x[index], cloud.y[index], cloud.z[index]]).astype(np.float64)
    level = offsets @ basis_from_up(cloud.up).T
    along, distance_m = _fullest_wall(level[:, :2])
    station = _station(cloud, scan)
    viewer = level.mean(axis=0) if station is None else basis_from_up(cloud.up) @ station
    on_wall = np.abs(level[:, :2] @ [along[1], -along[0]] - distance_m) <= _WALL_REACH_M
    # `right` points to the right as seen from the scanner.
    right = along if viewer[:2] @ [along[1], -along[0]] > distance_m else -along
    places = np.column_stack([level[:, :2] @ right, -level[:, 2]])[on_wall]
    low, high = np.percentile(places, [0.1, 99.9], axis=0)
    scale = _POLAR_SIDE_PX / max(float((high - low).max()), 1e-6)
    size = np.maximum(np.ceil((high - low) * scale).astype(int), 1)
    pixels = np.floor((places - low) * scale).astype(np.int64)
    shade = 1.0 if cloud.intensity is None else np.nan_to_num(cloud.intensity[index][on_wall])
    picture = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    is_inside = np.all((pixels >= 0) & (pixels < size), axis=1)
    grey = np.rint(40.0 + 120.0 * np.broadcast_to(shade, len(pixels))).astype(np.uint8)
    picture[pixels[is_inside, 1], pixels[is_inside, 0]] = grey[is_inside, None]
    rows, columns = (array[index][on_wall].astype(np.int64) for array in (cloud.row, cloud.column))
    for lines, order, colour in ((rows, columns, ROW_RGB), (columns, rows, COLUMN_RGB)):
        pieces = [piece for line in _some_lines(lines, order) for piece in _unbroken(pixels[line])]
        cv2.polylines(picture, pieces, isClosed=False, color=colour)
    return encode_png(picture)


class ContactSheet:
    """Thumbnails of the first hundred photos, with their names and without EXIF rotation."""

    def __init__(self, n_photos: int) -> None:
        self._n_photos = n_photos
        self._columns = math.ceil(math.sqrt(min(n_photos, _MOST)))
        self._cell_px = min(_CELL_PX, _SHEET_SIDE_PX // self._columns)
        self._cells: list[NDArray[np.uint8]] = []

    @property
    def caption(self) -> str:
        """Caption of the sheet in one sentence."""
        which = "The photos" if self._n_photos <= _MOST else f"The first of {self._n_photos} photos"
        return (
            f"{which}, as they are stored: orthoimages are good where several photos show a wall "
            "frontally; blur, and parts that no photo shows, cannot be corrected later."
        )

    def add(self, name: str, image: NDArray[np.uint8]) -> None:
        """Add a photo (rows, cols, 3) in RGB to the sheet if there is space."""
        import cv2

        if len(self._cells) == _MOST:
            return
        cell = np.full((self._cell_px, self._cell_px, 3), _PAPER, dtype=np.uint8)
        room_px = self._cell_px - 2 * _GAP_PX
        scale = min(room_px / image.shape[1], (room_px - _LABEL_PX) / image.shape[0])
        width, height = (max(1, int(side * scale)) for side in (image.shape[1], image.shape[0]))
        bottom = _GAP_PX + height
        cell[_GAP_PX:bottom, _GAP_PX : _GAP_PX + width] = cv2.resize(
            image, (width, height), interpolation=cv2.INTER_AREA
        )
        label, place = _shortened(name, room_px // _LETTER_PX), (_GAP_PX, bottom + _LABEL_PX - 8)
        cv2.putText(cell, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.8, _INK, 1, cv2.LINE_AA)
        self._cells.append(cell)

    def encoded(self) -> bytes:
        """Encode the sheet as WebP with sides of at most 1004 pixels."""
        blank = np.full_like(self._cells[0], _PAPER)
        cells = self._cells + [blank] * (-len(self._cells) % self._columns)
        starts = range(0, len(cells), self._columns)
        return encode_webp(np.vstack([np.hstack(cells[k : k + self._columns]) for k in starts]))


def _largest_scan(cloud: PointCloud) -> tuple[int, NDArray[np.int64]]:
    """Return the scan with the most points, and an evenly spaced sample of its points."""
    index = np.arange(0, len(cloud), max(1, len(cloud) // _POLAR_SAMPLE))
    if cloud.scan is None:
        return 0, index
    scan = int(np.bincount(cloud.scan[index]).argmax())
    return scan, index[cloud.scan[index] == scan]


def _station(cloud: PointCloud, scan: int) -> NDArray[np.float64] | None:
    """Return the station of a scan as an offset (3,), or None if the files do not contain it."""
    stations = cloud.stations
    if stations is None or scan >= len(stations) or cloud.stations_source == "view_from":
        return None
    station: NDArray[np.float64] = stations[scan] - cloud.origin
    return station


def _fullest_wall(plan: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return direction (2,) and distance of the vertical plane with the most points."""
    some = plan[:: max(1, len(plan) // _PLAN_SAMPLE)]
    # Limit the size of the table of cells, since points of damaged files can be anywhere.
    is_near = np.all(np.abs(some - np.median(some, axis=0)) <= _WALL_FARTHEST_M, axis=1)
    some = some[is_near] if is_near.any() else some[:1]
    angles = np.radians(np.arange(0.0, 180.0, _WALL_STEP_DEG))
    ways = [np.array([math.cos(angle), math.sin(angle)]) for angle in angles]
    cells = [_fullest_cell(some @ [along[1], -along[0]]) for along in ways]
    best = max(range(len(ways)), key=lambda way: cells[way][0])
    return ways[best], cells[best][1]


def _fullest_cell(distances_m: NDArray[np.float64]) -> tuple[int, float]:
    """Return the largest number of distances (n,) in a cell, and the centre of that cell."""
    cells = np.floor(distances_m / _WALL_CELL_M).astype(np.int64)
    counts = np.bincount(cells - cells.min())
    fullest = int(counts.argmax())
    return int(counts[fullest]), (fullest + int(cells.min()) + 0.5) * _WALL_CELL_M


def _some_lines(lines: NDArray[np.int64], order: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Yield the point indices of evenly selected lines of a scan."""
    numbers = np.unique(lines)
    for number in numbers[:: max(1, len(numbers) // _LINES)]:
        mine = np.flatnonzero(lines == number)
        yield mine[np.argsort(order[mine], kind="stable")]


def _unbroken(pixels: NDArray[np.int64]) -> list[NDArray[np.int32]]:
    """Split a line of points (n, 2), in pixels, at its gaps."""
    steps = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
    usual = max(1.0, float(np.median(steps))) if len(steps) else 1.0
    return np.split(pixels.astype(np.int32), np.flatnonzero(steps > _BREAK_STEPS * usual) + 1)


def _ways_of_grid(
    cloud: PointCloud,
    scan: int,
    index: NDArray[np.int64],
    row: NDArray[np.int64],
    column: NDArray[np.int64],
) -> tuple[bool, bool]:
    """Return whether rows run upwards, and columns to the left, as seen from the station."""
    station = _station(cloud, scan)
    if station is None:
        return True, False
    offsets = np.column_stack([cloud.x[index], cloud.y[index], cloud.z[index]]).astype(np.float64)
    rays = (offsets - station) @ basis_from_up(cloud.up).T
    elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    upward = float(np.cov(row, elevation)[0, 1]) >= 0.0
    # Compute the mean direction of each column. Differences between these directions keep their
    # sign at the seam of a panorama.
    east, north = (np.bincount(column, rays[:, axis]) for axis in (0, 1))
    azimuth = np.arctan2(north, east)[np.bincount(column) > 0]
    steps = (np.diff(azimuth) + np.pi) % (2.0 * np.pi) - np.pi
    return upward, bool(len(steps)) and float(np.median(steps)) > 0.0


def _shortened(name: str, n_letters: int) -> str:
    """Shorten a photo name in the middle, since the ends differ, and make it ASCII for OpenCV."""
    label = name.encode("ascii", "replace").decode()
    if len(label) <= n_letters:
        return label
    n_end = n_letters // 2
    return f"{label[: n_letters - n_end - 2]}..{label[-n_end:]}"
