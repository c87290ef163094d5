"""Which layer is preferred where: the rules by which overlapping photos share a wall."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.products import Layer, LayerMask, Wall
from orthoflow_plugins.mosaic.cutting import CutLabels, cut_labels

SeamRule = Literal["best-view", "voronoi", "graph-cut", "priority"]

# Preference (rows, cols) of a layer in some rows of its wall, made when they are joined: those of a
# large wall would not fit into memory.
Preference = Callable[[slice], NDArray[np.float32]]


def preferences(
    layers: Sequence[Layer],
    rule: SeamRule,
    *,
    priority: Sequence[str] = (),
    wall: Wall | None = None,
) -> list[Preference]:
    """Say by a rule how much each layer is preferred in rows of the wall, larger is more.

    `best-view` is the layers' own quality: incidence, resolution, distance to the photo's border.
    `voronoi` prefers the layer whose painted area ends farthest off, so that seams lie in the
    middle of overlaps. `priority` takes photos in the given order, the others by their quality.
    `graph-cut` lays seams where the layers look alike and away from depth edges of the wall.

    Raises:
        MethodError: `priority` names what is no layer of any wall.
    """
    if rule == "voronoi":
        return [partial(_rows_of, _depth_inside(layer)) for layer in layers]
    if rule == "priority":
        return _by_order(layers, priority)
    if rule == "graph-cut" and len(layers) > 1:
        cut = cut_labels(layers, wall)
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


def _best(layers: Sequence[Layer]) -> np.float32:
    return np.float32(max(1e-6, *(float(layer.quality.max()) for layer in layers)))


def _depth_inside(layer: Layer) -> NDArray[np.float32]:
    """Distance in cells to the nearest cell that the layer does not paint, or to the rim."""
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
