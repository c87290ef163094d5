"""The layers that photos make on walls, collected while they are painted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import Allocate, count_known, row_bands
from orthoflow.geometry.levels import Level
from orthoflow.products import Layer, LayerMask, Layers, Walls
from orthoflow.sdk import StepContext

if TYPE_CHECKING:
    from orthoflow_plugins.ortho.surfaces import Surface

NO_SOURCE: Final = "no photo"
UNSEEN_WALLS: Final = (
    "no oriented photo sees a wall: their cameras stand behind the walls, look past them, or "
    "something hides the walls; look at cameras.json and planes.json"
)


@dataclass(frozen=True, kw_only=True)
class CellCounts:
    """Cells of all walls by what photos show of them.

    Attributes:
        n_surface: with a depth.
        n_painted: painted by some photo.
        n_hidden: hidden from some photo, and painted by none.
    """

    n_surface: int
    n_painted: int
    n_hidden: int


class LayerStack:
    """Layers of walls, added photo by photo.

    Attributes:
        surfaces: the walls.
        painted: layers of photos, as they were added.
    """

    def __init__(self, walls: Walls, surfaces: list[Surface], ctx: StepContext) -> None:
        self.surfaces = surfaces
        self.painted: list[Layer] = []
        self._names = tuple(wall.name for wall in walls.walls)
        self._plane_indices = tuple(wall.plane_index for wall in walls.walls)
        self._ctx = ctx
        # What photos reach of walls that none has painted so far.
        self._reached: dict[int, NDArray[np.uint8]] = {}

    def allocator(self, wall: int) -> Allocate:
        """Give what gives the arrays of the next layer; a large one lies in files."""
        prefix = f"{wall}.{len(self.painted)}"

        def allocate(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
            return self._ctx.allocate("layers", f"{prefix}.{name}", shape, dtype)

        return allocate

    def scratch(self, wall: int) -> Allocate:
        """Give what gives arrays, in files, that are done with before the next layer of a wall."""

        def allocate(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
            return self._ctx.allocate("layers", f"{wall}.scratch.{name}", shape, dtype)

        return allocate

    @contextmanager
    def painting_from(self, source: str) -> Iterator[None]:
        """Log which walls a photo painted once it was laid onto all of them."""
        n_before = len(self.painted)
        yield
        names = [self._names[layer.wall] for layer in self.painted[n_before:]]
        self._ctx.log(f"{source}: paints {', '.join(names) or 'no wall'}")

    def add(self, layer: Layer) -> None:
        """Add the layer of a photo that paints something."""
        self._reached.pop(layer.wall, None)
        self.painted.append(layer)

    def note_reached(self, wall: int, mask: NDArray[np.uint8]) -> None:
        """Note what a photo reaches of a wall on which it paints nothing.

        Args:
            wall: its index.
            mask: (rows, cols) `LayerMask`; the next layer's may lie in the same file.
        """
        if any(layer.wall == wall for layer in self.painted):
            return
        if wall not in self._reached:
            kept = self._ctx.allocate("layers", f"{wall}.reached", mask.shape, np.uint8)
            self._reached[wall] = np.asarray(kept, np.uint8)
            self._reached[wall][...] = mask
            return
        for rows in row_bands(mask.shape):
            is_hidden = mask[rows] == LayerMask.OCCLUDED
            self._reached[wall][rows][is_hidden] = LayerMask.OCCLUDED

    def complete(self) -> Layers:
        """Order the layers by wall, and add an empty one for each wall that nothing paints.

        Raises:
            MethodError: no photo paints any wall.
        """
        if not self.painted:
            raise MethodError(UNSEEN_WALLS)
        painted = {layer.wall for layer in self.painted}
        bare = [wall for wall in range(len(self._names)) if wall not in painted]
        if bare:
            names = ", ".join(self._names[wall] for wall in bare)
            self._ctx.warn(f"no photo shows {names}: the orthoimage stays empty")
        layers = [*self.painted, *(self._bare_layer(wall) for wall in bare)]
        layers.sort(key=lambda layer: layer.wall)
        return Layers(layers=tuple(layers), names=self._names, plane_indices=self._plane_indices)

    def count_cells(self, layers: Layers) -> CellCounts:
        """Count the cells of all walls by what the layers show of them."""
        n_surface = n_painted = n_hidden = 0
        for wall, surface in enumerate(self.surfaces):
            masks = [layer.mask for layer in layers.layers if layer.wall == wall]
            n_surface += count_known(surface.relief.depth)
            for rows in row_bands(surface.frame.shape):
                is_painted = np.logical_or.reduce([m[rows] == LayerMask.PAINTED for m in masks])
                is_hidden = np.logical_or.reduce([m[rows] == LayerMask.OCCLUDED for m in masks])
                n_painted += int(np.count_nonzero(is_painted))
                n_hidden += int(np.count_nonzero(is_hidden & ~is_painted))
        return CellCounts(n_surface=n_surface, n_painted=n_painted, n_hidden=n_hidden)

    def _bare_layer(self, wall: int) -> Layer:
        """The layer of a wall that no photo paints."""
        surface = self.surfaces[wall]
        shape = surface.frame.shape
        new = partial(self._ctx.allocate, "layers")
        mask = self._reached.get(wall)
        if mask is None:
            mask = np.asarray(new(f"{wall}.bare.mask", shape, np.uint8), np.uint8)
            for rows in row_bands(shape):
                is_void = np.isnan(surface.relief.depth[rows])
                mask[rows] = np.where(is_void, LayerMask.NO_SURFACE, LayerMask.OUTSIDE)
        level: Level = np.uint16 if self.painted[0].rgb.dtype == np.uint16 else np.uint8
        return Layer(
            frame=surface.frame,
            wall=wall,
            source=NO_SOURCE,
            rgb=np.asarray(new(f"{wall}.bare.rgb", (*shape, 3), level), level),
            mask=mask,
            quality=np.asarray(new(f"{wall}.bare.quality", shape, np.float32), np.float32),
        )
