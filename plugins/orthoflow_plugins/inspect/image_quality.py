"""Properties of an orthoimage that every inspection reports.

These are the completeness, the sharpness, and the shares of filled cells and of stretched areas.

Sharpness is measured at edges in the image, by their width and by the MTF computed from their
profile. If a photo shows a surface at a grazing angle, few pixels are stretched over many cells, as
skarlatos2012 describes for vertical surfaces. The pixel from which a cell is coloured can be
computed from the depths of the wall and the camera. The distance between the pixels of neighbouring
cells is therefore known exactly, whatever the image shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import count_cells, row_bands
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.levels import REC_601, eight_bits
from orthoflow.products import (
    SHOWN_STATES,
    Cameras,
    Finding,
    Orthoimage,
    OrthoMask,
    Wall,
    is_painted,
    is_shown,
)
from orthoflow_plugins.inspect.findings import findings_of
from orthoflow_plugins.inspect.patches import GreyCells, GreyImage

# A cell is stretched if a pixel covers more cells than this in its longest direction.
_STRETCHED_CELLS: Final = 2.0
# A cell is smeared if a pixel covers more cells than this.
_SMEARED_CELLS: Final = 5.0
# Maximum number of cells per photo that are tested.
_ASKED_MOST: Final = 200_000
_REACH_CELLS: Final = 8
_STEP_CELLS: Final = 0.25
PROFILE_PLACES: Final = np.arange(-_REACH_CELLS, _REACH_CELLS + 0.5 * _STEP_CELLS, _STEP_CELLS)
_PEAKS_MOST: Final = 4000
_EDGES_MOST: Final = 400
# If the interpolated validity is at least this, all cells used in the interpolation are valid.
_WHOLE: Final = 0.999
TILE_CELLS: Final = 2048
_EDGES_LEAST: Final = 20
_CONTRAST_GREY: Final = 30.0
# Maximum variation of grey levels on either side of an edge, relative to the contrast of the edge.
_EVEN_SHARE: Final = 0.15
_END_CELLS: Final = 3.0
_LOW, _HIGH = 0.1, 0.9


@dataclass(frozen=True)
class OrthoimageGrey(GreyCells):
    """The grey levels of an orthoimage, 0 in cells without a colour."""

    image: Orthoimage

    @property
    def shape(self) -> tuple[int, int]:
        """The number of rows and the number of columns."""
        return self.image.frame.shape

    def cut(self, part: tuple[slice, slice]) -> GreyImage:
        """Return a part of the image."""
        shows = is_shown(self.image.mask[part])
        grey = np.where(shows, eight_bits(self.image.rgb[part]) @ REC_601, 0.0)
        return GreyImage(grey=grey, valid=shows, region=shows)


def n_shown(image: Orthoimage) -> int:
    """Return the number of cells that are coloured or filled."""
    return sum(count_cells(image.mask, state) for state in SHOWN_STATES)


def completeness(image: Orthoimage, wall: Wall) -> Finding:
    """Return the share of the scanned surface that an image with the same grid shows."""
    n_surface = n_both = 0
    for rows in row_bands(image.mask.shape):
        surface = np.isfinite(wall.depth_m[rows])
        n_surface += int(np.count_nonzero(surface))
        n_both += int(np.count_nonzero(surface & is_shown(image.mask[rows])))
    share = n_both / max(1, n_surface)
    return Finding(name="completeness", value=share, unit="1", wall=image.wall)


def quality_findings(image: Orthoimage, wall: Wall, cameras: Cameras | None) -> list[Finding]:
    """Compute the sharpness, and the shares of shown cells that are filled, stretched or smeared.

    Args:
        image: the orthoimage.
        wall: the wall, on the grid of the image.
        cameras: cameras of the photos; if None, stretched areas are not computed.
    """
    share = count_cells(image.mask, OrthoMask.FILLED) / max(1, n_shown(image))
    return [
        Finding(name="filled_share", value=share, unit="1", wall=image.wall),
        *sharpness_findings(OrthoimageGrey(image), image.wall),
        *stretch_findings(image, wall, cameras),
    ]


def sharpness_findings(image: GreyCells, wall: int) -> list[Finding]:
    """Compute the 10-90 % width of edges, and the frequency at which the MTF is one half.

    Profiles across the steepest edges between uniform areas are normalised and centred. Their
    median is the edge spread function, and the spectrum of its derivative is the MTF (ISO 12233).
    The result is empty if there are fewer than 20 such edges.

    Args:
        image: grey levels with a mask of valid cells.
        wall: index of the wall in the findings.
    """
    profiles = edge_profiles(image)
    if len(profiles) < _EDGES_LEAST:
        return []
    spread = np.median(profiles, axis=0)
    if spread[0] > _LOW or spread[-1] < _HIGH:
        return []
    return findings_of(
        [
            ("n_edges", len(profiles), "1"),
            ("edge_width_cells", _width_cells(spread), "cells"),
            ("mtf50_per_cell", _mtf50(spread), "cycles/cell"),
        ],
        wall,
    )


def stretch_findings(image: Orthoimage, wall: Wall, cameras: Cameras | None) -> list[Finding]:
    """Compute the shares of stretched and smeared cells; empty if there are no cameras.

    A cell is stretched (`stretch_share`) if a pixel of the photo covers more than two cells in some
    direction. It is smeared (`smear_share`) if a pixel covers more than five cells, or if the photo
    shows the surface from behind.

    Args:
        image: the orthoimage.
        wall: the wall, on the grid of the image.
        cameras: cameras of the photos.
    """
    if cameras is None:
        return []
    spread_cells = np.concatenate(
        [np.zeros(0), *(cells_per_pixel(image, wall, camera) for camera in _known(cameras))]
    )
    if not len(spread_cells):
        return []
    limits = {"stretch_share": _STRETCHED_CELLS, "smear_share": _SMEARED_CELLS}
    return findings_of(
        ((name, float(np.mean(spread_cells > most)), "1") for name, most in limits.items()),
        image.wall,
    )


def cells_per_pixel(
    image: Orthoimage, wall: Wall, camera: tuple[str, ViewingCamera]
) -> NDArray[np.float64]:
    """Return the number of cells that a pixel of a photo covers in its longest direction.

    Args:
        image: the orthoimage.
        wall: the wall, on the grid of the image.
        camera: name and camera of the photo.

    Returns:
        (n,) cells per pixel, for a sample of the cells that are coloured from the photo; infinite
        where the photo shows the surface from behind.
    """
    name, viewing = camera
    if name not in image.sources:
        return np.zeros(0)
    rows, columns = np.divmod(_asked_cells(image, wall, name), image.frame.width)
    # Use coordinates relative to the frame, because float64 loses precision with survey
    # coordinates.
    near = replace(image.frame, origin_world=np.zeros(3))
    moved = viewing.shifted(image.frame.origin_world)
    depth = wall.depth_m[rows, columns].astype(np.float64)
    places = np.column_stack([columns + 0.5, rows + 0.5])
    at = moved.project(near.world_from_wall(places, depth))[:, :2]
    along = [
        moved.project(_neighbours(near, wall, places, depth, step))[:, :2] - at
        for step in ((1, 0), (0, 1))
    ]
    jacobian = np.stack(along, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = 1.0 / np.linalg.svd(np.nan_to_num(jacobian), compute_uv=False)[:, 1]
        # If the photo shows the front of the surface, the determinant is positive.
        spread[np.linalg.det(jacobian) <= 0.0] = np.inf
    return spread[np.isfinite(jacobian).all(axis=(1, 2))]


def _asked_cells(image: Orthoimage, wall: Wall, name: str) -> NDArray[np.int64]:
    """Return every nth cell (row * width + column) that is coloured from the photo."""
    source, width = image.sources.index(name), image.frame.width

    def painted(rows: slice) -> NDArray[np.bool_]:
        is_own = is_painted(image.mask[rows])
        is_own &= (image.source[rows] == source) & np.isfinite(wall.depth_m[rows])
        return is_own

    bands = list(row_bands(image.mask.shape))
    counts = [int(np.count_nonzero(painted(rows))) for rows in bands]
    step, n_before, chosen = max(1, sum(counts) // _ASKED_MOST), 0, [np.zeros(0, dtype=np.int64)]
    for rows, count in zip(bands, counts, strict=True):
        cells = np.flatnonzero(painted(rows))
        chosen.append(rows.start * width + cells[-n_before % step :: step])
        n_before += count
    return np.concatenate(chosen)


def edge_profiles(cells: GreyCells) -> NDArray[np.float64]:
    """Return profiles (n, steps) across edges, from 0 on the dark side to 1 on the bright side."""
    from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

    # A tile of a few million cells contains enough edges.
    image = cells.fullest_part(TILE_CELLS)
    # The gradient of a single row or column is undefined.
    if not image.valid.any() or min(image.valid.shape) < 2:
        return np.zeros((0, PROFILE_PLACES.size))
    # Fill voids with the nearest value, so that they neither create edges nor distort profiles.
    grey = _closed(image)
    smooth = gaussian_filter(grey, 1.0)
    down, right = (np.asarray(part) for part in np.gradient(smooth))
    steep = np.hypot(down, right)
    peaks = image.valid & (steep == maximum_filter(steep, size=2 * _REACH_CELLS + 1))
    rows, columns = np.nonzero(peaks & (steep > 0.0))
    order = np.argsort(-steep[rows, columns], kind="stable")[:_PEAKS_MOST]
    rows, columns = rows[order], columns[order]
    length = steep[rows, columns][:, None]
    at = [
        rows[:, None] + PROFILE_PLACES * down[rows, columns][:, None] / length,
        columns[:, None] + PROFILE_PLACES * right[rows, columns][:, None] / length,
    ]
    whole = map_coordinates(image.valid.astype(np.float64), at, order=1, cval=0.0) > _WHOLE
    kept = np.flatnonzero(whole.all(axis=1))[:_EDGES_MOST]
    values = map_coordinates(grey, [part[kept] for part in at], order=3, mode="nearest")
    n_end = round(_END_CELLS / _STEP_CELLS)
    dark, bright = values[:, :n_end], values[:, -n_end:]
    low, high = dark.mean(axis=1), bright.mean(axis=1)
    contrast = np.maximum(high - low, 1e-9)
    even = np.maximum(np.ptp(dark, axis=1), np.ptp(bright, axis=1)) <= _EVEN_SHARE * contrast
    kept = even & (contrast >= _CONTRAST_GREY)
    scaled = (values[kept] - low[kept, None]) / contrast[kept, None]
    return _centred(scaled, PROFILE_PLACES)


def _closed(image: GreyImage) -> NDArray[np.float64]:
    """Return the grey levels, with void cells set to the level of the nearest valid cell."""
    from scipy.ndimage import distance_transform_edt

    grey = np.asarray(image.grey, dtype=np.float64)
    if image.valid.all():
        return grey
    nearest = np.asarray(
        distance_transform_edt(~image.valid, return_distances=False, return_indices=True)
    )
    closed: NDArray[np.float64] = grey[nearest[0], nearest[1]]
    return closed


def _centred(profiles: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift profiles so that their edges are centred."""
    # Compute the position of the edge from the area above the profile, so that it depends on all
    # samples and not only on the middle two.
    reach = along[-1]
    offset = reach - np.sum(profiles[:, :-1] + profiles[:, 1:], axis=1) * 0.5 * _STEP_CELLS
    moved = [
        np.interp(along + shift, along, profile)
        for profile, shift in zip(profiles, offset, strict=True)
    ]
    return np.array(moved).reshape(-1, len(along))


