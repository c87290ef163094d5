"""`ortho.dsm-forward`: every pixel of a photo is projected onto the wall that it shows."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.geometry.bands import (
    IN_MEMORY_CELLS,
    Allocate,
    Band,
    bands_with_reach,
    count_cells,
    in_memory,
)
from orthoflow.geometry.levels import level_of
from orthoflow.products import Layer, LayerMask
from orthoflow.sdk import Determinism, Method, MetricSpec, StepContext
from orthoflow_plugins.ortho.layers import (
    CellCounts,
    LayerStack,
    PaintedPhotos,
    count_shown,
)
from orthoflow_plugins.ortho.photos_on_walls import (
    LayersOfPhotos,
    OpenedPhoto,
    PhotosOnWalls,
    VisibilityParams,
    layers_of_photos,
    level_of_all,
    oriented_photos,
    pixels_of,
)

if TYPE_CHECKING:
    from orthoflow.geometry.cameras import ViewingCamera
    from orthoflow_plugins.ortho.forward_kernels import Catch
    from orthoflow_plugins.ortho.surfaces import Surface

# Larger layers are coloured in bands of this many cells: about 600 MB.
_BAND_CELLS: Final = 1 << 23


class DsmForward(Method):
    """Follow the ray of each pixel to its first intersection with the surface, and paint that cell.

    Of the pixels that hit the same cell, the one closest to its centre is used unchanged: nothing
    is interpolated. Objects in front of the slab of the raster hide the wall as in
    `ortho.dsm-backward`. A photo that is coarser than the wall leaves cells between its pixels;
    narrow gaps take the colour of the nearest painted cell and are marked as filled.
    """

    id: ClassVar[str] = "ortho.dsm-forward"
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_layers", label="photos projected onto walls"),
        MetricSpec("painted_share", label="cells painted"),
        MetricSpec("filled_share", label="cells filled from neighbours"),
        MetricSpec("occluders_s", label="time of the occlusion test", better="lower"),
        MetricSpec("painting_s", label="time of painting", better="lower"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (3.7)",
    )

    class Params(VisibilityParams):
        """When a pixel is used, and which gaps between pixels are filled."""

        fill_gap_cells: int = Field(
            default=1,
            ge=0,
            le=20,
            description="Cells that no pixel met are filled where no disc of this radius fits into "
            "the gap; 0 fills nothing.",
        )

    In = PhotosOnWalls
    Out = LayersOfPhotos

    def run(self, inputs: PhotosOnWalls, params: Params, ctx: StepContext) -> LayersOfPhotos:
        """Project the photos onto all walls, and sort their layers."""
        painted = self._painted(inputs, params, ctx)
        out = layers_of_photos(inputs, painted, ctx)
        _report(ctx, count_shown(inputs.walls, out.layers), painted)
        return out

    def _painted(self, inputs: PhotosOnWalls, params: Params, ctx: StepContext) -> PaintedPhotos:
        """Project photo by photo onto every wall it sees."""
        from orthoflow_plugins.ortho.occlusion import depth_buffer_of, occluders_of
        from orthoflow_plugins.ortho.surfaces import surfaces_of

        oriented = oriented_photos(inputs.walls, inputs.photos, inputs.cameras)
        level = level_of_all([photo for photo, _ in oriented], ctx)
        # For all photos, whichever are projected: which points are outliers depends on all cameras.
        viewers = [camera.viewing() for _, camera in oriented]
        seconds: defaultdict[str, float] = defaultdict(float)
        started = ctx.clock_s()
        occluders = occluders_of(inputs, viewers, params, ctx, method=self.id)
        seconds["occluders_s"] = ctx.clock_s() - started
        surfaces = surfaces_of(inputs.walls, params, ctx)
        stack = LayerStack(inputs.walls, ctx)
        for nth, ((photo, camera), viewer) in enumerate(zip(oriented, viewers, strict=True)):
            ctx.progress(nth / len(oriented), photo.name)
            pixels = pixels_of(photo, camera, level)
            started = ctx.clock_s()
            buffer = depth_buffer_of(occluders, viewer, photo)
            looked = ctx.clock_s()
            opened = OpenedPhoto(name=photo.name, pixels=pixels, viewer=viewer, buffer=buffer)
            with stack.painting_from(photo.name):
                for index, surface in enumerate(surfaces):
                    layer = _layer(opened, surface, stack, index, params, threads=ctx.cores)
                    if layer is not None:
                        stack.add(layer)
            seconds["occluders_s"] += looked - started
            seconds["painting_s"] += ctx.clock_s() - looked
        return PaintedPhotos(
            layers=tuple(stack.painted), reached=stack.reached, seconds=dict(seconds)
        )


@dataclass(frozen=True, kw_only=True)
class _Thrown:
    """A photo whose pixels were projected onto a wall.

    Attributes:
        photo: the photo.
        surface: the wall.
        catch: the pixel that each cell took.
        border_px: quality decreases to 0 over this distance from the image border.
        gap_cells: width of gaps that are filled.
        threads: number of threads.
    """

    photo: OpenedPhoto
    surface: Surface
    catch: Catch
    border_px: float
    gap_cells: int
    threads: int


def _layer(
    photo: OpenedPhoto,
    surface: Surface,
    stack: LayerStack,
    wall: int,
    params: DsmForward.Params,
    *,
    threads: int,
) -> Layer | None:
    """Project a photo onto one wall; None if no pixel hits it."""
    from orthoflow_plugins.ortho.forward_kernels import throw_pixels
    from orthoflow_plugins.ortho.surfaces import is_before, view_of

    view = view_of(photo.viewer, surface, params, is_exact=True)
    if not is_before(view, surface):
        return None
    shape = surface.frame.shape
    is_large = math.prod(shape) > IN_MEMORY_CELLS
    catch = _empty_catch(shape, stack.scratch(wall) if is_large else in_memory)
    lattice = _ray_lattice(photo.viewer, surface)
    if not throw_pixels(view, surface.relief, photo.buffer, lattice, catch):
        return None
    level, new = level_of(photo.pixels), stack.allocator(wall) if is_large else in_memory
    layer = Layer(
        frame=surface.frame,
        wall=wall,
        source=photo.name,
        rgb=np.asarray(new("rgb", (*shape, 3), level), level),
        mask=np.asarray(new("mask", shape, np.uint8), np.uint8),
        quality=np.asarray(new("quality", shape, np.float32), np.float32),
        filled=np.asarray(new("filled", shape, np.uint8), np.uint8),
    )
    thrown = _Thrown(
        photo=photo,
        surface=surface,
        catch=catch,
        border_px=view.border_px,
        gap_cells=params.fill_gap_cells,
        threads=threads,
    )
    # Whether a gap is narrow depends on cells two discs away, and its colour on those one farther.
    reach_rows = 2 * params.fill_gap_cells + 2
    for band in bands_with_reach(shape, cells_most=_BAND_CELLS, reach_rows=reach_rows):
        _lay_band(thrown, band, layer)
    return layer


def _empty_catch(shape: tuple[int, int], allocate: Allocate) -> Catch:
    from orthoflow_plugins.ortho.forward_kernels import NO_PIXEL, Catch

    # Kernels accept plain arrays only, not mapped files.
    catch = Catch(
        pixel=np.asarray(allocate("pixel", shape, np.int32), np.int32).view(np.ndarray),
        square=np.asarray(allocate("square", shape, np.float32), np.float32).view(np.ndarray),
    )
    catch.pixel.fill(NO_PIXEL)
    catch.square.fill(np.inf)
    return catch


def _lay_band(thrown: _Thrown, band: Band, layer: Layer) -> None:
    """Colour some rows of a layer with the pixels that they took, and the gaps between them."""
    from orthoflow.geometry.narrow_gaps import narrow_gaps
    from orthoflow_plugins.ortho.filling import Painted, painted_between
    from orthoflow_plugins.ortho.forward_kernels import NO_PIXEL

    around, inner = band.around, band.inner
    pixel, depth_m = thrown.catch.pixel[around], thrown.surface.relief.depth[around]
    width = thrown.surface.frame.width
    is_painted = pixel != NO_PIXEL
    seen, quality = _seen(
        thrown.photo.viewer, thrown.surface, band.rows, border_px=thrown.border_px
    )
    gaps = narrow_gaps(is_painted, thrown.gap_cells, threads=thrown.threads)
    gaps = gaps[(gaps >= inner.start * width) & (gaps < inner.stop * width)]
    is_seen = seen.ravel()[gaps - inner.start * width]
    gaps = gaps[is_seen & ~np.isnan(depth_m.ravel()[gaps])]
    rgb = thrown.photo.pixels.reshape(-1, 3)[np.maximum(pixel, 0).ravel()]
    rgb = rgb.reshape(*pixel.shape, 3)
    rgb[~is_painted] = 0
    is_filled = painted_between(
        gaps,
        rgb,
        Painted(
            places=np.where(is_painted.reshape(-1, 1), np.float32(0.0), np.float32(np.nan)).repeat(
                2, axis=1
            ),
            depth_m=depth_m.reshape(-1),
            # A gap takes the colours painted around it, of whatever surface.
            layer_m=np.inf,
        ),
        reach_cells=thrown.gap_cells,
        threads=thrown.threads,
    )[inner]
    is_shown = is_painted[inner] | is_filled
    mask = np.where(seen, LayerMask.OCCLUDED, LayerMask.OUTSIDE)
    mask[np.isnan(depth_m[inner])] = LayerMask.NO_SURFACE
    mask[is_shown] = LayerMask.PAINTED
    layer.rgb[band.rows] = rgb[inner]
    layer.mask[band.rows] = mask
    layer.quality[band.rows] = np.where(is_shown, quality, np.float32(0.0))
    if layer.filled is not None:
        layer.filled[band.rows] = is_filled


def _ray_lattice(viewer: ViewingCamera, surface: Surface) -> NDArray[np.float64]:
    """Return rays (n, m, 3) of every sixteenth pixel: columns, rows, metres of height per metre."""
    from orthoflow_plugins.ortho.forward_kernels import RAY_STEP_PX

    frame = surface.frame
    counts = (viewer.height // RAY_STEP_PX + 2, viewer.width // RAY_STEP_PX + 2)
    rows, columns = np.indices(counts) * float(RAY_STEP_PX)
    # The last row and column are outside the image, where a lens model may fold back.
    places = np.column_stack(
        [np.minimum(columns.ravel(), viewer.width), np.minimum(rows.ravel(), viewer.height)]
    )
    axes = np.column_stack(
        [frame.u_world / frame.gsd_m, frame.v_world / frame.gsd_m, frame.normal_world]
    )
    rays = (viewer.rays_camera(places) @ viewer.rotation @ axes).reshape(*counts, 3)
    return np.ascontiguousarray(_stretched(_stretched(rays, viewer.height, 0), viewer.width, 1))


def _stretched(rays: NDArray[np.float64], size_px: int, axis: int) -> NDArray[np.float64]:
    """Extrapolate the rays at the image's border to the last position of the lattice."""
    from orthoflow_plugins.ortho.forward_kernels import RAY_STEP_PX

    moved = np.moveaxis(rays.copy(), axis, 0)
    border = size_px / RAY_STEP_PX
    whole = int(np.ceil(border))
    inner = whole - 1
    moved[whole] = moved[inner] + (moved[whole] - moved[inner]) / (border - inner)
    moved[whole + 1 :] = moved[whole]
    return np.moveaxis(moved, 0, axis)


