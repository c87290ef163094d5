"""`ortho.dsm-backward`: every cell of a wall looks up its colour in the photos that see it."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry.row_bands import count_known, holds_cells, row_bands
from orthoflow.products import Camera, Layer, LayerMask, Layers, Photo
from orthoflow.sdk import Determinism, Method, Ports, StepContext
from orthoflow_plugins.ortho.oriented_photos import (
    UNSEEN_WALLS,
    bare_layer,
    oriented_photos,
    pixels_of,
    shared_profile,
    weighted_median,
)
from orthoflow_plugins.ortho.sights import (
    PhotosOnWalls,
    SightParams,
    occluders_before,
    surfaces_of,
)

if TYPE_CHECKING:
    from orthoflow.geometry.visibility_kernels import DepthBuffer
    from orthoflow_plugins.ortho.dsm_backward_occluders import Occluders
    from orthoflow_plugins.ortho.dsm_backward_painting import Painting, SightRule, Surface
    from orthoflow_plugins.ortho.dsm_backward_sampling import Footprint


class DsmBackward(Method):
    """Project each cell of a wall into the photos and take the colour that is there.

    A cell with a depth is a point in the world; the photo's distorted camera says where it lies in
    the photo. It is painted unless something hides it: the wall's own relief (the ray to the
    camera is followed over the raster), or points of the cloud that stand before the slab the
    raster was made of (a depth buffer in the photo; single points are taken for outliers). Where
    the photo is finer than the wall, colours are averaged over what a cell covers.

    The quality of a cell is the number of photo pixels it covers: the cosine of incidence times
    the square of cell size over photo GSD, falling to 0 at the border of the photo.
    """

    id: ClassVar[str] = "ortho.dsm-backward"
    result_version: ClassVar[int] = 4
    determinism: ClassVar[Determinism] = "exact"
    citations: ClassVar[tuple[str, ...]] = (
        "markiewicz2015: orthoimages of cultural heritage objects from TLS and images, 3.7, 4.4",
    )

    class Params(SightParams):
        """How colours are taken, and when a cell counts as seen."""

        resampling: Literal["nearest", "bilinear", "cubic", "lanczos"] = Field(
            default="bilinear",
            description="Colour between pixels; nearest paints the photo's pixels untouched.",
        )
        antialias: bool = Field(
            default=True,
            description="Average over what a cell covers where the photo is finer than the wall "
            "(not with nearest).",
        )
        visibility: Literal["full", "none"] = Field(
            default="full",
            description="What hides cells: relief and cloud (full), or nothing, for comparison and "
            "for flat walls with nothing before them.",
        )
        erosion_cells: int = Field(
            default=1,
            ge=0,
            le=20,
            description="Cells so near to a hidden patch are not painted: edges smear there.",
        )

    class In(PhotosOnWalls):
        """The walls, the cloud they were made from, and the oriented photos."""

    class Out(Ports):
        """A layer for each wall and photo that paints on it."""

        layers: Layers

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Take photo by photo, and lay each onto every wall it sees."""
        oriented = oriented_photos(inputs.walls, inputs.photos, inputs.cameras)
        if params.visibility == "none":
            ctx.warn("visibility none: cells that a photo cannot see are painted as well")
        studio = _Studio(inputs, params, ctx)
        studio.find_occluders([camera for _, camera in oriented])
        for place, (photo, camera) in enumerate(oriented):
            ctx.progress(place / len(oriented), photo.name)
            studio.lay(photo, camera)
        profile = shared_profile([photo for photo, _ in oriented], ctx)
        return self.Out(layers=replace(studio.finish(), icc_profile=profile))