def _width_cells(spread: NDArray[np.float64]) -> float:
    """Return the 10-90 % width, in cells, of an edge spread function."""
    steps = np.arange(len(spread))
    above = int(np.argmax(spread >= _HIGH))
    below = int(np.flatnonzero(spread[: above + 1] <= _LOW)[-1])
    high = np.interp(_HIGH, spread[above - 1 : above + 1], steps[above - 1 : above + 1])
    low = np.interp(_LOW, spread[below : below + 2], steps[below : below + 2])
    return float(high - low) * _STEP_CELLS


def _mtf50(spread: NDArray[np.float64]) -> float:
    """Return the frequency in cycles per cell at which the MTF is one half."""
    slope = np.diff(spread)
    n_padded = 4096
    spectrum = np.abs(np.fft.rfft(slope, n_padded))
    contrast = spectrum / spectrum[0]
    frequency = np.fft.rfftfreq(n_padded, _STEP_CELLS)
    # If the edge is a step within one sample, the MTF is always above one half.
    place = int(np.argmax(contrast < 0.5)) or len(contrast) - 1
    return float(
        np.interp(-0.5, -contrast[place - 1 : place + 1], frequency[place - 1 : place + 1])
    )


def _known(cameras: Cameras) -> list[tuple[str, ViewingCamera]]:
    return [(item.photo, item.viewing()) for item in cameras.cameras if item.status == "ok"]


def _neighbours(
    frame: WallFrame,
    wall: Wall,
    places: NDArray[np.float64],
    depth: NDArray[np.float64],
    step: tuple[int, int],
) -> NDArray[np.float64]:
    """Return the surface points that are one `step` (column, row) away from the given cells.

    The surface is extrapolated with the smaller of the slopes on either side of the cell, since the
    larger one may be a depth step.
    """
    rows, columns = (places[:, 1] - 0.5).astype(np.int64), (places[:, 0] - 0.5).astype(np.int64)
    after = _depth_at(wall, rows + step[1], columns + step[0]) - depth
    before = depth - _depth_at(wall, rows - step[1], columns - step[0])
    with np.errstate(invalid="ignore"):
        is_after = np.isnan(before) | (np.abs(after) <= np.abs(before))
    slope = np.nan_to_num(np.where(is_after & ~np.isnan(after), after, before))
    return frame.world_from_wall(places + step, depth + slope)


def _depth_at(
    wall: Wall, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return depths (n,) of cells; NaN outside the wall."""
    height, width = wall.depth_m.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    found = np.full(len(rows), np.nan)
    found[inside] = wall.depth_m[rows[inside], columns[inside]]
    return found
