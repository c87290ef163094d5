"""Seams by graph cuts, placed where two photos look similar and away from depth edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.levels import lit_shares
from orthoflow.products import Layer, LayerMask, Wall
from orthoflow_plugins.mosaic.blocks import Blocks, block_means, depth_edges_in, raster_means

if TYPE_CHECKING:
    from orthoflow_plugins.mosaic.balance import Balance

# Graph cuts are computed at a reduced scale, with about this many cells.
_CELLS_MOST: Final = 30_000
_SWEEPS_MOST: Final = 2
# Additional cost of a seam at a depth edge, equal to that of a seam between black and white.
_DEPTH_EDGE_COST: Final = 1.0
# Cost per cell of a seam, so that short seams are preferred where layers are identical.
_LENGTH_COST: Final = 0.01
_VIEW_WEIGHT: Final = 0.1
# Cost of assigning a cell to a layer that does not show it.
FORBIDDEN: Final = 1e3
_UNITS: Final = 1000.0


@dataclass(frozen=True, kw_only=True)
class CutScene:
    """Layers at reduced scale: colours (k, rows, cols, 3) in 0..1, views (k, rows, cols), edges.

    `views` is the cost of a layer in each cell; `edges` (rows, cols) is the additional cost of a
    seam in each cell.
    """

    colours: NDArray[np.float32]
    views: NDArray[np.float64]
    edges: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class CutLabels:
    """Layer assigned to each cell by a graph cut.

    Attributes:
        small: (rows, cols) int16 layer of each block, -1 if no layer shows it.
        blocks: division of the wall into blocks.
    """

    small: NDArray[np.int16]
    blocks: Blocks

    def in_rows(self, rows: slice) -> NDArray[np.int16]:
        """Return the layer (rows, cols) of each cell in the given rows of the wall."""
        first_rows, first_columns = self.blocks.rows, self.blocks.columns
        wanted = np.arange(*rows.indices(int(first_rows[-1])))
        blocks = np.searchsorted(first_rows, wanted, side="right") - 1
        return np.repeat(self.small[blocks], np.diff(first_columns), axis=1)


def cut_labels(
    layers: Sequence[Layer], wall: Wall | None, balance: Balance | None = None
) -> CutLabels:
    """Assign a layer to each cell by a graph cut; -1 if no layer shows the cell.

    Each layer in turn takes over cells of other layers if this lowers the sum of view costs and
    seam costs (Boykov, Veksler and Zabih 2001). The cost of a seam is the colour difference between
    the two layers on both sides of the seam (Kwatra et al. 2003), plus the cost of depth edges. The
    cut is computed at a reduced scale.

    Args:
        layers: layers of one wall.
        wall: the wall, or None if depth edges are unknown.
        balance: colour balance applied to the layers before their comparison, or None.
    """
    shape = layers[0].frame.shape
    factor = max(1, math.ceil(math.sqrt(shape[0] * shape[1] / _CELLS_MOST)))
    blocks = Blocks.over((shape[0], shape[1]), factor)
    scene = reduced_scene(layers, wall, blocks, balance)
    labels = np.argmin(scene.views, axis=0)
    for _ in range(_SWEEPS_MOST):
        before = labels
        for alpha in range(len(layers)):
            labels = expanded(scene, labels, alpha)
        if np.array_equal(labels, before):
            break
    labels = np.where(scene.views.min(axis=0) < FORBIDDEN, labels, -1)
    return CutLabels(small=labels.astype(np.int16), blocks=blocks)


def reduced_scene(
    layers: Sequence[Layer], wall: Wall | None, blocks: Blocks, balance: Balance | None
) -> CutScene:
    """Return the layers reduced to the mean of each block, with the costs of views and edges."""
    painted = np.stack([block_means(partial(_painted_in, layer.mask), blocks) for layer in layers])
    colours = np.stack(
        [
            np.stack([raster_means(layer.rgb[..., band], blocks) for band in range(3)], axis=-1)
            / np.maximum(share, 1e-3)[..., None]
            / np.iinfo(layer.rgb.dtype).max
            for layer, share in zip(layers, painted, strict=True)
        ]
    )
    if balance is not None:
        rows, columns = (middles.astype(np.int64) for middles in blocks.centres())
        at = [side.ravel() for side in np.broadcast_arrays(rows[:, None], columns)]
        for index, shares in enumerate(colours):
            gains = balance.log_gains(index, at[0], at[1])
            colours[index] = lit_shares(shares.reshape(-1, 3), gains).reshape(shares.shape)
    quality = np.stack([raster_means(layer.quality, blocks) for layer in layers])
    best = np.maximum(quality.max(axis=0), 1e-12)
    views = np.where(painted > 0.5, _VIEW_WEIGHT * (1.0 - quality / best), FORBIDDEN)
    edges = np.zeros(views.shape[1:])
    if wall is not None:
        steps = block_means(partial(depth_edges_in, wall.depth_m), blocks)
        edges = np.where(steps > 0.0, _DEPTH_EDGE_COST, 0.0)
    return CutScene(colours=colours.astype(np.float32), views=views, edges=edges)


def _painted_in(mask: NDArray[np.uint8], rows: slice) -> NDArray[np.bool_]:
    return np.asarray(mask[rows] == LayerMask.PAINTED, dtype=np.bool_)


def expanded(scene: CutScene, labels: NDArray[np.int64], alpha: int) -> NDArray[np.int64]:
    """Return the labels after the optimal expansion of one layer, found by a minimum cut."""
    from scipy.sparse import coo_array, csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count = labels.size
    source, sink = count, count + 1
    flat = labels.ravel()
    cells = np.arange(count)
    # Unary costs of keeping the label (0) and of changing it to alpha (1). Integers make sums
    # exact, so that results do not depend on the order of neighbours.
    views = np.rint(_UNITS * scene.views)
    keep = views.reshape(len(views), -1)[flat, cells]
    take = views[alpha].ravel().copy()
    starts, ends, between = [], [], []
    grid = cells.reshape(labels.shape)
    for one, other in ((grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:])):
        p, q = one.ravel(), other.ravel()
        right = seam_cost(scene, p, q, flat[p], np.full(len(p), alpha))
        left = seam_cost(scene, p, q, np.full(len(p), alpha), flat[q])
        # Enforce the triangle inequality: a seam costs at most as much as both seams with alpha
        # together.
        kept = np.minimum(seam_cost(scene, p, q, flat[p], flat[q]), right + left)
        # Kolmogorov and Zabih 2004: A + (C - A) p - C q + (B + C - A) (1 - p) q.
        np.add.at(take, p, left - kept)
        np.add.at(take, q, -left)
        starts.append(p)
        ends.append(q)
        between.append(right + left - kept)
    low = np.minimum(keep, take)
    starts += [np.full(count, source), cells]
    ends += [cells, np.full(count, sink)]
    # A cell on the sink side of the cut changes to alpha, which cuts the edge from the source.
    between += [take - low, keep - low]
    # An edge from p to q is cut where p keeps its label (source side) and q changes.
    capacity = np.minimum(np.concatenate(between), 4.0 * FORBIDDEN * _UNITS)
    graph = coo_array(
        (
            np.rint(capacity).astype(np.int32),
            (np.concatenate(starts).astype(np.int32), np.concatenate(ends).astype(np.int32)),
        ),
        shape=(count + 2, count + 2),
    ).tocsr()
    flow = maximum_flow(graph, source, sink).flow
    rest = csr_array(graph - flow)
    rest.data = np.maximum(rest.data, 0)
    rest.eliminate_zeros()
    reached = breadth_first_order(rest, source, return_predecessors=False)
    keeps = np.zeros(count + 2, dtype=np.bool_)
    keeps[reached] = True
    moved = np.where(keeps[:count], flat, alpha)
    return moved.reshape(labels.shape)


def seam_cost(
    scene: CutScene,
    p: NDArray[np.int64],
    q: NDArray[np.int64],
    label_p: NDArray[np.int64],
    label_q: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the integer seam cost (n,) between neighbours with these labels; 0 if equal."""
    colours = scene.colours.reshape(len(scene.colours), -1, 3)
    views = scene.views.reshape(len(scene.views), -1)
    edges = scene.edges.ravel()
    cost = _LENGTH_COST + edges[p] + edges[q]
    for cell in (p, q):
        apart = np.abs(colours[label_p, cell] - colours[label_q, cell]).mean(axis=1)
        # If only one layer shows a cell, the colours cannot be compared and no step is visible.
        both = (views[label_p, cell] < FORBIDDEN) & (views[label_q, cell] < FORBIDDEN)
        cost = cost + np.where(both, apart, 0.0)
    return np.where(label_p == label_q, 0.0, np.rint(_UNITS * cost))
