"""How the colours of layers are balanced: what is added to their light, smooth over each wall.

Only what is smooth over blocks of cells is changed. Two layers are therefore never mixed: detail
is that of one photo everywhere, and there are no double contours, whatever parallax is left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.levels import Colours
from orthoflow.products import Camera, Layer, Wall
from orthoflow_plugins.mosaic.blocks import Blocks, Box, block_means
from orthoflow_plugins.mosaic.depth_edges import depth_edges_in
from orthoflow_plugins.mosaic.exposures import Exposures, Radii, estimate
from orthoflow_plugins.mosaic.light import BlockLight, block_light, common, inside, lit, pairs

# Sides of blocks in cells, at most, and about how many blocks a small wall has.
_BLOCK_CELLS_MOST: Final = 16
_BLOCKS_LEAST: Final = 4_000
# Photos of which nothing has to be changed by more than this factor do not differ.
_ALIKE: Final = 0.02
# Differences are smooth over so many blocks; where fewer than so much is known, they fade.
_SMOOTH_BLOCKS: Final = 1.5
_KNOWN_LEAST: Final = 0.02
# What two balanced photos differ by beyond this is another thing, not another light.
_SAME_THING: Final = 0.15
# Focal lengths of one lens differ by less than about this factor.
_SAME_ZOOM: Final = 0.1


@dataclass(frozen=True, kw_only=True)
class Balance:
    """What is added to the logarithm of the light of each layer of a wall.

    Attributes:
        blocks: of the wall.
        lights: of each layer, as it is.
        logs: (rows, cols, 3) float32 in the blocks of each layer's box; bilinear between their
            middles.
        exposures: how they came about.
    """

    blocks: Blocks
    lights: tuple[BlockLight, ...]
    logs: tuple[NDArray[np.float32], ...]
    exposures: Exposures

    def shown(
        self, index: int, colours: Colours, rows: NDArray[np.int64], columns: NDArray[np.int64]
    ) -> Colours:
        """Give colours (n, 3) of a layer, in its cells at rows and columns (n,), as balanced."""
        return lit(colours, self.log_gains(index, rows, columns))

    def log_gains(
        self, index: int, rows: NDArray[np.int64], columns: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """What is added (n, 3) to the logarithm of a layer's light in cells."""
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
    """Between which blocks cells (n,) lie: the first of two (n,), and how far on (n, 1), 0 to 1."""
    n_blocks = part.stop - part.start
    middles = 0.5 * (edges[part] + edges[part.start + 1 : part.stop + 1])
    # Cells of one row or column share what is looked up.
    at = np.interp(np.arange(edges[-1]) + 0.5, middles, np.arange(n_blocks))
    first = np.minimum(at.astype(np.int64), max(0, n_blocks - 2))
    return first[cells], (at - first).astype(np.float32)[cells][:, None]


def balance_of(
    layers: Sequence[Layer],
    wall: Wall | None,
    cameras: Sequence[Camera | None],
    *,
    is_local: bool,
) -> Balance | None:
    """Find what makes layers of a wall alike; None where they are.

    Args:
        layers: that paint something, at least one.
        wall: its surface, or None.
        cameras: of each layer, where it is a photo whose camera is known.
        is_local: find what is smooth over a photo, too, not only its exposure.
    """
    shape = layers[0].frame.shape
    blocks = Blocks.over(shape, _block_cells(shape))
    lights = [block_light(layer, blocks) for layer in layers]
    seen = cameras if is_local else [None] * len(layers)
    radii = _radii(layers[0].frame, wall, seen, blocks, lights)
    exposures = estimate(lights, radii, is_local=is_local)
    logs = [
        exposures.logs(index, light, seen).astype(np.float32)
        for index, (light, seen) in enumerate(zip(lights, radii, strict=True))
    ]
    if max(float(np.abs(values).max()) for values in logs) < _ALIKE:
        return None
    return Balance(blocks=blocks, lights=tuple(lights), logs=tuple(logs), exposures=exposures)


def _block_cells(shape: tuple[int, int]) -> int:
    """Side of the blocks of a wall, cells."""
    return int(np.clip(np.sqrt(shape[0] * shape[1] / _BLOCKS_LEAST), 2, _BLOCK_CELLS_MOST))


