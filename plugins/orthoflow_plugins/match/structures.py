"""Structure of photos and walls: position and direction of edges, regardless of their sign.

Laser and camera use different wavelengths, so contrast may be weaker, missing or inverted,
depending on the material. Edges keep their position and their orientation (modulo 180 degrees).
Relief steps are also edges of the wall. A photo is compared with the wall at many scales. Nine
overlapping parts of the photo are correlated with the whole wall, and may be displaced slightly
relative to each other because of perspective. The score of a position is the sum of their
correlations. The lead of a scale is the difference between its best score and the median score of
all positions, relative to the spread of the scores. The scale with the largest lead is selected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.robust import NMAD_FACTOR
from orthoflow.products import Wall
from orthoflow_plugins.match.channels import Channels
from orthoflow_plugins.match.pictures import Spread, filled_smoothly, usual_spread

# Number of cells along the shorter side of a wall, unless its raster is coarser.
_CELLS: Final = 200.0
# Range of scales, as multiples of the shorter side of the wall: the minimum length of the longer
# side of the photo on the wall, and the maximum length of the photo's shorter side.
_SIZES: Final = (0.2, 1.6)
_STEP: Final = 1.1
_MAX_PART_CELLS: Final = 250
_MIN_PART_CELLS: Final = 16
# Maximum shift of a part, relative to the width of the photo.
_SLIP_SHARE: Final = 0.03
# A relief step of this height has the same weight as a step from black to white.
_STEP_M: Final = 0.5
_MIN_KNOWN: Final = 0.8
_NOISE_SIGMA_CELLS: Final = 1.0
_EVEN_SIGMA_CELLS: Final = 12.0
_POOL_SIGMA_CELLS: Final = 1.5
_BROAD_SIGMA_CELLS: Final = 15.0
_STRONGEST: Final = 3.0
# This energy limit prevents high scores for parts that hardly overlap the wall.
_MIN_ENERGY: Final = 0.25
# Two positions are distinct if their distance is at least the first of these shares of the width of
# the photo, or if the logarithms of their scales differ by at least the second value.
_ELSEWHERE: Final = (0.25, 0.25)
# Maximum number of cells along the longer side of a photo; larger photos are compared in cells that
# are two or four times as wide.
_PHOTO_CELLS: Final = 250
# Channels are so smooth that every second cell is enough.
_SAMPLE_CELLS: Final = 2
_LEVELS: Final = 3
PHOTO_SIDE_PX: Final = 2 * _MAX_PART_CELLS
"""Longer side to which photos are reduced first; no scale needs more pixels."""


@dataclass(frozen=True, kw_only=True)
class WallStructure:
    """The structure of a wall, prepared for correlation.

    Attributes:
        wall: the wall with coarse cells.
        channels: structure of the wall.
        levels: spectra of the structure at one, two and four times the cell size.
        spread: result of `usual_spread` for the wall.
    """

    wall: Wall
    channels: Channels
    levels: Sequence[Spectra]
    spread: Spread


@dataclass(frozen=True, kw_only=True)
class Spectra:
    """Fourier transforms of the structure of a wall.

    Attributes:
        layers: (c, ...) complex64 conjugate transforms of the channels.
        energy: complex64 transform of the sum of the squared channels.
        shape: number of rows and columns of samples.
        padded: number of rows and columns including the padding that prevents wraparound.
        sample_m: width of a sample in metres.
    """

    layers: NDArray[np.complex64]
    energy: NDArray[np.complex64]
    shape: tuple[int, int]
    padded: tuple[int, int]
    sample_m: float


@dataclass(frozen=True, kw_only=True)
class Place:
    """A possible position of a photo on a wall.

    Attributes:
        centre_m: (2,) float64 centre of the photo, in metres to the right and down from the corner
            of the raster.
        width_m: approximate width of the photo on the wall.
        lead: score of the position minus the median score of all positions at this scale, in robust
            standard deviations.
        parts_photo: (9, 2) float64 centres of the nine parts of the photo, relative to its width
            and height.
        parts_m: (9, 2) float64 positions of the parts on the wall, as in `centre_m`.
    """

    centre_m: NDArray[np.float64]
    width_m: float
    lead: float
    parts_photo: NDArray[np.float64]
    parts_m: NDArray[np.float64]


def wall_structure(wall: Wall) -> WallStructure | None:
    """Compute the structure of a wall; None if it has no intensity or is too small."""
    if wall.intensity is None or not np.isfinite(wall.intensity).any():
        return None
    factor = max(1, round(min(wall.frame.shape) / _CELLS))
    coarse = _coarser(wall, factor)
    if min(coarse.frame.shape) < 2 * _MIN_PART_CELLS or coarse.intensity is None:
        return None
    channels = _wall_channels(coarse.intensity, coarse.depth_m)
    levels = [(channels, coarse.frame.gsd_m)]
    intensity, depth_m = coarse.intensity, coarse.depth_m
    for _ in range(1, _LEVELS):
        # Use the mean of four intensities; use the first of four depths if most of them are known.
        known = _halved(np.isfinite(depth_m)) >= _MIN_KNOWN
        rows, columns = known.shape
        depth_m = np.where(known, depth_m[: 2 * rows : 2, : 2 * columns : 2], np.float32(np.nan))
        intensity = _halved(intensity)
        levels.append((_wall_channels(intensity, depth_m), 2.0 * levels[-1][1]))
    return WallStructure(
        wall=coarse,
        channels=channels,
        levels=[_spectra(*level) for level in levels],
        spread=usual_spread(coarse),
    )


def _wall_channels(intensity: NDArray[np.float32], depth_m: NDArray[np.float32]) -> Channels:
    relief = depth_m / np.float32(_STEP_M)
    known = np.isfinite(depth_m) & np.isfinite(intensity)
    return structure_of(np.stack([intensity, relief], axis=-1), known)


def _halved(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the means (rows, cols, ...) of 2 x 2 values; an odd last row or column is dropped."""
    import cv2

    rows, columns = (length // 2 for length in values.shape[:2])
    even = np.ascontiguousarray(values[: 2 * rows, : 2 * columns], dtype=np.float32)
    return np.asarray(
        cv2.resize(even, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.float32
    )


def _spectra(channels: Channels, cell_m: float) -> Spectra:
    from scipy import fft

    layers = _samples(channels)
    energy = np.einsum("cij,cij->ij", layers, layers)
    photo = _PHOTO_CELLS // _SAMPLE_CELLS
    most = photo // 2 + 2 * _slip(photo) + 1
    rows, columns = (int(fft.next_fast_len(length + most, real=True)) for length in energy.shape)
    spectra = _spectrum(layers, (rows, columns))
    return Spectra(
        layers=np.conj(spectra, out=spectra),
        energy=_spectrum(energy[None], (rows, columns))[0],
        shape=(energy.shape[0], energy.shape[1]),
        padded=(rows, columns),
        sample_m=_SAMPLE_CELLS * cell_m,
    )


def _samples(channels: Channels) -> NDArray[np.float32]:
    """Return layers (c, rows, cols) at half the resolution."""
    return np.ascontiguousarray(np.moveaxis(_halved(channels.values), -1, 0))


def _slip(width: int) -> int:
    return max(1, int(_SLIP_SHARE * width))


def structure_of(layers: NDArray[np.float32], known: NDArray[np.bool_]) -> Channels:
    """Return the structure of a picture (rows, cols, layers) with known cells (rows, cols)."""
    import cv2

    soft = []
    for layer in np.moveaxis(layers, 2, 0):
        filled = filled_smoothly(np.where(known, layer, np.float32(np.nan)))
        blurred = cv2.GaussianBlur(filled, (0, 0), _NOISE_SIGMA_CELLS)
        soft.append(np.asarray(blurred, dtype=np.float32))
    safe = cv2.erode(known.astype(np.uint8), np.ones((3, 3), dtype=np.uint8)).astype(np.float32)
    values = np.moveaxis(_channels(soft, safe), 0, -1)
    return Channels(values=np.ascontiguousarray(values), known=safe)


def _coarser(wall: Wall, factor: int) -> Wall:
    """Join factor x factor cells of a wall; use their mean intensity (0..1) and one depth."""
    import cv2

    assert wall.intensity is not None  # noqa: S101 - checked before
    height, width = (max(1, length // factor) for length in wall.frame.shape)
    known = np.isfinite(wall.depth_m) & np.isfinite(wall.intensity)
    low, high = np.percentile(wall.intensity[np.isfinite(wall.intensity)], (1.0, 99.0))
    scaled = np.clip((wall.intensity - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    grey = np.rint(255.0 * filled_smoothly(np.where(known, scaled, np.nan))).astype(np.uint8)
    # Each cell contains only a few scan points, and their speckle is not structure.
    grey = np.asarray(cv2.medianBlur(grey, 3), dtype=np.uint8)
    cells = (slice(0, height * factor), slice(0, width * factor))

    def mean(values: NDArray[np.generic]) -> NDArray[np.float32]:
        part = values[cells].astype(np.float32)
        return np.asarray(
            cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32
        )

    one = slice(factor // 2, None, factor)
    depth = wall.depth_m[one, one][:height, :width].copy()
    depth[mean(known) < _MIN_KNOWN] = np.nan
    return replace(
        wall,
        frame=replace(wall.frame, gsd_m=wall.frame.gsd_m * factor, width=width, height=height),
        depth_m=depth,
        sigma_m=wall.sigma_m[one, one][:height, :width].copy(),
        count=wall.count[one, one][:height, :width].copy(),
        mask=wall.mask[one, one][:height, :width].copy(),
        intensity=mean(grey) / np.float32(255.0),
        rgb=None,
        rgb_mask=None,
        percentiles_m=None,
    )


def likely_places(rgb: NDArray[np.uint8], wall: WallStructure, *, n_most: int) -> list[Place]:
    """Return possible positions of a photo on a wall, starting with the most likely.

    Args:
        rgb: (height, width, 3) colours of the photo, upright to within about 9 degrees.
        wall: the wall.
        n_most: maximum number of positions.
    """
    found = []
    for width in _widths_cells(rgb.shape, wall.wall.frame.shape):
        longer = width * max(1.0, rgb.shape[0] / rgb.shape[1])
        level = max(0, math.ceil(math.log2(longer / _PHOTO_CELLS)))
        found.append(_best_at(rgb, width / 2**level, wall.levels[level]))
    places: list[Place] = []
    for place in sorted(found, key=lambda each: -each.lead):
        if len(places) < n_most and all(_is_elsewhere(place, other) for other in places):
            places.append(place)
    return places


def _widths_cells(photo: Sequence[int], wall: tuple[int, ...]) -> list[int]:
    height, width = photo[0], photo[1]
    least = _SIZES[0] * min(wall) * width / max(height, width)
    # Each part is half as wide and high as the photo.
    most = min(
        _SIZES[1] * min(wall) * width / min(height, width),
        2.0 * (_MAX_PART_CELLS - 1) * width / max(height, width),
    )
    least = max(least, 2.0 * _MIN_PART_CELLS * width / min(height, width))
    count = max(0, math.floor(math.log(max(most / least, 1e-9)) / math.log(_STEP)) + 1)
    return [round(least * _STEP**nth) for nth in range(count)]


def _best_at(rgb: NDArray[np.uint8], width_cells: float, wall: Spectra) -> Place:
    """Return the best position of a photo with a given width in cells."""
    import cv2
    from scipy import fft

    # Round the size to a multiple of the sample size.
    width, height = (
        max(2, round(length / _SAMPLE_CELLS))
        for length in (width_cells, width_cells * rgb.shape[0] / rgb.shape[1])
    )
    size = (_SAMPLE_CELLS * width, _SAMPLE_CELLS * height)
    picture = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    known = np.ones(picture.shape[:2], dtype=np.bool_)
    channels = _samples(structure_of(picture / np.float32(255.0), known))
    side = (height // 2, width // 2)
    slip = _slip(width)
    corners = [
        (top, left)
        for top in (0, (height - side[0]) // 2, height - side[0])
        for left in (0, (width - side[1]) // 2, width - side[1])
    ]
    # Energy of the wall within a part of the photo, for each position of the corner of the part
    # (positions wrap around). It is the same for all parts, because these have the same size.
    box = _spectrum(np.ones((1, *side), dtype=np.float32), wall.padded)[0]
    under = np.asarray(fft.irfft2(wall.energy * np.conj(box), wall.padded), dtype=np.float32)
    maps = [
        _part_map(channels[:, top : top + side[0], left : left + side[1]], under, wall)
        for top, left in corners
    ]
    # Corner positions for which the centre of the photo is on the wall.
    rows, columns = (
        np.arange(n) - m // 2 for n, m in zip(wall.shape, (height, width), strict=True)
    )
    kernel = np.ones((2 * slip + 1, 2 * slip + 1), dtype=np.uint8)
    scores = np.zeros(wall.shape, dtype=np.float32)
    for part, (top, left) in zip(maps, corners, strict=True):
        at = np.ix_((rows + top) % wall.padded[0], (columns + left) % wall.padded[1])
        scores += cv2.dilate(part, kernel)[at]
    usual = float(np.median(scores))
    spread = NMAD_FACTOR * float(np.median(np.abs(scores - usual)))
    row, column = np.unravel_index(int(scores.argmax()), scores.shape)
    best = (int(rows[row]), int(columns[column]))
    half = 0.5 * np.array([side[1], side[0]])
    found = np.array(
        [
            _slipped(part, (best[0] + corner[0], best[1] + corner[1]), slip) + half
            for part, corner in zip(maps, corners, strict=True)
        ]
    )
    middles = np.array([[left, top] for top, left in corners]) + half
    return Place(
        centre_m=wall.sample_m * (np.array([best[1], best[0]]) + 0.5 * np.array([width, height])),
        width_m=wall.sample_m * width,
        lead=(float(scores.max()) - usual) / max(spread, 1e-9),
        parts_photo=middles / [width, height],
        parts_m=wall.sample_m * found,
    )


def _part_map(
    part: NDArray[np.float32], under: NDArray[np.float32], wall: Spectra
) -> NDArray[np.float32]:
    """Correlate a part of a photo with the wall at each (wrapped) position of its corner."""
    from scipy import fft

    own = float(np.einsum("cij,cij->", part, part))
    spectra = _spectrum(part, wall.padded)
    spectrum = np.multiply(spectra, wall.layers, out=spectra).sum(axis=0)
    cross = fft.irfft2(np.conj(spectrum, out=spectrum), wall.padded)
    norm = np.sqrt(max(own, 1e-9) * np.maximum(under, max(_MIN_ENERGY * own, 1e-9)))
    return np.asarray(cross / norm, dtype=np.float32)


def _spectrum(layers: NDArray[np.float32], padded: tuple[int, int]) -> NDArray[np.complex64]:
    """Transform layers (c, rows, cols) with padding; transforms along rows skip padding rows."""
    from scipy import fft

    along = fft.rfft(layers, padded[1], axis=2)
    return np.asarray(fft.fft(along, padded[0], axis=1, overwrite_x=True), dtype=np.complex64)


def _slipped(part: NDArray[np.float32], at: tuple[int, int], slip: int) -> NDArray[np.float64]:
    """Return the best position (column, row) of the corner of a part within `slip` of `at`."""
    steps = np.arange(-slip, slip + 1)
    rows, columns = at[0] + steps, at[1] + steps
    near = part[np.ix_(rows % part.shape[0], columns % part.shape[1])]
    row, column = np.unravel_index(int(near.argmax()), near.shape)
    return np.array([columns[column], rows[row]], dtype=np.float64)


def _is_elsewhere(place: Place, other: Place) -> bool:
    apart_m = float(np.hypot(*(place.centre_m - other.centre_m)))
    return (
        apart_m > _ELSEWHERE[0] * other.width_m
        or abs(math.log(place.width_m / other.width_m)) > _ELSEWHERE[1]
    )


def _channels(
    layers: Sequence[NDArray[np.float32]], known: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return channels (5, rows, cols) that describe the orientation of edges in all layers.

    The channels are the strength of the gradient, and the cosine and sine of twice and four times
    its angle, weighted by the strength and normalised locally. They are the first terms of the
    Fourier series of a histogram of orientations modulo 180 degrees.
    """
    import cv2

    def blurred(values: NDArray[np.floating], sigma: float) -> NDArray[np.float32]:
        single = np.ascontiguousarray(values, dtype=np.float32)
        return np.asarray(cv2.GaussianBlur(single, (0, 0), sigma), dtype=np.float32)

    squared = np.zeros(known.shape, dtype=np.complex64)
    for layer in layers:
        across = cv2.Scharr(layer, cv2.CV_32F, 1, 0)
        down = cv2.Scharr(layer, cv2.CV_32F, 0, 1)
        squared += (across + 1j * down) ** 2
    size = np.abs(squared)
    doubled = squared / np.maximum(size, 1e-20)
    strength = np.sqrt(size) * known
    local = blurred(strength, _EVEN_SIGMA_CELLS)
    local /= np.maximum(blurred(known, _EVEN_SIGMA_CELLS), 1e-3)
    floor = 0.2 * float(np.median(local[known > 0.0])) if (known > 0.0).any() else 1.0
    strength = np.minimum(strength / (local + max(floor, 1e-9)), _STRONGEST) * known
    fourfold = doubled * doubled
    share = np.maximum(blurred(known, _BROAD_SIGMA_CELLS), 1e-3)
    values = []
    for part in (doubled.real, doubled.imag, fourfold.real, fourfold.imag, np.ones_like(known)):
        pooled = blurred(part * strength, _POOL_SIGMA_CELLS)
        values.append((pooled - blurred(pooled * known, _BROAD_SIGMA_CELLS) / share) * known)
    channels = np.stack(values)
    length = np.sqrt(np.einsum("cij,cij->ij", channels, channels))
    usual = float(np.median(length[known > 0.0])) if (known > 0.0).any() else 1.0
    return np.asarray(channels / (length + 0.3 * usual + 1e-9), dtype=np.float32)
