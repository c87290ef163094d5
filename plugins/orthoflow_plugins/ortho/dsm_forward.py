"""`ortho.dsm-forward`: every pixel of a photo is thrown onto the wall that it shows."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.products import Layer, LayerMask, Layers
from orthoflow.sdk import Determinism, Method, Ports, StepContext
from orthoflow_plugins.ortho.layers import LayerStack
from orthoflow_plugins.ortho.photos_on_walls import (
    OpenedPhoto,
    PhotosOnWalls,
    VisibilityParams,
    level_of_all,
    oriented_photos,
    pixels_of,
    shared_profile,
)

if TYPE_CHECKING:
    from orthoflow.geometry.cameras import ViewingCamera
    from orthoflow_plugins.ortho.surfaces import Surface


class DsmForward(Method):
    """Follow the ray of each pixel to where it first meets the surface, and paint that cell.

    Pixels that meet the same cell compete, the one that meets it nearest to the centre wins and
    is painted untouched: nothing is interpolated. What stands before the slab of the raster hides
    the wall as in `ortho.dsm-backward`. A photo that is coarser than the wall leaves cells between
    its pixels; narrow gaps take the colour of the nearest painted cell and are marked as filled.
    """

    id: ClassVar[str] = "ortho.dsm-forward"
    result_version: ClassVar[int] = 5
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[str, ...]] = (
        "n_layers",
        "painted_share",
        "filled_share",
        "occluders_s",
        "painting_s",
    )
    citations: ClassVar[tuple[str, ...]] = (
        "markiewicz2015: orthoimages of cultural heritage objects from TLS and images, 3.7",
    )

    class Params(VisibilityParams):
        """When a pixel counts, and which gaps between pixels are filled."""

        fill_gap_cells: int = Field(
            default=1,
            ge=0,
            le=20,
            description="Cells that no pixel met are filled where no disc of this radius fits into "
            "the gap; 0 fills nothing.",
        )

    class In(PhotosOnWalls):
        """The walls, the cloud they were made from, and the oriented photos."""

    class Out(Ports):
        """A layer for each wall and photo that paints on it."""

        layers: Layers

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Take photo by photo, and throw each onto every wall it sees."""
        from orthoflow_plugins.ortho.occlusion import depth_buffer_of, occluders_before
        from orthoflow_plugins.ortho.surfaces import surfaces_of

        oriented = oriented_photos(inputs.walls, inputs.photos, inputs.cameras)
        level = level_of_all([photo for photo, _ in oriented], ctx)
        viewers = [camera.viewing() for _, camera in oriented]
        seconds: defaultdict[str, float] = defaultdict(float)
        started = ctx.clock_s()
        occluders = occluders_before(inputs, viewers, params, ctx, method=self.id)
        seconds["occluders_s"] = ctx.clock_s() - started
        surfaces = surfaces_of(inputs.walls, params, ctx)
        stack = LayerStack(inputs.walls, surfaces, ctx)
        for place, ((photo, camera), viewer) in enumerate(zip(oriented, viewers, strict=True)):
            ctx.progress(place / len(oriented), photo.name)
            pixels = pixels_of(photo, camera, level)
            started = ctx.clock_s()
            buffer = depth_buffer_of(occluders, viewer)
            looked = ctx.clock_s()
            opened = OpenedPhoto(name=photo.name, pixels=pixels, viewer=viewer, buffer=buffer)
            with stack.painting_from(photo.name):
                for index, surface in enumerate(surfaces):
                    layer = _layer(opened, surface, index, params, threads=ctx.cores)
                    if layer is not None:
                        stack.add(layer)
            seconds["occluders_s"] += looked - started
            seconds["painting_s"] += ctx.clock_s() - looked
        profile = shared_profile([photo for photo, _ in oriented], ctx)
        layers = stack.complete()
        _report(ctx, stack, layers, seconds)
        return self.Out(layers=replace(layers, icc_profile=profile))


