"""Colour balance of layers by smooth corrections of their brightness.

Each cell keeps the detail of one photo, since layers are not blended and corrections are smooth
over blocks of cells. Double contours therefore do not occur, even if some parallax remains.

The model consists of an exposure per photo, the vignetting of each lens, and a smooth field per
photo. All of these are logarithms, so that factors become sums. Where two photos show the same
blocks of a wall, the difference between their corrections should cancel the observed difference in
brightness.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.levels import Colours, lit
from orthoflow.geometry.robust import median_deviation
from orthoflow.products import Camera, Layer, Wall
from orthoflow_plugins.mosaic.blocks import (
    BlockLight,
    Blocks,
    Box,
    block_light,
    block_means,
    common,
    depth_edges_in,
    inside,
    pairs,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_array


# Maximum side of a block in cells.
_BLOCK_CELLS_MOST: Final = 16
# Approximate number of blocks on a small wall.
_BLOCKS_LEAST: Final = 4_000
# Photos are left unchanged if all corrections, as logarithms, are smaller than this.
_ALIKE: Final = 0.02
# Standard deviation of the smoothing of differences, in blocks.
_SMOOTH_BLOCKS: Final = 1.5
# Regularisation, which takes effect where differences are known in only a few blocks.
_KNOWN_LEAST: Final = 0.02
# If balanced photos differ by more than this, they probably show different objects there.
_SAME_THING: Final = 0.15
# Photos may have the same lens if the logarithms of their focal lengths differ by less than about
# this value.
_SAME_ZOOM: Final = 0.1
# Overlaps with fewer blocks than this are ignored.
_LEAST_BLOCKS: Final = 4
# Overlaps with more blocks than this are sampled.
_BLOCKS_MOST: Final = 200
# An overlap counts as at most this many independent blocks.
_INDEPENDENT: Final = 50.0
# Minimum standard deviation of the brightness difference between two photos in a block.
_SPREAD_LEAST: Final = 0.01
# Prior standard deviations of exposures, lens terms and nodes of fields, as logarithms.
_EXPOSURE_PRIOR: Final = 1.0
_LENS_PRIOR: Final = 0.5
_FIELD_PRIOR: Final = 0.05
# Number of nodes along each side of a field.
_NODES: Final = 4
_SWEEPS: Final = 6
_OUTLIER: Final = 2.0
# Distance from a seam within which colours are blended.
FEATHER_CELLS: Final = 64


@dataclass(frozen=True, kw_only=True)
class Balance:
    """Corrections of the layers of a wall, as logarithms of brightness factors.

    Attributes:
        blocks: blocks of the wall.
        lights: uncorrected brightness of each layer.
        logs: (rows, cols, 3) float32 corrections of each layer, per block and channel; values
            between block centres are interpolated bilinearly.
        exposures: parameters from which the corrections were computed.
    """

    blocks: Blocks
    lights: tuple[BlockLight, ...]
    logs: tuple[NDArray[np.float32], ...]
    exposures: Exposures

    def shown(
        self, index: int, colours: Colours, rows: NDArray[np.int64], columns: NDArray[np.int64]
    ) -> Colours:
        """Return the colours (n, 3) of a layer at rows and columns (n,) after balancing."""
        return lit(colours, self.log_gains(index, rows, columns))

    def log_gains(
        self, index: int, rows: NDArray[np.int64], columns: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Return the logarithmic corrections (n, 3) of a layer at rows and columns (n,)."""
        logs, box = self.logs[index], self.lights[index].box
        row, down = _between(rows, self.blocks.rows, box[0])
        column, right = _between(columns, self.blocks.columns, box[1])
        below, beside = (
            (logs.shape[axis] > 1) * step for axis, step in ((0, logs.shape[1]), (1, 1))
        )
        flat = logs.reshape(-1, 3)
        first = row * logs.shape[1] + column
        upper = flat[first] + right * (flat[first + beside] - flat[first])
        first += below
        lower = flat[first] + right * (flat[first + beside] - flat[first])
        gains: NDArray[np.float32] = upper + down * (lower - upper)
        return gains


