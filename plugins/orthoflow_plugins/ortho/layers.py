"""The layers of photos on walls: collected during painting, and joined."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import Allocate, count_known, row_bands
from orthoflow.geometry.levels import Level
from orthoflow.products import Layer, LayerMask, Layers, Wall, Walls
from orthoflow.sdk import DiagnosticSpec, StepContext

NO_SOURCE: Final = "no photo"
UNSEEN_WALLS: Final = (
    "no oriented photo sees a wall: their cameras are behind the walls, look past them, "
    "or something hides the walls; check cameras.json and planes.json"
)
NO_PHOTO: Final = DiagnosticSpec(
    code="wall-without-photo",
    severity="error",
    text="no photo shows {walls}: the orthoimage stays empty",
    rank_by="n_walls",
)


@dataclass(frozen=True, kw_only=True)
class CellCounts:
    """Cells of all walls by what photos show of them.

    Attributes:
        n_surface: cells with a depth.
        n_painted: cells painted by some photo.
        n_hidden: cells hidden from some photo, and painted by none.
    """

    n_surface: int
    n_painted: int
    n_hidden: int


@dataclass(frozen=True, kw_only=True)
class ReachedWall:
    """The visibility of a wall on which the photos paint nothing.

    Attributes:
        wall: its index.
        mask: (rows, cols) uint8 `LayerMask`.
    """

    wall: int
    mask: NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class PaintedPhotos:
    """The result of painting all photos.

    Attributes:
        layers: photo by photo.
        reached: walls on which none of them paints.
        seconds: duration of each part.
    """

    layers: tuple[Layer, ...]
    reached: tuple[ReachedWall, ...]
    seconds: dict[str, float]


class LayerStack:
    """Layers of walls, added photo by photo.

    Attributes:
        painted: layers of photos, in the order of addition.
    """

    def __init__(self, walls: Walls, ctx: StepContext) -> None:
        self.painted: list[Layer] = []
        self._names = tuple(wall.name for wall in walls.walls)
        self._ctx = ctx
        # Visibility of walls that no photo has painted so far.
        self._reached: dict[int, NDArray[np.uint8]] = {}

    @property
    def reached(self) -> tuple[ReachedWall, ...]:
        """Return the visibility of walls on which none paints."""
        return tuple(
            ReachedWall(wall=wall, mask=mask) for wall, mask in sorted(self._reached.items())
        )

    def allocator(self, wall: int) -> Allocate:
        """Return a function that allocates the arrays of the next layer; a large one in files."""
        prefix = f"{wall}.{len(self.painted)}"

        def allocate(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
            return self._ctx.allocate("layers", f"{prefix}.{name}", shape, dtype)

        return allocate

    def scratch(self, wall: int) -> Allocate:
        """Return a function that allocates arrays in files, reused for the next layer of a wall."""

        def allocate(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
            return self._ctx.allocate("layers", f"{wall}.scratch.{name}", shape, dtype)

        return allocate

    @contextmanager
    def painting_from(self, source: str) -> Iterator[None]:
        """Log which walls a photo painted once it was projected onto all of them."""
        n_before = len(self.painted)
        yield
        names = [self._names[layer.wall] for layer in self.painted[n_before:]]
        self._ctx.log(f"{source}: paints {', '.join(names) or 'no wall'}")

    def add(self, layer: Layer) -> None:
        """Add the layer of a photo that paints something."""
        self._reached.pop(layer.wall, None)
        self.painted.append(layer)

    def note_reached(self, wall: int, mask: NDArray[np.uint8]) -> None:
        """Record the visibility of a wall on which a photo paints nothing.

        Args:
            wall: its index.
            mask: (rows, cols) `LayerMask`; the next layer's may be in the same file.
        """
        if any(layer.wall == wall for layer in self.painted):
            return
        if wall in self._reached:
            _add_hidden(mask, self._reached[wall])
            return
        kept = self._ctx.allocate("layers", f"{wall}.reached", mask.shape, np.uint8)
        self._reached[wall] = np.asarray(kept, np.uint8)
        self._reached[wall][...] = mask


def joined_layers(walls: Walls, photos: PaintedPhotos, ctx: StepContext) -> Layers:
    """Sort the layers of all photos by wall, and add an empty one for each unpainted wall.

    Raises:
        MethodError: no photo paints any wall.
    """
    layers = list(photos.layers)
    if not layers:
        raise MethodError(UNSEEN_WALLS)
    level: Level = np.uint16 if layers[0].rgb.dtype == np.uint16 else np.uint8
    painted = {layer.wall for layer in layers}
    bare = [place for place in range(len(walls.walls)) if place not in painted]
    if bare:
        names = ", ".join(walls.walls[place].name for place in bare)
        ctx.report(NO_PHOTO, n_walls=len(bare), walls=names)
    for place in bare:
        reached = [found.mask for found in photos.reached if found.wall == place]
        layers.append(_bare_layer(walls.walls[place], place, reached, level, ctx))
    layers.sort(key=lambda layer: layer.wall)
    return Layers(
        layers=tuple(layers),
        names=tuple(wall.name for wall in walls.walls),
        plane_indices=tuple(wall.plane_index for wall in walls.walls),
    )


def count_shown(walls: Walls, layers: Layers) -> CellCounts:
    """Count the cells of all walls by what the layers show of them."""
    n_surface = n_painted = n_hidden = 0
    for place, wall in enumerate(walls.walls):
        masks = [layer.mask for layer in layers.layers if layer.wall == place]
        n_surface += count_known(wall.depth_m)
        for rows in row_bands(wall.frame.shape):
            is_painted = np.logical_or.reduce([m[rows] == LayerMask.PAINTED for m in masks])
            is_hidden = np.logical_or.reduce([m[rows] == LayerMask.OCCLUDED for m in masks])
            n_painted += int(np.count_nonzero(is_painted))
            n_hidden += int(np.count_nonzero(is_hidden & ~is_painted))
    return CellCounts(n_surface=n_surface, n_painted=n_painted, n_hidden=n_hidden)


def _bare_layer(
    wall: Wall, place: int, reached: Sequence[NDArray[np.uint8]], level: Level, ctx: StepContext
) -> Layer:
    """Return the layer of a wall that no photo paints, from what parts of the photos reach it."""
    shape = wall.frame.shape
    new = partial(ctx.allocate, "layers")
    mask = np.asarray(new(f"{place}.bare.mask", shape, np.uint8), np.uint8)
    if reached:
        mask[...] = reached[0]
        for other in reached[1:]:
            _add_hidden(other, mask)
    else:
        for rows in row_bands(shape):
            is_void = np.isnan(wall.depth_m[rows])
            mask[rows] = np.where(is_void, LayerMask.NO_SURFACE, LayerMask.OUTSIDE)
    return Layer(
        frame=wall.frame,
        wall=place,
        source=NO_SOURCE,
        rgb=np.asarray(new(f"{place}.bare.rgb", (*shape, 3), level), level),
        mask=mask,
        quality=np.asarray(new(f"{place}.bare.quality", shape, np.float32), np.float32),
    )


def _add_hidden(other: NDArray[np.uint8], mask: NDArray[np.uint8]) -> None:
    """Mark cells that are hidden from another photo, too."""
    for rows in row_bands(mask.shape):
        mask[rows][other[rows] == LayerMask.OCCLUDED] = LayerMask.OCCLUDED
