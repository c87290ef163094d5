"""Collection of the layers of all walls and photos."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import Allocate, count_known, row_bands
from orthoflow.geometry.levels import Level
from orthoflow.products import Layer, LayerMask, Layers, Walls
from orthoflow.sdk import DiagnosticSpec, StepContext

NO_SOURCE: Final = "no photo"
UNSEEN_WALLS: Final = (
    "no oriented photo shows a wall: the cameras are behind the walls or do not face them, or "
    "objects hide the walls; check cameras.json and planes.json"
)
NO_PHOTO: Final = DiagnosticSpec(
    code="wall-without-photo",
    severity="error",
    text="{subject}: no photo shows it, so its orthoimage is empty",
)


class LayerStack:
    """The layers of all walls, added photo by photo.

    Attributes:
        painted: layers of photos, in the order in which they were added.
    """

    def __init__(self, walls: Walls, ctx: StepContext) -> None:
        self.painted: list[Layer] = []
        self._walls, self._ctx = walls, ctx

    def allocator(self, wall: int) -> Allocate:
        """Return a function that allocates the arrays of the next layer in memory-mapped files."""
        prefix = f"{wall}.{len(self.painted)}"
        return lambda name, shape, dtype: self._new(f"{prefix}.{name}", shape, dtype)

    def scratch(self, wall: int) -> Allocate:
        """Return a function that allocates temporary arrays, which the layers of a wall share."""
        return lambda name, shape, dtype: self._new(f"{wall}.scratch.{name}", shape, dtype)

    def add(self, layer: Layer) -> None:
        """Add a layer, in which at least one cell has a colour."""
        self.painted.append(layer)

    def joined(self, level: Level) -> Layers:
        """Return the layers sorted by wall, with an empty layer for each wall that no photo shows.

        Args:
            level: numpy type of the colours.

        Raises:
            MethodError: no photo shows any wall.
        """
        if not self.painted:
            raise MethodError(UNSEEN_WALLS)
        walls, painted = self._walls.walls, {layer.wall for layer in self.painted}
        bare = [place for place in range(len(walls)) if place not in painted]
        for place in bare:
            self._ctx.report(NO_PHOTO, subject=walls[place].name)
        layers = [*self.painted, *(self._bare_layer(place, level) for place in bare)]
        return Layers(
            layers=tuple(sorted(layers, key=lambda layer: layer.wall)),
            names=tuple(wall.name for wall in walls),
            plane_indices=tuple(wall.plane_index for wall in walls),
        )

    def _bare_layer(self, place: int, level: Level) -> Layer:
        wall = self._walls.walls[place]
        shape, prefix = wall.frame.shape, f"{place}.bare"
        mask = np.asarray(self._new(f"{prefix}.mask", shape, np.uint8), np.uint8)
        for rows in row_bands(shape):
            is_void = np.isnan(wall.depth_m[rows])
            mask[rows] = np.where(is_void, LayerMask.NO_SURFACE, LayerMask.OUTSIDE)
        return Layer(
            frame=wall.frame,
            wall=place,
            source=NO_SOURCE,
            rgb=np.asarray(self._new(f"{prefix}.rgb", (*shape, 3), level), level),
            mask=mask,
            quality=np.asarray(self._new(f"{prefix}.quality", shape, np.float32), np.float32),
        )

    def _new(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
        return self._ctx.allocate("layers", name, shape, dtype)


def count_shown(walls: Walls, layers: Layers) -> tuple[int, int, int]:
    """Count the cells with a depth, with a colour, and without a colour because they are hidden."""
    n_surface = n_painted = n_hidden = 0
    for place, wall in enumerate(walls.walls):
        masks = [layer.mask for layer in layers.layers if layer.wall == place]
        n_surface += count_known(wall.depth_m)
        for rows in row_bands(wall.frame.shape):
            is_painted = np.logical_or.reduce([m[rows] == LayerMask.PAINTED for m in masks])
            is_hidden = np.logical_or.reduce([m[rows] == LayerMask.OCCLUDED for m in masks])
            n_painted += int(np.count_nonzero(is_painted))
            n_hidden += int(np.count_nonzero(is_hidden & ~is_painted))
    return n_surface, n_painted, n_hidden