def _between(
    cells: NDArray[np.int64], edges: NDArray[np.int64], part: slice
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the first of the two blocks between whose centres each cell (n,) lies.

    Also return the interpolation weight (n,) of the second block.
    """
    n_blocks = part.stop - part.start
    middles = 0.5 * (edges[part] + edges[part.start + 1 : part.stop + 1])
    # Interpolate once per row or column instead of once per cell.
    at = np.interp(np.arange(edges[-1]) + 0.5, middles, np.arange(n_blocks))
    first = np.minimum(at.astype(np.int64), max(0, n_blocks - 2))
    return first[cells], (at - first).astype(np.float32)[cells][:, None]


def balance_of(
    layers: Sequence[Layer],
    wall: Wall | None,
    cameras: Sequence[Camera | None],
) -> Balance | None:
    """Estimate corrections that equalise the layers of a wall; None if they already agree.

    Args:
        layers: at least one layer; each has coloured cells.
        wall: the wall, or None.
        cameras: camera of each layer, or None if unknown.
    """
    shape = layers[0].frame.shape
    blocks = Blocks.over(shape, _block_cells(shape))
    lights = [block_light(layer, blocks) for layer in layers]
    radii = radii_of_blocks(layers[0].frame, wall, cameras, blocks, lights)
    exposures = estimate(lights, radii)
    logs = [
        exposures.logs(index, light, seen).astype(np.float32)
        for index, (light, seen) in enumerate(zip(lights, radii, strict=True))
    ]
    if max(float(np.abs(values).max()) for values in logs) < _ALIKE:
        return None
    return Balance(blocks=blocks, lights=tuple(lights), logs=tuple(logs), exposures=exposures)


def _block_cells(shape: tuple[int, int]) -> int:
    return int(np.clip(np.sqrt(shape[0] * shape[1] / _BLOCKS_LEAST), 2, _BLOCK_CELLS_MOST))


def radii_of_blocks(
    frame: WallFrame,
    wall: Wall | None,
    cameras: Sequence[Camera | None],
    blocks: Blocks,
    lights: Sequence[BlockLight],
) -> list[Radii | None]:
    """Return, for each layer, the distances of its blocks from the centre of its photo."""
    lenses: dict[tuple[int, int, int], int] = {}
    found: list[Radii | None] = []
    down, right = blocks.centres()
    for camera, light in zip(cameras, lights, strict=True):
        if camera is None or camera.intrinsics is None:
            found.append(None)
            continue
        lens = camera.intrinsics
        # Estimated focal lengths of the same lens differ slightly if photos are oriented
        # separately.
        key = (lens.width, lens.height, round(math.log(lens.fx) / _SAME_ZOOM))
        rows, columns = down[light.box[0]], right[light.box[1]]
        middles = np.stack(np.broadcast_arrays(columns, rows[:, None]), axis=-1).reshape(-1, 2)
        depths_m = 0.0 if wall is None else _depths_at(wall, middles)
        pixels = camera.viewing().project(frame.world_from_wall(middles, depths_m))[:, :2]
        half = np.array([0.5 * lens.width, 0.5 * lens.height])
        radii = np.linalg.norm(pixels - half, axis=1) / np.linalg.norm(half)
        # Coloured cells are inside the photo. All other cells, and cells whose distance is NaN, get
        # the distance of the corner.
        radii = np.fmin(radii, 1.0).astype(np.float32)
        values = radii.reshape(len(rows), len(columns))
        found.append(Radii(values=values, lens=lenses.setdefault(key, len(lenses))))
    return found


def _depths_at(wall: Wall, middles: NDArray[np.float64]) -> NDArray[np.float64]:
    columns, rows = middles.astype(np.int64).T
    depths_m = wall.depth_m[rows, columns].astype(np.float64)
    return np.asarray(np.nan_to_num(depths_m), dtype=np.float64)


def with_seams(balance: Balance, source: NDArray[np.int16], wall: Wall | None) -> Balance:
    """Add corrections that blend the remaining differences between layers near their seams.

    Near a seam, the brightness of each layer approaches the mean of the layers on both sides,
    weighted by their shares of the nearby cells. Blocks with depth edges, and blocks in which two
    layers show different objects, do not contribute. Where no difference is known, the correction
    fades to zero.

    Args:
        balance: the colour balance of the layers.
        source: (rows, cols) index of the layer used in each cell, -1 for none.
        wall: the wall, or None.
    """
    blocks = balance.blocks
    side = float(np.diff(blocks.rows).max())
    spread = max(0.5, 0.5 * FEATHER_CELLS / side)
    shares = _Shares.of(balance, source, spread)
    says = np.ones(blocks.shape, dtype=np.float32)
    if wall is not None:
        edges = block_means(partial(depth_edges_in, wall.depth_m), blocks)
        says[edges > 0.0] = 0.0
    logs = [values.copy() for values in balance.logs]
    for i, j, shared in pairs(balance.lights):
        # Extend the difference beyond the seam, because one of the two layers may end there.
        around = _grown(shared, _reach(_SMOOTH_BLOCKS), blocks.shape)
        apart = _apart(balance, (i, j), shared, around, says)
        if apart is None:
            continue
        for mine, other, sign in ((i, j, 1.0), (j, i, -1.0)):
            part = common(balance.lights[mine].box, around)
            assert part is not None  # noqa: S101 - both contain the overlap
            part = common(part, shares.boxes[other])
            assert part is not None  # noqa: S101 - both contain the overlap
            weights = shares.within(other, part)
            towards = np.float32(sign) * apart[inside(part, around)] * weights[..., None]
            logs[mine][inside(part, balance.lights[mine].box)] += towards
    return replace(balance, logs=tuple(logs))


def _apart(
    balance: Balance, pair: tuple[int, int], shared: Box, around: Box, says: NDArray[np.float32]
) -> NDArray[np.float32] | None:
    """Return the smooth difference (rows, cols, 3), second minus first, between balanced layers.

    Args:
        balance: the colour balance of all layers.
        pair: indices of the two layers.
        shared: blocks in the boxes of both layers.
        around: the shared blocks with a margin; the difference is returned for these.
        says: (rows, cols) weight of each block of the wall: 1 if it may be used, otherwise 0.
    """
    parts = [inside(shared, balance.lights[k].box) for k in pair]
    first, second = (
        balance.lights[k].log_light[part] + balance.logs[k][part]
        for k, part in zip(pair, parts, strict=True)
    )
    apart = second - first
    weights = np.where(np.isnan(apart[..., 0]), np.float32(0.0), says[shared])
    if not weights.any():
        return None
    apart = np.nan_to_num(apart)
    weights /= (1.0 + (np.abs(apart).mean(axis=2) / _SAME_THING) ** 2) ** 2
    values = np.zeros((*says[around].shape, 4), dtype=np.float32)
    values[inside(shared, around)] = np.dstack([apart * weights[..., None], weights])
    values = _blurred(values, _SMOOTH_BLOCKS)
    return values[..., :3] / (values[..., 3:] + np.float32(_KNOWN_LEAST))


@dataclass(frozen=True, kw_only=True)
class _Shares:
    """Share of the cells around each block that are taken from each layer.

    Attributes:
        boxes: box of each layer, with a margin.
        values: (rows, cols) float32 smoothed share of each layer in the blocks of its box.
        total: (rows, cols) float32 sum of the shares of all layers, for all blocks of the wall.
    """

    boxes: tuple[Box, ...]
    values: tuple[NDArray[np.float32], ...]
    total: NDArray[np.float32]

    @classmethod
    def of(cls, balance: Balance, source: NDArray[np.int16], spread: float) -> _Shares:
        """Compute the share of each layer per block, smoothed over `spread` blocks."""
        blocks = balance.blocks
        reach = _reach(spread)
        boxes, values = [], []
        total = np.zeros(blocks.shape, dtype=np.float32)
        for index, light in enumerate(balance.lights):
            rows, columns = blocks.cells(light.box)
            is_mine = partial(_is_layer, source[rows, columns], index)
            share = block_means(is_mine, blocks.within(light.box)).astype(np.float32)
            box = _grown(light.box, reach, blocks.shape)
            about = np.zeros([part.stop - part.start for part in box], dtype=np.float32)
            about[inside(light.box, box)] = share
            about = _blurred(about, spread)
            total[box] += about
            boxes.append(box)
            values.append(about)
        return cls(boxes=tuple(boxes), values=tuple(values), total=total)

    def within(self, index: int, part: Box) -> NDArray[np.float32]:
        """Return the share of a layer, relative to all layers, in a part of its box."""
        value = self.values[index][inside(part, self.boxes[index])]
        return np.asarray(value / np.maximum(self.total[part], np.float32(1e-6)), np.float32)


def _is_layer(source: NDArray[np.int16], index: int, rows: slice) -> NDArray[np.bool_]:
    return np.asarray(source[rows] == index, dtype=np.bool_)


def _reach(spread: float) -> int:
    return math.ceil(3.0 * spread)


def _blurred(values: NDArray[np.float32], spread: float) -> NDArray[np.float32]:
    import cv2

    side = 2 * _reach(spread) + 1
    blurred = cv2.GaussianBlur(values, (side, side), spread, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred, dtype=np.float32)


def _grown(box: Box, reach: int, shape: tuple[int, int]) -> Box:
    rows, columns = (
        slice(max(0, part.start - reach), min(size, part.stop + reach))
        for part, size in zip(box, shape, strict=True)
    )
    return rows, columns


@dataclass(frozen=True, kw_only=True)
class Radii:
    """Distances between the blocks of a layer and the centre of its photo.

    Attributes:
        values: (rows, cols) float32, 1 in the corners of the photo.
        lens: number of the lens; photos taken with the same lens have the same vignetting.
    """

    values: NDArray[np.float32]
    lens: int


@dataclass(frozen=True, kw_only=True)
class Exposures:
    """Parameters of the corrections of all layers.

    Attributes:
        exposures: (k, 3) logarithmic exposure correction per layer and channel.
        lenses: (lenses, 2) coefficients of r^2 and r^4, where r is 1 in the corners of a photo.
        nodes: (k, 4, 4, 3) values at the nodes of the smooth fields, which are interpolated
            bilinearly over the box of each layer.
    """

    exposures: NDArray[np.float64]
    lenses: NDArray[np.float64]
    nodes: NDArray[np.float64]

    def logs(self, index: int, light: BlockLight, radii: Radii | None) -> NDArray[np.float64]:
        """Return the logarithmic corrections (rows, cols, 3) in the blocks of a layer."""
        rows, columns = (_hats(np.arange(size), size) for size in light.log_light.shape[:2])
        logs: NDArray[np.float64] = self.exposures[index] + np.einsum(
            "ri,cj,ijk->rck", rows, columns, self.nodes[index], optimize=True
        )
        if radii is not None:
            logs += (_powers(radii.values) @ self.lenses[radii.lens])[..., None]
        return logs


@dataclass(frozen=True, kw_only=True)
class Overlap:
    """Blocks that two layers have in common.

    Attributes:
        layers: indices of the two layers.
        places: two arrays (n, 2): row and column of each block in the box of the first layer, and
            in the box of the second layer.
        apart: (n, 3) logarithm of the brightness of the second layer minus that of the first.
    """

    layers: tuple[int, int]
    places: tuple[NDArray[np.int64], NDArray[np.int64]]
    apart: NDArray[np.float64]


def estimate(lights: Sequence[BlockLight], radii: Sequence[Radii | None]) -> Exposures:
    """Estimate the corrections that equalise overlaps, robust against moved objects and glare.

    Exposures and vignetting are first estimated from the mean of the channels. The remaining
    differences are modelled by exposures per channel and by smooth fields, which are kept small.

    Args:
        lights: brightness of the layers of a wall.
        radii: distances from the photo centre for the same layers; None if the camera of a layer is
            unknown.
    """
    count = len(lights)
    n_lenses = 1 + max((item.lens for item in radii if item is not None), default=-1)
    overlaps = overlaps_of(lights)
    if not overlaps:
        return Exposures(
            exposures=np.zeros((count, 3)),
            lenses=np.zeros((n_lenses, 2)),
            nodes=np.zeros((count, _NODES, _NODES, 3)),
        )
    apart = np.concatenate([item.apart for item in overlaps])
    exposures = _exposure_columns(overlaps, count)
    bends = _lens_columns(overlaps, radii, n_lenses)
    alike = _solved(
        [exposures, bends],
        apart.mean(axis=1, keepdims=True),
        np.repeat([_EXPOSURE_PRIOR, _LENS_PRIOR], [count, 2 * n_lenses]),
        overlaps,
    )
    lenses = alike[count:]
    found = _solved(
        [exposures, _field_columns(overlaps, lights)],
        apart - bends @ lenses,
        np.repeat([_EXPOSURE_PRIOR, _FIELD_PRIOR], [count, count * _NODES**2]),
        overlaps,
    )
    return Exposures(
        exposures=found[:count],
        lenses=lenses.reshape(n_lenses, 2),
        nodes=found[count:].reshape(count, _NODES, _NODES, 3),
    )


def overlaps_of(lights: Sequence[BlockLight]) -> list[Overlap]:
    """Return the differences of light, block by block, of each pair of layers that overlap."""
    found = []
    for i, j, shared in pairs(lights):
        parts = [inside(shared, lights[k].box) for k in (i, j)]
        known = lights[i].is_known[parts[0]] & lights[j].is_known[parts[1]]
        places = np.argwhere(known)
        if len(places) < _LEAST_BLOCKS:
            continue
        n_taken = min(len(places), _BLOCKS_MOST)
        places = places[np.linspace(0, len(places) - 1, n_taken).round().astype(np.int64)]
        one, other = (places + _corner(part) for part in parts)
        apart = lights[j].log_light[tuple(other.T)] - lights[i].log_light[tuple(one.T)]
        found.append(Overlap(layers=(i, j), places=(one, other), apart=apart.astype(np.float64)))
    return found


def _corner(part: Box) -> NDArray[np.int64]:
    return np.array([part[0].start, part[1].start], dtype=np.int64)


def _exposure_columns(overlaps: Sequence[Overlap], count: int) -> csr_array:
    """Return the exposure columns of the design matrix: 1 for first, -1 for second layers."""
    from scipy.sparse import csr_array

    layers = np.repeat(
        [item.layers for item in overlaps], [len(item.apart) for item in overlaps], 0
    )
    n_rows = len(layers)
    values = np.tile([1.0, -1.0], n_rows)
    at = (np.repeat(np.arange(n_rows), 2), layers.ravel())
    return csr_array((values, at), shape=(n_rows, count))


def _lens_columns(
    overlaps: Sequence[Overlap], radii: Sequence[Radii | None], n_lenses: int
) -> csr_array:
    """Return the lens columns of the design matrix, two per lens."""
    from scipy.sparse import csr_array

    columns = np.zeros((sum(len(item.apart) for item in overlaps), 2 * n_lenses))
    first = 0
    for item in overlaps:
        rows = slice(first, first + len(item.apart))
        for layer, places, sign in zip(item.layers, item.places, (1.0, -1.0), strict=True):
            seen = radii[layer]
            if seen is not None:
                terms = sign * _powers(seen.values[tuple(places.T)])
                columns[rows, 2 * seen.lens : 2 * seen.lens + 2] += terms
        first = rows.stop
    return csr_array(columns)


def _field_columns(overlaps: Sequence[Overlap], lights: Sequence[BlockLight]) -> csr_array:
    """Return the field columns of the design matrix, one per node and layer."""
    from scipy.sparse import csr_array

    n_nodes = _NODES**2
    values, rows, columns = [], [], []
    first = 0
    for item in overlaps:
        n_blocks = len(item.apart)
        for layer, places, sign in zip(item.layers, item.places, (1.0, -1.0), strict=True):
            shape = lights[layer].log_light.shape
            hats = [_hats(places[:, axis], shape[axis]) for axis in (0, 1)]
            values.append(sign * np.einsum("ni,nj->nij", *hats).ravel())
            rows.append(np.repeat(np.arange(first, first + n_blocks), n_nodes))
            columns.append(np.tile(np.arange(n_nodes) + n_nodes * layer, n_blocks))
        first += n_blocks
    at = (np.concatenate(rows), np.concatenate(columns))
    return csr_array((np.concatenate(values), at), shape=(first, n_nodes * len(lights)))


def _hats(places: NDArray[np.int64], size: int) -> NDArray[np.float64]:
    """Return the weights (n, nodes) for linear interpolation between nodes along one side."""
    at = (places + 0.5) / size * (_NODES - 1)
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(_NODES)))


def _powers(radii: NDArray[np.floating]) -> NDArray[np.float64]:
    squares = np.asarray(radii, dtype=np.float64) ** 2
    return np.stack([squares, squares**2], axis=-1)


def _solved(
    columns: Sequence[csr_array],
    apart: NDArray[np.float64],
    priors: NDArray[np.float64],
    overlaps: Sequence[Overlap],
) -> NDArray[np.float64]:
    """Solve for unknowns (unknowns, channels) by robust least squares with zero-mean priors.

    Cauchy weights are used, scaled by the scatter of the residuals of each pair of layers.
    """
    from scipy.sparse import diags_array, hstack
    from scipy.sparse.linalg import spsolve

    matrix = hstack(list(columns)).tocsr()
    ridge = diags_array(1.0 / priors**2)
    ends = np.cumsum([len(item.apart) for item in overlaps])
    weights = np.ones(len(apart))
    found = np.zeros((len(priors), apart.shape[1]))
    for sweep in range(_SWEEPS):
        residuals = np.abs(apart - matrix @ found).mean(axis=1)
        for part in np.split(np.arange(len(apart)), ends[:-1]):
            spread = max(_SPREAD_LEAST, median_deviation(residuals[part], 0.0))
            counted = min(1.0, _INDEPENDENT / len(part)) / spread**2
            # Exposures are unknown in the first iteration, so large differences are not yet
            # outliers.
            limit = np.inf if sweep == 0 else _OUTLIER * spread
            weights[part] = counted / (1.0 + (residuals[part] / limit) ** 2)
        weighted = matrix.T @ diags_array(weights)
        normal = (weighted @ matrix + ridge).tocsc()
        found = np.reshape(spsolve(normal, weighted @ apart), found.shape)
    return found