class _Studio:
    """Walls that are being painted, photo by photo."""

    def __init__(
        self, inputs: DsmBackward.In, params: DsmBackward.Params, ctx: StepContext
    ) -> None:
        from orthoflow_plugins.ortho.dsm_backward_painting import SightRule

        self._inputs = inputs
        self._params = params
        self._ctx = ctx
        self._rule: SightRule = SightRule(
            resampling=params.resampling,
            is_filtered=params.antialias,
            incidence_max_deg=params.incidence_max_deg,
            erosion_cells=params.erosion_cells if params.visibility == "full" else 0,
            border_share=params.border_share,
        )
        self._surfaces: list[Surface] = surfaces_of(
            inputs.walls, params, ctx, hides=params.visibility == "full"
        )
        self._occluders: Occluders | None = None
        self._layers: list[Layer] = []
        self._footprints: list[Footprint] = []
        # What photos reach of walls that none has painted so far.
        self._reached: dict[int, NDArray[np.uint8]] = {}
        self._seconds: defaultdict[str, float] = defaultdict(float)

    def find_occluders(self, cameras: list[Camera]) -> None:
        """Get the cloud ready to be looked at."""
        started = time.perf_counter()
        if self._params.visibility == "full":
            self._occluders = occluders_before(
                self._inputs,
                [camera.viewing() for camera in cameras],
                self._params,
                self._ctx,
                method=DsmBackward.id,
            )
        self._seconds["occluders_s"] += time.perf_counter() - started

    def lay(self, photo: Photo, camera: Camera) -> None:
        """Lay a photo onto all walls."""
        started = time.perf_counter()
        pixels = pixels_of(photo, camera)
        decoded = time.perf_counter()
        buffer = self._depth_buffer(camera)
        looked = time.perf_counter()
        painted = [
            self._inputs.walls.walls[index].name
            for index in range(len(self._surfaces))
            if self._lay_on(index, photo, camera, pixels, buffer)
        ]
        self._seconds["decoding_s"] += decoded - started
        self._seconds["occluders_s"] += looked - decoded
        self._seconds["painting_s"] += time.perf_counter() - looked
        self._ctx.log(f"{photo.name}: paints {', '.join(painted) or 'no wall'}")

    def finish(self) -> Layers:
        """Order the layers by wall, and add an empty one for each wall that nothing paints.

        Raises:
            MethodError: no photo paints any wall.
        """
        if not self._layers:
            raise MethodError(UNSEEN_WALLS)
        walls = self._inputs.walls.walls
        painted = {layer.wall for layer in self._layers}
        bare = [index for index in range(len(walls)) if index not in painted]
        if bare:
            names = ", ".join(walls[index].name for index in bare)
            self._ctx.warn(f"no photo shows {names}: the orthoimage stays empty")
        layers = [*self._layers, *(self._bare_layer(index) for index in bare)]
        layers.sort(key=lambda layer: layer.wall)
        self._report(layers)
        return Layers(layers=tuple(layers), names=tuple(wall.name for wall in walls))

    def _depth_buffer(self, camera: Camera) -> DepthBuffer:
        from orthoflow_plugins.ortho.dsm_backward_occluders import (
            depth_buffer,
            nothing_in_the_way,
        )

        if self._occluders is None:
            return nothing_in_the_way(camera.viewing())
        return depth_buffer(self._occluders, camera.viewing())

    def _lay_on(
        self,
        index: int,
        photo: Photo,
        camera: Camera,
        pixels: NDArray[np.uint8],
        buffer: DepthBuffer,
    ) -> bool:
        """Lay a photo onto one wall; say whether it painted something."""
        from orthoflow_plugins.ortho.dsm_backward_painting import paint, view_of

        def allocate(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
            return self._ctx.allocate("layers", f"{index}.{len(self._layers)}.{name}", shape, dtype)

        surface = self._surfaces[index]
        view = view_of(camera.viewing(), surface, self._rule)
        if view.height_m <= float(surface.relief.bottoms.min()):
            return False
        painting = paint(
            pixels,
            view,
            surface,
            buffer,
            self._rule,
            allocate=allocate,
            threads=self._ctx.cores,
        )
        self._footprints.extend(painting.footprints[key] for key in sorted(painting.footprints))
        return self._keep(index, photo.name, painting)

    def _keep(self, index: int, source: str, painting: Painting) -> bool:
        is_empty = not holds_cells(painting.mask, LayerMask.PAINTED)
        if is_empty or painting.rgb is None or painting.quality is None:
            if all(layer.wall != index for layer in self._layers):
                self._reach(index, painting.mask)
            return False
        self._reached.pop(index, None)
        self._layers.append(
            Layer(
                frame=self._surfaces[index].frame,
                wall=index,
                source=source,
                rgb=painting.rgb,
                mask=painting.mask,
                quality=painting.quality,
            )
        )
        return True

    def _reach(self, index: int, mask: NDArray[np.uint8]) -> None:
        """Note what a photo reaches of a wall; the next one's mask will lie in the same file."""
        if index not in self._reached:
            kept = self._ctx.allocate("layers", f"{index}.reached", mask.shape, np.uint8)
            self._reached[index] = np.asarray(kept, np.uint8)
            self._reached[index][...] = mask
            return
        for rows in row_bands(mask.shape):
            is_hidden = mask[rows] == LayerMask.OCCLUDED
            self._reached[index][rows][is_hidden] = LayerMask.OCCLUDED

    def _bare_layer(self, index: int) -> Layer:
        surface = self._surfaces[index]
        return bare_layer(surface.frame, index, surface.relief.depth, self._reached.get(index))

    def _report(self, layers: list[Layer]) -> None:
        ctx = self._ctx
        n_surface = n_painted = n_hidden = 0
        for index, surface in enumerate(self._surfaces):
            masks = [layer.mask for layer in layers if layer.wall == index]
            n_surface += count_known(surface.relief.depth)
            for rows in row_bands(surface.frame.shape):
                is_painted = np.logical_or.reduce([m[rows] == LayerMask.PAINTED for m in masks])
                is_hidden = np.logical_or.reduce([m[rows] == LayerMask.OCCLUDED for m in masks])
                n_painted += int(np.count_nonzero(is_painted))
                n_hidden += int(np.count_nonzero(is_hidden & ~is_painted))
        ctx.metric("n_layers", len(self._layers), "1")
        ctx.metric("painted_share", n_painted / max(1, n_surface), "1")
        ctx.metric("occluded_share", n_hidden / max(1, n_surface), "1")
        n_cells = np.array([footprint.n_cells for footprint in self._footprints])
        gsds = np.array([footprint.photo_gsd_m for footprint in self._footprints])
        angles = np.array([footprint.obliquity_deg for footprint in self._footprints])
        ctx.metric("photo_gsd_mm", 1e3 * weighted_median(gsds, n_cells), "mm")
        ctx.metric("obliquity_deg", weighted_median(angles, n_cells), "deg")
        for name, seconds in self._seconds.items():
            ctx.metric(name, seconds, "s")