def _layer(
    photo: OpenedPhoto, surface: Surface, wall: int, params: DsmForward.Params, *, threads: int
) -> Layer | None:
    """Throw a photo onto one wall; None where no pixel meets it."""
    from orthoflow.geometry.narrow_gaps import narrow_gaps
    from orthoflow_plugins.ortho.filling import Painted, painted_between
    from orthoflow_plugins.ortho.forward_kernels import NO_PIXEL, Catch, throw_pixels
    from orthoflow_plugins.ortho.surfaces import is_before, view_of

    view = view_of(photo.viewer, surface, params, is_exact=True)
    if not is_before(view, surface):
        return None
    shape = surface.frame.shape
    catch = Catch(
        pixel=np.full(shape, NO_PIXEL, dtype=np.int32),
        square=np.full(shape, np.inf, dtype=np.float32),
    )
    relief = surface.relief
    if not throw_pixels(view, relief, photo.buffer, _ray_lattice(photo.viewer, surface), catch):
        return None
    is_painted = catch.pixel != NO_PIXEL
    seen, quality = _seen(photo.viewer, surface, border_px=view.border_px)
    gaps = narrow_gaps(is_painted, params.fill_gap_cells, threads=threads)
    gaps = gaps[~np.isnan(relief.depth.ravel()[gaps]) & seen.ravel()[gaps]]
    rgb = photo.pixels.reshape(-1, 3)[np.maximum(catch.pixel, 0).ravel()].reshape(*shape, 3)
    rgb[~is_painted] = 0
    is_filled = painted_between(
        gaps,
        rgb,
        Painted(
            places=np.where(is_painted.reshape(-1, 1), np.float32(0.0), np.float32(np.nan)).repeat(
                2, axis=1
            ),
            depth_m=relief.depth.reshape(-1),
            # A gap takes what is painted about it, whatever surface it is of.
            layer_m=np.inf,
        ),
        reach_cells=params.fill_gap_cells,
        threads=threads,
    )
    filled = is_filled.astype(np.uint8)
    is_shown = is_painted | is_filled
    mask = np.where(seen, LayerMask.OCCLUDED, LayerMask.OUTSIDE)
    mask[np.isnan(relief.depth)] = LayerMask.NO_SURFACE
    mask[is_shown] = LayerMask.PAINTED
    return Layer(
        frame=surface.frame,
        wall=wall,
        source=photo.name,
        rgb=rgb,
        mask=mask.astype(np.uint8),
        quality=np.where(is_shown, quality, np.float32(0.0)),
        filled=filled,
    )


def _ray_lattice(viewer: ViewingCamera, surface: Surface) -> NDArray[np.float64]:
    """Rays (n, m, 3) of every sixteenth pixel: columns, rows, metres of height per metre."""
    from orthoflow_plugins.ortho.forward_kernels import RAY_STEP_PX

    frame = surface.frame
    counts = (viewer.height // RAY_STEP_PX + 2, viewer.width // RAY_STEP_PX + 2)
    rows, columns = np.indices(counts) * float(RAY_STEP_PX)
    # The last row and column lie outside the image, where a lens model may fold back.
    places = np.column_stack(
        [np.minimum(columns.ravel(), viewer.width), np.minimum(rows.ravel(), viewer.height)]
    )
    axes = np.column_stack(
        [frame.u_world / frame.gsd_m, frame.v_world / frame.gsd_m, frame.normal_world]
    )
    rays = (viewer.rays_camera(places) @ viewer.rotation @ axes).reshape(*counts, 3)
    return np.ascontiguousarray(_stretched(_stretched(rays, viewer.height, 0), viewer.width, 1))


def _stretched(rays: NDArray[np.float64], size_px: int, axis: int) -> NDArray[np.float64]:
    """Move the rays at the image's border on to where the lattice has its last place."""
    from orthoflow_plugins.ortho.forward_kernels import RAY_STEP_PX

    moved = np.moveaxis(rays.copy(), axis, 0)
    border = size_px / RAY_STEP_PX
    whole = int(np.ceil(border))
    inner = whole - 1
    moved[whole] = moved[inner] + (moved[whole] - moved[inner]) / (border - inner)
    moved[whole + 1 :] = moved[whole]
    return np.moveaxis(moved, 0, axis)


def _seen(
    viewer: ViewingCamera, surface: Surface, *, border_px: float
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Which cells lie in the photo, and how many of its pixels each covers."""
    frame, depth = surface.frame, surface.relief.depth
    seen = np.zeros(frame.shape, dtype=np.bool_)
    quality = np.zeros(frame.shape, dtype=np.float32)
    columns = np.arange(frame.width) + 0.5
    area_px = viewer.fx * viewer.fy * frame.gsd_m**2
    for row in range(frame.height):
        places = np.column_stack([columns, np.full(frame.width, row + 0.5)])
        points = frame.world_from_wall(places, depth[row].astype(np.float64))
        u, v, distance = viewer.project(points).T
        towards = viewer.centre_world - points
        with np.errstate(invalid="ignore"):
            cosine = towards @ frame.normal_world / np.linalg.norm(towards, axis=1)
            seen[row] = (u >= 0) & (u < viewer.width) & (v >= 0) & (v < viewer.height)
            border = np.minimum(np.minimum(u, viewer.width - u), np.minimum(v, viewer.height - v))
            value = cosine * area_px / distance**2 * np.clip(border / border_px, 0.0, 1.0)
        quality[row] = np.where(seen[row], np.nan_to_num(value), 0.0)
    return seen, np.maximum(quality, 0.0)


def _report(ctx: StepContext, stack: LayerStack, layers: Layers, seconds: dict[str, float]) -> None:
    counts = stack.count_cells(layers)
    n_filled = sum(
        int(np.count_nonzero(layer.filled)) for layer in stack.painted if layer.filled is not None
    )
    n_shown = sum(int(np.count_nonzero(layer.mask == LayerMask.PAINTED)) for layer in stack.painted)
    ctx.metric("n_layers", len(stack.painted), "1")
    ctx.metric("painted_share", counts.n_painted / max(1, counts.n_surface), "1")
    ctx.metric("filled_share", n_filled / max(1, n_shown), "1")
    for name, value in seconds.items():
        ctx.metric(name, value, "s")
