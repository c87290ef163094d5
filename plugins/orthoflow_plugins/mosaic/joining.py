"""Which layer paints each cell of a wall: by a rule, in patches rather than in specks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import Allocate, bands_with_reach, in_memory
from orthoflow.geometry.levels import Colours, Level, in_levels
from orthoflow.products import Layer, LayerMask, OrthoMask, Wall
from orthoflow_plugins.mosaic.graph_cut import CutLabels, cut_labels

if TYPE_CHECKING:
    from orthoflow_plugins.mosaic.balance import Balance
    from orthoflow_plugins.mosaic.drawn_seams import DrawnSeams

SeamRule = Literal["best-view", "voronoi", "graph-cut", "priority"]

# Preference (rows, cols) of a layer in some rows of its wall, computed during joining: those of a
# large wall would not fit into memory.
Preference = Callable[[slice], NDArray[np.float32]]

NOBODY: Final = -1
# Walls with more cells are joined in bands of this many.
_BAND_CELLS: Final = 1 << 25
# Balancing colours takes more than a hundred bytes per cell temporarily.
_BALANCED_AT_ONCE: Final = 1 << 20
# A cell takes the highest state of any layer. Occluded: no source paints it, although at least one
# faces it. A filled cell ranks below a painted one.
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


@dataclass(frozen=True, kw_only=True)
class SeamOptions:
    """Where seams are preferred.

    Attributes:
        rule: decides which layer paints a cell that several show.
        priority: names of photos, for that rule.
        island_cells_min: smaller patches from one source are painted from the source around them,
            if that one sees them too.
        drawn: areas that a person assigns to photos, which precede all rules where those photos
            paint them.
    """

    rule: SeamRule
    priority: tuple[str, ...] = ()
    island_cells_min: int = 1
    drawn: DrawnSeams | None = None


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The state of each cell, before colours are taken.

    Attributes:
        rank: (rows, cols) uint8 position of its state in the order of states.
        source: (rows, cols) int16 layer that paints it, `NOBODY` without one.
    """

    rank: NDArray[np.uint8]
    source: NDArray[np.int16]


def preferences(
    layers: Sequence[Layer],
    options: SeamOptions,
    *,
    wall: Wall | None = None,
    balance: Balance | None = None,
    allocate: Allocate = in_memory,
) -> list[Preference]:
    """Return by a rule how much each layer is preferred in rows of the wall; larger is better.

    `best-view` is the layers' own quality: incidence, resolution, distance to the photo's border.
    `voronoi` prefers the layer whose painted area ends farthest away, so that seams are in the
    middle of overlaps. `priority` takes photos in the given order, the others by their quality.
    `graph-cut` puts seams where the layers look similar and away from depth edges of the wall.

    Raises:
        MethodError: `priority` names something that is not a layer of any wall.
    """
    if options.rule == "voronoi":
        return [_by_depth_inside(layer, index, allocate) for index, layer in enumerate(layers)]
    if options.rule == "priority":
        return _by_order(layers, options.priority)
    if options.rule == "graph-cut" and len(layers) > 1:
        cut = cut_labels(layers, wall, balance)
        return [
            partial(_cut_off, layer, index, cut, _best(layers))
            for index, layer in enumerate(layers)
        ]
    return [partial(_rows_of, layer.quality) for layer in layers]


def require_sources(layers: Sequence[Layer], priority: Sequence[str]) -> None:
    """Refuse names in `priority` that no layer has.

    Raises:
        MethodError: there is such a name.
    """
    sources = {layer.source for layer in layers}
    unknown = [name for name in priority if name not in sources]
    if unknown:
        raise MethodError(
            f"priority names {', '.join(unknown)}, but the layers are of "
            f"{', '.join(sorted(sources))} (mosaic.seams)"
        )


