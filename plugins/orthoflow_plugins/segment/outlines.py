"""Polygonal outlines of areas of cells, their accuracy, and alignment with image edges."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.frames import signed_area
from orthoflow.geometry.robust import median_deviation
from orthoflow_plugins.segment.areas import Area, Relief

# Corners closer than this to the line between neighbouring corners are caused by the grid and
# noise.
_STRAIGHT_CELLS: Final = 2.0
# After lines have been fitted, two sides are joined if the corner between them deviates by at most
# this from a straight line.
_JOINED_CELLS: Final = 1.0
# Lines are fitted only to sides longer than this, and no corner is moved by more than this.
_FITTED_CELLS: Final = 8.0
# Sides that meet at a smaller angle than this are not intersected; the corner between them is kept.
_TURN_LEAST: Final = math.sin(math.radians(15.0))
# Length at each end of a side that is part of the corner and not used in the fit.
_ENDS_CELLS: Final = 3.0
# Cells whose deviation exceeds this multiple of the median deviation are rejected.
_FAR_CELLS: Final = 3.0
# Distances from a side, outwards, at which the wall's face is searched for.
_BESIDE_CELLS: Final = (2.0, 3.0, 4.0)
# A side is considered measured if the face was found along at least this share of it.
_BESIDE_LEAST: Final = 0.5
# Standard deviation of a uniform distribution in an interval of length 1.
_UNIFORM: Final = 1.0 / math.sqrt(12.0)
# A cell that the border crosses may be on either side of it, so the border is uncertain by two
# cells.
_BORDER_CELLS: Final = 2.0

_LONG_CELLS: Final = 20.0
_PROFILE_ENDS_CELLS: Final = 4.0
# Profiles extend this far to the inside and outside of an outline.
_REACH_CELLS: Final = 4.0
# Sampling interval of the profiles.
_STEP_CELLS: Final = 0.25
# Number of pieces into which a side is divided.
_PIECES: Final = 5
# Minimum number of pieces in which the edge must be found.
_PIECES_LEAST: Final = 4
# Minimum slope of an edge in grey levels per cell; weaker edges are stains.
_CONTRAST_LEAST_GREY: Final = 4.0
# Minimum ratio of the slope of an edge to the median slope.
_CONTRAST_LEAST: Final = 3.0
# Slopes that are at least this share of the steepest slope belong to the edge.
_EDGE_SHARE: Final = 0.2
# Minimum standard deviation of an edge. Errors of the depths also affect edges in the orthoimage,
# because it was computed with these depths.
_SIGMA_LEAST_CELLS: Final = 0.5
# An edge in the orthoimage does not correspond to the edge in depth if the distance between the two
# exceeds this number of standard deviations of the edge in depth.
_APART_SIGMAS: Final = 1.5
# The edge is ambiguous if the slope of another edge in the profile exceeds this share of the
# steepest slope.
_SECOND_MOST: Final = 0.6
_PARALLEL: Final = 0.26


@dataclass(frozen=True, kw_only=True)
class Outline:
    """An outline, in cells of the relief.

    Attributes:
        corners: (n, 2) column and row, counter-clockwise for the viewer; the centre of the first
            cell is at (0.5, 0.5).
        sigma: (n,) standard deviation of each side in the perpendicular direction, in cells; side i
            begins at corner i.
        seen_share: (n,) share of each side along which the wall's face was measured.
    """

    corners: NDArray[np.float64]
    sigma: NDArray[np.float64]
    seen_share: NDArray[np.float64]

    @property
    def lengths(self) -> NDArray[np.float64]:
        """Lengths (n,) of the sides in cells."""
        ways = np.roll(self.corners, -1, axis=0) - self.corners
        return np.asarray(np.hypot(ways[:, 0], ways[:, 1]))

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """Mask (n,) of the sides along which the wall was measured."""
        return self.seen_share >= _BESIDE_LEAST

    @property
    def seen_of_all(self) -> float:
        """Share of the total length of the outline along which the wall was measured."""
        return float(self.lengths @ self.seen_share / self.lengths.sum())


def outline_of(area: Area, relief: Relief, spacing_m: float) -> Outline | None:
    """Return the outline of an area; None if fewer than three sides remain.

    Args:
        area: the area.
        relief: the relief in which it was found.
        spacing_m: point spacing of the scan, in metres; the border may be anywhere between two
            points.
    """
    ring = _ring(area.cells)
    kept = _corner_places(ring)
    sides = _without_short_cuts(
        [_side(ring, int(kept[k]), int(kept[(k + 1) % len(kept)])) for k in range(len(kept))]
    )
    sides = _joined(ring, sides)
    if len(sides) < 3:
        return None
    corners = _corners(sides) + np.array([area.corner[1], area.corner[0]], dtype=np.float64)
    rows, columns = relief.is_face.shape
    corners = np.clip(corners, 0.0, [columns, rows])
    spacing = spacing_m / relief.gsd_m
    sigma = np.array([_sigma(side, spacing) for side in sides])
    return Outline(corners=corners, sigma=sigma, seen_share=_seen_shares(corners, relief.is_face))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Side:
    """A part of a ring, given by the indices of its ends, and the line fitted to the part.

    `middle` and `direction` are None if the part is too short to fit a line.
    """

    first: int
    last: int
    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    scatter: float
    middle: NDArray[np.float64] | None = None
    direction: NDArray[np.float64] | None = None

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.end - self.begin))


def _ring(cells: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return midpoints (n, 2) of cell sides on the border, counter-clockwise for the viewer."""
    from orthoflow.files.polygons import outlines

    found = outlines(cells.astype(np.int16) - 1)
    if len(found) != 1:
        raise MethodError(f"an area of cells must be connected, got {len(found)} parts")
    ring = found[0][1][0][:-1]
    ways = np.roll(ring, -1, axis=0) - ring
    steps = np.rint(np.abs(ways).sum(axis=1)).astype(np.int64)
    along = np.concatenate([np.arange(count) + 0.5 for count in steps])
    unit = ways / steps[:, None]
    middles = np.repeat(ring, steps, axis=0) + along[:, None] * np.repeat(unit, steps, axis=0)
    # Row numbers increase downwards, so a positive area means clockwise for the viewer.
    return np.asarray(middles[::-1] if signed_area(middles) > 0.0 else middles, dtype=np.float64)


