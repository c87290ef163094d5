"""Selection of a layer for each cell of a wall by a rule, and removal of small patches."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import Allocate, bands_with_reach
from orthoflow.geometry.levels import Colours, Level, in_levels
from orthoflow.geometry.rows import raster_rows
from orthoflow.products import Layer, LayerMask, OrthoMask, Wall
from orthoflow_plugins.mosaic.graph_cut import CutLabels, cut_labels
from orthoflow_plugins.mosaic.parameters import SeamsParams

if TYPE_CHECKING:
    from orthoflow_plugins.mosaic.balance import Balance
    from orthoflow_plugins.mosaic.drawn_seams import DrawnSeams

# Function that returns the preference (rows, cols) of a layer in the given rows of a wall.
# Preferences are computed in bands, because those of a large wall would not fit into memory.
Preference = Callable[[slice], NDArray[np.float32]]

NOBODY: Final = -1
# Walls with more cells than this are processed in bands of about this size.
BAND_CELLS: Final = 1 << 25
# Balancing colours temporarily takes more than a hundred bytes per cell.
_BALANCED_AT_ONCE: Final = 1 << 20
# States in ascending order; a cell takes the highest state that it has in any layer. It is occluded
# if at least one source faces it but none shows it.
_RANKED: Final = (
    OrthoMask.NONE,
    OrthoMask.NO_SURFACE,
    OrthoMask.OCCLUDED,
    OrthoMask.FILLED,
    OrthoMask.PAINTED,
)
_MASK_OF_RANK: Final = np.array(_RANKED, dtype=np.uint8)
_RANK_OF_LAYER_MASK: Final = np.array(
    [_RANKED.index(OrthoMask[name]) for name in ("NONE", "PAINTED", "OCCLUDED", "NO_SURFACE")],
    dtype=np.uint8,
)


def preferences(
    layers: Sequence[Layer],
    params: SeamsParams,
    *,
    wall: Wall | None = None,
    balance: Balance | None = None,
) -> list[Preference]:
    """Return functions that compute the preference of each layer by the given rule.

    A cell is taken from the layer with the highest preference. `best-view` is the quality of the
    layer, which depends on the angle of incidence, the resolution and the distance from the border
    of the photo. `voronoi` prefers the layer whose border is farthest away, so that seams are in
    the middle of overlaps. `priority` takes photos in the given order, followed by all others by
    quality. `graph-cut` puts seams where the layers look similar, away from depth edges of the
    wall.
    """
    if params.seams == "voronoi":
        return [_depth_inside(layer) for layer in layers]
    best = np.float32(max(1e-6, *(float(layer.quality.max()) for layer in layers)))
    if params.seams == "priority":
        names = params.priority
        places = {name: len(names) - place for place, name in enumerate(names)}
        raised = [np.float32(2 * places.get(layer.source, 0)) * best for layer in layers]
        return [partial(_raised, layer, bonus) for layer, bonus in zip(layers, raised, strict=True)]
    if params.seams == "graph-cut" and len(layers) > 1:
        cut = cut_labels(layers, wall, balance)
        return [partial(_cut_off, layer, k, cut, best) for k, layer in enumerate(layers)]
    return [partial(_raised, layer, np.float32(0.0)) for layer in layers]


def _raised(layer: Layer, bonus: np.float32, rows: slice) -> NDArray[np.float32]:
    return layer.quality[rows] + bonus


def _cut_off(
    layer: Layer, index: int, cut: CutLabels, best: np.float32, rows: slice
) -> NDArray[np.float32]:
    is_mine = cut.in_rows(rows) == index
    return layer.quality[rows] + np.where(is_mine, np.float32(2.0) * best, np.float32(0.0))


def _depth_inside(layer: Layer) -> Preference:
    """Return the distance in cells to the nearest cell without a colour, or to the border.

    For a large wall, distances are computed for every n-th cell and interpolated linearly.
    """
    import cv2

    shape = layer.mask.shape
    step = math.ceil(math.sqrt(layer.mask.size / BAND_CELLS))
    painted = np.pad((layer.mask[step // 2 :: step, step // 2 :: step] == LayerMask.PAINTED), 1)
    distance = cv2.distanceTransform(painted.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inside = np.float32(step) * np.asarray(distance, dtype=np.float32)
    if step == 1:
        return lambda rows: inside[1:-1, 1:-1][rows]

    def preference(rows: slice) -> NDArray[np.float32]:
        # Because of the padding, the first sampled cell is the second cell of the image.
        row, column = (
            (np.arange(*part.indices(size)) - step // 2) / step + 1.0
            for part, size in zip((rows, slice(None)), shape, strict=True)
        )
        at = np.stack(np.meshgrid(column, row), axis=-1).astype(np.float32)
        border = cv2.BORDER_REPLICATE
        found = cv2.remap(inside, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=border)
        return np.asarray(found, dtype=np.float32)

    return preference


def require_sources(layers: Sequence[Layer], priority: Sequence[str]) -> None:
    """Check that all names in `priority` are sources of layers.

    Raises:
        MethodError: a name is unknown.
    """
    sources = {layer.source for layer in layers}
    unknown = [name for name in priority if name not in sources]
    if unknown:
        raise MethodError(
            f"priority refers to {', '.join(unknown)}, but the layers come from "
            f"{', '.join(sorted(sources))} (mosaic.seams)"
        )


def require_one_raster(layers: Sequence[Layer], name: str) -> None:
    """Check that all layers of a wall have the same frame.

    Raises:
        MethodError: the frames differ.
    """
    first = layers[0]
    for layer in layers[1:]:
        if not layer.frame.has_cells_of(first.frame):
            raise MethodError(
                f"the layers {first.source} and {layer.source} of {name} have different rasters: "
                "all layers must be made from the same walls"
            )


def joined(
    painters: Sequence[Layer],
    others: Sequence[Layer],
    params: SeamsParams,
    *,
    drawn: DrawnSeams | None,
    wall: Wall | None,
    balance: Balance | None,
    allocate: Allocate,
) -> tuple[NDArray[np.uint8], NDArray[np.int16]]:
    """Determine the state and the layer of each cell of a wall, in bands if the wall is large.

    Args:
        painters: layers of the wall with coloured cells.
        others: layers without coloured cells; their masks show which cells are occluded.
        params: the rule for seams.
        drawn: areas assigned to photos by hand; they override the rule where the photo shows them.
        wall: the surface, to keep seams away from its depth edges, or None.
        balance: the colour balance of `painters`, or None.
        allocate: function that allocates the arrays of the orthoimage.

    Returns:
        (rows, cols) `OrthoMask`, and (rows, cols) index of the layer of each cell, `NOBODY` if
        none.
    """
    preferred: list[Preference] = []
    if painters:
        preferred = preferences(painters, params, wall=wall, balance=balance)
    shape = [*painters, *others][0].frame.shape
    mask = np.asarray(allocate("mask", shape, np.uint8), np.uint8)
    source = np.asarray(allocate("source", shape, np.int16), np.int16)
    # A cell can influence another one only if they are at most this many rows apart.
    cells_min = params.island_cells_min
    reach = cells_min + math.ceil(math.sqrt(cells_min)) + 1 if cells_min > 1 else 0
    for band in bands_with_reach(shape, cells_most=BAND_CELLS, reach_rows=reach):
        rows = band.around
        parts = [raster_rows(layer, rows) for layer in painters]
        values = [preference(rows) for preference in preferred]
        if drawn is not None:
            chosen = drawn.chosen(rows)
            values = [
                np.where(chosen == index, np.float32(np.inf), value)
                for index, value in enumerate(values)
            ]
        rank, owner = best_views(
            [*parts, *(raster_rows(layer, rows) for layer in others)],
            [*values, *(layer.quality[rows] for layer in others)],
        )
        if cells_min > 1 and len(painters) > 1:
            owner = without_islands(rank, owner, parts, cells_min)
        mask[band.rows] = _MASK_OF_RANK[rank[band.inner]]
        source[band.rows] = owner[band.inner]
    return mask, source


def coloured(
    painters: Sequence[Layer],
    source: NDArray[np.int16],
    balance: Balance | None,
    *,
    allocate: Allocate,
) -> Colours:
    """Return the colours (rows, cols, 3) of the cells from the layers assigned to them.

    Args:
        painters: layers of the wall with coloured cells.
        source: (rows, cols) index of the layer of each cell, `NOBODY` if it has none.
        balance: colour balance of the layers; None leaves colours unchanged.
        allocate: function that allocates the result.
    """
    is_deep = any(layer.rgb.dtype == np.uint16 for layer in painters)
    level: Level = np.uint16 if is_deep else np.uint8
    rgb: Colours = np.asarray(allocate("rgb", (*source.shape, 3), level), level)
    cells_most = BAND_CELLS if balance is None else _BALANCED_AT_ONCE
    for band in bands_with_reach(source.shape, cells_most=cells_most, reach_rows=0):
        rows = band.rows
        for index, layer in enumerate(painters):
            is_mine = source[rows] == index
            colours = in_levels(layer.rgb[rows][is_mine], level)
            if balance is not None and len(colours):
                down, columns = np.nonzero(is_mine)
                colours = balance.shown(index, colours, down + rows.start, columns)
            rgb[rows][is_mine] = colours
    return rgb


def best_views(
    layers: Sequence[Layer], preferences: Sequence[NDArray[np.float32]]
) -> tuple[NDArray[np.uint8], NDArray[np.int16]]:
    """Assign each cell to the layer with the highest preference, or to the first of equal layers.

    Returns:
        (rows, cols) rank of the state of each cell, and (rows, cols) its layer, `NOBODY` if it has
        none.
    """
    shape = layers[0].frame.shape
    best = np.zeros(shape, dtype=np.float32)
    rank = np.zeros(shape, dtype=np.uint8)
    source = np.full(shape, NOBODY, dtype=np.int16)
    for index, (layer, preference) in enumerate(zip(layers, preferences, strict=True)):
        states = _ranks(layer)
        is_painted = layer.mask == LayerMask.PAINTED
        wins = (states > rank) | (is_painted & (states == rank) & (preference > best))
        rank[wins] = states[wins]
        best[wins] = preference[wins]
        source[wins & is_painted] = index
    return rank, source


def without_islands(
    rank: NDArray[np.uint8], owner: NDArray[np.int16], layers: Sequence[Layer], cells_min: int
) -> NDArray[np.int16]:
    """Reassign small patches to a source that surrounds them and also shows them.

    Cells of a patch are connected by their sides. A cell takes the source that most of the
    surrounding cells have. It is unchanged if no source of a larger patch shows it.
    """
    import cv2

    is_island = np.zeros(owner.shape, dtype=np.bool_)
    for index in range(len(layers)):
        is_mine = (owner == index).view(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(is_mine, connectivity=4)
        is_small = stats[:, cv2.CC_STAT_AREA] < cells_min
        is_small[0] = False
        is_island |= is_small[labels]
    if not is_island.any():
        return owner
    source, most = owner.copy(), np.zeros(owner.shape, dtype=np.float32)
    side = 2 * math.ceil(math.sqrt(cells_min)) + 1
    for index, layer in enumerate(layers):
        mainland = ((owner == index) & ~is_island).astype(np.float32)
        about = cv2.boxFilter(
            mainland, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        takes = is_island & (_ranks(layer) == rank) & (about > most)
        source[takes] = index
        most[takes] = about[takes]
    return source


def _ranks(layer: Layer) -> NDArray[np.uint8]:
    ranks = _RANK_OF_LAYER_MASK[layer.mask]
    if layer.filled is not None:
        is_filled = (layer.filled > 0) & (layer.mask == LayerMask.PAINTED)
        ranks[is_filled] = _RANKED.index(OrthoMask.FILLED)
    return ranks