def require_one_raster(layers: Sequence[Layer], name: str) -> None:
    """Refuse layers of a wall that do not share one frame.

    Raises:
        MethodError: they do not.
    """
    first = layers[0]
    for layer in layers[1:]:
        if not layer.frame.has_cells_of(first.frame):
            raise MethodError(
                f"the layers {first.source} and {layer.source} of {name} lie on different rasters: "
                "all layers of a wall must come from the same walls"
            )


def joined(
    painters: Sequence[Layer],
    others: Sequence[Layer],
    options: SeamOptions,
    *,
    wall: Wall | None,
    balance: Balance | None,
    allocate: Allocate,
) -> tuple[NDArray[np.uint8], NDArray[np.int16]]:
    """Determine the state of each cell of a wall, a large one band by band.

    Args:
        painters: layers of the wall that paint something.
        others: layers that paint nothing, but state what is hidden.
        options: where seams are preferred.
        wall: its surface, for seams off its depth edges, or None.
        balance: the colour balance of the painters, or None.
        allocate: returns the arrays of the orthoimage, by name.

    Returns:
        (rows, cols) `OrthoMask`, and the index of the painter of each cell, `NOBODY` without one.
    """
    preferred = (
        preferences(painters, options, wall=wall, balance=balance, allocate=allocate)
        if painters
        else []
    )
    shape = [*painters, *others][0].frame.shape
    mask = np.asarray(allocate("mask", shape, np.uint8), np.uint8)
    source = np.asarray(allocate("source", shape, np.int16), np.int16)
    reach = _island_reach(options.island_cells_min)
    for band in bands_with_reach(shape, cells_most=_BAND_CELLS, reach_rows=reach):
        rows = band.rows
        choice = _choice_in(band.around, painters, others, preferred, options)
        mask[rows] = _MASK_OF_RANK[choice.rank[band.inner]]
        source[rows] = choice.source[band.inner]
    return mask, source


def coloured(
    painters: Sequence[Layer],
    source: NDArray[np.int16],
    balance: Balance | None,
    *,
    allocate: Allocate,
) -> Colours:
    """Return the colour (rows, cols, 3) of each cell from its layer, a large wall band by band.

    Args:
        painters: layers of the wall that paint something.
        source: (rows, cols) index of the painter of each cell, `NOBODY` without one.
        balance: their colour balance; None leaves colours unchanged.
        allocate: returns the array.
    """
    is_deep = any(layer.rgb.dtype == np.uint16 for layer in painters)
    level: Level = np.uint16 if is_deep else np.uint8
    rgb: Colours = np.asarray(allocate("rgb", (*source.shape, 3), level), level)
    cells_most = _BAND_CELLS if balance is None else _BALANCED_AT_ONCE
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


def _choice_in(
    rows: slice,
    painters: Sequence[Layer],
    others: Sequence[Layer],
    preferred: Sequence[Preference],
    options: SeamOptions,
) -> Choice:
    """Return the state of the cells of some rows."""
    parts = [_part(layer, rows) for layer in painters]
    values = [preference(rows) for preference in preferred]
    if options.drawn is not None:
        chosen = options.drawn.chosen(rows)
        values = [
            np.where(chosen == index, np.float32(np.inf), value)
            for index, value in enumerate(values)
        ]
    choice = best_views(
        [*parts, *(_part(layer, rows) for layer in others)],
        [*values, *(layer.quality[rows] for layer in others)],
    )
    if options.island_cells_min > 1 and len(painters) > 1:
        return without_islands(choice, parts, options.island_cells_min)
    return choice


def _island_reach(cells_min: int) -> int:
    """Return how many rows away a cell may influence who paints another."""
    return cells_min + math.ceil(math.sqrt(cells_min)) + 1 if cells_min > 1 else 0


def _part(layer: Layer, rows: slice) -> Layer:
    """Return some rows of a layer, without a copy."""
    return replace(
        layer,
        frame=replace(layer.frame, height=rows.stop - rows.start),
        rgb=layer.rgb[rows],
        mask=layer.mask[rows],
        quality=layer.quality[rows],
        filled=None if layer.filled is None else layer.filled[rows],
    )