def _radii(
    frame: WallFrame,
    wall: Wall | None,
    cameras: Sequence[Camera | None],
    blocks: Blocks,
    lights: Sequence[BlockLight],
) -> list[Radii | None]:
    """Where in their photos the blocks of layers lie."""
    lenses: dict[tuple[int, int, int], int] = {}
    found: list[Radii | None] = []
    down, right = blocks.centres()
    for camera, light in zip(cameras, lights, strict=True):
        if camera is None or camera.intrinsics is None:
            found.append(None)
            continue
        lens = camera.intrinsics
        # Adjusted photo by photo, focal lengths of one lens differ a little.
        key = (lens.width, lens.height, round(math.log(lens.fx) / _SAME_ZOOM))
        rows, columns = down[light.box[0]], right[light.box[1]]
        middles = np.stack(np.broadcast_arrays(columns, rows[:, None]), axis=-1).reshape(-1, 2)
        depths_m = 0.0 if wall is None else _depths_at(wall, middles)
        pixels = camera.viewing().project(frame.world_from_wall(middles, depths_m))[:, :2]
        half = np.array([0.5 * lens.width, 0.5 * lens.height])
        radii = np.linalg.norm(pixels - half, axis=1) / np.linalg.norm(half)
        # Beyond the photo nothing is painted; the corner stands for what cannot be projected.
        radii = np.minimum(np.nan_to_num(radii, nan=1.0), 1.0).astype(np.float32)
        values = radii.reshape(len(rows), len(columns))
        found.append(Radii(values=values, lens=lenses.setdefault(key, len(lenses))))
    return found


def _depths_at(wall: Wall, middles: NDArray[np.float64]) -> NDArray[np.float64]:
    columns, rows = np.minimum(middles.astype(np.int64), np.array(wall.frame.shape[::-1]) - 1).T
    depths_m = wall.depth_m[rows, columns].astype(np.float64)
    return np.asarray(np.nan_to_num(depths_m), dtype=np.float64)


def with_seams(
    balance: Balance, source: NDArray[np.int16], wall: Wall | None, *, feather_cells: int
) -> Balance:
    """Bring the layers together near their seams, with what they still differ by there.

    Each layer goes over a width to what those about a seam show on average, by the share of each
    in the neighbourhood. Blocks with depth edges, and those in which two layers show different
    things, say nothing of their difference; where nothing is known it fades to none.

    Args:
        balance: of the layers.
        source: (rows, cols) index of the layer that paints each cell, -1 for none.
        wall: its surface, or None.
        feather_cells: how far from a seam colours change.
    """
    blocks = balance.blocks
    side = float(np.diff(blocks.rows).max())
    spread = max(0.5, 0.5 * feather_cells / side)
    shares = _Shares.of(balance, source, spread)
    says = np.ones(blocks.shape, dtype=np.float32)
    if wall is not None:
        edges = block_means(partial(depth_edges_in, wall.depth_m), blocks)
        says[edges > 0.0] = 0.0
    logs = [values.copy() for values in balance.logs]
    for i, j, shared in pairs(balance.lights):
        # One of the two may end at the seam: the other goes over beyond it.
        around = _grown(shared, _reach(_SMOOTH_BLOCKS), blocks.shape)
        apart = _apart(balance, (i, j), shared, around, says)
        if apart is None:
            continue
        for mine, other, sign in ((i, j, 1.0), (j, i, -1.0)):
            part = common(balance.lights[mine].box, around)
            part = None if part is None else common(part, shares.boxes[other])
            if part is None:
                continue
            weights = shares.within(other, part)
            towards = np.float32(sign) * apart[inside(part, around)] * weights[..., None]
            logs[mine][inside(part, balance.lights[mine].box)] += towards
    return replace(balance, logs=tuple(logs))


def _apart(
    balance: Balance, pair: tuple[int, int], shared: Box, around: Box, says: NDArray[np.float32]
) -> NDArray[np.float32] | None:
    """Smooth difference (rows, cols, 3), second less first, of two balanced layers.

    Args:
        balance: of all layers.
        pair: the two.
        shared: blocks in the boxes of both.
        around: these and some more, of which the difference is given.
        says: (rows, cols) 0 in blocks of the wall that say nothing, else 1.
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
    smooth: NDArray[np.float32] = values[..., :3] / (values[..., 3:] + np.float32(_KNOWN_LEAST))
    return smooth


@dataclass(frozen=True, kw_only=True)
class _Shares:
    """How much of the neighbourhood of a block each layer paints, of what is painted there.

    Attributes:
        boxes: of each layer and as far about it as it counts.
        values: (rows, cols) float32 in them.
        total: (rows, cols) float32 of all layers together, over the wall.
    """

    boxes: tuple[Box, ...]
    values: tuple[NDArray[np.float32], ...]
    total: NDArray[np.float32]

    @classmethod
    def of(cls, balance: Balance, source: NDArray[np.int16], spread: float) -> _Shares:
        """Spread the cells of each layer over so many blocks."""
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
        """Share of a layer in the blocks of a part of its box."""
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