def _corner_places(ring: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the indices of the corners of a ring (Douglas-Peucker algorithm)."""
    import cv2

    # Doubled coordinates are integers, so the corners can be found exactly.
    doubled = np.rint(2.0 * ring).astype(np.int32)
    simple = cv2.approxPolyDP(doubled[:, None, :], 2.0 * _STRAIGHT_CELLS, closed=True)[:, 0]
    place_of = {(int(x), int(y)): place for place, (x, y) in enumerate(doubled)}
    kept = sorted(place_of[(int(x), int(y))] for x, y in simple)
    # The algorithm always keeps its starting point, which may not be a corner.
    for place in list(kept):
        at = kept.index(place)
        before, after = ring[kept[at - 1]], ring[kept[(at + 1) % len(kept)]]
        way = after - before
        to = ring[place] - before
        length = max(float(np.linalg.norm(way)), 1e-9)
        off = abs(float(way[0] * to[1] - way[1] * to[0])) / length
        if len(kept) > 3 and off <= _STRAIGHT_CELLS:
            kept.remove(place)
    return np.array(kept, dtype=np.int64)


def _without_short_cuts(sides: list[_Side]) -> list[_Side]:
    """Remove short sides that only cut off the corner at which the adjoining sides meet."""
    kept = list(sides)
    for side in sides:
        at = kept.index(side)
        before, after = kept[at - 1], kept[(at + 1) % len(kept)]
        met = _meeting(before, after)
        if len(kept) > 3 and side.middle is None and met is not None:
            reach = max(np.linalg.norm(met - side.begin), np.linalg.norm(met - side.end))
            if reach <= _FITTED_CELLS:
                kept.pop(at)
    return kept


def _side(ring: NDArray[np.float64], first: int, last: int) -> _Side:
    """Fit a line to the midpoints between two corners, rejecting outliers."""
    along = ring[first : last + 1] if first <= last else np.vstack([ring[first:], ring[: last + 1]])
    begin, end = along[0], along[-1]
    length = float(np.linalg.norm(end - begin))
    direct = (end - begin) / max(length, 1e-9)
    place = (along - along[0]) @ direct
    ends = min(_ENDS_CELLS, 0.25 * length)
    inner = along[(place >= ends) & (place <= length - ends)]
    if length < _FITTED_CELLS or len(inner) < _FITTED_CELLS / 2:
        return _Side(first=first, last=last, begin=begin, end=end, scatter=_STRAIGHT_CELLS)
    for _ in range(3):
        middle = inner.mean(axis=0)
        _, _, rows = np.linalg.svd(inner - middle, full_matrices=False)
        across = np.array([-rows[0, 1], rows[0, 0]])
        off = np.abs((inner - middle) @ across)
        kept = off <= max(_FAR_CELLS * median_deviation(off), 0.75)
        if kept.all() or np.count_nonzero(kept) < _FITTED_CELLS / 2:
            break
        inner = inner[kept]
    scatter = float(np.sqrt(np.mean(((inner - inner.mean(axis=0)) @ across) ** 2)))
    return _Side(
        first=first,
        last=last,
        begin=begin,
        end=end,
        scatter=scatter,
        middle=inner.mean(axis=0),
        direction=np.array([across[1], -across[0]]),
    )


def _joined(ring: NDArray[np.float64], sides: list[_Side]) -> list[_Side]:
    joined = list(sides)
    while len(joined) > 3:
        corners = _corners(joined)
        before, after = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
        ways, to = after - before, corners - before
        area = np.abs(ways[:, 0] * to[:, 1] - ways[:, 1] * to[:, 0])
        off = area / np.maximum(np.hypot(ways[:, 0], ways[:, 1]), 1e-9)
        at = int(off.argmin())
        if off[at] > _JOINED_CELLS:
            break
        side = _side(ring, joined[at - 1].first, joined[at].last)
        joined[at] = side
        joined.pop(at - 1)
    return joined


def _corners(sides: list[_Side]) -> NDArray[np.float64]:
    return np.array([_corner(sides[k - 1], sides[k]) for k in range(len(sides))])


def _corner(before: _Side, after: _Side) -> NDArray[np.float64]:
    """Return the intersection of two sides, or the original corner if it is too far away."""
    met = _meeting(before, after)
    if met is not None and np.linalg.norm(met - after.begin) <= _FITTED_CELLS:
        return met
    for side in (after, before):
        if side.middle is not None and side.direction is not None:
            return side.middle + ((after.begin - side.middle) @ side.direction) * side.direction
    return after.begin


def _meeting(first: _Side, second: _Side) -> NDArray[np.float64] | None:
    if first.middle is None or second.middle is None:
        return None
    if first.direction is None or second.direction is None:
        return None
    matrix = np.column_stack([first.direction, -second.direction])
    if abs(float(np.linalg.det(matrix))) < _TURN_LEAST:
        return None
    share = np.linalg.solve(matrix, second.middle - first.middle)
    met: NDArray[np.float64] = first.middle + share[0] * first.direction
    return met


def _sigma(side: _Side, spacing: float) -> float:
    scatter = side.scatter
    if side.middle is not None:
        scatter /= math.sqrt(max(1.0, side.length / spacing))
    return math.hypot(_BORDER_CELLS * _UNIFORM, spacing * _UNIFORM, scatter)


def _seen_shares(corners: NDArray[np.float64], is_face: NDArray[np.bool_]) -> NDArray[np.float64]:
    rows, columns = is_face.shape
    shares = np.zeros(len(corners))
    for k, (begin, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        way = end - begin
        length = float(np.linalg.norm(way))
        if length <= 0.0:
            continue
        # The outline is counter-clockwise for the viewer, so the outside is to the right.
        outwards = np.array([-way[1], way[0]]) / length
        at = begin + ((np.arange(math.ceil(length)) + 0.5) / math.ceil(length))[:, None] * way
        found = np.zeros(len(at), dtype=np.bool_)
        for aside in _BESIDE_CELLS:
            cells = np.floor(at + aside * outwards).astype(np.int64)
            inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=1)
            found[inside] |= is_face[cells[inside, 1], cells[inside, 0]]
        shares[k] = found.mean()
    return shares


def moved_to_edges(
    outline: Outline, grey: NDArray[np.float32]
) -> tuple[Outline, NDArray[np.bool_]]:
    """Move each long, measured side to the corresponding edge of an image, if this is unambiguous.

    Args:
        outline: the outline; cells are pixels of the image.
        grey: (rows, cols) grey values 0..255, NaN where unknown.

    Returns:
        The outline, and a mask (n,) of the sides that were moved.
    """
    count = len(outline.corners)
    shifts, sigma = np.zeros(count), outline.sigma.copy()
    by_image = np.zeros(count, dtype=np.bool_)
    for side in np.flatnonzero(outline.is_seen & (outline.lengths >= _LONG_CELLS)):
        begin, end = outline.corners[side], outline.corners[(side + 1) % count]
        found = _edge(grey, begin, end)
        if found is None or found[1] >= sigma[side]:
            continue
        if abs(found[0]) > _APART_SIGMAS * sigma[side]:
            continue
        shifts[side], sigma[side] = found
        by_image[side] = True
    return replace(outline, corners=_shifted(outline.corners, shifts), sigma=sigma), by_image


def _edge(
    grey: NDArray[np.float32], begin: NDArray[np.float64], end: NDArray[np.float64]
) -> tuple[float, float] | None:
    """Return the outward distance from a side to its image edge, and the sigma, in cells."""
    import cv2

    way = end - begin
    length = float(np.linalg.norm(way))
    along = way / length
    outwards = np.array([-along[1], along[0]])
    offsets = np.arange(-_REACH_CELLS, _REACH_CELLS + _STEP_CELLS / 2, _STEP_CELLS)
    places = np.arange(_PROFILE_ENDS_CELLS, length - _PROFILE_ENDS_CELLS, 0.5)
    at = begin + places[:, None, None] * along + offsets[None, :, None] * outwards
    x, y = (np.ascontiguousarray(at[..., axis] - 0.5, dtype=np.float32) for axis in range(2))
    profiles = np.asarray(cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderValue=(np.nan,)))
    kept = profiles[np.isfinite(profiles).all(axis=1)].astype(np.float64)
    if len(kept) < 0.5 * len(profiles) or len(kept) < 2 * _PIECES:
        return None
    whole = _slopes(kept)
    peak = int(np.abs(whole).argmax())
    size = abs(float(whole[peak]))
    if size < max(_CONTRAST_LEAST_GREY, _CONTRAST_LEAST * float(np.median(np.abs(whole)))):
        return None
    around = round(1.0 / _STEP_CELLS)
    others = np.concatenate([whole[: max(0, peak - around)], whole[peak + around + 1 :]])
    if np.abs(others).max(initial=0.0) > _SECOND_MOST * size:
        return None
    found = []
    for piece in np.array_split(kept, _PIECES):
        slopes = np.sign(whole[peak]) * _slopes(piece)
        top = int(slopes.argmax())
        if slopes[top] >= 0.5 * size and 0 < top < len(slopes) - 1:
            found.append(_STEP_CELLS * _middle(slopes, top))
    if len(found) < _PIECES_LEAST:
        return None
    # The position of a slope is the middle of the cell over which it is computed.
    place = float(np.median(found)) - _REACH_CELLS + 0.5
    spread = float(np.std(found, ddof=1)) / np.sqrt(len(found))
    return place, float(np.hypot(_SIGMA_LEAST_CELLS, spread))


def _slopes(profiles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the changes of the mean profile over one cell, valid at the middle of the cell."""
    mean = profiles.mean(axis=0)
    apart = round(1.0 / _STEP_CELLS)
    slopes: NDArray[np.float64] = mean[apart:] - mean[:-apart]
    return slopes


def _middle(slopes: NDArray[np.float64], top: int) -> float:
    """Return the position of an edge: the centroid of its slopes."""
    is_low = slopes < _EDGE_SHARE * slopes[top]
    before = np.flatnonzero(is_low[:top])
    behind = np.flatnonzero(is_low[top:])
    first = int(before[-1]) + 1 if len(before) else 0
    last = top + int(behind[0]) if len(behind) else len(slopes)
    part = slopes[first:last]
    return float(np.arange(first, last) @ part / part.sum())


def _shifted(corners: NDArray[np.float64], shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    ways = np.roll(corners, -1, axis=0) - corners
    along = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    outwards = np.column_stack([-along[:, 1], along[:, 0]])
    moved = corners.copy()
    for corner in range(len(corners)):
        pair = [corner - 1, corner]
        rows = outwards[pair]
        # Move a corner between nearly parallel sides by the mean of their displacements.
        if abs(float(np.linalg.det(rows))) < _PARALLEL:
            moved[corner] += (shifts[pair] @ rows) / 2.0
        else:
            moved[corner] += np.linalg.solve(rows, shifts[pair])
    return moved