def _seen(
    viewer: ViewingCamera, surface: Surface, rows: slice, *, border_px: float
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Report which cells of some rows are in the photo, and how many of its pixels each covers."""
    frame, depth = surface.frame, surface.relief.depth[rows]
    seen = np.zeros(depth.shape, dtype=np.bool_)
    quality = np.zeros(depth.shape, dtype=np.float32)
    columns = np.arange(frame.width) + 0.5
    area_px = viewer.fx * viewer.fy * frame.gsd_m**2
    for row in range(len(depth)):
        places = np.column_stack([columns, np.full(frame.width, rows.start + row + 0.5)])
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


def _report(ctx: StepContext, counts: CellCounts, photos: PaintedPhotos) -> None:
    painted = photos.layers
    n_filled = sum(
        int(np.count_nonzero(layer.filled)) for layer in painted if layer.filled is not None
    )
    n_shown = sum(count_cells(layer.mask, LayerMask.PAINTED) for layer in painted)
    ctx.metric("n_layers", len(painted), "1")
    ctx.metric("painted_share", counts.n_painted / max(1, counts.n_surface), "1")
    ctx.metric("filled_share", n_filled / max(1, n_shown), "1")
    for name in ("occluders_s", "painting_s"):
        ctx.metric(name, photos.seconds.get(name, 0.0), "s")
