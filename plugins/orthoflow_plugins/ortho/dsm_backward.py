"""`ortho.dsm-backward`: project every cell of a wall into the photos to find its colour."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import holds_cells
from orthoflow.products import Layer, LayerMask
from orthoflow.sdk import Determinism, DiagnosticSpec, Method, MetricSpec, StepContext
from orthoflow_plugins.ortho.layers import NO_SOURCE, LayerStack, count_shown
from orthoflow_plugins.ortho.parameters import BackwardParams
from orthoflow_plugins.ortho.photos_on_walls import (
    LayersOfPhotos,
    OpenedPhoto,
    PhotosOnWalls,
    project_photos,
)

if TYPE_CHECKING:
    from orthoflow_plugins.ortho.surfaces import Surface

VISIBILITY_OFF: Final = DiagnosticSpec(
    code="visibility-not-tested",
    severity="warning",
    text="visibility is none: cells also take colours from photos in which they are hidden",
)


class DsmBackward(Method):
    """Project each cell of a wall into the photos and take its colour from them.

    The depth of a cell gives its point in the world, and the camera with its distortion gives the
    position of that point in the photo. The cell takes the colour at this position unless something
    hides the cell. To find cells hidden by the relief of the wall, the ray from each cell to the
    camera is traced over the raster. To find cells hidden by objects in front of the depth range of
    the wall, a depth buffer of the cloud is computed for the photo; isolated points are ignored as
    outliers. Cells near the outline of a convex surface remain empty if errors of pose and depth,
    or averaging over a cell and a pixel, could mix in what is behind the surface. If the photo has
    a higher resolution than the wall, colours are averaged over the cell.

    The quality of a cell is the number of photo pixels that it covers, which is the cosine of the
    angle of incidence times the squared ratio of cell size to photo GSD. It decreases to 0 at the
    border of the photo.
    """

    id: ClassVar[str] = "ortho.dsm-backward"
    determinism: ClassVar[Determinism] = "exact"
    result_version: ClassVar[int] = 3
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_layers", label="layers (one per photo and wall)"),
        MetricSpec("painted_share", label="covered cells"),
        MetricSpec("occluded_share", label="cells hidden from the photos"),
        MetricSpec("photo_gsd_mm", label="photo pixel size on the wall"),
        MetricSpec("obliquity_deg", label="angle of incidence"),
        MetricSpec("occluders_s", label="time for the occlusion test", better="lower"),
        MetricSpec("decoding_s", label="time for decoding photos", better="lower"),
        MetricSpec("painting_s", label="time for resampling the colours", better="lower"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (3.7, 4.4)",
    )

    Params = BackwardParams
    In = PhotosOnWalls
    Out = LayersOfPhotos

    def run(
        self, inputs: PhotosOnWalls, params: BackwardParams, ctx: StepContext
    ) -> LayersOfPhotos:
        """Project the photos onto all walls."""
        from orthoflow_plugins.ortho.painting import CellFootprint, paint
        from orthoflow_plugins.ortho.surfaces import is_before, view_of

        hides = params.visibility == "full"
        if not hides:
            ctx.report(VISIBILITY_OFF)
        footprints: list[CellFootprint] = []

        def project(photo: OpenedPhoto, surface: Surface, stack: LayerStack, wall: int) -> None:
            view = view_of(photo.viewer, surface, params, photo.sigma_m)
            if not is_before(view, surface):
                return
            painting = paint(
                photo.pixels,
                view,
                surface,
                photo.buffer,
                params,
                allocate=stack.allocator(wall),
                threads=ctx.cores,
            )
            footprints.extend(painting.footprints[key] for key in sorted(painting.footprints))
            is_bare = not holds_cells(painting.mask, LayerMask.PAINTED)
            if is_bare or painting.rgb is None or painting.quality is None:
                return
            layer = Layer(
                frame=surface.frame,
                wall=wall,
                source=photo.name,
                rgb=painting.rgb,
                mask=painting.mask,
                quality=painting.quality,
            )
            stack.add(layer)

        out, seconds = project_photos(inputs, ctx, project, hides=hides)
        n_layers = sum(layer.source != NO_SOURCE for layer in out.layers.layers)
        n_surface, n_painted, n_hidden = count_shown(inputs.walls, out.layers)
        ctx.metric("n_layers", n_layers, "1")
        ctx.metric("painted_share", n_painted / max(1, n_surface), "1")
        ctx.metric("occluded_share", n_hidden / max(1, n_surface), "1")
        n_cells = np.array([tile.n_cells for tile in footprints])
        gsds_m = np.array([tile.photo_gsd_m for tile in footprints])
        angles_deg = np.array([tile.obliquity_deg for tile in footprints])
        ctx.metric("photo_gsd_mm", 1e3 * _weighted_median(gsds_m, n_cells), "mm")
        ctx.metric("obliquity_deg", _weighted_median(angles_deg, n_cells), "deg")
        for name in ("occluders_s", "decoding_s", "painting_s"):
            ctx.metric(name, seconds.get(name, 0.0), "s")
        return out


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.int64]) -> float:
    order = np.argsort(values, kind="stable")
    totals = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(totals, totals[-1] / 2.0)])
