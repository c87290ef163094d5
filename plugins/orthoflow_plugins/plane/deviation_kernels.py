"""Compiled pass over labelled points: how they lie about their planes, and how far they reach."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow_plugins.plane.assignment_kernels import ALONG_NORMAL, centre_block, place_along
from orthoflow_plugins.plane.block_kernels import BLOCK_POINTS, BlockedPoints
from orthoflow_plugins.plane.slab_kernels import STEPS_PER_TOLERANCE

# Bins that the deviations of a plane's points are counted in.
HISTOGRAM_BINS: Final = 200


@kernel_part
def _list_owners(
    claims: NDArray[np.int8], owners: NDArray[np.int64], seen: NDArray[np.uint8]
) -> int:
    """List the planes that have points of a block; gives how many."""
    count = 0
    last = np.int8(-1)
    for i in range(claims.size):
        k = claims[i]
        # Neighbours have one owner, so this asks little.
        if k != last and k >= 0 and seen[k] == 0:
            seen[k] = 1
            owners[count] = k
            count += 1
        last = k
    for j in range(count):
        seen[owners[j]] = 0
    return count


@kernel_part
def _add_distances(
    claims: NDArray[np.int8],
    k: int,
    distances: NDArray[np.float32],
    limits: NDArray[np.float64],
    places: NDArray[np.int32],
    sums: NDArray[np.int64],
    histogram: NDArray[np.int64],
) -> None:
    """Add the distances of one plane's points of a block to its sums and its histogram."""
    find_m, fit_m = np.float32(limits[k, 0]), np.float32(limits[k, 1])
    to_steps = np.float32(STEPS_PER_TOLERANCE / limits[k, 1])
    to_bins = np.float32(0.5 * HISTOGRAM_BINS) / find_m
    half, one, none = np.float32(0.5), np.int32(1), np.int32(0)
    shift, last = np.float32(0.5 * HISTOGRAM_BINS), np.float32(HISTOGRAM_BINS - 1)
    zero, mine = np.float32(0.0), np.int8(k)
    n_find, n_fit = np.int32(0), np.int32(0)
    total, squares = np.int64(0), np.int64(0)
    total_fit, squares_fit = np.int64(0), np.int64(0)
    # Without branches, so that the processor takes several points at once.
    for i in range(claims.size):
        place = distances[i] * to_bins + shift
        place = max(zero, place)
        place = min(last, place)
        places[i] = np.int32(place) if claims[i] == mine else np.int32(-1)
    for i in range(claims.size):
        is_mine = claims[i] == mine
        fits = is_mine & (abs(distances[i]) <= fit_m)
        scaled = distances[i] * to_steps
        # Truncation after a half towards the number's own side rounds to the nearest.
        steps = np.int32(scaled + (half if scaled >= zero else -half))
        steps = steps if is_mine else none
        step = np.int64(steps)
        step_fit = np.int64(steps if fits else none)
        n_find += one if is_mine else none
        n_fit += one if fits else none
        total += step
        squares += step * step
        total_fit += step_fit
        squares_fit += step_fit * step_fit
    for i in range(claims.size):
        if places[i] >= 0:
            histogram[k, places[i]] += 1
    sums[k, 0] += n_find
    sums[k, 1] += total
    sums[k, 2] += squares
    sums[k, 3] += n_fit
    sums[k, 4] += total_fit
    sums[k, 5] += squares_fit


@kernel_part
def _reaches_further(
    boxes: NDArray[np.float32],
    block: int,
    slabs: NDArray[np.float64],
    extents: NDArray[np.float64],
    k: int,
) -> bool:
    """Whether points of a block may lie beyond what the plane reached so far."""
    for row in range(1, 3):
        centre, half = -slabs[k, 4 * row + 3], 0.0
        for axis in range(3):
            low, high = np.float64(boxes[block, 2 * axis]), np.float64(boxes[block, 2 * axis + 1])
            centre += slabs[k, 4 * row + axis] * 0.5 * (low + high)
            half += abs(slabs[k, 4 * row + axis]) * 0.5 * (high - low)
        if centre - half < extents[k, 2 * row - 2] or centre + half > extents[k, 2 * row - 1]:
            return True
    return False


@kernel_part
def _reach(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    points: BlockedPoints,
    block: int,
    claims: NDArray[np.int8],
    distances: NDArray[np.float32],
    slabs: NDArray[np.float64],
    limits: NDArray[np.float64],
    extents: NDArray[np.float64],
    k: int,
) -> None:
    """Widen the extents of a plane to its points of a block."""
    x, y, z = points.x, points.y, points.z
    start = block * BLOCK_POINTS
    fit_m = np.float32(limits[k, 1])
    for i in range(claims.size):
        if claims[i] != k or abs(distances[i]) > fit_m:
            continue
        px, py, pz = np.float64(x[start + i]), np.float64(y[start + i]), np.float64(z[start + i])
        u = slabs[k, 4] * px + slabs[k, 5] * py + slabs[k, 6] * pz - slabs[k, 7]
        v = slabs[k, 8] * px + slabs[k, 9] * py + slabs[k, 10] * pz - slabs[k, 11]
        if limits[k, 2] <= u <= limits[k, 3] and limits[k, 4] <= v <= limits[k, 5]:
            extents[k, 0], extents[k, 1] = min(extents[k, 0], u), max(extents[k, 1], u)
            extents[k, 2], extents[k, 3] = min(extents[k, 2], v), max(extents[k, 3], v)


@compiled
def measure_deviations(
    points: BlockedPoints,
    claims: NDArray[np.int8],
    slabs: NDArray[np.float64],
    limits: NDArray[np.float64],
    sums: NDArray[np.int64],
    histogram: NDArray[np.int64],
    extents: NDArray[np.float64],
) -> None:
    """Sum and bin the distances of claimed points to their plane, and see how far they reach.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) plane of each point, negative for none.
        slabs: (k, 12) the planes.
        limits: (k, 6) find tolerance, fit tolerance, smallest and largest u, smallest and largest
            v of the plane's rectangle; metres.
        sums: (k, 6) of points within the find tolerance: number, steps, squared steps, then
            the same within the fit tolerance; added to.
        histogram: (k, HISTOGRAM_BINS) points per bin of -find tolerance..find tolerance.
        extents: (k, 4) smallest and largest u, smallest and largest v of the points within the fit
            tolerance and the rectangle; widened.
    """
    local = np.zeros((3, BLOCK_POINTS), dtype=np.float32)
    middle = np.empty(3)
    distances = np.empty(BLOCK_POINTS, dtype=np.float32)
    places = np.empty(BLOCK_POINTS, dtype=np.int32)
    owners, seen = np.empty(slabs.shape[0], dtype=np.int64), np.zeros(128, dtype=np.uint8)
    for block in range(points.boxes.shape[0]):
        start = block * BLOCK_POINTS
        held = claims[start : min(start + BLOCK_POINTS, claims.size)]
        n_owners = _list_owners(held, owners, seen)
        if n_owners == 0:
            continue
        centre_block(points, block, middle, local)
        for k in owners[:n_owners]:
            place_along(local, middle, slabs, k, ALONG_NORMAL, 1.0, 0.0, distances)
            _add_distances(held, k, distances, limits, places, sums, histogram)
            if _reaches_further(points.boxes, block, slabs, extents, k):
                _reach(points, block, held, distances, slabs, limits, extents, k)