def best_views(layers: Sequence[Layer], preferences: Sequence[NDArray[np.float32]]) -> Choice:
    """Assign each cell to the layer that is preferred there, the first of equals."""
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
    return Choice(rank=rank, source=source)


def without_islands(choice: Choice, layers: Sequence[Layer], cells_min: int) -> Choice:
    """Return small patches to the source that surrounds them, if it shows them as well.

    A patch is connected over sides of cells. The source with the most cells around a cell takes it;
    cells that no larger patch's source shows are unchanged.
    """
    import cv2

    is_island = np.zeros(choice.source.shape, dtype=np.bool_)
    for index in range(len(layers)):
        is_island |= _small_patches(choice.source == index, cells_min)
    if not is_island.any():
        return choice
    source = choice.source.copy()
    most = np.zeros(source.shape, dtype=np.float32)
    side = 2 * math.ceil(math.sqrt(cells_min)) + 1
    for index, layer in enumerate(layers):
        mainland = ((choice.source == index) & ~is_island).astype(np.float32)
        about = cv2.boxFilter(
            mainland, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        takes = is_island & (_ranks(layer) == choice.rank) & (about > most)
        source[takes] = index
        most[takes] = about[takes]
    return replace(choice, source=source)


def _small_patches(is_mine: NDArray[np.bool_], cells_min: int) -> NDArray[np.bool_]:
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(is_mine.view(np.uint8), connectivity=4)
    is_small = stats[:, cv2.CC_STAT_AREA] < cells_min
    is_small[0] = False
    return np.asarray(is_small[labels], dtype=np.bool_)


def _ranks(layer: Layer) -> NDArray[np.uint8]:
    ranks = _RANK_OF_LAYER_MASK[layer.mask]
    if layer.filled is not None:
        is_filled = (layer.filled > 0) & (layer.mask == LayerMask.PAINTED)
        ranks[is_filled] = _RANKED.index(OrthoMask.FILLED)
    return ranks


def _best(layers: Sequence[Layer]) -> np.float32:
    return np.float32(max(1e-6, *(float(layer.quality.max()) for layer in layers)))


def _by_depth_inside(layer: Layer, index: int, allocate: Allocate) -> Preference:
    if layer.mask.size <= _BAND_CELLS:
        return partial(_rows_of, _depth_inside(layer))
    from orthoflow_plugins.mosaic.depths_inside import column_distances, depths_inside

    return partial(depths_inside, column_distances(layer.mask, f"inside.{index}", allocate))


def _depth_inside(layer: Layer) -> NDArray[np.float32]:
    """Return the distance in cells to the nearest unpainted cell, or to the border."""
    import cv2

    painted = np.pad((layer.mask == LayerMask.PAINTED).astype(np.uint8), 1)
    distance = cv2.distanceTransform(painted, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance[1:-1, 1:-1], dtype=np.float32)


def _by_order(layers: Sequence[Layer], priority: Sequence[str]) -> list[Preference]:
    places = {name: len(priority) - place for place, name in enumerate(priority)}
    bonus = np.float32(2.0) * _best(layers)
    return [
        partial(_raised, layer, np.float32(places.get(layer.source, 0)) * bonus) for layer in layers
    ]


def _rows_of(values: NDArray[np.float32], rows: slice) -> NDArray[np.float32]:
    return values[rows]


def _raised(layer: Layer, bonus: np.float32, rows: slice) -> NDArray[np.float32]:
    return layer.quality[rows] + bonus


def _cut_off(
    layer: Layer, index: int, cut: CutLabels, best: np.float32, rows: slice
) -> NDArray[np.float32]:
    is_mine = cut.in_rows(rows) == index
    return layer.quality[rows] + np.where(is_mine, np.float32(2.0) * best, np.float32(0.0))
