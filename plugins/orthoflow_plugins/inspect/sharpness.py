"""How sharp an image is, told from its own edges: their width, and the MTF that they imply."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import Finding
from orthoflow_plugins.inspect.matching import GreyImage

_REACH_CELLS: Final = 8
_STEP_CELLS: Final = 0.25
_ALONG: Final = np.arange(-_REACH_CELLS, _REACH_CELLS + 0.5 * _STEP_CELLS, _STEP_CELLS)
_PEAKS_MOST: Final = 4000
_EDGES_MOST: Final = 400
# Between valid cells only, but for rounding.
_WHOLE: Final = 0.999
_TILE_CELLS: Final = 2048
_EDGES_LEAST: Final = 20
_CONTRAST_GREY: Final = 30.0
# Either side of an edge must be this even, as a share of its contrast.
_EVEN_SHARE: Final = 0.15
_END_CELLS: Final = 3.0
_LOW, _HIGH = 0.1, 0.9


def sharpness_findings(image: GreyImage, wall: int) -> list[Finding]:
    """Width of edges from 10 to 90 %, and the frequency at which contrast is halved.

    Profiles across the steepest places that have an even side each are brought to one contrast and
    their middle; the median profile is the edge spread, its derivative's spectrum the MTF (ISO
    12233). Nothing where there are fewer than 20 such edges.

    Args:
        image: grey levels, and cells that count.
        wall: of the findings.
    """
    profiles = _edge_profiles(image)
    if len(profiles) < _EDGES_LEAST:
        return []
    spread = np.median(profiles, axis=0)
    if spread[0] > _LOW or spread[-1] < _HIGH:
        return []
    numbers = [
        ("n_edges", float(len(profiles)), "1"),
        ("edge_width_cells", _width_cells(spread), "cells"),
        ("mtf50_per_cell", _mtf50(spread), "cycles/cell"),
    ]
    return [Finding(name=name, value=value, unit=unit, wall=wall) for name, value, unit in numbers]


def _edge_profiles(image: GreyImage) -> NDArray[np.float64]:
    """Profiles (n, steps) across edges, 0 on the dark side and 1 on the bright one."""
    from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

    # A few million cells have edges enough.
    image = image.fullest_part(_TILE_CELLS)
    if not image.valid.any():
        return np.zeros((0, _ALONG.size))
    # Voids go on as what is nearest: neither do they make edges, nor do they ring into profiles.
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
        rows[:, None] + _ALONG * down[rows, columns][:, None] / length,
        columns[:, None] + _ALONG * right[rows, columns][:, None] / length,
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
    return _centred(scaled, _ALONG)


def _closed(image: GreyImage) -> NDArray[np.float64]:
    """Grey levels where every void cell has that of the nearest valid one."""
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
    """Profiles moved so that their middle lies in the middle."""
    # The area above an edge tells its place with all samples, not with the two at the middle.
    reach = along[-1]
    offset = reach - np.sum(profiles[:, :-1] + profiles[:, 1:], axis=1) * 0.5 * _STEP_CELLS
    moved = [
        np.interp(along + shift, along, profile)
        for profile, shift in zip(profiles, offset, strict=True)
    ]
    return np.array(moved).reshape(-1, len(along))


def _width_cells(spread: NDArray[np.float64]) -> float:
    """Distance between where the spread first passes 90 % and last was below 10 %."""
    steps = np.arange(len(spread))
    above = int(np.argmax(spread >= _HIGH))
    below = int(np.flatnonzero(spread[: above + 1] <= _LOW)[-1])
    high = np.interp(_HIGH, spread[above - 1 : above + 1], steps[above - 1 : above + 1])
    low = np.interp(_LOW, spread[below : below + 2], steps[below : below + 2])
    return float(high - low) * _STEP_CELLS


def _mtf50(spread: NDArray[np.float64]) -> float:
    """Frequency in cycles per cell at which the spectrum of the slope is half of its start."""
    slope = np.diff(spread)
    n_padded = 4096
    spectrum = np.abs(np.fft.rfft(slope, n_padded))
    contrast = spectrum / spectrum[0]
    frequency = np.fft.rfftfreq(n_padded, _STEP_CELLS)
    # A step within one sample never halves below the last frequency.
    place = int(np.argmax(contrast < 0.5)) or len(contrast) - 1
    return float(
        np.interp(-0.5, -contrast[place - 1 : place + 1], frequency[place - 1 : place + 1])
    )
