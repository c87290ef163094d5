"""`ortho.dsm-forward`: project the pixels of the photos onto the walls."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.geometry.bands import (
    bands_with_reach,
    count_cells,
)
from orthoflow.geometry.levels import level_of
from orthoflow.products import Layer, LayerMask
from orthoflow.sdk import Determinism, Method, MetricSpec, StepContext
from orthoflow_plugins.ortho.layers import NO_SOURCE, LayerStack, count_shown
from orthoflow_plugins.ortho.parameters import VisibilityParams
from orthoflow_plugins.ortho.photos_on_walls import (
    LayersOfPhotos,
    OpenedPhoto,
    PhotosOnWalls,
    project_photos,
)

if TYPE_CHECKING:
    from orthoflow.geometry.cameras import ViewingCamera
    from orthoflow_plugins.ortho.surfaces import Surface

# Larger layers are coloured in bands of this many cells; a band needs about 600 MB.
BAND_CELLS: Final = 1 << 23


class DsmForward(Method):
    """Trace the ray of each pixel to the surface of a wall, and colour the first cell that it hits.

    If several pixels hit the same cell, the one closest to the cell centre is used unchanged;
    colours are not interpolated. Objects in front of the depth range of the wall hide cells as in
    `ortho.dsm-backward`. If the photo has a lower resolution than the wall, no pixel hits some of
    the cells; narrow gaps are filled from the surrounding cells and marked as filled.
    """

    id: ClassVar[str] = "ortho.dsm-forward"
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_layers", label="layers (one per photo and wall)"),
        MetricSpec("painted_share", label="covered cells"),
        MetricSpec("filled_share", label="cells filled from neighbours"),
        MetricSpec("occluders_s", label="time for the occlusion test", better="lower"),
        MetricSpec("painting_s", label="time for resampling the colours", better="lower"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (3.7)",
    )

    class Params(VisibilityParams):
        """Visibility of cells, and filling of gaps between coloured cells."""

        fill_gap_cells: int = Field(
            default=1,
            ge=0,
            le=20,
            description="Gaps between projected pixels are filled if no disc of this radius fits "
            "into them; 0 fills none.",
        )

    In = PhotosOnWalls
    Out = LayersOfPhotos

    def run(self, inputs: PhotosOnWalls, params: Params, ctx: StepContext) -> LayersOfPhotos:
        """Project the photos onto all walls."""

        def project(photo: OpenedPhoto, surface: Surface, stack: LayerStack, wall: int) -> None:
            layer = _layer(photo, surface, stack, wall, params, threads=ctx.cores)
            if layer is not None:
                stack.add(layer)

        out, seconds = project_photos(inputs, ctx, project)
        painted = [layer for layer in out.layers.layers if layer.source != NO_SOURCE]
        filled = [layer.filled for layer in painted if layer.filled is not None]
        n_filled = sum(int(np.count_nonzero(values)) for values in filled)
        n_shown = sum(count_cells(layer.mask, LayerMask.PAINTED) for layer in painted)
        n_surface, n_painted, _ = count_shown(inputs.walls, out.layers)
        ctx.metric("n_layers", len(painted), "1")
        ctx.metric("painted_share", n_painted / max(1, n_surface), "1")
        ctx.metric("filled_share", n_filled / max(1, n_shown), "1")
        for name in ("occluders_s", "painting_s"):
            ctx.metric(name, seconds.get(name, 0.0), "s")
        return out


def _layer(
    photo: OpenedPhoto,
    surface: Surface,
    stack: LayerStack,
    wall: int,
    params: DsmForward.Params,
    *,
    threads: int,
) -> Layer | None:
    from orthoflow.geometry.interpolation import Surroundings
    from orthoflow.geometry.narrow_gaps import narrow_gaps
    from orthoflow.geometry.occluders import nothing_in_the_way
    from orthoflow_plugins.ortho.filling import painted_between
    from orthoflow_plugins.ortho.forward_kernels import NO_PIXEL, Catch, throw_pixels
    from orthoflow_plugins.ortho.surfaces import cells_seen, is_before, view_of

    surface.frame.require_plane("ortho.dsm-forward")
    view = view_of(photo.viewer, surface, params)
    if not is_before(view, surface):
        return None
    shape, level = surface.frame.shape, level_of(photo.pixels)
    scratch = stack.scratch(wall)
    # Kernels accept only plain arrays, not memory-mapped files.
    catch = Catch(
        pixel=np.asarray(scratch("pixel", shape, np.int32), np.int32).view(np.ndarray),
        square=np.asarray(scratch("square", shape, np.float32), np.float32).view(np.ndarray),
    )
    catch.pixel.fill(NO_PIXEL)
    catch.square.fill(np.inf)
    lattice = _ray_lattice(photo.viewer, surface)
    if not throw_pixels(view, surface.relief, photo.buffer, lattice, catch):
        return None
    new = stack.allocator(wall)
    filled = np.asarray(new("filled", shape, np.uint8), np.uint8)
    layer = Layer(
        frame=surface.frame,
        wall=wall,
        source=photo.name,
        rgb=np.asarray(new("rgb", (*shape, 3), level), level),
        mask=np.asarray(new("mask", shape, np.uint8), np.uint8),
        quality=np.asarray(new("quality", shape, np.float32), np.float32),
        filled=filled,
    )
    # Find the cells inside the photo, ignoring occlusion.
    from_anywhere, empty = view._replace(cosine_least=-1.0), nothing_in_the_way(photo.viewer)
    free = surface.relief._replace(bottoms=np.full_like(surface.relief.bottoms, np.inf))
    # The width of a gap depends on cells within two disc radii, and its colour on one more cell.
    reach_rows = 2 * params.fill_gap_cells + 2
    for band in bands_with_reach(shape, cells_most=BAND_CELLS, reach_rows=reach_rows):
        inner, width = band.inner, surface.frame.width
        pixel, depth_m = catch.pixel[band.around], surface.relief.depth[band.around]
        visible = cells_seen(from_anywhere, free, empty, band.rows, slice(0, width))
        seen = visible.mask == LayerMask.PAINTED
        quality = np.maximum(visible.quality, np.float32(0.0))
        # Free 12 bytes per cell before the gaps need memory.
        del visible
        is_painted = pixel != NO_PIXEL
        gaps = narrow_gaps(is_painted, params.fill_gap_cells)
        gaps = gaps[(gaps >= inner.start * width) & (gaps < inner.stop * width)]
        is_seen = seen.ravel()[gaps - inner.start * width]
        gaps = gaps[is_seen & ~np.isnan(depth_m.ravel()[gaps])]
        rgb = photo.pixels.reshape(-1, 3)[np.maximum(pixel, 0).ravel()].reshape(*pixel.shape, 3)
        rgb[~is_painted] = 0
        nowhere = np.where(is_painted, np.float32(0.0), np.float32(np.nan))
        # Fill a gap with the colours around it, whatever surface they belong to.
        is_filled = painted_between(
            gaps,
            rgb,
            Surroundings(nowhere.reshape(-1, 1).repeat(2, 1), width, np.inf),
            depth_m.reshape(-1),
            reach_cells=params.fill_gap_cells,
            threads=threads,
        )[inner]
        is_shown = is_painted[inner] | is_filled
        mask = np.where(seen, LayerMask.OCCLUDED, LayerMask.OUTSIDE)
        mask[np.isnan(depth_m[inner])] = LayerMask.NO_SURFACE
        mask[is_shown] = LayerMask.PAINTED
        layer.rgb[band.rows], layer.mask[band.rows] = rgb[inner], mask
        layer.quality[band.rows] = np.where(is_shown, quality, np.float32(0.0))
        filled[band.rows] = is_filled
    return layer


def _ray_lattice(viewer: ViewingCamera, surface: Surface) -> NDArray[np.float64]:
    """Return the rays (n, m, 3) through every 16th pixel, per metre along the optical axis.

    Components along columns and rows are in cells, and those along the normal are in metres.
    """
    from orthoflow_plugins.ortho.forward_kernels import RAY_STEP_PX

    frame = surface.frame
    counts = (viewer.height // RAY_STEP_PX + 2, viewer.width // RAY_STEP_PX + 2)
    rows, columns = np.indices(counts) * float(RAY_STEP_PX)
    # Beyond the image border, a lens model may fold back, so positions are limited to the border.
    places = np.column_stack(
        [np.minimum(columns.ravel(), viewer.width), np.minimum(rows.ravel(), viewer.height)]
    )
    axes = np.column_stack(
        [frame.u_world / frame.gsd_m, frame.v_world / frame.gsd_m, frame.normal_world]
    )
    rays = (viewer.rays_camera(places) @ viewer.rotation @ axes).reshape(*counts, 3)
    # Extrapolate the rays at the image border to the last row and column of the lattice.
    for lines, size_px in ((rays, viewer.height), (rays.transpose(1, 0, 2), viewer.width)):
        border = size_px / RAY_STEP_PX
        whole = math.ceil(border)
        inner = lines[whole - 1].copy()
        lines[whole] = inner + (lines[whole] - inner) / (border - (whole - 1))
        lines[whole + 1 :] = lines[whole]
    return rays
